"""Adaptation to many tasks at once: their rollouts fill a vector environment."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sb3_poem.adaptation.bayes import Bayes
from sb3_poem.adaptation.environments import Env, model_and_env, warn_if_untrained
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.preference import PLACES, Preference, as_preference
from sb3_poem.adaptation.rule import Rule, Setting, as_rule, inference_rng, latent_of, rollout_seed
from sb3_poem.common.checks import check_whole, check_whole_numbers
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory

OracleFactory = Callable[..., Callable[..., Any]]
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
    rounding, and for action noise with ``deterministic=False``. The tasks are set in ``env``, and
    known to the oracles; a rule that infers from answers never sees them. Arguments that are not
    explained here are those of :class:`PreferenceAdapter`.

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
    tasks = np.asarray(tasks, dtype=np.float64)
    if tasks.ndim != 2 or len(tasks) < 1:
        expected = "shape (n_tasks, task_dim) with at least one task"
        raise ValueError(f"`tasks` must have {expected}, but has shape {tasks.shape}")
    check_whole("seed", seed, 0)
    check_whole("n_queries", n_queries, 1)
    record_at = range(n_queries + 1) if record_at is None else record_at
    kept = check_whole_numbers("record_at", record_at, 0, n_queries)
    numbered = list(enumerate(tasks, seed))
    oracles = [oracle_factory(env=vec_env, task=task, seed=number) for number, task in numbered]
    rule = (Bayes() if rule is None else as_rule(rule)).answered_by(oracles[0])
    libraries = [library(task) if callable(library) else library for task in tasks]
    rule.check(model, Setting(n_queries, libraries[0], vec_env))
    warn_if_untrained(model)
    inferences = [
        rule.start(model, inference_rng(number), Setting(n_queries, own, vec_env, task))
        for own, (number, task) in zip(libraries, numbered, strict=True)
    ]

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
                policies = np.stack([latent_of(item) for item in asked])
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
