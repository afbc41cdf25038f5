"""What a run will do: which cells are done, which are to do, which cannot be done, and what must be
trained for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from sb3_poem.benchmark.estimate import Pace, cell_seconds, measure_pace, training_seconds
from sb3_poem.benchmark.families import family_facts
from sb3_poem.benchmark.hyperparameters import training_plan
from sb3_poem.benchmark.methods import VARIANTS
from sb3_poem.benchmark.models import ModelLibrary
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import Budget, Cell, ModelKey, Suite, Training


@dataclass
class Plan:
    """A run.

    :param todo: Cells to be run, in order.
    :param done: Cells that the store has.
    :param skipped: Cells that cannot be run, with the reason.
    """

    todo: list[Cell] = field(default_factory=list)
    done: list[Cell] = field(default_factory=list)
    skipped: list[tuple[Cell, str]] = field(default_factory=list)

    def __str__(self) -> str:
        return (
            f"{len(self.done)} cells done, {len(self.todo)} to do, {len(self.skipped)} not possible"
        )

    @property
    def models(self) -> list[ModelKey]:
        """What the cells to be run need, each once, a variant after its base."""
        keys: dict[ModelKey, None] = {}
        for cell in self.todo:
            key = cell.model_key
            base = VARIANTS[key.variant].base
            if base is not None:
                keys[ModelKey(key.env_id, base, key.seed, key.training)] = None
            keys[key] = None
        return list(keys)


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
    """Look at what there is.

    :param library: Models.
    :param store: Results; None: none yet.
    :param families: Names or ids; None: the suite's own.
    :param methods: Only these; None: all of the suite, without those that cannot run on a family.
    :param budget: Numbers of tasks and episodes.
    :param training: What differs from the hyperparameter files.
    :param snapshots: See :meth:`Suite.cells`.
    :return: The plan.
    :raises ValueError: If a family or method does not exist, a method that was named cannot run on
        a family, or there are no hyperparameters for a model that is missing.
    """
    plan = Plan()
    facts = {fact.env_id: fact for fact in map(family_facts, families or suite.families)}
    finished = set() if store is None else store.keys()
    origins: dict[ModelKey, str] = {}
    for cell in suite.cells(list(facts), seeds, methods, budget, training, snapshots):
        objection = cell.definition.objection(facts[cell.env_id].shared_dynamics)
        if objection is not None and methods:
            raise ValueError(f"--methods {cell.method} cannot run on {cell.family}: {objection}")
        if objection is not None:
            plan.skipped.append((cell, f"{cell.method} cannot run on {cell.family}: {objection}"))
            continue
        if cell.model_key not in origins:
            origins[cell.model_key] = library.origin(cell.model_key)
        cell = replace(cell, model=origins[cell.model_key])
        if cell.key in finished:
            plan.done.append(cell)
        elif cell.snapshot is not None and not library.has_snapshots(cell.model_key):
            plan.skipped.append(
                (cell, "the model was handed over, without those along its training")
            )
        else:
            plan.todo.append(cell)
    plan.todo = _in_order(plan.todo)
    return plan


def describe(plan: Plan, library: ModelLibrary) -> list[str]:
    """The plan in lines, with an estimate of its time on this machine, which takes a few seconds
    for each family.

    :param library: Models.
    :return: Lines.
    """
    lines = [str(plan)]
    reasons: dict[str, int] = {}
    for _, reason in plan.skipped:
        reasons[reason] = reasons.get(reason, 0) + 1
    lines += [f"  not possible, {count} cells: {reason}" for reason, count in reasons.items()]
    place = library.workplace

    def pace(env_id: str) -> Pace:
        return measure_pace(env_id, place.device, place.num_threads)

    seconds = 0.0
    if plan.models:
        lines.append("models:")
    for key in plan.models:
        state = library.state(key)
        text = f"  {key}: {state}"
        if state in ("missing", "interrupted"):
            estimate = training_seconds(key, pace(key.env_id))
            seconds += estimate
            base = VARIANTS[key.variant].base
            if base is None:
                training = training_plan(key)
                text += f", {training.timesteps:,} steps, {training.updates:,} updates"
            else:
                text += f", from the experience of {base}"
            text += f", about {_minutes(estimate)}" + (
                " if from scratch" if state == "interrupted" else ""
            )
        elif state == "handed over":
            text += f" ({library.given(key)})"
        lines.append(text)
    if plan.todo:
        lines.append("cells:")
        lines += [f"  {cell}" for cell in plan.todo]
        seconds += sum(cell_seconds(cell, pace(cell.env_id)) for cell in plan.todo)
        lines.append(
            f"about {_minutes(seconds)} in one process, if this machine stays as busy as it is"
        )
    return lines


def _in_order(cells: list[Cell]) -> list[Cell]:
    """By family and seed as they come, then by model, its final cells before those along its
    training.
    """
    groups: dict[tuple[str, int], int] = {}
    models: dict[ModelKey, int] = {}
    for cell in cells:
        groups.setdefault((cell.env_id, cell.seed), len(groups))
        models.setdefault(cell.model_key, len(models))
    return sorted(
        cells,
        key=lambda cell: (
            groups[cell.env_id, cell.seed],
            models[cell.model_key],
            cell.snapshot is not None,
        ),
    )


def _minutes(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds >= 5400 else f"{max(1, round(seconds / 60))} min"
