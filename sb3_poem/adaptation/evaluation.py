"""How well adaptation does: true returns after each answer, what a known task would give, and
Property 1 on held-out tasks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_poem.adaptation.environments import Env, model_and_env
from sb3_poem.adaptation.limits import information_limit
from sb3_poem.adaptation.lockstep import OracleFactory, TaskAdaptations, adapt_tasks
from sb3_poem.adaptation.noise import NoiseModel
from sb3_poem.adaptation.oracles import ReturnOracle
from sb3_poem.adaptation.preference import Preference
from sb3_poem.common.checks import check_whole
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.rollouts import rollout_outcomes

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


# Latents to try for each task, where every one must be rolled out in every task, and where one
# rollout serves all of them.
LATENTS_WITH_OWN_DYNAMICS, LATENTS_WITH_SHARED_DYNAMICS = 30, 300

N_TEST_TASKS = 30


@dataclass(frozen=True, eq=False)
class EpisodeOutcomes:
    """What the episodes of some latents on some tasks came to.

    :param returns: (n, n_episodes) true returns.
    :param successes: (n, n_episodes), whether an episode was a success; None for a family that does
        not say.
    """

    returns: np.ndarray
    successes: np.ndarray | None

    def __repr__(self) -> str:
        rows, episodes = self.returns.shape
        return f"EpisodeOutcomes({rows} times {episodes} episodes, mean return {self.returns.mean():.1f})"


def evaluate_latents(
    model: Any,
    env: Env,
    latents: np.ndarray,
    tasks: np.ndarray,
    n_episodes: int = 10,
    seed: int = 0,
    deterministic: bool = True,
) -> np.ndarray:
    """True returns of latents on tasks, (n, n_episodes): those of :func:`evaluate_episodes`, with
    the same arguments.
    """
    return evaluate_episodes(model, env, latents, tasks, n_episodes, seed, deterministic).returns


def evaluate_episodes(
    model: Any,
    env: Env,
    latents: np.ndarray,
    tasks: np.ndarray,
    n_episodes: int = 10,
    seed: int = 0,
    deterministic: bool = True,
) -> EpisodeOutcomes:
    """True returns of latents on tasks: an episode's rewards up to its end, early or not, not
    discounted; and successes.

    Episode e of row i always starts from the same seed, so the same rows with other latents are
    compared on equal starts.

    :param model: See :func:`adapt_tasks`.
    :param env: See :func:`adapt_tasks`.
    :param latents: (n, latent_dim).
    :param tasks: (n, task_dim), row i for latent i.
    :param n_episodes: Episodes per row.
    :param seed: Where the episodes' reset seeds start.
    :param deterministic: Whether policies act by their mode.
    :return: Returns and successes, each (n, n_episodes).
    :raises ValueError: If shapes do not fit or an episode is not finite.
    """
    model, vec_env = model_and_env(model, env)
    latents, tasks = np.asarray(latents, dtype=np.float64), np.asarray(tasks, dtype=np.float64)
    if latents.ndim != 2 or tasks.ndim != 2 or len(latents) != len(tasks):
        raise ValueError(
            f"`latents` (n, latent_dim) and `tasks` (n, task_dim) must have equally many rows, "
            f"but have shapes {latents.shape} and {tasks.shape}"
        )
    check_whole("n_episodes", n_episodes, 1)
    n = len(latents)
    rows = np.tile(np.arange(n), n_episodes)
    outcomes = rollout_outcomes(model, vec_env, latents[rows], tasks[rows], seed, deterministic)
    family = FamilyView(vec_env)
    returns = [
        float(np.sum(family.compute_rewards(tasks[row], outcome.reward_features)))
        for row, outcome in zip(rows, outcomes, strict=True)
    ]
    successes = None
    if all(outcome.success is not None for outcome in outcomes):
        successes = (
            np.array([outcome.success for outcome in outcomes], dtype=bool).reshape(n_episodes, n).T
        )
    return EpisodeOutcomes(np.array(returns).reshape(n_episodes, n).T, successes)


@dataclass(frozen=True, eq=False)
class AdaptationEvaluation:
    """True returns of adapted policies.

    :param tasks: (n_tasks, task_dim).
    :param record_at: Numbers of answers, ascending.
    :param latents: (n_tasks, len(record_at), latent_dim) the estimates.
    :param returns: (n_tasks, len(record_at), n_episodes).
    :param preferences: A task's answers in order.
    :param successes: (n_tasks, len(record_at), n_episodes), whether an episode was a success; None
        for a family that does not say.
    """

    tasks: np.ndarray
    record_at: tuple[int, ...]
    latents: np.ndarray
    returns: np.ndarray
    preferences: list[list[Preference]]
    successes: np.ndarray | None = None

    def __repr__(self) -> str:
        means = ", ".join(f"{mean:.1f}" for mean in self.mean_returns)
        answers = ", ".join(map(str, self.record_at))
        return f"AdaptationEvaluation({len(self.tasks)} tasks, mean return {means} after {answers} answers)"

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
        """Mean return after so many answers.

        :param n_answers: One of ``record_at``.
        :return: The mean over tasks and episodes.
        :raises ValueError: If it was not recorded.
        """
        if n_answers not in self.record_at:
            raise ValueError(
                f"returns were recorded after {self.record_at} answers, not after {n_answers}"
            )
        return float(self.mean_returns[self.record_at.index(n_answers)])

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready data.

        :return: Every task's mean return, and success rate if there are successes, after every
            recorded number of answers; and the means.
        """
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
    model: Any,
    env: Env,
    tasks: np.ndarray | int | None = None,
    oracle_factory: OracleFactory = ReturnOracle,
    *,
    record_at: Sequence[int] = (0, 1, 2, 5, 10),
    n_episodes: int = 10,
    seed: int = 0,
    progress_bar: bool = False,
    on_record: Callable[[AdaptationEvaluation], None] | None = None,
    **options: Any,
) -> AdaptationEvaluation:
    """Adapt to each task, and measure the true return of the policy after some numbers of answers.

    :param model: See :func:`adapt_tasks`.
    :param env: See :func:`adapt_tasks`.
    :param tasks: (n_tasks, task_dim), or a number: so many that no model was trained on, which
        ``seed`` draws, the same as in :func:`known_task_return`; None takes 30.
    :param oracle_factory: See :func:`adapt_tasks`.
    :param record_at: After how many answers to measure; the largest is the number of questions.
    :param n_episodes: Episodes per measurement.
    :param seed: Task i adapts with seed + i; the episodes' seeds follow from it too.
    :param progress_bar: Whether to show one.
    :param on_record: Called with all that is measured so far, after each measurement.
    :param options: Further options of :func:`adapt_tasks`; ``adapter`` chooses the method.
    :return: The returns.
    :raises ValueError: If an argument is out of its range.
    """
    if len(record_at) == 0:
        raise ValueError(
            f"`record_at` must hold at least one number of answers, but is {tuple(record_at)}"
        )
    for k in record_at:
        check_whole("record_at", k, 0)
    check_whole("n_episodes", n_episodes, 1)
    model, vec_env = model_and_env(model, env)
    tasks = _test_tasks(model, vec_env, tasks, seed)
    start, deterministic = evaluation_seed(seed), options.get("deterministic", True)
    outcomes: list[EpisodeOutcomes] = []

    def measure(adapted: TaskAdaptations) -> None:
        latents = adapted.latents[:, -1]
        outcomes.append(
            evaluate_episodes(
                model, vec_env, latents, adapted.tasks, n_episodes, start, deterministic
            )
        )
        if on_record is not None:
            on_record(_evaluation(adapted, outcomes))

    adapted = adapt_tasks(
        model,
        vec_env,
        tasks,
        oracle_factory,
        n_queries=max(1, *record_at),
        record_at=record_at,
        seed=seed,
        progress_bar=progress_bar,
        on_record=measure,
        **options,
    )
    return _evaluation(adapted, outcomes)


