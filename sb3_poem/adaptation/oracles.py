"""Who answers. Oracles alone may know the task; an adapter never does."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, Self, TypeAlias, runtime_checkable

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation.noise import INFER, BoltzmannNoise, ExactNoise, MistakeNoise, NoiseModel
from sb3_poem.adaptation.preference import ANSWERS, BEST_OF_FOUR, Preference, Query, check_shown
from sb3_poem.common.checks import check_choice, check_number
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.vec_env import vectorised

#: Any callable of the trajectories that a question shows; it gives a preference, or its word. What
#: else it may say of itself is in the protocols below.
Oracle: TypeAlias = Callable[..., Preference | str]

ORACLE_STREAM = 8
PROMPTS = {
    "pair": "Which is better? [l]eft, [r]ight, or [e]qual (can't tell): ",
    "graded": "Which is better? 1 left, much; 2 left, a bit; 3 can't tell; 4 right, a bit; "
    "5 right, much: ",
    BEST_OF_FOUR: "Which is best? 1, 2, 3 or 4, or 0 (can't tell): ",
}
NUMBERS = {
    "pair": {"1": Preference.LEFT, "2": Preference.RIGHT},
    "graded": dict(zip("54321", ANSWERS["graded"], strict=True)),
    BEST_OF_FOUR: dict(zip("04321", ANSWERS[BEST_OF_FOUR], strict=True)),
}
WORDS = {
    **{answer.value: answer for answer in Preference},
    **{"l": Preference.LEFT, "ll": Preference.MUCH_LEFT},
    **{"r": Preference.RIGHT, "rr": Preference.MUCH_RIGHT},
    **dict.fromkeys(("e", "=", "can't tell", "cant tell", "?"), Preference.EQUAL),
}


@runtime_checkable
class HasQuestion(Protocol):
    """An oracle that answers questions of one kind, see :class:`Query`."""

    question: str


@runtime_checkable
class HasNoiseModel(Protocol):
    """An oracle that says how it errs, for the Bayesian rule: "infer" that it does not know."""

    noise_model: NoiseModel | str | None


@runtime_checkable
class HasNeedsFrames(Protocol):
    """An oracle that says whether it looks at frames: at every one, or at every n-th."""

    needs_frames: bool | int


class TaskOracle(ABC):
    """An oracle that computes true returns from the trajectories' reward features. A subclass says
    how it perceives these:

    >>> class Spoilt(TaskOracle):
    ...     def _perceive(self, returns):  # only the right one can please
    ...         return returns + np.array([-100.0, 0.0])
    >>> from sb3_poem import PreferenceAdapter
    >>> adapter = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", seed=0)
    >>> query = adapter.ask()
    >>> Spoilt(adapter.env)(query.left, query.right)
    <Preference.RIGHT: 'right'>

    :param env: A task family: a ``gym.Env``, or a vector environment of Gymnasium's or SB3's; also
        given by :meth:`bind`.
    :param task: (task_dim,) the task by whose reward to judge; None takes the one in effect in
        ``env`` (in its first copy) whenever a question is asked.
    :param seed: Of the oracle's own noise.
    :param thresholds: Answers are graded: EQUAL up to the first difference of returns, MUCH_LEFT or
        MUCH_RIGHT beyond the second (see :func:`~sb3_poem.adaptation.return_spread`); None
        compares, and only a difference of 0 is EQUAL. Of four the best one is told from the second
        best by the first of them.
    :param question: The kind of questions that it answers, see :class:`Query`: "best-of-four", or
        None, which is "graded" with ``thresholds`` and else "pair".
    """

    thresholds: tuple[float, float] | None = None
    #: How this oracle errs, for the Bayesian rule.
    noise_model: NoiseModel = ExactNoise()
    #: The environment that an adapter has bound it to, which another one may replace.
    lent_env: VecEnv | None = None

    def __init__(
        self,
        env: gym.Env | gym.vector.VectorEnv | VecEnv | None = None,
        task: np.ndarray | None = None,
        seed: int | None = None,
        thresholds: tuple[float, float] | None = None,
        question: str | None = None,
    ) -> None:
        if thresholds is not None:
            equal, much = thresholds if np.shape(thresholds) == (2,) else (np.nan, np.nan)
            if not 0.0 <= equal <= much < np.inf:
                two = "two finite differences of returns, the first not the larger"
                raise ValueError(f"`thresholds` must be {two}, but is {thresholds!r}")
            self.thresholds = (float(equal), float(much))
        usual = "pair" if thresholds is None else "graded"
        if question not in (None, usual, BEST_OF_FOUR):
            raise ValueError(
                f'`question` must be None, "{usual}" with thresholds={thresholds} or '
                f'"{BEST_OF_FOUR}", but is {question!r}'
            )
        if isinstance(env, str):
            raise TypeError(f"`env` must be an environment, gym.make({env!r}) say, but is its id")
        self.question = question or usual
        self.env = env
        self.task = None if task is None else np.asarray(task, dtype=np.float64)
        # A stream of its own: an adaptation's inference with the same seed draws from another.
        self.rng = np.random.default_rng(None if seed is None else [seed, ORACLE_STREAM])

    def __repr__(self) -> str:
        hidden = ["env", "lent_env", "task", "rng", "noise_model"]
        hidden += ["question"] * (self.question != BEST_OF_FOUR)  # thresholds or none say it
        own = "".join(f"{k}={value}, " for k, value in vars(self).items() if k not in hidden)
        task = "the environment's" if self.task is None else self.task.tolist()
        return f"{type(self).__name__}({own}task={task})"

    @abstractmethod
    def _perceive(self, returns: np.ndarray) -> np.ndarray:
        """The returns by which to answer, from true ones; both (n,)."""

    def bind(self, env: gym.Env | gym.vector.VectorEnv | VecEnv) -> Self:
        """Give the oracle its environment; returns itself."""
        self.env = env
        return self

    def __call__(self, *shown: Trajectory) -> Preference:
        """Compare trajectories with reward features, as many as a question of its kind shows."""
        check_shown(self.question, shown)
        perceived = self._perceive(np.array([self.true_return(item) for item in shown]))
        equal, much = self.thresholds or (0.0, np.inf)
        ascending = np.argsort(perceived, kind="stable")
        best = int(ascending[-1])
        lead = perceived[best] - perceived[ascending[-2]]
        if lead <= equal:
            return Preference.EQUAL
        if self.question == BEST_OF_FOUR:
            return ANSWERS[BEST_OF_FOUR][::-1][best]
        if lead > much:
            return (Preference.MUCH_LEFT, Preference.MUCH_RIGHT)[best]
        return (Preference.LEFT, Preference.RIGHT)[best]

    def true_return(self, trajectory: Trajectory) -> float:
        """The undiscounted return of a trajectory under the task, from its reward features."""
        if self.env is None:
            name = type(self).__name__
            raise RuntimeError(f"{name} has no environment: pass `env` or call bind(env)")
        value = float(np.sum(step_rewards(self.env, self.task, trajectory)))
        if not np.isfinite(value):
            raise ValueError(
                f"the true return of a trajectory is {value}: its reward features are not finite"
            )
        return value


class ReturnOracle(TaskOracle):
    """The largest true return wins; equal returns are EQUAL. See :class:`TaskOracle`.

    >>> from sb3_poem import PreferenceAdapter
    >>> adapter = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", oracle=ReturnOracle(), seed=0)
    >>> policy = adapter.adapt()
    """

    def _perceive(self, returns: np.ndarray) -> np.ndarray:
        return returns


class BoltzmannOracle(TaskOracle):
    """Left wins with probability 1 / (1 + exp(-beta (R_left - R_right))) (C.6 of Xu & Zhu 2025).

    With the paper's beta (None), ``1 / (|R_left| + |R_right|)``, an answer is right at most 73 % of
    the time. Of four each wins with a probability proportional to exp(beta R), where the paper's
    beta becomes ``1 / (2 mean |R|)``. For the other arguments see :class:`TaskOracle`.

    >>> BoltzmannOracle(beta=0.5).noise_model
    BoltzmannNoise(beta=0.5)

    :param beta: Per unit of return, above 0; None is the paper's.
    """

    def __init__(self, beta: float | None = None, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.beta, self.noise_model = beta, BoltzmannNoise(beta)

    def _perceive(self, returns: np.ndarray) -> np.ndarray:
        scale = 2.0 * np.abs(returns).mean() or 1.0
        if self.beta is not None:
            scale = 1.0 / self.beta
        if len(returns) > 2:
            return returns + self.rng.gumbel(scale=scale, size=len(returns))
        drawn = self.rng.random()  # two such errors differ by a logistic one
        return returns - [scale * np.log(drawn / (1.0 - drawn)), 0.0]


class MistakeOracle(TaskOracle):
    """The right answer, flipped with a probability in [0, 1]; of four another one, whichever. Equal
    returns stay EQUAL. For the other arguments see :class:`TaskOracle`.

    >>> MistakeOracle(0.1).noise_model
    MistakeNoise(rate=0.1)

    :param rate: In [0, 1]; the noise model has at most 0.5.
    """

    def __init__(self, rate: float = 0.2, *args: Any, **kwargs: Any) -> None:
        check_number("rate", rate, 0.0, 1.0)
        super().__init__(*args, **kwargs)
        self.rate, self.noise_model = rate, MistakeNoise(min(rate, 0.5))

    def _perceive(self, returns: np.ndarray) -> np.ndarray:
        if self.rng.random() < self.rate:
            best, n = int(np.argmax(returns)), len(returns)
            other = (best + 1 + int(self.rng.integers(n - 1))) % n
            returns[[best, other]] = returns[[other, best]]
        return returns


def step_rewards(
    env: gym.Env | gym.vector.VectorEnv | VecEnv, task: np.ndarray | None, trajectory: Trajectory
) -> np.ndarray:
    """The true rewards (T,) of a trajectory; for the arguments see :class:`TaskOracle`."""
    if trajectory.reward_features is None:
        raise ValueError(
            "returns are computed from reward features, but the trajectory has none: its "
            'environment gave no info["reward_features"]. Use an oracle that does not need them, '
            "such as HumanOracle."
        )
    family = FamilyView(vectorised(env))
    return family.compute_rewards(family.task if task is None else task, trajectory.reward_features)


@dataclass(frozen=True, eq=False)
class HumanAnswer:
    """An answer with its video, and when (seconds since 1970) it was asked for and shown."""

    preference: Preference
    query: Query
    video: Path
    fps: float
    asked: float
    shown: float


class HumanOracle:
    """Shows a question's trajectories beside each other in a video file, and asks at the terminal.

    The files are ``query-001.gif`` and so on (or ``.mp4``) within the folder. The prompt takes l or
    left, r or right, and e, equal, = or ?, or a number: 1 or 2 of a pair, 1 (left is much better)
    to 5 of a graded question, and 1 to 4, or 0, of a best of four.

    >>> from sb3_poem import PreferenceAdapter
    >>> import gymnasium as gym
    >>> env = gym.make("poem/PointGoal-v0", render_mode="rgb_array", width=48, height=48)
    >>> oracle = HumanOracle(read=lambda prompt: "l")  # without it, ``input`` asks
    >>> adapter = PreferenceAdapter("PointGoal", env, oracle=oracle, n_queries=1, seed=0)
    >>> policy = adapter.adapt()
    Query 1: preference_queries/query-001.gif

    :param folder: Of the videos; made if it is missing.
    :param video_format: "gif" (any viewer plays it) or "mp4" (smaller).
    :param fps: Frames a second.
    :param mistake_rate: How often a person is taken to err, for the Bayesian rule; None lets it
        infer how they do.
    :param question: "pair", "graded" or "best-of-four", as the rule's.
    :param read: Reads a line after showing a prompt; ``write`` shows one.
    :param record: Called with each :class:`HumanAnswer`; ``sb3_poem.label.StoreRecorder`` keeps
        them in the store of the web page.
    """

    needs_frames = True

    def __init__(
        self,
        folder: str | Path = "preference_queries",
        video_format: str = "gif",
        fps: float = 20.0,
        mistake_rate: float | None = None,
        read: Callable[[str], str] = input,
        write: Callable[[str], None] = print,
        record: Callable[[HumanAnswer], None] | None = None,
        question: str = "pair",
    ) -> None:
        check_choice("video_format", video_format, ("gif", "mp4"))
        check_choice("question", question, tuple(PROMPTS))
        if mistake_rate is not None:
            check_number("mistake_rate", mistake_rate, 0.0, 0.5)
        self.question = question
        self.folder, self.video_format, self.fps = Path(folder), video_format, fps
        self.noise_model = INFER if mistake_rate is None else MistakeNoise(mistake_rate)
        self.n_asked = 0
        self._read, self._write, self._record = read, write, record

    def __repr__(self) -> str:
        return f"HumanOracle({self.n_asked} asked, videos in {self.folder})"

    def __call__(self, *shown: Trajectory) -> Preference:
        """Write the video of trajectories with frames, and ask until an answer is understood; an
        ``EOFError`` if standard input has ended.
        """
        asked, query = time.time(), Query(shown, self.question)
        name = f"query-{self.n_asked + 1:03d}.{self.video_format}"
        path = query.to_video(self.folder / name, self.fps)
        self.n_asked += 1
        seen = time.time()
        self._write(f"Query {self.n_asked}: {path}")
        while True:
            try:
                line = self._read(PROMPTS[self.question])
            except EOFError:
                raise EOFError("no answer can be read: standard input is closed") from None
            answer = (WORDS | NUMBERS[self.question]).get(line.strip().lower())
            if answer in ANSWERS[self.question]:
                if self._record is not None:
                    self._record(HumanAnswer(answer, query, path, self.fps, asked, seen))
                return answer
            self._write(f"{line.strip()!r} is no answer.")
