"""What a rule of inference is: options that start an inference, which asks and is told."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation.environments import check_model_fits
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.noise import NoiseModel
from sb3_poem.adaptation.oracles import HasQuestion, Oracle
from sb3_poem.adaptation.preference import PLACES, Preference
from sb3_poem.common.trajectory import Trajectory

# What a question compares: trajectories, or the latents of policies to roll out.
Shown: TypeAlias = Trajectory | np.ndarray


@dataclass(frozen=True, eq=False)
class Answer:
    """One answered question: the answer, and the trajectories that were shown, in order (or their
    latents, to a rule that needs no more).

    >>> from sb3_poem import PreferenceAdapter
    >>> adapter = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", seed=0)
    >>> _ = adapter.ask()
    >>> adapter.tell("left")
    >>> adapter.inference.answers[0].preference
    <Preference.LEFT: 'left'>
    """

    preference: Preference
    shown: tuple[Shown, ...]


class Inference(ABC):
    """One task's inference under a rule: ``ask`` says what to compare, ``tell`` takes the answer,
    ``estimate`` gives the latent to act on. ``rng`` is the only source of randomness.

    >>> import sb3_poem
    >>> model = sb3_poem.POEMSAC.from_pretrained("PointGoal")
    >>> inference = sb3_poem.Paper().start(model, np.random.default_rng(0), Setting(n_queries=3))
    >>> left, right = inference.ask()  # the latents whose policies are to be compared
    >>> inference.estimate().shape
    (5,)
    """

    #: Names of the arrays that change while answers come in.
    state: tuple[str, ...] = ()
    #: Trajectories to ask about; None where questions are new rollouts.
    library: list[Trajectory] | None = None
    _library_returns: np.ndarray | None = None  # as far as they have been predicted

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.answers: list[Answer] = []

    @abstractmethod
    def ask(self) -> tuple[Shown, ...]:
        """What to compare next: latents (d,) to roll out, or trajectories to show."""

    def same_latents(self, number: int, *latents: np.ndarray) -> tuple[Shown, ...]:
        """The latents of question ``number``, from 0, which may come from a file; others where they
        mean something to one model alone.
        """
        return latents

    @abstractmethod
    def tell(self, preference: Preference, *shown: Shown) -> None:
        """Take an answer, see :class:`Answer`."""

    @abstractmethod
    def estimate(self) -> np.ndarray:
        """(d,) the latent to act on, given the answers so far."""

    def contradicted(self) -> int | None:
        """See :attr:`PreferenceAdapter.contradicted`."""
        return None

    def posterior(self) -> tuple[np.ndarray, np.ndarray]:
        """The latents (n, d) that are still possible, and weights (n,) summing to one: the estimate
        alone unless overridden.
        """
        return equally_weighted(self.estimate()[None])

    def snapshot(self) -> dict[str, Any]:
        """The generator's ``random_state``, and copies of the ``arrays`` of :attr:`state`."""
        arrays = {name: np.array(getattr(self, name)) for name in self.state}
        return {"random_state": self.rng.bit_generator.state, "arrays": arrays}

    def restore(self, snapshot: dict[str, Any], answers: list[Answer]) -> None:
        """Go back, or on, to a snapshot of such an inference and the answers up to then."""
        arrays = snapshot["arrays"]
        missing = [name for name in self.state if name not in arrays]
        if missing:
            raise ValueError(f"not a snapshot of {type(self).__name__}: {missing[0]} is missing")
        rng = np.random.default_rng(0)
        try:
            rng.bit_generator.state = snapshot["random_state"]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"not the state of a PCG64 generator: {error}") from error
        for name in self.state:
            setattr(self, name, arrays[name].copy())
        self.rng, self.answers, self._library_returns = rng, list(answers), None


@dataclass(frozen=True, eq=False)
class Setting:
    """What an adaptation is given beside model and rule.

    >>> Setting(n_queries=3).library is None  # questions are new rollouts
    True

    :param library: Trajectories to ask about instead of new rollouts.
    :param env: Where rollouts are made; None where none are.
    :param task: (task_dim,) whose rewards a rule may read that reads any; None takes the one in
        effect in ``env``.
    :param visibility: The share in [0, 1] of what a question tells that is left when a person has
        to see the difference of what is shown; None where nobody looks.
    """

    n_queries: int = 10
    library: Sequence[Trajectory] | None = None
    env: VecEnv | None = None
    task: np.ndarray | None = None
    visibility: Callable[[Shown, Shown], float] | None = None


