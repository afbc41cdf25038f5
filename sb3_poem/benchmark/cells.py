"""One cell: load the model, adapt, measure, and note everything; and verify it."""

import textwrap
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation import BoltzmannOracle, MistakeOracle, ReturnOracle, TaskOracle
from sb3_poem.adaptation.evaluation import Library, evaluate_adaptation
from sb3_poem.adaptation.known_task import (
    SELECTION_EPISODES,
    known_task_return,
    preference_order,
    return_spread,
)
from sb3_poem.adaptation.meta_model import HasSimilarity
from sb3_poem.adaptation.preference import Preference
from sb3_poem.baselines import ANOLE, MAMLRewardModel, rollout_fragments
from sb3_poem.baselines.anole import has_experience
from sb3_poem.baselines.fragments import default_fragment_length
from sb3_poem.benchmark.models import ModelLibrary, Say
from sb3_poem.benchmark.provenance import provenance
from sb3_poem.benchmark.store import Record, Store
from sb3_poem.benchmark.suites import REVISION, Cell, OracleSpec
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.vec_env import make_task_vec_env

SEED_STRIDE = 10_000
DIGITS = 4  # of returns in the store
#: How a result writes answers
LETTERS = dict(zip(Preference, "LlerR1234", strict=True))
#: What a result holds that is another at each run
TIMES = ("seconds", "training_seconds", "training_cpu_seconds")


def run_cell(cell: Cell, library: ModelLibrary, say: Say = print) -> Record:
    """Run one cell. Its model is trained first if it is missing."""
    training = library.ensure(cell.model_key, say)
    th.set_num_threads(library.workplace.num_threads)
    env = make_task_vec_env(cell.env_id, 2 * cell.budget.tasks)
    try:
        model = library.load(cell.model_key, env, cell.snapshot)
        tasks = FamilyView(env).test_tasks(cell.budget.tasks, cell.budget.task_seed)
        started = time.perf_counter()
        measure = _measure_known if cell.definition.rule is None else _measure_adaptation
        result = measure(cell, model, env, tasks)
        result["seconds"] = round(time.perf_counter() - started, 2)
    finally:
        env.close()
    if isinstance(model, MAMLRewardModel):
        samples, updates = training["env_steps"], training["updates"]
    else:
        samples, updates = int(model.num_timesteps), int(model._n_updates)
    result |= {"training_samples": samples, "updates": updates}
    result |= {f"training_{name}": training.get(name) for name in ("seconds", "cpu_seconds")}
    if cell.snapshot is not None:
        training = {**training, "snapshot": cell.snapshot}
    place = library.workplace
    about = {**provenance(), "device": place.device, "num_threads": place.num_threads}
    which = (cell.key, cell.family, cell.method, cell.seed, cell.identity())
    return Record(*which, result, {**about, "model": training})


def make_oracle_factory(
    spec: OracleSpec, question: str = "pair", spread: float | None = None
) -> Callable[..., TaskOracle]:
    """A function of ``env``, ``task`` and ``seed``. With the family's spread of returns, which
    graded answers need (:func:`~sb3_poem.adaptation.return_spread`), it has thresholds.
    """
    kinds: dict[str, Any] = {"boltzmann": BoltzmannOracle, "mistake": MistakeOracle}
    own = () if spec.kind == "return" else (spec.value,)
    thresholds = None if spread is None else tuple(spread * share for share in spec.thresholds)

    def make(*given: Any, **named: Any) -> TaskOracle:
        how = {"question": question, "thresholds": thresholds}
        oracle: TaskOracle = kinds.get(spec.kind, ReturnOracle)(*own, *given, **how, **named)
        if spec.told is not None:
            oracle.noise_model = make_oracle_factory(spec.told)().noise_model
        return oracle

    return make


def _episode_seed(cell: Cell) -> int:
    """Task i takes what follows it by i; seeds lie further apart than there are tasks."""
    return cell.budget.task_seed + SEED_STRIDE * cell.seed


def _measure_adaptation(cell: Cell, model: Any, env: VecEnv, tasks: np.ndarray) -> dict[str, Any]:
    rule, budget = cell.definition.make_rule(**dict(cell.overrides)), cell.budget
    fragments: Library | None = None
    shown: dict[str, Any] = {}
    if cell.definition.library:
        n, source = 2 * budget.record_at[-1], rule.to_dict()["options"]["candidates"]
        rng = np.random.default_rng([_episode_seed(cell), 8])

        def fragments(task: np.ndarray) -> list[Trajectory]:
            latents = model.sample_latents(n, rng, source=source)
            seed = int(rng.integers(2**31))
            return rollout_latents(model, env, latents, np.repeat(task[None], n, axis=0), seed)

        shown = {"fragments": "rollouts of the new task", "fragment_length": model.horizon}
        rolled_out = n * len(tasks)
    elif isinstance(rule, ANOLE):
        length = rule.fragment_length or default_fragment_length(model.horizon)
        source = "replay buffer"
        if not has_experience(model):
            source = "rollouts of the training tasks"
            fragments = rollout_fragments(model, env, 2 * rule.n_pairs, length, cell.seed)
        shown = {"fragments": source, "fragment_length": length}
        rolled_out = 0  # on the new tasks
    how: dict[str, Any] = {"rule": rule, "record_at": budget.record_at, "library": fragments}
    how |= {"n_episodes": budget.episodes, "seed": _episode_seed(cell)}
    question, films = cell.definition.question, cell.definition.films
    spread = return_spread(model, env) if question == "graded" else None
    oracles = make_oracle_factory(cell.oracle, question, spread)
    evaluation = evaluate_adaptation(model, env, tasks, oracles, **how)
    answers = ["".join(map(LETTERS.__getitem__, row)) for row in evaluation.preferences]
    data: dict[str, Any] = {
        "queries": list(evaluation.record_at),
        "tasks": _rounded(tasks),
        "task_returns": _rounded(evaluation.task_returns),
        "task_deviations": _rounded(evaluation.returns.std(axis=2)),
        "answers": answers,
        "adaptation_trajectories": rolled_out if shown else films * sum(map(len, answers)),
        **shown,
    }
    if evaluation.successes is not None:
        data["task_success_rates"] = _rounded(evaluation.successes.mean(axis=2))
    return data


