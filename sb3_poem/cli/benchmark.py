"""``sb3-poem benchmark``: run suites into a store, report what it holds, and verify it."""

import argparse
from collections.abc import Sequence
from os.path import abspath
from pathlib import Path

from sb3_poem.benchmark.cells import find_record, verify_cell
from sb3_poem.benchmark.models import ModelLibrary, Workplace, model_folder
from sb3_poem.benchmark.ray_backend import run_with_ray
from sb3_poem.benchmark.running import Plan, describe, export_model, make_plan, run_cells
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import (
    SUITES,
    Budget,
    Cell,
    Training,
    family_id,
    family_label,
    hashable,
)
from sb3_poem.benchmark.tables import make_report
from sb3_poem.cli.needs import check_device, check_writable, import_packages, parse_pairs, say


def run_benchmark(arguments: argparse.Namespace) -> int:
    """Run the command, and return the exit status: 1 if a cell failed or differs."""
    return {"run": _run, "report": _report, "verify": _verify}[arguments.part](arguments)


def _run(arguments: argparse.Namespace) -> int:
    check_device(arguments.device)
    import_packages(arguments.gym_packages)
    suite = SUITES[arguments.suite]
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    training = Training(arguments.timesteps, _parse_params(arguments.params))
    if not training.is_default and (arguments.models or arguments.model):
        trained = "--models and --model hand over models that were trained already"
        raise ValueError(f"{trained}: leave out --timesteps and --params")
    if arguments.export is not None and (suite.name != "shipped" or arguments.methods):
        raise ValueError("--export is for --suite shipped with all of its methods")
    library = _library(arguments, arguments.device, arguments.num_threads)
    store = Store(arguments.store) if arguments.store.exists() else None
    usual = suite.budget
    budget = Budget(arguments.tasks or usual.tasks, arguments.episodes or usual.episodes)
    about = (suite, library, store, arguments.families, arguments.methods, seeds)
    plan = make_plan(*about, budget, training, arguments.snapshots)
    _check_models(arguments.model, library, plan)
    if arguments.list:
        print("\n".join(describe(plan, library)))
        return 0
    for folder in filter(None, (arguments.runs, arguments.export)):
        check_writable(folder)
    store = store or Store(arguments.store)
    say(f"{plan}; results in {arguments.store}")
    if arguments.backend == "ray":
        trial = {"cpu": arguments.cpus_per_trial, "gpu": arguments.gpus_per_trial}
        how = (arguments.address, trial, arguments.max_failures)
        failures = run_with_ray(plan, library, store, *how, say)
    else:
        failures = run_cells(plan.todo, library, store, say)
    for failure in failures:
        print(f"FAILED {failure}")
    left = f", {len(failures)} failed: the same command tries them again" if failures else ""
    finished = store.keys()
    print(f"{sum(cell.key in finished for cell in plan.todo)} cells run{left}")
    if failures:
        return 1
    cells = [cell for cell in (*plan.done, *plan.todo) if cell.seed == arguments.first_seed]
    for env_id in dict.fromkeys(cell.env_id for cell in cells if arguments.export is not None):
        folder = arguments.export / model_folder(env_id)
        export_model([cell for cell in cells if cell.env_id == env_id], library, store, folder)
        print(f"Wrote {folder}")
    return 0


def _check_models(given: Sequence[str], library: ModelLibrary, plan: Plan) -> None:
    """Refuse what would quietly be trained instead of being taken."""
    cells = [*plan.todo, *plan.done, *(cell for cell, _ in plan.skipped)]
    keys = {cell.model_key.base or cell.model_key for cell in cells}
    used = {
        "families": {family_label(key.env_id) for key in keys},
        "models": {key.variant for key in keys},
        "seeds": {str(key.seed) for key in keys},
    }
    for text, (family, variant, seed, _) in zip(given, library.workplace.named, strict=True):
        named = (family_label(family), variant, str(seed))
        for one, (what, known) in zip(named, used.items(), strict=True):
            if one not in known:
                none = f"{one} is none of the {what} of this run: {', '.join(sorted(known))}"
                raise ValueError(f"--model {text}: {none}")


def _report(arguments: argparse.Namespace) -> int:
    store, what = Store(arguments.store, create=False), (arguments.suite, arguments.families)
    if arguments.out is not None:
        check_writable(arguments.out)
    text, files = make_report(store, *what, arguments.format, arguments.out, arguments.seeds)
    if arguments.out is None:
        print(text)
    for file in files:
        print(f"Wrote {file}")
    return 0


def _verify(arguments: argparse.Namespace) -> int:
    import_packages(arguments.gym_packages)
    store = Store(arguments.store, create=False)
    if arguments.cell is None:
        for one in store.records():
            print(f"{one.key}  {Cell.of_identity(one.method, one.identity)}")
        return 0
    record = find_record(store, arguments.cell)
    where = record.provenance.get("device", "cpu"), record.provenance.get("num_threads", 1)
    print(f"running {record.key} again: {record.family}, {record.method}, seed {record.seed}")
    differences = verify_cell(record, _library(arguments, *where), say)
    for line in differences or ["the same, bit for bit"]:
        print(line)
    return 1 if differences else 0


def _library(arguments: argparse.Namespace, device: str, num_threads: int) -> ModelLibrary:
    for folder in arguments.models:
        if not Path(folder).is_dir():
            raise ValueError(f"--models {folder}: there is no such folder")
    named = tuple(_parse_named(text) for text in arguments.model)
    runs, models = abspath(arguments.runs), tuple(map(abspath, arguments.models))
    packages = tuple(arguments.gym_packages)
    return ModelLibrary(Workplace(runs, models, named, device, num_threads, packages))


def _parse_params(pairs: list[str]) -> tuple[tuple[str, object], ...]:
    params = parse_pairs("--params", pairs)
    try:
        return tuple((name, hashable(params[name])) for name in sorted(params))
    except ValueError as error:
        raise ValueError(f"--params {' '.join(pairs)}: {error}") from error


def _parse_named(text: str) -> tuple[str, str, int, str]:
    """FAMILY:VARIANT:SEED=PATH."""
    name, equals, path = text.partition("=")
    parts = name.rsplit(":", 2)
    if not equals or len(parts) != 3 or not parts[2].isdigit():
        raise ValueError(f"--model {text}: must have the form FAMILY:VARIANT:SEED=PATH")
    family, variant, seed = parts
    if not Path(path).exists():
        raise ValueError(f"--model {text}: there is no such file or folder")
    return family_id(family), variant, int(seed), abspath(path)
