"""Adaptation to many tasks at once, and what it earns: true returns after each answer."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from sb3_poem.adaptation.bayes import Bayes
from sb3_poem.adaptation.environments import Env, model_and_env, warn_if_untrained
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.oracles import Oracle, ReturnOracle
from sb3_poem.adaptation.preference import PLACES, Preference, as_preference
from sb3_poem.adaptation.rule import Rule, Setting, as_rule, inference_rng, latents_of, rollout_seed
from sb3_poem.common.checks import check_whole, check_whole_numbers
from sb3_poem.common.family_view import FamilyView, demanded
from sb3_poem.common.rollouts import rollout_episodes, rollout_latents
from sb3_poem.common.trajectory import Trajectory

N_TEST_TASKS = 30

OracleFactory = Callable[..., Oracle]
Library = Sequence[Trajectory] | Callable[[np.ndarray], Sequence[Trajectory]]


@dataclass(frozen=True, eq=False)
class TaskAdaptations:
    """From :func:`adapt_tasks`: ``tasks`` (n_tasks, task_dim), the numbers of answers at which
    estimates were kept, ascending, those ``latents`` (n_tasks, len(record_at), latent_dim), and
    each task's answers in order.

    >>> from sb3_poem import ReturnOracle
    >>> tasks = np.array([[0.5], [1.5]])
    >>> adapt_tasks("PointGoal", "poem/PointGoal-v0", tasks, ReturnOracle, record_at=(0, 3))
    TaskAdaptations(2 tasks, after 0, 3 answers)
    """

    tasks: np.ndarray
    record_at: tuple[int, ...]
    latents: np.ndarray
    preferences: list[list[Preference]]

    def __repr__(self) -> str:
        after = ", ".join(map(str, self.record_at))
        return f"TaskAdaptations({len(self.tasks)} tasks, after {after} answers)"


def adapt_tasks(
    model: MetaModel | str | Path,
    env: Env,
    tasks: np.ndarray,
    oracle_factory: OracleFactory,
    *,
    rule: Rule | None = None,
    n_queries: int = 10,
    record_at: Sequence[int] | None = None,
    seed: int = 0,
    deterministic: bool = True,
    library: Library | None = None,
    progress_bar: bool = False,
    on_record: Callable[[TaskAdaptations], None] | None = None,
) -> TaskAdaptations:
    """Adapt a model to each of many tasks (n_tasks, task_dim), with all rollouts of a question at
    once.

    Task i is adapted as ``PreferenceAdapter(model, env, seed=seed + i, ...)`` would alone, but for
    rounding, and for action noise with ``deterministic=False`` or ``MAMLReward``. The tasks are set
    in ``env``, and known to the oracles; a rule that infers from answers never sees them. Arguments
    that are not explained here are those of :class:`PreferenceAdapter`.

    :param env: A task family. Any number of copies will do; twice the number of tasks is best, and
        an id makes 60.
    :param oracle_factory: Called as ``oracle_factory(env=vec_env, task=task, seed=seed + i)``,
        gives task i's oracle: an oracle's class, say, or ``functools.partial(MistakeOracle, 0.1)``.
        The first task's oracle says how all err.
    :param library: Trajectories to ask about instead of new rollouts, or a function that gives
        those of a task (task_dim,).
    :param record_at: Numbers of answers at which to keep the estimate; None keeps 0, 1, ...,
        n_queries.
    :param on_record: Called with all that there is so far, each time that estimates are kept.
    """
    model, vec_env = model_and_env(model, env)
    _check_factory(oracle_factory)
    tasks = _check_tasks(tasks, vec_env)
    check_whole("seed", seed, 0)
    check_whole("n_queries", n_queries, 1)
    record_at = range(n_queries + 1) if record_at is None else record_at
    kept = check_whole_numbers("record_at", record_at, 0, n_queries)
    numbered = list(enumerate(tasks, seed))
    oracles = [oracle_factory(env=vec_env, task=task, seed=number) for number, task in numbered]
    for oracle in oracles:
        if not callable(oracle):
            raise TypeError(f"`oracle_factory` must return an oracle, but returned {oracle!r}")
    rule = (Bayes() if rule is None else as_rule(rule)).answered_by(oracles[0])
    settings = [
        Setting(n_queries, library(task) if callable(library) else library, vec_env, task)
        for task in tasks
    ]
    for setting in settings:
        rule.check(model, setting)
    warn_if_untrained(model)
    inferences = [rule.start(model, inference_rng(i), own) for i, own in enumerate(settings, seed)]

    preferences: list[list[Preference]] = [[] for _ in tasks]
    latents = np.empty((len(tasks), len(kept), model.latent_dim))
    n_shown, by_mode = len(PLACES[rule.question]), deterministic and not rule.explores
    with tqdm(total=kept[-1], unit="query", disable=not progress_bar) as bar:
        for query in range(kept[-1] + 1):
            if query in kept:
                rows = kept.index(query) + 1
                latents[:, rows - 1] = [inference.estimate() for inference in inferences]
                if on_record is not None:
                    told = list(map(list, preferences))
                    on_record(TaskAdaptations(tasks, kept[:rows], latents[:, :rows].copy(), told))
            if query == kept[-1]:
                break
            asked = [item for inference in inferences for item in inference.ask()]
            shown = [item for item in asked if isinstance(item, Trajectory)]
            if not shown:
                own_seeds = [rollout_seed(number, query) for number, _ in numbered]
                seeds = np.repeat(own_seeds, n_shown).tolist()
                where = np.repeat(tasks, n_shown, axis=0)
                policies = latents_of(asked)
                shown = rollout_latents(model, vec_env, policies, where, seeds, by_mode)
            for i, (inference, oracle) in enumerate(zip(inferences, oracles, strict=True)):
                own = shown[n_shown * i : n_shown * (i + 1)]
                answer = as_preference(oracle(*own), rule.question)
                inference.tell(answer, *own)
                preferences[i].append(answer)
            bar.update()
    return TaskAdaptations(tasks, kept, latents, preferences)


def _check_factory(oracle_factory: OracleFactory) -> None:
    try:
        inspect.signature(oracle_factory).bind(env=None, task=None, seed=0)
    except (TypeError, ValueError) as error:
        raise TypeError(
            "`oracle_factory` must be called as oracle_factory(env=..., task=..., seed=...) and "
            "return a task's oracle, such as the class ReturnOracle or "
            f"functools.partial(MistakeOracle, 0.1), but is {oracle_factory!r}: {error}"
        ) from error


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
    episodes = rollout_episodes(model, vec_env, every, of, seed, deterministic)
    found = [
        (family.compute_rewards(task, demanded(seen.reward_features)).sum(), success)
        for task, (seen, success) in zip(of, episodes, strict=True)
    ]
    returns = np.array([paid for paid, _ in found]).reshape(shape).T
    flags = np.array([success for _, success in found]).reshape(shape).T
    return EpisodeOutcomes(returns, None if None in flags else flags.astype(bool))


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
    rule: Rule | None = None,
    record_at: Sequence[int] = (0, 1, 2, 5, 10),
    n_episodes: int = 10,
    seed: int = 0,
    deterministic: bool = True,
    library: Library | None = None,
    progress_bar: bool = False,
    on_record: Callable[[AdaptationEvaluation], None] | None = None,
) -> AdaptationEvaluation:
    """Adapt to each task, and measure the true return of the policy after some numbers of answers.

    Arguments that are not explained here are those of :func:`adapt_tasks`.

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
    found: list[AdaptationEvaluation] = []

    def measure(adapted: TaskAdaptations) -> None:
        latents = adapted.latents[:, -1], adapted.tasks
        outcomes.append(evaluate_episodes(own, vec_env, *latents, n_episodes, start, deterministic))
        returns = np.stack([each.returns for each in outcomes], axis=1)
        known = [each.successes for each in outcomes if each.successes is not None]
        successes = np.stack(known, axis=1) if len(known) == len(outcomes) else None
        found.append(AdaptationEvaluation(**vars(adapted), returns=returns, successes=successes))
        if on_record is not None:
            on_record(found[-1])

    adapt_tasks(
        own,
        vec_env,
        tasks,
        oracle_factory,
        rule=rule,
        n_queries=max(1, *record_at),
        record_at=record_at,
        seed=seed,
        deterministic=deterministic,
        library=library,
        progress_bar=progress_bar,
        on_record=measure,
    )
    return found[-1]