def _measure_known(cell: Cell, model: Any, env: VecEnv, tasks: np.ndarray) -> dict[str, Any]:
    """Returns of the best of the model's policies for each task, and the limits."""
    budget = cell.budget
    episodes = min(budget.episodes, SELECTION_EPISODES)
    how: dict[str, Any] = {"n_episodes": budget.episodes, "selection_episodes": episodes}
    known = known_task_return(model, env, tasks, seed=_episode_seed(cell), **how)
    data: dict[str, Any] = {
        "tasks": _rounded(tasks),
        "task_returns": _rounded(known.returns.mean(axis=1)),
        "limits": {name: _rounded(value) for name, value in vars(known.limits).items()},
    }
    if known.successes is not None:
        data["task_success_rates"] = _rounded(known.successes.mean(axis=1))
    if isinstance(model, HasSimilarity):
        names = "preference_accuracy", "kendall_tau"
        order = zip(names, preference_order(model, known), strict=True)
        # JSON has no NaN
        data |= {name: None if np.isnan(value) else round(value, 6) for name, value in order}
    return data


def _rounded(values: Any) -> Any:
    return np.round(np.asarray(values, dtype=np.float64), DIGITS).tolist()


def find_record(store: Store, cell_id: str) -> Record:
    """The finished cell of a key, or of the beginning of one."""
    found = [record for record in store.records() if record.key.startswith(cell_id)]
    if len(found) != 1:
        many = f"is the beginning of {len(found)} keys" if found else "is no cell's key"
        lists = "`sb3-poem benchmark verify` without --cell lists them"
        raise ValueError(f"--cell {cell_id} {many} in {store.path}; {lists}")
    return found[0]


def verify_cell(record: Record, library: ModelLibrary, say: Say = print) -> list[str]:
    """Run a finished cell again and compare with its record, number by number as the store holds
    them, times left out. What differs, a line each; nothing if nothing does.

    :raises ValueError: If the record is of another revision of the code, its identity does not have
        its key, or its model is not there
    """
    if record.identity["revision"] != REVISION:
        raise ValueError(
            f"cell {record.key} is of revision {record.identity['revision']} of the code, and this "
            f"is {REVISION}: check out commit {record.provenance.get('commit')}"
        )
    cell = Cell.of_identity(record.method, record.identity)
    if cell.key != record.key:
        changed = "it was changed after the cell was run"
        raise ValueError(f"the identity of cell {record.key} has the key {cell.key}: {changed}")
    origin, state = library.origin(cell.model_key), library.state(cell.model_key)
    # What was handed over may be this model under another name: its figures tell.
    is_told = state == "handed over" and cell.snapshot is None
    if not is_told and (origin != cell.model or state != "trained"):
        raise ValueError(
            f"cell {record.key} needs the model of {cell.model!r}, but for {cell.model_key} there "
            f"is that of {origin!r}, {state}: say where it is by --runs, --models or --model"
        )
    again = run_cell(cell, library, say)
    kept, found = ({**one.result, **dict.fromkeys(TIMES)} for one in (record, again))
    lines = list(_differences("", kept, found))
    if lines:  # another model, other code, versions or machines may be why
        if origin != cell.model:
            lines.append(f"  model: {cell.model} then, {origin} here")
        for name in ("commit", "machine", "device", "num_threads", "versions"):
            then, now = record.provenance.get(name), again.provenance.get(name)
            if then != now:
                lines.append(f"  {name}: {then} then, {now} here")
    return lines


def _differences(name: str, kept: Any, found: Any) -> Iterator[str]:
    if kept == found:
        return
    if isinstance(kept, dict) and isinstance(found, dict):
        for part in sorted(kept.keys() | found.keys()):
            whole = f"{name}.{part}".lstrip(".")
            yield from _differences(whole, kept.get(part), found.get(part))
        return
    try:
        one, other = np.array(kept, dtype=np.float64), np.array(found, dtype=np.float64)
        alike = one.shape == other.shape
    except (TypeError, ValueError):  # text
        alike = False
    if not alike:
        then, now = (textwrap.shorten(str(one), 200) for one in (kept, found))
        yield f"{name}: the store has {then}, and this run {now}"
        return
    gaps = np.abs(one - other)
    place = np.unravel_index(np.argmax(gaps), gaps.shape)
    yield (
        f"{name}: {np.count_nonzero(gaps)} of {gaps.size} numbers differ, the most at "
        f"{[int(i) for i in place]}: the store has {one[place]:g}, and this run {other[place]:g}"
    )
