"""The methods that are compared: which model each adapts, and how. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_poem.adaptation import Rule

EPSILONS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4)
LATENT_DIMS = (2, 10)  # beside the default, 5
QUERY_RULES = ("worst-case", "information-gain", "random")
DEFAULT_QUERY_RULE = {"paper": "worst-case", "bayes": "information-gain"}
ANOLES = {"ANOLE": "berlekamp", "ANOLE-greedy": "greedy", "ANOLE-random": "random"}
CANDIDATES = {"prior": "prior", "aggregate": "training tasks"}
INFERENCE_LABELS = {"paper": "POEM (paper)", "bayes": "POEM (Bayes)"}
#: What ends the name of a method, and its label, that takes candidates from the training tasks
FORMS: dict[str, tuple[str, dict[str, Any]]] = {
    "": ("", {}),
    "-aggregate": (", training tasks", {"candidates": "aggregate"}),
}
ABLATIONS = {
    "poem-inner": "inner product",
    "poem-cosine": "cosine",
    "poem-pearl-context": "PEARL's context",
    "poem-no-preferences": "no preference loss",
    **{f"poem-d{d}": f"d = {d}" for d in LATENT_DIMS},
}

# Outer steps of MAML-reward's meta-training, with what differs for a family.
META_ITERATIONS = 500
META_ITERATIONS_OF = {"PointGoal": 100}

SHARED_DYNAMICS_REASONS = {
    "ANOLE": "ANOLE asks which fragment of the training tasks is better on the new task, and here "
    "these show another world",
    "MAMLReward": "MAML-reward learns from what tasks say of each other's fragments",
}

# How the identity of a cell, which records keep, says what a rule is.
RECORDED: dict[str | None, tuple[str, dict[str, str]]] = {
    "Bayes": ("preference", {"inference": "bayes"}),
    "Paper": ("preference", {"inference": "paper"}),
    "ANOLE": ("anole", {}),
    "MAMLReward": ("maml", {}),
    "RewardOracle": ("oracle", {}),
    None: ("known", {}),
}


@dataclass(frozen=True)
class Variant:
    """A model to be trained, named as its folder: what differs from the hyperparameters in
    ``zoo_configs/``, or the variant (``base``) from whose model it is derived without training.
    """

    name: str
    algorithm: str
    hyperparameters: Mapping[str, Any] = field(default_factory=dict)
    base: str | None = None


@dataclass(frozen=True)
class Method:
    """A row of the tables.

    :param variant: The model that it adapts
    :param rule: The rule's name in :mod:`sb3_poem`; None for what the model's policies could earn
    :param paper_row: Its row in Table 3 of Xu & Zhu 2025
    :param library: It asks about whole rollouts on the new task, two for each question, all made
        before the first
    """

    name: str
    label: str
    variant: str
    rule: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    paper_row: str | None = None
    library: bool = False

    @property
    def question(self) -> str:
        """The kind of its questions."""
        return str(self.options.get("question", "pair"))

    @property
    def films(self) -> int:
        """How many trajectories a question shows."""
        return 4 if self.question == "best-of-four" else 2

    def objection(self, shared_dynamics: bool) -> str | None:
        """Why the method cannot run on a family; None if it can."""
        reason = SHARED_DYNAMICS_REASONS.get(self.rule or "")
        if self.rule == "ANOLE" and self.library:
            reason = None
        elif self.rule == "Bayes" and self.options.get("likelihood") == "decoder":
            reason = "a decoder's error is known only where they do"
        if shared_dynamics or reason is None:
            return None
        return f"its tasks do not share their dynamics, and {reason}"

    def make_rule(self, **changes: Any) -> Rule:
        """The rule, with these changes of its options."""
        import sb3_poem

        rule: Rule = getattr(sb3_poem, self.rule or "")(**{**self.options, **changes})
        return rule

    def recorded(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """What a cell's identity says of the rule, with these changes."""
        kind, words = RECORDED[self.rule]
        asked = {"library": "rollouts"} if self.library else {}
        return {"kind": kind, "options": {**words, **self.options, **changes}, **asked}


