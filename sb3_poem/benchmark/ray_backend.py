"""Runs cells as Ray Tune trials, on one machine or many, by the same code as the default backend.

Models come first, each a trial that trains it; then the cells. Trials hand their records to this
process, which alone writes the store. Trainings go on from their checkpoints in the folder of runs,
which all machines must share: so a lost worker's trial is tried again where it stood, and the same
command resumes a whole experiment.
"""

import importlib
import json
import logging
import shutil
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_poem.benchmark.cells import run_cell
from sb3_poem.benchmark.models import ModelLibrary, Say, Workplace
from sb3_poem.benchmark.running import Plan
from sb3_poem.benchmark.store import Record, Store
from sb3_poem.benchmark.suites import Cell, ModelKey


def run_with_ray(
    plan: Plan,
    library: ModelLibrary,
    store: Store,
    address: str | None,
    resources: Mapping[str, float],
    max_failures: int,
    say: Say,
) -> list[str]:
    """Run a plan as Tune trials; what failed, a line each. The library's folders must be the same
    on all machines.

    :param address: None is the cluster that this process is connected to, or one on this machine
    :param resources: How many "cpu" and "gpu" a trial reserves
    :param max_failures: How often a trial is tried again that fails or whose worker is lost
    """
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            "--backend ray needs Ray: pip install -c constraints.txt '.[ray]' in a checkout "
            f"({error})"
        ) from error
    own = not ray.is_initialized()
    if own:
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        ray.init(address=address, include_dashboard=False, **quiet)
    models = [key for key in plan.models if library.state(key) in ("missing", "interrupted")]
    derived = [key for key in models if key.base is not None]
    trained = [key for key in models if key.base is None]
    failures: list[str] = []
    try:
        for jobs in (trained, derived, plan.todo):  # what is made from others comes after them
            where = library.workplace, store.path.absolute()
            failures += _run_trials(jobs, *where, resources, max_failures, say)
    finally:
        if own:
            ray.shutdown()
    return failures


def _run_trials(
    jobs: Sequence[ModelKey | Cell],
    workplace: Workplace,
    store: Path,
    resources: Mapping[str, float],
    max_failures: int,
    say: Say,
) -> list[str]:
    """One Tune experiment; returns what failed."""
    if not jobs:
        return []
    from ray import tune

    class KeepRecords(tune.Callback):
        """Keeps each record when it arrives, so that losing this process loses no finished cell.
        Tune pickles it with everything else, hence the store's path.
        """

        def on_trial_result(
            self, iteration: int, trials: list, trial: Any, result: dict, **info: Any
        ) -> None:
            if result.get("record"):
                with Store(store) as opened:
                    opened.add(Record(**json.loads(result["record"])))
            if "name" in result:
                say(f"finished {result['name']}")

    # Where all machines can see it. Of Tune's own files nothing is needed afterwards: store and
    # runs hold everything.
    storage = Path(workplace.runs) / ".ray" / uuid.uuid4().hex
    storage.mkdir(parents=True)
    run = tune.with_parameters(_run_trial, jobs=list(jobs), workplace=workplace)
    tuner = tune.Tuner(
        tune.with_resources(run, dict(resources)),
        param_space={"number": tune.grid_search(list(range(len(jobs))))},
        run_config=tune.RunConfig(
            storage_path=str(storage),
            failure_config=tune.FailureConfig(max_failures=max_failures),
            callbacks=[KeepRecords()],
            verbose=0,
        ),
    )
    try:
        results = tuner.fit()
    finally:
        shutil.rmtree(storage, ignore_errors=True)
    failed = [result for i in range(len(results)) if (result := results[i]).error is not None]
    return [f"{jobs[(result.config or {})['number']]}: {result.error}" for result in failed]


def _run_trial(
    config: dict[str, Any], jobs: Sequence[ModelKey | Cell], workplace: Workplace
) -> None:
    from ray import tune

    for package in workplace.packages:
        importlib.import_module(package)
    job, library, record = jobs[config["number"]], ModelLibrary(workplace), ""
    if isinstance(job, ModelKey):
        library.ensure(job, print)
    else:
        record = json.dumps(vars(run_cell(job, library, print)))
    tune.report({"record": record, "name": str(job)})