def _evaluation(
    adapted: TaskAdaptations, outcomes: Sequence[EpisodeOutcomes]
) -> AdaptationEvaluation:
    """One outcome (n_tasks, n_episodes) for each number of answers."""
    returns = np.stack([outcome.returns for outcome in outcomes], axis=1)
    known = [outcome.successes for outcome in outcomes if outcome.successes is not None]
    successes = np.stack(known, axis=1) if len(known) == len(outcomes) else None
    return AdaptationEvaluation(
        adapted.tasks, adapted.record_at, adapted.latents, returns, adapted.preferences, successes
    )


@dataclass(frozen=True, eq=False)
class KnownTaskReturn:
    """What the model's repertoire holds for each task.

    :param tasks: (n_tasks, task_dim).
    :param returns: (n_tasks, n_episodes) of each task's best latent, on episodes that had no part
        in choosing it.
    :param latents: (n_tasks, latent_dim) those latents.
    :param candidate_latents: (n_latents, latent_dim) all that were tried.
    :param candidate_returns: (n_tasks, n_latents) their returns on every task (J).
    :param successes: (n_tasks, n_episodes), of the episodes of ``returns``; None for a family that
        does not say.
    """

    tasks: np.ndarray
    returns: np.ndarray
    latents: np.ndarray
    candidate_latents: np.ndarray
    candidate_returns: np.ndarray
    successes: np.ndarray | None = None

    def __repr__(self) -> str:
        found = f"mean return {self.mean_return:.1f} of the best of {len(self.candidate_latents)} latents"
        return f"KnownTaskReturn({len(self.tasks)} tasks, {found})"

    @property
    def mean_return(self) -> float:
        """Mean over tasks and episodes."""
        return float(self.returns.mean())

    @property
    def success_rate(self) -> float | None:
        """Share of successful episodes; None for a family that does not say."""
        return None if self.successes is None else float(self.successes.mean())

    def limit(self, k: int, noise_model: NoiseModel | None = None) -> float:
        """The information limit for k answers within this repertoire, see
        :func:`information_limit`.

        :param k: Number of answers.
        :param noise_model: How the oracle errs; None is an oracle that does not.
        :return: A mean return.
        """
        ordered = self.tasks.shape[1] == 1
        returns = (
            self.candidate_returns[np.argsort(self.tasks[:, 0])]
            if ordered
            else self.candidate_returns
        )
        return information_limit(returns, k, noise_model=noise_model, ordered=ordered)


