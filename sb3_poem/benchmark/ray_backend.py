"""Runs cells as Ray Tune trials, on one machine or many, by the same code as the default backend.

Models come first, each a trial that trains it; then the cells. Trials hand their records to this
process, which alone writes the store. Trainings go on from their checkpoints in the folder of runs,
which all machines must share; and the store knows what is finished: so a lost worker's trial is
tried again where it stood, and the same command resumes a whole experiment.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sb3_poem.benchmark.methods import VARIANTS
from sb3_poem.benchmark.models import ModelLibrary, Say, Workplace
from sb3_poem.benchmark.plan import Plan
from sb3_poem.benchmark.store import Record, Store
from sb3_poem.benchmark.suites import Budget, Cell, ModelKey, OracleSpec, Training


@dataclass(frozen=True)
class RayOptions:
    """How to use Ray.

    :param address: Of a cluster; None: the one that this process is connected to, or else one on
        this machine.
    :param cpus: Processor cores of a trial.
    :param gpus: GPUs of a trial.
    :param max_failures: How often a trial is tried again when it fails or its worker is lost.
    """

    address: str | None = None
    cpus: float = 1.0
    gpus: float = 0.0
    max_failures: int = 3


def run_with_ray(
    plan: Plan, library: ModelLibrary, store: Store, options: RayOptions, say: Say = print
) -> list[str]:
    """Run a plan as Tune trials.

    :param library: The models; its folders must be the same on all machines.
    :param store: The results.
    :param options: See there.
    :param say: Takes lines of progress.
    :return: What failed, a line each; the other cells were run all the same.
    :raises ValueError: If Ray is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            f"--backend ray needs Ray: pip install 'sb3_poem[ray]' ({error})"
        ) from error
    workplace = _absolute(library.workplace)
    own = not ray.is_initialized()
    if own:
        ray.init(
            address=options.address,
            log_to_driver=False,
            include_dashboard=False,
            logging_level=logging.ERROR,
        )
    try:
        failures: list[str] = []
        for depth in (False, True):  # what is derived from others comes after them
            keys = [
                key
                for key in plan.models
                if (VARIANTS[key.variant].base is not None) == depth
                and library.state(key) in ("missing", "interrupted")
            ]
            jobs = [{"model": _model_to_dict(key)} for key in keys]
            failures += _run_trials(jobs, list(map(str, keys)), workplace, store, options, say)
        cells = [cell for cell in plan.todo if cell.key not in store]
        jobs = [{"cell": cell_to_dict(cell)} for cell in cells]
        failures += _run_trials(jobs, list(map(str, cells)), workplace, store, options, say)
        return failures
    finally:
        if own:
            ray.shutdown()


def _run_trials(
    jobs: Sequence[dict[str, Any]],
    names: Sequence[str],
    workplace: Workplace,
    store: Store,
    options: RayOptions,
    say: Say,
) -> list[str]:
    """One Tune experiment; returns what failed."""
    if not jobs:
        return []
    from ray import tune

    # Where all machines can see it. Of Tune's own files nothing is needed afterwards: store and
    # runs hold everything.
    storage = Path(workplace.runs) / ".ray" / uuid.uuid4().hex
    storage.mkdir(parents=True)
    try:
        tuner = tune.Tuner(
            tune.with_resources(_trial, {"cpu": options.cpus, "gpu": options.gpus}),
            param_space={
                "workplace": workplace.to_dict(),
                "job": tune.grid_search(
                    [{**job, "name": name} for job, name in zip(jobs, names, strict=True)]
                ),
            },
            run_config=tune.RunConfig(
                storage_path=str(storage),
                failure_config=tune.FailureConfig(max_failures=options.max_failures),
                callbacks=[_keep_records(store.path.absolute(), say)],
                verbose=0,
            ),
        )
        results = tuner.fit()
    finally:
        shutil.rmtree(storage, ignore_errors=True)
    failures = []
    for result in (results[i] for i in range(len(results))):
        if result.error is not None:
            failures.append(
                f"{(result.config or {}).get('job', {}).get('name', 'a trial')}: {result.error}"
            )
    return failures


def _keep_records(store: Path, say: Say) -> Any:
    """A callback that keeps each record when it arrives, so that losing this process loses no
    finished cell. Tune pickles it with everything else, hence the path.
    """
    from ray import tune

    class KeepRecords(tune.Callback):
        def on_trial_result(
            self, iteration: int, trials: list, trial: Any, result: dict, **info: Any
        ) -> None:
            if result.get("record"):
                with Store(store) as opened:
                    opened.add(Record(**json.loads(result["record"])))
            if "name" in result:
                say(f"finished {result['name']}")

    return KeepRecords()


def _trial(config: dict[str, Any]) -> None:
    """What a trial runs, in a worker."""
    from ray import tune

    from sb3_poem.benchmark.cells import run_cell

    job, library = config["job"], ModelLibrary(Workplace.from_dict(config["workplace"]))
    record = ""
    if "model" in job:
        library.ensure(_model_from_dict(job["model"]), print)
    else:
        record = json.dumps(run_cell(cell_from_dict(job["cell"]), library, print).to_dict())
    tune.report({"record": record, "name": job["name"]})


def _absolute(workplace: Workplace) -> Workplace:
    """Workers have other working folders."""
    return replace(
        workplace,
        runs=os.path.abspath(workplace.runs),
        models=tuple(map(os.path.abspath, workplace.models)),
        named=tuple(
            (family, variant, seed, str(Path(path).absolute()))
            for family, variant, seed, path in workplace.named
        ),
    )


def _training_to_dict(training: Training) -> dict[str, Any]:
    return {
        "timesteps": training.timesteps,
        "hyperparameters": [list(pair) for pair in training.hyperparameters],
    }


def _training_from_dict(data: dict[str, Any]) -> Training:
    return Training(
        data["timesteps"], tuple((str(name), value) for name, value in data["hyperparameters"])
    )


def _model_to_dict(key: ModelKey) -> dict[str, Any]:
    return {
        "env_id": key.env_id,
        "variant": key.variant,
        "seed": key.seed,
        "training": _training_to_dict(key.training),
    }


def _model_from_dict(data: dict[str, Any]) -> ModelKey:
    return ModelKey(
        data["env_id"], data["variant"], data["seed"], _training_from_dict(data["training"])
    )


def cell_to_dict(cell: Cell) -> dict[str, Any]:
    """A cell as plain data, which :func:`cell_from_dict` reads.

    :return: A dictionary.
    """
    return {
        "env_id": cell.env_id,
        "method": cell.method,
        "seed": cell.seed,
        "oracle": {"kind": cell.oracle.kind, "value": cell.oracle.value},
        "budget": {**vars(cell.budget), "record_at": list(cell.budget.record_at)},
        "training": _training_to_dict(cell.training),
        "snapshot": cell.snapshot,
        "overrides": [list(pair) for pair in cell.overrides],
    }


def cell_from_dict(data: dict[str, Any]) -> Cell:
    """Read what :func:`cell_to_dict` wrote.

    :param data: The dictionary.
    :return: The cell.
    """
    budget = {**data["budget"], "record_at": tuple(data["budget"]["record_at"])}
    return Cell(
        data["env_id"],
        data["method"],
        data["seed"],
        OracleSpec(**data["oracle"]),
        Budget(**budget),
        _training_from_dict(data["training"]),
        data["snapshot"],
        tuple((str(name), value) for name, value in data["overrides"]),
    )
