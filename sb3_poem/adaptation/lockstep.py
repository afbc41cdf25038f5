"""Adaptation to many tasks at once: their rollouts fill a vector environment."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.adaptation.environments import Env, model_and_env, warn_if_untrained
from sb3_poem.adaptation.options import inference_rng, rollout_seed
from sb3_poem.adaptation.preference import Preference, as_preference
from sb3_poem.common.checks import check_whole
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory

OracleFactory = Callable[..., Callable[[Trajectory, Trajectory], Any]]


@dataclass(frozen=True, eq=False)
class TaskAdaptations:
    """Many tasks, adapted.

    :param tasks: (n_tasks, task_dim).
    :param record_at: Numbers of answers at which estimates were kept, ascending.
    :param latents: (n_tasks, len(record_at), latent_dim).
    :param preferences: A task's answers in order.
    """

    tasks: np.ndarray
    record_at: tuple[int, ...]
    latents: np.ndarray
    preferences: list[list[Preference]]

    def __repr__(self) -> str:
        return f"TaskAdaptations({len(self.tasks)} tasks, after {', '.join(map(str, self.record_at))} answers)"


def adapt_tasks(
    model: Any,
    env: Env,
    tasks: np.ndarray,
    oracle_factory: OracleFactory,
    *,
    adapter: type[PreferenceAdapter] = PreferenceAdapter,
    n_queries: int = 10,
    record_at: Sequence[int] | None = None,
    seed: int = 0,
    library: Sequence[Trajectory] | None = None,
    progress_bar: bool = False,
    on_record: Callable[[TaskAdaptations], None] | None = None,
    **options: Any,
) -> TaskAdaptations:
    """Adapt a model to each of many tasks, with all rollouts of a question in lockstep.

    Task i is adapted as ``adapter(model, env, seed=seed + i, ...)`` would alone: with the same
    candidates, questions and reset seeds. (Matrix products may round otherwise in a batch than
    alone, in the last bits; and with ``deterministic=False`` the actions' noise is drawn for all
    rollouts of a question together.) The tasks are set in ``env`` for the rollouts, and known to
    the oracles; inference never sees them.

    :param model: See :class:`PreferenceAdapter`.
    :param env: See :class:`PreferenceAdapter`; a task family. Any number of copies will do; twice
        the number of tasks is best, and an id makes 60.
    :param tasks: (n_tasks, task_dim).
    :param oracle_factory: Called as ``oracle_factory(env=vec_env, task=task, seed=seed + i)``,
        gives task i's oracle. The oracles' classes will do, and ``functools.partial(MistakeOracle,
        0.1)``.
    :param adapter: The method: :class:`PreferenceAdapter`, or a baseline's adapter that ends in a
        latent.
    :param n_queries: Answers per task.
    :param record_at: Numbers of answers at which to keep the estimate; None keeps 0, 1, ...,
        n_queries.
    :param seed: Task i takes seed + i.
    :param library: See :class:`PreferenceAdapter`.
    :param progress_bar: Whether to show one.
    :param on_record: Called with all that there is so far, each time that estimates are kept. It
        may use ``vec_env``.
    :param options: Further options of the adapter; for :class:`PreferenceAdapter` ``inference``,
        ``query_rule``, ``n_candidates``, ``epsilon``, ``candidates``, ``likelihood``, ``decision``,
        ``noise_model``, ``deterministic``.
    :return: The estimates.
    :raises ValueError: If an argument is out of its range, or the model belongs to another
        environment.
    :raises TypeError: If an argument is of another kind.
    """
    from tqdm import tqdm

    model, vec_env = model_and_env(model, env)
    _check_factory(oracle_factory)
    tasks = np.asarray(tasks, dtype=np.float64)
    if tasks.ndim != 2 or len(tasks) < 1:
        raise ValueError(
            f"`tasks` must have shape (n_tasks, task_dim) with at least one task, but has shape {tasks.shape}"
        )
    check_whole("seed", seed, 0)
    kept = _check_record_at(record_at, n_queries)
    oracles = [
        oracle_factory(env=vec_env, task=task, seed=seed + i) for i, task in enumerate(tasks)
    ]
    settings = adapter.make_options(oracles[0], n_queries=n_queries, **options)
    settings.check(model, vec_env, library)
    warn_if_untrained(model)
    inferences = [
        settings.make_inference(model, inference_rng(seed + i), library) for i in range(len(tasks))
    ]

    for inference, task in zip(inferences, tasks, strict=True):
        if hasattr(inference, "bind"):  # a method that is allowed to read rewards
            inference.bind(vec_env, task)

    preferences: list[list[Preference]] = [[] for _ in tasks]
    latents = np.empty((len(tasks), len(kept), model.latent_dim))
    for query in tqdm(range(n_queries + 1), unit="query", disable=not progress_bar):
        if query in kept:
            row = kept.index(query)
            latents[:, row] = [inference.estimate() for inference in inferences]
            if on_record is not None:
                on_record(
                    TaskAdaptations(
                        tasks,
                        kept[: row + 1],
                        latents[:, : row + 1].copy(),
                        list(map(list, preferences)),
                    )
                )
        if query == n_queries or query >= kept[-1]:
            break
        shown: list[Trajectory] = []
        if inferences[0].library is None:
            pairs = [inference.ask_latents() for inference in inferences]
            seeds = [rollout_seed(seed + i, query) for i in range(len(tasks))]
            shown = rollout_latents(
                model,
                vec_env,
                np.concatenate(pairs),
                np.repeat(tasks, 2, axis=0),
                np.repeat(seeds, 2).tolist(),
                settings.deterministic,
            )
        else:
            for inference in inferences:
                shown += [inference.library[index] for index in inference.ask_library()]
        for i, (inference, oracle) in enumerate(zip(inferences, oracles, strict=True)):
            left, right = shown[2 * i], shown[2 * i + 1]
            answer = as_preference(oracle(left, right))
            inference.tell(answer, left, right)
            preferences[i].append(answer)
    return TaskAdaptations(tasks, kept, latents, preferences)


def _check_factory(oracle_factory: OracleFactory) -> None:
    try:
        inspect.signature(oracle_factory).bind(env=None, task=None, seed=0)
    except (TypeError, ValueError) as error:
        raise TypeError(
            "`oracle_factory` must be called as oracle_factory(env=..., task=..., seed=...) and return a "
            "task's oracle, such as the class ReturnOracle or functools.partial(MistakeOracle, 0.1), but "
            f"is {oracle_factory!r}: {error}"
        ) from error


def _check_record_at(record_at: Sequence[int] | None, n_queries: int) -> tuple[int, ...]:
    check_whole("n_queries", n_queries, 1)
    if record_at is None:
        return tuple(range(n_queries + 1))
    for k in record_at:
        check_whole("record_at", k, 0)
    kept = tuple(sorted({int(k) for k in record_at}))
    if not kept or kept[-1] > n_queries:
        raise ValueError(
            f"`record_at` must hold numbers from 0 to n_queries={n_queries}, but is {tuple(record_at)}"
        )
    return kept