def known_task_return(
    model: Any,
    env: Env,
    tasks: np.ndarray | int | None = None,
    n_latents: int | None = None,
    n_episodes: int = 10,
    seed: int = 0,
    *,
    source: str = "both",
    selection_episodes: int = 1,
    deterministic: bool = True,
) -> KnownTaskReturn:
    """The return if the task were known: for each task the best of many latents.

    Beside the adapted return it tells which to work on: the repertoire of policies, or the
    inference among them. Where tasks share their dynamics every latent is rolled out once, and its
    trajectory relabelled for every task. The winners are then rolled out anew, so that the luck of
    having been chosen does not count.

    :param model: See :func:`adapt_tasks`.
    :param env: See :func:`adapt_tasks`.
    :param tasks: See :func:`evaluate_adaptation`.
    :param n_latents: How many latents to try; None for 300, or for 30 where tasks do not share
        their dynamics and every latent must be rolled out in every task.
    :param n_episodes: Fresh episodes per winner.
    :param seed: Of the draws and the episodes.
    :param source: Where latents come from: "prior", "aggregate", or "both" in equal parts.
    :param selection_episodes: Episodes per latent (and task, where dynamics differ) for choosing.
    :param deterministic: Whether policies act by their mode.
    :return: See :class:`KnownTaskReturn`.
    :raises ValueError: If an argument is out of its range.
    """
    model, vec_env = model_and_env(model, env)
    tasks = _test_tasks(model, vec_env, tasks, seed)
    if n_latents is None:
        n_latents = (
            LATENTS_WITH_SHARED_DYNAMICS
            if FamilyView(vec_env).shared_dynamics
            else LATENTS_WITH_OWN_DYNAMICS
        )
    check_whole("n_latents", n_latents, 1)
    candidates = _draw_latents(model, n_latents, source, np.random.default_rng([seed, 2]))
    returns = return_matrix(
        model,
        vec_env,
        tasks,
        candidates,
        selection_episodes,
        evaluation_seed(seed, 1),
        deterministic,
    )
    best = candidates[np.argmax(returns, axis=1)]
    fresh = evaluate_episodes(
        model, vec_env, best, tasks, n_episodes, evaluation_seed(seed), deterministic
    )
    return KnownTaskReturn(tasks, fresh.returns, best, candidates, returns, fresh.successes)


