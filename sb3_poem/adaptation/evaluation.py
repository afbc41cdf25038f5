"""How well adaptation does: true returns after each answer."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation.environments import Env, model_and_env
from sb3_poem.adaptation.many_tasks import OracleFactory, TaskAdaptations, adapt_tasks
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.oracles import ReturnOracle
from sb3_poem.common.checks import check_whole, check_whole_numbers
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.rollouts import rollout_outcomes

N_TEST_TASKS = 30


@dataclass(frozen=True, eq=False)
class EpisodeOutcomes:
    """What the episodes of some latents on some tasks came to.

    >>> import numpy as np
    >>> outcomes = EpisodeOutcomes(np.array([[-9.0, -7.0]]), np.array([[False, True]]))
    >>> outcomes.mean_return, outcomes.success_rate
    (-8.0, 0.5)

    :param returns: (n, n_episodes) true returns.
    :param successes: (n, n_episodes), whether an episode was a success; None for a family that does
        not say.
    """

    returns: np.ndarray
    successes: np.ndarray | None

    @property
    def mean_return(self) -> float:
        """Mean over rows and episodes."""
        return float(self.returns.mean())

    @property
    def success_rate(self) -> float | None:
        """Share of successful episodes; None for a family that does not say."""
        return None if self.successes is None else float(self.successes.mean())

    def __repr__(self) -> str:
        rows, episodes = self.returns.shape
        mean = f"mean return {self.mean_return:.1f}"
        return f"EpisodeOutcomes({rows} times {episodes} episodes, {mean})"


def evaluate_episodes(
    model: MetaModel | str | Path,
    env: Env,
    latents: np.ndarray,
    tasks: np.ndarray,
    n_episodes: int = 10,
    seed: int = 0,
    deterministic: bool = True,
) -> EpisodeOutcomes:
    """True undiscounted returns of latents (n, latent_dim) on tasks (n, task_dim), row by row; and
    successes. Episode e of row i always starts from the same seed, so that other latents are
    compared on equal starts. For ``model`` and ``env`` see :func:`adapt_tasks`.

    :param seed: Where the episodes' reset seeds start.
    :param deterministic: Whether policies act by their mode.
    :raises ValueError: If shapes do not fit or an episode is not finite.
    """
    model, vec_env = model_and_env(model, env)
    latents, tasks = np.asarray(latents, dtype=np.float64), np.asarray(tasks, dtype=np.float64)
    if latents.ndim != 2 or tasks.ndim != 2 or len(latents) != len(tasks):
        raise ValueError(
            "`latents` (n, latent_dim) and `tasks` (n, task_dim) must have equally many rows, "
            f"but have shapes {latents.shape} and {tasks.shape}"
        )
    check_whole("n_episodes", n_episodes, 1)
    shape, family = (n_episodes, len(latents)), FamilyView(vec_env)
    every, of = np.tile(latents, (n_episodes, 1)), np.tile(tasks, (n_episodes, 1))
    outcomes = rollout_outcomes(model, vec_env, every, of, seed, deterministic)
    returns = [
        float(np.sum(family.compute_rewards(task, outcome.reward_features)))
        for task, outcome in zip(of, outcomes, strict=True)
    ]
    flags = np.array([outcome.success for outcome in outcomes]).reshape(shape).T
    successes = None if None in flags else flags.astype(bool)
    return EpisodeOutcomes(np.array(returns).reshape(shape).T, successes)


@dataclass(frozen=True, eq=False)
class AdaptationEvaluation(TaskAdaptations):
    """True returns of adapted policies, which :func:`evaluate_adaptation` measures.

    >>> how = dict(record_at=(0, 2), n_episodes=1)
    >>> result = evaluate_adaptation("PointGoal", "poem/PointGoal-v0", 3, **how)
    >>> result.task_returns.shape
    (3, 2)

    :param returns: (n_tasks, len(record_at), n_episodes), and ``successes``, whether an episode was
        one; None for a family that does not say.
    """

    returns: np.ndarray
    successes: np.ndarray | None = None

    def __repr__(self) -> str:
        means = ", ".join(f"{mean:.1f}" for mean in self.mean_returns)
        found = f"mean return {means} after {', '.join(map(str, self.record_at))} answers"
        return f"AdaptationEvaluation({len(self.tasks)} tasks, {found})"

    @property
    def task_returns(self) -> np.ndarray:
        """(n_tasks, len(record_at)) means over the episodes."""
        return self.returns.mean(axis=2)

    @property
    def mean_returns(self) -> np.ndarray:
        """(len(record_at),) means over tasks and episodes."""
        return self.returns.mean(axis=(0, 2))

    @property
    def success_rates(self) -> np.ndarray | None:
        """(len(record_at),) shares of successful episodes; None for a family that does not say."""
        return None if self.successes is None else self.successes.mean(axis=(0, 2))

    def after(self, n_answers: int) -> float:
        """Mean return after so many answers, which must be one of ``record_at``."""
        if n_answers not in self.record_at:
            raise ValueError(
                f"returns were recorded after {self.record_at} answers, not after {n_answers}"
            )
        return float(self.mean_returns[self.record_at.index(n_answers)])

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready: means, and those of every task, after the recorded numbers of answers."""
        data: dict[str, Any] = {
            "queries": list(self.record_at),
            "mean_return": self.mean_returns.tolist(),
            "tasks": self.tasks.tolist(),
            "task_returns": self.task_returns.tolist(),
            "answers": [[answer.value for answer in answers] for answers in self.preferences],
        }
        if self.successes is not None:
            data["success_rate"] = self.successes.mean(axis=(0, 2)).tolist()
            data["task_success_rates"] = self.successes.mean(axis=2).tolist()
        return data