def choose_test_tasks(
    model: MetaModel, vec_env: VecEnv, tasks: np.ndarray | int | None, seed: int
) -> np.ndarray:
    """Tasks as they are, or so many test tasks as :func:`evaluate_adaptation` explains."""
    if tasks is None or isinstance(tasks, (int, np.integer)):
        n_tasks = N_TEST_TASKS if tasks is None else int(tasks)
        check_whole("tasks", n_tasks, 1)
        return FamilyView.for_training(vec_env, model.horizon).test_tasks(n_tasks, seed)
    return _check_tasks(tasks, vec_env)


def _check_tasks(tasks: np.ndarray, vec_env: VecEnv) -> np.ndarray:
    tasks, dim = np.asarray(tasks, dtype=np.float64), FamilyView(vec_env).task_dim
    if tasks.shape[1:] != (dim,) or not tasks.size:
        expected = f"shape (n_tasks, {dim}) with at least one task"
        raise ValueError(f"`tasks` must have {expected}, but has shape {tasks.shape}")
    return tasks


def evaluation_seed(seed: int, stream: int = 0) -> int:
    """Where the reset seeds of evaluation episodes start, by purpose: far from the questions'."""
    return int(np.random.SeedSequence([seed, 3, stream]).generate_state(1)[0] >> 2)
