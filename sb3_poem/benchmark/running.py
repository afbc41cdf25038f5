"""What a run will do, and doing it in this process, one cell after another."""

import contextlib
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sb3_poem.adaptation.limits import AnswerLimits
from sb3_poem.benchmark.cells import run_cell
from sb3_poem.benchmark.estimate import cell_seconds, measure_pace, training_seconds
from sb3_poem.benchmark.models import ModelLibrary, Say, locked, try_lock
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import (
    Budget,
    Cell,
    ModelKey,
    Suite,
    Training,
    family_id,
    family_label,
)
from sb3_poem.benchmark.training import FamilyFacts, family_facts, training_plan
from sb3_poem.common.vec_env import make_task_vec_env


@dataclass
class Plan:
    """Cells to be run, in order; that the store has; and that cannot be run, with the reason."""

    todo: list[Cell] = field(default_factory=list)
    done: list[Cell] = field(default_factory=list)
    skipped: list[tuple[Cell, str]] = field(default_factory=list)

    def __str__(self) -> str:
        done, todo, skipped = len(self.done), len(self.todo), len(self.skipped)
        return f"{done} cells done, {todo} to do, {skipped} not possible"

    @property
    def models(self) -> list[ModelKey]:
        """What the cells to be run need, each once, a variant after its base."""
        keys = [key for cell in self.todo for key in (cell.model_key.base, cell.model_key)]
        return list(filter(None, dict.fromkeys(keys)))


def make_plan(
    suite: Suite,
    library: ModelLibrary,
    store: Store | None,
    families: Sequence[str] | None,
    methods: Sequence[str] | None,
    seeds: Sequence[int],
    budget: Budget,
    training: Training,
    snapshots: int | None = None,
) -> Plan:
    """Look at what there is, in a store if there is one yet. For ``families``, ``methods`` and
    ``snapshots`` None is the suite's own; then methods are left out where they cannot run, families
    where their extra is missing.
    """
    plan = Plan()
    facts: dict[str, FamilyFacts] = {}
    missing: dict[str, str] = {}
    for name in families or suite.families:
        try:
            facts[family_id(name)] = family_facts(name)
        except ImportError as error:
            if families:
                raise ValueError(f"--families {name}: {error}") from error
            missing[family_id(name)] = f"{family_label(name)}: {error}"
    finished = set() if store is None else store.keys()
    origins: dict[ModelKey, str] = {}
    for cell in suite.cells([*facts, *missing], seeds, methods, budget, training, snapshots):
        if cell.env_id in missing:
            plan.skipped.append((cell, missing[cell.env_id]))
            continue
        key = cell.model_key
        objection = cell.definition.objection(facts[cell.env_id].shared_dynamics)
        if objection is not None:
            reason = f"{cell.method} cannot run on {cell.family}: {objection}"
            if methods:
                raise ValueError(f"--methods {reason}")
            plan.skipped.append((cell, reason))
            continue
        if key not in origins:
            origins[key] = library.origin(key)
        cell = replace(cell, model=origins[key])
        if cell.key in finished:
            plan.done.append(cell)
        elif cell.snapshot is not None and library.given(key) is not None:
            reason = "the model was handed over, without those along its training"
            plan.skipped.append((cell, reason))
        else:
            plan.todo.append(cell)
    # By model as they come (family by family, and seed by seed), the final cells first
    order = list(dict.fromkeys(cell.model_key for cell in plan.todo))
    plan.todo.sort(key=lambda cell: (order.index(cell.model_key), cell.snapshot is not None))
    return plan


def describe(plan: Plan, library: ModelLibrary) -> list[str]:
    """The plan in lines, with an estimate of its time, which takes a few seconds a family."""
    reasons = Counter(reason for _, reason in plan.skipped)
    lines = [str(plan)]
    lines += [f"  not possible, {count} cells: {reason}" for reason, count in reasons.items()]
    device, threads = library.workplace.device, library.workplace.num_threads
    seconds = 0.0
    if plan.models:
        lines.append("models:")
    for key in plan.models:
        state = library.state(key)
        text = f"  {key}: {state}"
        if state == "handed over":
            text += f" ({library.given(key)})"
        elif state != "trained":
            estimate = training_seconds(key, measure_pace(key.env_id, device, threads))
            seconds += estimate
            if key.base is None:
                training = training_plan(key)
                text += f", {training.timesteps:,} steps, {training.updates:,} updates"
            else:
                text += f", from the experience of {key.base.variant}"
            text += f", about {_minutes(estimate)}"
            text += " if from scratch" if state == "interrupted" else ""
        lines.append(text)
    if plan.todo:
        lines += ["cells:", *(f"  {cell}" for cell in plan.todo)]
        for cell in plan.todo:
            seconds += cell_seconds(cell, measure_pace(cell.env_id, device, threads))
        alike = "in one process, if this machine stays as busy as it is"
        lines.append(f"about {_minutes(seconds)} {alike}")
    return lines