VARIANTS = {
    variant.name: variant
    for variant in (
        Variant("poem", "poem_sac"),
        Variant("poem-inner", "poem_sac", {"similarity": "inner"}),
        Variant("poem-cosine", "poem_sac", {"similarity": "cosine"}),
        Variant("poem-pearl-context", "poem_sac", {"context": "pearl"}),
        Variant("poem-no-preferences", "poem_sac", {"preference_coef": 0.0}),
        *(Variant(f"poem-d{d}", "poem_sac", {"latent_dim": d}) for d in LATENT_DIMS),
        Variant("pearl", "pearl_sac"),
        Variant("maml-reward", "pearl_sac", base="pearl"),
    )
}


def _methods() -> Iterator[Method]:
    for suffix, (of, own) in FORMS.items():
        for rule, poem in sorted(INFERENCE_LABELS.items()):
            row = None if suffix else "POEM"
            yield Method(f"poem-{rule}{suffix}", poem + of, "poem", rule.capitalize(), own, row)
        for name, strategy in ANOLES.items():
            options, row = {"strategy": strategy, **own}, None if suffix else name
            yield Method(name.lower() + suffix, name + of, "pearl", "ANOLE", options, row)
        yield Method(f"reward-oracle{suffix}", f"reward oracle{of}", "pearl", "RewardOracle", own)
        name, label = f"anole-rollouts{suffix}", f"ANOLE on rollouts{of}"
        options = {"strategy": "berlekamp", **own}
        yield Method(name, label, "pearl", "ANOLE", options, library=True)
        name, label = f"pearl-bayes{suffix}", f"Bayes, PEARL's model{of}"
        options = {"candidates": "prior", "likelihood": "decoder", **own}
        yield Method(name, label, "pearl", "Bayes", options, library=True)
        name, label = f"poem-bayes-untold{suffix}", f"POEM (Bayes), not told the noise{of}"
        yield Method(name, label, "poem", "Bayes", {"noise_model": "infer", **own})
    for question in ("graded", "best-of-four"):
        label = f"POEM (Bayes), {question.replace('-', ' ')}"
        yield Method(f"poem-bayes-{question}", label, "poem", "Bayes", {"question": question})
        options = {"question": question, "noise_model": "infer"}
        name, label = f"poem-bayes-{question}-untold", f"{label}, not told the noise"
        yield Method(name, label, "poem", "Bayes", options)
    yield Method("maml-reward", "MAML-reward", "maml-reward", "MAMLReward", paper_row="MAML-reward")
    yield Method("known-task", "task known (POEM's policies)", "poem")
    yield Method("known-task-pearl", "task known (PEARL's policies)", "pearl")
    for source, of in CANDIDATES.items():
        for likelihood, by in (("similarity", "S"), ("decoder", "decoder")):
            options = {"candidates": source, "likelihood": likelihood}
            name, label = f"poem-bayes-{source}-{likelihood}", f"POEM (Bayes), {of}, {by}"
            yield Method(name, label, "poem", "Bayes", options)
    for variant, label in ABLATIONS.items():
        yield Method(f"known-task-{variant}", f"task known ({label})", variant)
        for rule, poem in INFERENCE_LABELS.items():
            yield Method(f"{variant}-{rule}", f"{poem}, {label}", variant, rule.capitalize())
    for rule, poem in INFERENCE_LABELS.items():
        for asked in QUERY_RULES:
            if asked != DEFAULT_QUERY_RULE[rule]:
                name, label = f"poem-{rule}-{asked}", f"{poem}, {asked} queries"
                yield Method(name, label, "poem", rule.capitalize(), {"query_rule": asked})
    for variant, of in (("poem", ""), ("poem-cosine", ", cosine")):
        for epsilon in EPSILONS:
            # 0.1 is the default, and so the same cell as poem-paper.
            tolerant = {} if epsilon == 0.1 else {"epsilon": epsilon}
            name, label = f"{variant}-paper-epsilon-{epsilon:g}", f"epsilon = {epsilon:g}{of}"
            yield Method(name, label, variant, "Paper", tolerant)


METHODS = {method.name: method for method in _methods()}