def return_matrix(
    model: Any,
    vec_env: VecEnv,
    tasks: np.ndarray,
    latents: np.ndarray,
    n_episodes: int = 1,
    seed: int = 0,
    deterministic: bool = True,
) -> np.ndarray:
    """J[i, j], the mean true return on task i of the policy of latent j.

    :param vec_env: A vector environment of the task family. If its tasks share their dynamics each
        latent is rolled out once for all tasks, else once for each.
    :param tasks: (n_tasks, task_dim).
    :param latents: (n_latents, latent_dim).
    :param n_episodes: Episodes to average over.
    :param seed: Where the reset seeds start.
    :param deterministic: Whether policies act by their mode.
    :return: (n_tasks, n_latents).
    :raises ValueError: If shapes do not fit or an episode is not finite.
    """
    tasks, latents = np.asarray(tasks, dtype=np.float64), np.asarray(latents, dtype=np.float64)
    family = FamilyView(vec_env)
    if not family.shared_dynamics:
        rows = np.repeat(tasks, len(latents), axis=0)
        returns = evaluate_latents(
            model, vec_env, np.tile(latents, (len(tasks), 1)), rows, n_episodes, seed, deterministic
        )
        return returns.mean(axis=1).reshape(len(tasks), len(latents))
    # The task in effect does not matter, and it must be one that every copy accepts.
    some_task = np.repeat(tasks[:1], n_episodes * len(latents), axis=0)
    outcomes = rollout_outcomes(
        model, vec_env, np.tile(latents, (n_episodes, 1)), some_task, seed, deterministic
    )
    totals = np.stack(
        [
            family.compute_rewards(tasks[:, None, :], episode.reward_features[None]).sum(axis=1)
            for episode in outcomes
        ],
        axis=1,
    )
    return totals.reshape(len(tasks), n_episodes, len(latents)).mean(axis=1)


def property_one(similarities: np.ndarray, returns: np.ndarray) -> tuple[float, float]:
    """How well S orders policies as true returns do (Property 1).

    :param similarities: (n_tasks, n_policies) S(z_i, z_j).
    :param returns: (n_tasks, n_policies) J[i, j].
    :return: Preference accuracy, the share of pairs of policies with different returns that S puts
        in the right order (a tie of S counts one half); and Kendall's tau-b, averaged over tasks.
        NaN if no task tells any two policies apart.
    :raises ValueError: If the shapes differ.
    """
    similarities, returns = (
        np.asarray(similarities, dtype=np.float64),
        np.asarray(returns, dtype=np.float64),
    )
    if similarities.shape != returns.shape or similarities.ndim != 2:
        raise ValueError(
            f"`similarities` and `returns` must have the same shape (n_tasks, n_policies), but have {similarities.shape} and "
            f"{returns.shape}"
        )
    first, second = np.triu_indices(returns.shape[1], 1)
    order = np.sign(returns[:, first] - returns[:, second])
    guess = np.sign(similarities[:, first] - similarities[:, second])
    decided = np.count_nonzero(order)
    if not decided:
        return float("nan"), float("nan")
    agreement = order * guess
    accuracy = float((0.5 * (1.0 + agreement))[order != 0].mean())
    norms = np.sqrt(np.abs(order).sum(axis=1) * np.abs(guess).sum(axis=1))
    told = np.abs(order).sum(axis=1) > 0
    tau = np.divide(agreement.sum(axis=1), norms, out=np.zeros(len(norms)), where=norms > 0)
    return accuracy, float(tau[told].mean())


def preference_order(model: Any, known: KnownTaskReturn) -> tuple[float, float]:
    """Property 1 on held-out tasks. A held-out task's latent is the best of the candidates for it;
    S between those latents is compared with the returns of their policies on those tasks.

    :param model: A model with ``similarity``.
    :param known: What :func:`known_task_return` found for the tasks.
    :return: Preference accuracy and Kendall's tau, see :func:`property_one`.
    """
    best = np.argmax(known.candidate_returns, axis=1)
    policies = np.unique(best)
    similarities = model.similarities(known.latents, known.candidate_latents[policies])
    return property_one(similarities, known.candidate_returns[:, policies])


def _test_tasks(
    model: Any, vec_env: VecEnv, tasks: np.ndarray | int | None, seed: int
) -> np.ndarray:
    if tasks is None or isinstance(tasks, (int, np.integer)):
        n_tasks = N_TEST_TASKS if tasks is None else int(tasks)
        return FamilyView.for_training(vec_env, model.horizon).test_tasks(n_tasks, seed)
    return np.asarray(tasks, dtype=np.float64)


def evaluation_seed(seed: int, stream: int = 0) -> int:
    """Where the reset seeds of evaluation episodes start: far from those of the questions.

    :param seed: The evaluation's seed.
    :param stream: Different episodes for different purposes.
    :return: A non-negative 30-bit integer.
    """
    return int(np.random.SeedSequence([seed, 3, stream]).generate_state(1)[0] >> 2)


def _draw_latents(model: Any, n: int, source: str, rng: np.random.Generator) -> np.ndarray:
    if source in ("prior", "aggregate"):
        return model.sample_latents(n, rng, source=source)
    if source != "both":
        raise ValueError(f'`source` must be "prior", "aggregate" or "both", but is {source!r}')
    half = n // 2
    return np.concatenate(
        [model.sample_latents(n - half, rng, source="prior")]
        + ([model.sample_latents(half, rng, source="aggregate")] if half else [])
    )