def _minutes(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 5400 else f"{max(1, round(seconds / 60))} min"


def run_cells(
    cells: Sequence[Cell], library: ModelLibrary, store: Store, say: Say = print
) -> list[str]:
    """Run cells, and keep each as soon as it is finished; what failed, a line each. What another
    process is at, or has finished, is left to it, and cells whose model it is training come last.
    """
    failures: list[str] = []
    postponed: list[Cell] = []
    broken: dict[ModelKey | None, str] = {}

    def run_one(cell: Cell, place: str) -> None:
        if cell.key in store:
            return
        key = cell.model_key
        if (why := broken.get(key, broken.get(key.base))) is not None:  # a training that failed
            failures.append(f"{cell}: {why}")
            return
        say(f"{place} {cell}")
        try:
            record = run_cell(cell, library, say)
            store.add(record)
        except Exception as error:
            traceback.print_exc()
            failures.append(f"{cell}: {error}")
            if library.state(key) not in ("handed over", "trained"):
                broken[key] = str(error)
            return
        say(f"    {summary(record.result)}, {record.result['seconds']:.0f} s")

    def lock_file(cell: Cell) -> Path:
        # beside the store, wherever each process keeps its models
        path = store.path.resolve()
        return path.with_name(f".{path.name}.locks") / cell.key

    for position, cell in enumerate(cells, start=1):
        with try_lock(lock_file(cell)) as mine:
            if mine and (cell.key in store or not library.is_taken(cell.model_key)):
                run_one(cell, f"[{position}/{len(cells)}]")
            else:
                postponed.append(cell)
    for cell in postponed:  # whoever has them, or trains for them, may have died
        wait = f"waiting for another process: {cell}"
        with locked(lock_file(cell), lambda wait=wait: say(wait)):  # type: ignore[misc]
            run_one(cell, "[postponed]")
    return failures


def summary(result: dict) -> str:
    """The mean returns of a result in a line."""
    means = np.mean(result["task_returns"], axis=0)
    if "queries" not in result:
        return f"return {means:.1f}"
    return ", ".join(f"{k}: {mean:.1f}" for k, mean in zip(result["queries"], means, strict=True))


def export_model(cells: Sequence[Cell], library: ModelLibrary, store: Store, folder: Path) -> None:
    """Write the model of finished cells as a pretrained folder, with what it earns on its card."""
    records = {record.key: record for record in store.records()}
    found = {cell.definition.rule: records[cell.key] for cell in cells}
    known = found.pop(None)
    limits, rates = AnswerLimits(**known.result["limits"]), "task_success_rates"
    adaptations = []
    for rule, record in found.items():
        result = record.result
        figures = {
            "inference": str(rule).lower(),
            "queries": result["queries"],
            "mean_return": np.mean(result["task_returns"], axis=0).tolist(),
            "limit": [limits.after(k) for k in result["queries"]],
            "known_task_return": float(np.mean(known.result["task_returns"])),
        }
        if rates in known.result:
            figures["success_rate"] = np.mean(result[rates], axis=0).tolist()
            figures["known_task_success_rate"] = float(np.mean(known.result[rates]))
        adaptations.append(figures)
    training = known.provenance["model"]
    order = {name: known.result[name] for name in ("preference_accuracy", "kendall_tau")}
    order |= {"env_steps": known.result["training_samples"], "updates": known.result["updates"]}
    tasks = f"adaptation to {len(known.result['tasks'])} unseen tasks"
    card: dict[str, Any] = {
        **training.get("card", {}),  # of a model that was handed over
        **{name: training[name] for name in ("command", "commit", "machine") if name in training},
        "seed": cells[0].seed,
        "wall_seconds": training.get("seconds"),
        "cpu_seconds": training.get("cpu_seconds"),
        "results": {tasks: adaptations, "property 1": order},
    }
    with contextlib.closing(make_task_vec_env(cells[0].env_id, 1)) as env:
        library.load(cells[0].model_key, env).save_pretrained(folder, card)