def evaluate_adaptation(
    model: MetaModel | str | Path,
    env: Env,
    tasks: np.ndarray | int | None = None,
    oracle_factory: OracleFactory = ReturnOracle,
    *,
    record_at: Sequence[int] = (0, 1, 2, 5, 10),
    n_episodes: int = 10,
    seed: int = 0,
    deterministic: bool = True,
    on_record: Callable[[AdaptationEvaluation], None] | None = None,
    **options: Any,
) -> AdaptationEvaluation:
    """Adapt to each task, and measure the true return of the policy after some numbers of answers.

    Arguments that are not explained here, and ``options``, are those of :func:`adapt_tasks`:
    ``rule``, ``library`` and ``progress_bar``.

    :param tasks: (n_tasks, task_dim), or a number (None is 30) of tasks that no model was trained
        on, which ``seed`` draws, the same as in :func:`known_task_return`.
    :param record_at: After how many answers to measure; the largest is the number of questions.
    :param seed: Task i adapts with seed + i; the episodes' seeds follow from it too.
    :param on_record: Called with all that is measured so far, after each measurement.
    """
    record_at = check_whole_numbers("record_at", record_at, 0)
    check_whole("n_episodes", n_episodes, 1)
    own, vec_env = model_and_env(model, env)
    tasks, start = choose_test_tasks(own, vec_env, tasks, seed), evaluation_seed(seed)
    outcomes: list[EpisodeOutcomes] = []
    found: AdaptationEvaluation | None = None

    def measure(adapted: TaskAdaptations) -> None:
        nonlocal found
        latents = adapted.latents[:, -1], adapted.tasks
        outcomes.append(evaluate_episodes(own, vec_env, *latents, n_episodes, start, deterministic))
        returns = np.stack([each.returns for each in outcomes], axis=1)
        known = [each.successes for each in outcomes if each.successes is not None]
        successes = np.stack(known, axis=1) if len(known) == len(outcomes) else None
        found = AdaptationEvaluation(**vars(adapted), returns=returns, successes=successes)
        if on_record is not None:
            on_record(found)

    how: dict[str, Any] = {"n_queries": max(1, *record_at), "record_at": record_at}
    how |= {"seed": seed, "deterministic": deterministic, "on_record": measure}
    adapt_tasks(own, vec_env, tasks, oracle_factory, **how, **options)
    assert found is not None
    return found


def choose_test_tasks(
    model: MetaModel, vec_env: VecEnv, tasks: np.ndarray | int | None, seed: int
) -> np.ndarray:
    """Tasks as they are, or so many test tasks as :func:`evaluate_adaptation` explains."""
    if tasks is None or isinstance(tasks, (int, np.integer)):
        n_tasks = N_TEST_TASKS if tasks is None else int(tasks)
        return FamilyView.for_training(vec_env, model.horizon).test_tasks(n_tasks, seed)
    return np.asarray(tasks, dtype=np.float64)


def evaluation_seed(seed: int, stream: int = 0) -> int:
    """Where the reset seeds of evaluation episodes start, by purpose: far from the questions'."""
    return int(np.random.SeedSequence([seed, 3, stream]).generate_state(1)[0] >> 2)
