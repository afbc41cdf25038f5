"""Who answers. Oracles alone may know the task; an adapter never does."""

from abc import ABC, abstractmethod
from typing import Self

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation.noise import BoltzmannNoise, ExactNoise, MistakeNoise, NoiseModel
from sb3_poem.adaptation.preference import ANSWERS, BEST_OF_FOUR, Preference, check_number
from sb3_poem.common.family_view import FamilyView, vectorised
from sb3_poem.common.trajectory import Trajectory

ORACLE_STREAM = 8


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

    :param env: A task family: a ``gym.Env``, or an SB3 ``VecEnv`` of them. It can be given later by
        :meth:`bind`.
    :param task: (task_dim,) the task by whose reward to judge; None takes the one in effect in
        ``env`` (in a ``VecEnv``, in its first copy) whenever a question is asked.
    :param seed: Seeds the oracle's own noise, if it has any.
    :param thresholds: Answers are graded: EQUAL up to the first difference of returns, MUCH_LEFT or
        MUCH_RIGHT beyond the second; None compares, and nothing but a difference of 0 is EQUAL. See
        :func:`~sb3_poem.adaptation.known_task.return_spread` for what is much in a family. Of four
        the best one is told from the second best by the first of them.
    :param question: The kind of questions that it answers, see :class:`Query`: "best-of-four", or
        None, which is "graded" with ``thresholds`` and else "pair".
    """

    needs_frames = False
    thresholds: tuple[float, float] | None = None
    #: How this oracle errs, for the Bayesian rule.
    noise_model: NoiseModel = ExactNoise()

    def __init__(
        self,
        env: gym.Env | VecEnv | None = None,
        task: np.ndarray | None = None,
        seed: int | None = None,
        thresholds: tuple[float, float] | None = None,
        question: str | None = None,
    ) -> None:
        if thresholds is not None:
            equal, much = thresholds if len(thresholds) == 2 else (np.nan, np.nan)
            if not 0.0 <= equal <= much < np.inf:
                raise ValueError(
                    "`thresholds` must be two finite differences of returns, the first not the "
                    f"larger, but is {thresholds!r}"
                )
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

    def bind(self, env: gym.Env | VecEnv, task: np.ndarray | None = None) -> Self:
        """Give the oracle its environment, and its task unless that is None; returns itself."""
        self.env = env
        if task is not None:
            self.task = np.asarray(task, dtype=np.float64)
        return self

    def __call__(self, *shown: Trajectory) -> Preference:
        """Compare trajectories with reward features, as many as a question of its kind shows."""
        check_number(self.question, shown)
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
        name = type(self).__name__
        if self.env is None:
            raise RuntimeError(f"{name} has no environment: pass `env` or call bind(env)")
        value = float(np.sum(step_rewards(self.env, self.task, trajectory)))
        if not np.isfinite(value):
            why = "its reward features are not finite"
            raise ValueError(f"the true return of a trajectory is {value}; {why}")
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
    """Left wins with probability 1 / (1 + exp(-beta (R_left - R_right))) (C.6 of Xu & Zhu 2025): it
    perceives the difference with a logistic error of scale 1 / beta.

    With the paper's beta (None), ``1 / (|R_left| + |R_right|)``, an answer is right at most 73 % of
    the time, and ten answers carry less than two bits. Of four each wins with a probability
    proportional to exp(beta R), where the paper's beta becomes ``1 / (2 mean |R|)``. For the other
    arguments see :class:`TaskOracle`.

    >>> BoltzmannOracle(beta=0.5).noise_model
    BoltzmannNoise(beta=0.5)
    """

    def __init__(
        self,
        beta: float | None = None,
        env: gym.Env | VecEnv | None = None,
        task: np.ndarray | None = None,
        seed: int | None = None,
        thresholds: tuple[float, float] | None = None,
        question: str | None = None,
    ) -> None:
        super().__init__(env, task, seed, thresholds, question)
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
    """The right answer, flipped with a probability in [0, 1], of which the noise model knows those
    up to 0.5; of four another one, whichever. Equal returns stay EQUAL. For the other arguments see
    :class:`TaskOracle`.

    >>> MistakeOracle(0.1).noise_model
    MistakeNoise(rate=0.1)
    """

    def __init__(
        self,
        rate: float = 0.2,
        env: gym.Env | VecEnv | None = None,
        task: np.ndarray | None = None,
        seed: int | None = None,
        thresholds: tuple[float, float] | None = None,
        question: str | None = None,
    ) -> None:
        if not 0.0 <= rate <= 1.0:
            raise ValueError(f"`rate` must lie in [0, 1], but is {rate}")
        super().__init__(env, task, seed, thresholds, question)
        self.rate, self.noise_model = rate, MistakeNoise(min(rate, 0.5))

    def _perceive(self, returns: np.ndarray) -> np.ndarray:
        if self.rng.random() < self.rate:
            best, n = int(np.argmax(returns)), len(returns)
            other = (best + 1 + int(self.rng.integers(n - 1))) % n
            returns[[best, other]] = returns[[other, best]]
        return returns


def step_rewards(
    env: gym.Env | VecEnv, task: np.ndarray | None, trajectory: Trajectory
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
