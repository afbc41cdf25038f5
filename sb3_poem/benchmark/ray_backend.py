"""Runs cells as tasks of Ray, on one machine or many, by the same code as the default backend.

Tasks hand their records to this process, which alone writes the store. A lost worker's training is
tried again from its checkpoint, in the folder of runs that all machines share.
"""

import importlib
import logging

from sb3_poem.benchmark.cells import run_cell
from sb3_poem.benchmark.models import ModelLibrary, Say, Workplace
from sb3_poem.benchmark.running import Plan
from sb3_poem.benchmark.store import Record, Store
from sb3_poem.benchmark.suites import Cell, ModelKey


def run_with_ray(
    plan: Plan,
    library: ModelLibrary,
    store: Store,
    address: str | None = None,
    cpus: float = 1.0,
    gpus: float = 0.0,
    max_failures: int = 3,
    say: Say = print,
) -> list[str]:
    """Run a plan as tasks of Ray; what failed, a line each. The library's folders must be the same
    on all machines.

    :param address: Of the cluster; None is the one that this process is connected to, or else one
        on this machine
    :param cpus: Of a task, as ``gpus``
    :param max_failures: How often a task is tried again that fails or loses its worker
    """
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            f"--backend ray needs Ray: pip install 'sb3_poem[ray]' ({error})"
        ) from error
    own = not ray.is_initialized()
    if own:
        quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
        ray.init(address=address, include_dashboard=False, **quiet)
    run = ray.remote(_run_job).options(
        num_cpus=cpus,
        num_gpus=gpus,
        max_retries=max_failures,
        retry_exceptions=True,
    )
    models = [key for key in plan.models if library.state(key) in ("missing", "interrupted")]
    derived = [key for key in models if key.base is not None]
    trained = [key for key in models if key.base is None]
    failures: list[str] = []
    try:
        for jobs in (trained, derived, plan.todo):  # what is made from others comes after them
            running = {run.remote(job, library.workplace): job for job in jobs}
            while running:
                [finished], _ = ray.wait(list(running))
                job = running.pop(finished)
                try:
                    record = ray.get(finished)
                except ray.exceptions.RayError as error:
                    failures.append(f"{job}: {getattr(error, 'cause', error)}")
                    continue
                if record is not None:
                    store.add(record)
                say(f"finished {job}")
    finally:
        if own:
            ray.shutdown()
    return failures


def _run_job(job: ModelKey | Cell, workplace: Workplace) -> Record | None:
    for package in workplace.packages:
        importlib.import_module(package)
    library = ModelLibrary(workplace)
    if isinstance(job, Cell):
        return run_cell(job, library)
    library.ensure(job)
    return None
