"""The suites, and the cells that they are made of. Nothing heavy is imported here."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

from poem_envs.registration import did_you_mean, family_name
from sb3_poem.benchmark.methods import EPSILONS, METHODS, QUERY_RULES, VARIANTS, Method

#: Those of Table 3, the quickest to train first
PAPER_FAMILIES = (
    "HalfCheetahVel",
    "MetaWorldML1",
    "AntVel",
    "AntDir2D",
    "HalfCheetahFwdBack",
    "AntGoal",
    "AntFwdBack",
    "HumanoidDir2D",
    "MetaWorldML10",
)
#: Of figures 7 and 12 to 15
ABLATED_FAMILIES = ("HalfCheetahVel", "AntDir2D", "AntGoal", "HumanoidDir2D")
RECORD_AT = (0, 1, 2, 3, 5, 7, 10)
REVISION = 3
"""Of the code that trains, adapts and measures: part of every cell's identity. Raise it with each
change after which the same cell may come to another figure (a loss, a default, how tasks and seeds
are drawn), not for ``zoo_configs/``, whose hyperparameters are in the identity by themselves.
"""
POEMS = ("poem-bayes", "poem-paper")
ANOLES = ("anole", "anole-greedy", "anole-random")
TABLE_METHODS = (*POEMS, *ANOLES, "maml-reward", "reward-oracle")
#: By each likelihood; tasks with dynamics of their own allow the second alone
PRIOR_BAYES = ("poem-bayes-prior-decoder", "poem-bayes-prior-similarity")
#: Methods that have as much to choose from: candidates from the prior, or from the training tasks.
#: ANOLE may ask about rollouts on the new task, too
PRIOR_METHODS = (
    *(*PRIOR_BAYES, "poem-paper", *ANOLES),
    *("anole-rollouts", "maml-reward", "reward-oracle"),
)
INFORMED_METHODS = (
    *(f"{name}-aggregate" for name in (*POEMS, *ANOLES)),
    *("anole-rollouts-aggregate", "maml-reward", "reward-oracle-aggregate"),
)
#: What makes the difference between the paper's row and the other: rule, candidates, likelihood,
#: model, preference loss
PARTS = (
    *(*POEMS, "poem-paper-aggregate"),
    *(f"poem-bayes-{c}-{s}" for c in ("prior", "aggregate") for s in ("similarity", "decoder")),
    *("pearl-bayes", "pearl-bayes-aggregate"),
    *("poem-no-preferences-bayes", "poem-no-preferences-paper"),
)
#: Methods that are not told how answers err: POEM infers it or does not ask, ANOLE takes a fifth to
#: be wrong whoever answers
UNTOLD_METHODS = (
    *("poem-bayes-untold", "poem-bayes-untold-aggregate", "poem-paper", "poem-paper-aggregate"),
    *("anole", "anole-aggregate", "anole-rollouts-aggregate", "maml-reward"),
)
#: Kinds of questions, each told how answers err, and not
QUESTIONS = tuple(
    f"poem-bayes{kind}{told}"
    for told in ("", "-untold")
    for kind in ("", "-graded", "-best-of-four")
)
TABLE_REFERENCES = ("known-task", "known-task-pearl")
# MAML-reward trains a reward only, so its return does not depend on how long a policy was trained;
# greedy search takes as long as all the others together, and lies beside ANOLE.
WITHOUT_CURVE = ("maml-reward", "anole-greedy")
#: How the origin of a model begins that was handed over
FILE = "file "


@dataclass(frozen=True)
class OracleSpec:
    """Who answers: "return", "boltzmann" with a beta (None: the paper's), "mistake" with a rate.

    :param told: As whom rules take it that are told how answers err; None: as it is
    :param thresholds: From what differences on graded answers say better and much better, as shares
        of the family's spread of returns
    """

    kind: str = "return"
    value: float | None = None
    told: Self | None = None
    thresholds: tuple[float, float] = (0.12, 1.0)

    @property
    def label(self) -> str:
        words = "exact answers"
        if self.kind == "mistake":
            words = f"{100 * (self.value or 0):g} % of the answers flipped"
        elif self.kind == "boltzmann":
            words = "Boltzmann answers" + ("" if self.value is None else f", beta = {self.value:g}")
        if self.told is not None:
            words += f", told as {self.told.label}"
        if self.thresholds != OracleSpec.thresholds:
            words += ", graded from {:g} and {:g} of the spread on".format(*self.thresholds)
        return words

    def recorded(self, question: str) -> dict[str, Any]:
        """What a cell's identity says of it, who is asked questions of this kind."""
        own: dict[str, Any] = {"kind": self.kind, "value": self.value}
        if self.told is not None:
            own["told"] = self.told.recorded("pair")
        return own | ({"thresholds": list(self.thresholds)} if question == "graded" else {})

    @classmethod
    def of_identity(cls, data: dict[str, Any] | None) -> Self:
        """The one of a record."""
        own = dict(data or {})
        if "told" in own:
            own["told"] = cls.of_identity(own["told"])
        if "thresholds" in own:
            own["thresholds"] = tuple(own["thresholds"])
        return cls(**own)


EXACT, BOLTZMANN = OracleSpec(), OracleSpec("boltzmann")
NOISES = (BOLTZMANN, OracleSpec("mistake", 0.1), OracleSpec("mistake", 0.2))
#: Whom rules that are told how answers err are told wrongly
MISJUDGED = (
    OracleSpec("mistake", 0.2, told=OracleSpec("mistake", 0.1)),
    OracleSpec("boltzmann", told=EXACT),
)


@dataclass(frozen=True)
class Budget:
    """What a cell may spend: test tasks (alike for all methods and seeds, drawn by ``task_seed``),
    episodes per task and measurement, and after how many answers to measure.
    """

    tasks: int = 30
    episodes: int = 10
    record_at: tuple[int, ...] = RECORD_AT
    task_seed: int = 100


@dataclass(frozen=True)
class Training:
    """What differs from the hyperparameter files, for all models of a run; sorted by name."""

    timesteps: int | None = None
    hyperparameters: tuple[tuple[str, Any], ...] = ()

    @property
    def is_default(self) -> bool:
        return self == Training()

    def to_dict(self) -> dict[str, Any]:
        return {"timesteps": self.timesteps, "hyperparameters": dict(self.hyperparameters)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        given = {name: hashable(value) for name, value in data["hyperparameters"].items()}
        return cls(data["timesteps"], tuple(sorted(given.items())))


@dataclass(frozen=True)
class ModelKey:
    """Which trained model: the family, a name of :data:`VARIANTS`, and the seed of the training."""

    env_id: str
    variant: str
    seed: int
    training: Training = Training()

    @property
    def family(self) -> str:
        return family_name(self.env_id)

    @property
    def base(self) -> Self | None:
        """The model that this one is derived from without a training of its own, if any."""
        base = VARIANTS[self.variant].base
        return None if base is None else replace(self, variant=base)

    def __str__(self) -> str:
        return f"{family_label(self.env_id)} {self.variant} seed {self.seed}"


@dataclass(frozen=True)
class Cell:
    """One entry of the store: a method with its settings on a family, with one seed, of the
    training and of what is random in the adaptation.

    :param snapshot: The share of the training after which the model is taken; None: all of it
    :param overrides: Options of the rule that differ from the method's own, sorted by name
    :param model: What the model is made of, see :meth:`ModelLibrary.origin`; None: not told
    """

    env_id: str
    method: str
    seed: int
    oracle: OracleSpec = EXACT
    budget: Budget = Budget()
    training: Training = Training()
    snapshot: float | None = None
    overrides: tuple[tuple[str, Any], ...] = ()
    model: str | None = None
    revision: int = REVISION

    @property
    def family(self) -> str:
        return family_name(self.env_id)

    @property
    def definition(self) -> Method:
        return METHODS[self.method]

    @property
    def model_key(self) -> ModelKey:
        return ModelKey(self.env_id, self.definition.variant, self.seed, self.training)

    def identity(self) -> dict[str, Any]:
        """All that can change the cell's figure, JSON-ready; so it names no suite."""
        method = self.definition
        known = method.rule is None
        return {
            "env_id": self.env_id,
            "variant": method.variant,
            **method.recorded(dict(self.overrides)),
            "seed": self.seed,
            # What a model's policies could earn does not depend on who answers.
            "oracle": None if known else self.oracle.recorded(method.question),
            "record_at": None if known else list(self.budget.record_at),
            "tasks": self.budget.tasks,
            "episodes": self.budget.episodes,
            "task_seed": self.budget.task_seed,
            "training": self.training.to_dict(),
            "snapshot": self.snapshot,
            "model": self.model,
            "revision": self.revision,
        }

    @classmethod
    def of_identity(cls, method: str, identity: dict[str, Any]) -> Self:
        """The cell of a record, from its method's name and what :meth:`identity` gave."""
        usual = METHODS[method].recorded({})["options"]
        options = ((name, hashable(value)) for name, value in identity["options"].items())
        sizes = {name: identity[name] for name in ("tasks", "episodes", "task_seed")}
        record_at = tuple(identity["record_at"] or RECORD_AT)
        alike = {
            name: identity[name] for name in ("env_id", "seed", "snapshot", "model", "revision")
        }
        return cls(
            method=method,
            oracle=OracleSpec.of_identity(identity["oracle"]),
            budget=Budget(**sizes, record_at=record_at),
            training=Training.from_dict(identity["training"]),
            overrides=tuple(sorted(one for one in options if one not in usual.items())),
            **alike,
        )

    @property
    def key(self) -> str:
        return digest(self.identity())

    def __str__(self) -> str:
        words = [family_label(self.env_id), self.method, f"seed {self.seed}"]
        if self.oracle != EXACT:
            words.append(self.oracle.label)
        if self.budget.record_at[-1] != RECORD_AT[-1]:
            words.append(f"{self.budget.record_at[-1]} queries")
        if self.snapshot is not None:
            words.append(f"after {100 * self.snapshot:g} % of the training")
        return ", ".join(words)


@dataclass(frozen=True)
class Entry:
    """Methods that a suite compares under the same conditions: a table, and a figure.

    :param curves: With whose answers the methods are measured along the training too
    :param by_inference: Figures have a row for each of POEM's inference rules
    :param shown: Numbers of answers that tables show, of those that were recorded
    :param by_task: Tables show standard errors over tasks and success rates, and no interquartile
        means
    :param compared: Methods whose differences from all others tables show
    :param films: Tables also show returns after so many films watched, as questions of one kind
        show more than those of another, and no limits, which are of pairs
    """

    name: str
    title: str
    methods: tuple[str, ...]
    oracles: tuple[OracleSpec, ...] = (EXACT,)
    record_at: tuple[int, ...] = RECORD_AT
    curves: tuple[OracleSpec, ...] = ()
    by_inference: bool = False
    shown: tuple[int, ...] = (1, 5, 10, 20)
    by_task: bool = False
    compared: tuple[str, ...] = POEMS
    films: tuple[int, ...] = ()


@dataclass(frozen=True)
class Suite:
    """A declared set of cells.

    >>> cells = SUITES["smoke"].cells(["poem/PointGoal-v0"], seeds=[0, 1, 2])
    >>> sorted({cell.oracle.kind for cell in cells})
    ['boltzmann', 'return']

    :param references: Methods that say what the models' policies could earn, for the limits
    :param snapshots: In how many parts the training is cut for measurements along it; 1: none
    :param overrides: Options of rules by the rule's name, where they differ from the defaults
    """

    name: str
    title: str
    families: tuple[str, ...]
    entries: tuple[Entry, ...]
    references: tuple[str, ...]
    snapshots: int = 5
    budget: Budget = Budget()
    overrides: dict[str, tuple[tuple[str, Any], ...]] = field(default_factory=dict)

    @property
    def methods(self) -> tuple[str, ...]:
        compared = [name for entry in self.entries for name in entry.methods]
        return tuple(dict.fromkeys([*compared, *self.references]))

    def cells(
        self,
        env_ids: Sequence[str],
        seeds: Sequence[int],
        methods: Sequence[str] | None = None,
        budget: Budget | None = None,
        training: Training | None = None,
        snapshots: int | None = None,
    ) -> list[Cell]:
        """The suite's cells, each once, in the order in which they should be run; None takes the
        suite's own methods and numbers (``record_at`` is always the entries').
        """
        for name in methods or ():
            if name not in self.methods:
                raise ValueError(
                    f"--methods {name}: it is not in the suite {self.name!r}, which has: "
                    f"{', '.join(self.methods)}{did_you_mean(name, self.methods)}"
                )
        parts = snapshots or self.snapshots
        shares = [round(part / parts, 4) for part in range(1, parts)]
        spent, given = budget or self.budget, training or Training()
        cells: dict[str, Cell] = {}
        for env_id in env_ids:
            for seed in seeds:
                base = Cell(env_id, "", seed, budget=spent, training=given)
                for entry in (*self.entries, Entry("references", "", self.references)):
                    for cell in self.entry_cells(entry, base, shares):
                        if not methods or cell.method in methods:
                            cells.setdefault(cell.key, cell)
        return list(cells.values())

    def entry_cells(self, entry: Entry, base: Cell, shares: Sequence[float]) -> list[Cell]:
        """The cells of one entry, in all else like ``base``, with curves at these shares."""
        cells = []
        for name in entry.methods:
            overrides = self.overrides.get(METHODS[name].rule or "", ())
            for oracle in entry.oracles:
                own = replace(base, method=name, oracle=oracle, overrides=overrides)
                moments: list[tuple[float | None, tuple[int, ...]]] = [(None, entry.record_at)]
                if oracle in entry.curves and name not in WITHOUT_CURVE:
                    moments += [(share, entry.record_at[-1:]) for share in shares]
                for share, record_at in moments:
                    budget = replace(base.budget, record_at=record_at)
                    cells.append(replace(own, budget=budget, snapshot=share))
        return cells


def digest(data: Any) -> str:
    """A short name of JSON-ready data."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()[:24]


def hashable(value: Any) -> Any:
    """A hyperparameter's value, with tuples for lists. A dictionary is refused."""
    if isinstance(value, dict):
        raise ValueError(
            f'{value!r} is a dictionary; write it as text, as rl_zoo3\'s files do: "dict(...)"'
        )
    return tuple(map(hashable, value)) if isinstance(value, (list, tuple)) else value


def family_label(env_id: str) -> str:
    """AntGoal of poem/AntGoal-v0; ids of other namespaces or versions stay."""
    name = family_name(env_id)
    return name if env_id == family_id(name) else env_id


def family_id(name: str) -> str:
    """poem/AntGoal-v0 of AntGoal; an id stays as it is."""
    return name if "/" in name or "-v" in name else f"poem/{name}-v0"


_ABLATED = ("poem-inner", "poem-cosine", "poem-pearl-context", "poem-d2", "poem-d10")
_DESIGNS = (*POEMS, *(f"{variant}-{rule}" for variant in _ABLATED for rule in ("bayes", "paper")))
# A rule's own way of asking has no name of its own.
_ASKING = (*POEMS, *(name for b in POEMS for q in QUERY_RULES if (name := f"{b}-{q}") in METHODS))
_TABLE = Entry("methods", "Methods", TABLE_METHODS, curves=(EXACT,))
_PRIOR = Entry(
    "prior",
    "Methods with candidates from the prior",
    PRIOR_METHODS,
    compared=(*PRIOR_BAYES, "poem-paper"),
)
_INFORMED = Entry(
    "informed",
    "Methods with candidates from the training tasks",
    INFORMED_METHODS,
    compared=tuple(f"{name}-aggregate" for name in POEMS),
)
_QUESTIONS = Entry(
    "questions",
    "Kinds of questions",
    QUESTIONS,
    (EXACT, *NOISES),
    compared=QUESTIONS,
    films=(4, 20),
)
_THRESHOLDS = replace(
    _QUESTIONS,
    name="thresholds",
    title="Other thresholds",
    methods=tuple(name for name in QUESTIONS if METHODS[name].question == "graded"),
    oracles=(OracleSpec(thresholds=(0.3, 1.6)),),
)
_MISJUDGED = replace(
    _QUESTIONS,
    name="misjudged",
    title="Rules told wrongly",
    methods=("poem-bayes", "poem-bayes-graded"),
    oracles=MISJUDGED,
)
_UNTOLD = Entry(
    "untold",
    "Methods that are not told the noise",
    UNTOLD_METHODS,
    NOISES,
    compared=("poem-bayes-untold", "poem-bayes-untold-aggregate"),
)

SUITES = {
    suite.name: suite
    for suite in (
        Suite(
            "table3",
            "Methods under exact answers (Table 3; figures 5, 9, 10)",
            PAPER_FAMILIES,
            (_TABLE, _PRIOR, _INFORMED, Entry("parts", "What POEM's rows owe to what", PARTS)),
            TABLE_REFERENCES,
        ),
        Suite(
            "shipped",
            "The models that ship",
            (*PAPER_FAMILIES, "FetchReach", "PointGoal"),
            (Entry("rules", "Inference rules", POEMS, shown=(0, 1, 2, 5, 10), by_task=True),),
            ("known-task",),
            snapshots=1,
        ),
        Suite(
            "noise",
            "Methods under answers with errors (figures 6, 11)",
            PAPER_FAMILIES,
            (replace(_TABLE, oracles=NOISES, curves=(BOLTZMANN,)), _UNTOLD),
            TABLE_REFERENCES,
        ),
        Suite(
            "answers",
            "Kinds of questions, and who answers them",
            ("HalfCheetahVel", "AntGoal", "AntDir2D", "FetchReach", "MetaWorldML1"),
            (_QUESTIONS, _THRESHOLDS, _MISJUDGED),
            ("known-task",),
            snapshots=1,
        ),
        Suite(
            "ablation",
            "Ablations of POEM (figures 7, 12, 13)",
            ABLATED_FAMILIES,
            (
                Entry(
                    "design",
                    "Similarity, context and latent dimension",
                    _DESIGNS,
                    curves=(EXACT,),
                    by_inference=True,
                ),
                Entry("rules", "Query rules", _ASKING, by_inference=True),
                Entry("queries", "Number of queries", POEMS, record_at=tuple(range(21))),
            ),
            ("known-task", *(f"known-task-{variant}" for variant in _ABLATED)),
        ),
        Suite(
            "epsilon",
            "Tolerance of the paper's rule (figures 14, 15)",
            ABLATED_FAMILIES,
            tuple(
                Entry(
                    f"tolerance{of}",
                    f"Tolerance epsilon{of.replace('-', ', ')}",
                    tuple(f"poem{of}-paper-epsilon-{epsilon:g}" for epsilon in EPSILONS),
                    (EXACT, BOLTZMANN),
                )
                for of in ("", "-cosine")
            ),
            ("known-task", "known-task-poem-cosine"),
        ),
        Suite(
            "smoke",
            "All methods on a small family",
            ("PointGoal",),
            (replace(_TABLE, oracles=(EXACT, BOLTZMANN)),),
            TABLE_REFERENCES,
            snapshots=3,
            budget=Budget(tasks=10, episodes=5),
            # The networks of SAC are as large here as elsewhere, and a point needs fewer steps.
            overrides={"MAMLReward": (("gradient_steps", 20),)},
        ),
    )
}