@dataclass(frozen=True, repr=False)
class Rule(ABC):
    """How to ask and how to infer: a rule's own options and nothing else.

    A rule of your own is a frozen dataclass that subclasses this, says in ``__post_init__`` which
    values its options may have, and starts an :class:`Inference`.

    >>> from sb3_poem import Bayes
    >>> Rule.from_dict(Bayes(n_particles=100).to_dict()) == Bayes(n_particles=100)
    True
    """

    #: Whether questions show policies with their exploration noise, whatever the adapter says.
    explores: ClassVar[bool] = False
    #: Why the rule takes no library; None if it takes one.
    refuses_library: ClassVar[str | None] = None

    _known: ClassVar[dict[str, "type[Rule]"]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        Rule._known[cls.__name__] = cls

    def __repr__(self) -> str:
        chosen = ((f.name, getattr(self, f.name), f.default) for f in fields(self))
        options = ", ".join(f"{name}={value!r}" for name, value, usual in chosen if value != usual)
        return f"{type(self).__name__}({options})"

    @property
    def question(self) -> str:
        """The kind of the questions, see :class:`Query`."""
        return "pair"

    def check(self, model: MetaModel, setting: Setting) -> None:
        """Refuse, by a ``ValueError``, what the rule cannot run with, before anything starts."""
        if setting.env is not None:
            check_model_fits(model, setting.env)
        if setting.library is not None and self.refuses_library:
            raise ValueError(f"`library` must be None: {self.refuses_library}")
        needed, given = len(PLACES[self.question]), setting.library
        if given is not None and len(given) < needed:
            held = f"but holds {len(given)}"
            raise ValueError(f"`library` must hold at least {needed} trajectories, {held}")

    @abstractmethod
    def start(self, model: MetaModel, rng: np.random.Generator, setting: Setting) -> Inference:
        """Begin with a task, with what :meth:`check` has accepted."""

    def answered_by(self, oracle: Oracle | None) -> Self:
        """The rule for the answers of this oracle; a ``ValueError`` if it answers questions of
        another kind.
        """
        if isinstance(oracle, HasQuestion) and (kind := oracle.question) != self.question:
            raise ValueError(
                f'the oracle answers "{kind}" questions, but the rule asks "{self.question}" ones: '
                'Bayes(question="graded") goes with ReturnOracle(thresholds=(20, 100)), and '
                f'"best-of-four" with ReturnOracle(question="best-of-four"); it is {oracle!r}'
            )
        return self

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        options = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, value in options.items():
            if isinstance(value, np.generic):  # JSON does not know NumPy's numbers
                options[name] = value.item()
            elif isinstance(value, NoiseModel):
                options[name] = value.to_dict()
        return {"name": type(self).__name__, "module": type(self).__module__, "options": options}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Rule":
        """Read what :meth:`to_dict` of any imported rule wrote."""
        name, module = data["name"], data["module"]
        if name not in cls._known:
            first = f"import it first, by `from {module} import {name}`"
            raise ValueError(f"the rule is {name!r}, which this program does not know: {first}")
        return cls._known[name](**data["options"])


def as_rule(rule: object) -> Rule:
    """A rule as it is; a ``TypeError`` that says what to write if it is none."""
    if isinstance(rule, Rule):
        return rule
    if isinstance(rule, type):
        name = rule.__name__
        raise TypeError(f"`rule` is the class {name}, but must be an object: {name}()")
    known = {name.lower(): name for name in Rule._known}
    word = str(rule).lower()
    meant = f"; write rule={known[word]}()" if word in known else ""
    objects = "Bayes(), Paper(n_candidates=50) or ANOLE()"
    raise TypeError(f"`rule` must be an object as {objects}, but is {rule!r}{meant}")


def equally_weighted(latents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Latents (n, d), and the same weight for each, (n,)."""
    return latents, np.full(len(latents), 1.0 / len(latents))


def latent_of(shown: Shown) -> np.ndarray:
    """(d,) the latent behind what was shown."""
    return shown.latent if isinstance(shown, Trajectory) else np.asarray(shown, dtype=np.float64)


def latents_of(shown: Sequence[Shown]) -> np.ndarray:
    """(n, d) the latents behind what was shown."""
    return np.stack([latent_of(item) for item in shown])


def seen(shown: Sequence[Shown]) -> tuple[Trajectory, ...]:
    """What was shown, for a rule that looks at what was done; latents are refused."""
    trajectories = tuple(item for item in shown if isinstance(item, Trajectory))
    if len(trajectories) < len(shown):
        raise ValueError("this rule needs the trajectories that were shown, not their latents")
    return trajectories


def inference_rng(seed: int) -> np.random.Generator:
    """The generator of an adaptation's inference, from the adaptation's seed."""
    return np.random.default_rng([seed, 0])


def rollout_seed(seed: int, query: int) -> int:
    """The reset seed of the rollouts of a question, from 0, of an adaptation with this seed."""
    return int(np.random.SeedSequence([seed, 1, query]).generate_state(1)[0] >> 1)
