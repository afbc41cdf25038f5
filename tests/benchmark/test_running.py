"""Running for real, in a small form: all methods, interruption, and two processes at once."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sb3_poem.benchmark.locks import locked
from sb3_poem.benchmark.models import ModelLibrary, Workplace
from sb3_poem.benchmark.plan import make_plan
from sb3_poem.benchmark.runner import run_cells
from sb3_poem.benchmark.selection import Selection
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import (
    EXACT,
    TABLE_METHODS,
    TABLE_REFERENCES,
    Budget,
    Entry,
    Suite,
    Training,
)
from sb3_poem.benchmark.tables import suite_rows

TINY_MODEL = {
    "n_train_tasks": 12,
    "n_envs": 12,
    "gradient_steps": 3,
    "batch_size": 8,
    "meta_batch_size": 6,
}
TINY = Suite(
    "tiny",
    "A suite of two questions",
    ("PointGoal",),
    (Entry("methods", "Methods", TABLE_METHODS, record_at=(0, 1, 2), curves=(EXACT,)),),
    TABLE_REFERENCES,
    snapshots=2,
    overrides={"maml": (("gradient_steps", 1), ("batch_size", 8))},
)
BUDGET = Budget(tasks=2, episodes=1)
TRAINING = Training(1800, tuple(sorted(TINY_MODEL.items())))


def test_every_method_runs_and_is_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_poem.benchmark.models.META_ITERATIONS_OF", {"PointGoal": 2})
    library, store = (
        ModelLibrary(Workplace(str(tmp_path / "runs"))),
        Store(tmp_path / "store.sqlite"),
    )
    arguments = (TINY, library, store, None, None, range(1), BUDGET, TRAINING)
    plan = make_plan(*arguments)
    assert run_cells(plan.todo, library, store) == []
    records = list(store.records())
    assert {record.method for record in records} == {*TABLE_METHODS, *TABLE_REFERENCES}
    assert (
        len(records) == len(plan.todo) == 9 + 5
    )  # MAML-reward, greedy search and what is known have no curve
    for record in records:
        model = record.provenance["model"]
        returns = np.array(record.result["task_returns"])
        assert np.isfinite(returns).all()
        assert len(returns) == 2
        assert record.provenance["versions"]["torch"]
        assert record.result["training_samples"] > 0
        assert str(tmp_path) not in json.dumps([record.result, record.provenance, record.identity])
        assert (model.get("base") or model)["hyperparameters"]["gradient_steps"] == 3
        if record.identity["snapshot"] is None:
            assert record.result["training_samples"] == 1800
            assert "queries" not in record.result or returns.shape == (2, 3)
        else:
            assert 300 < record.result["training_samples"] < 1800
            assert returns.shape == (2, 1)
    fragments = {record.result.get("fragments") for record in records if record.method == "anole"}
    assert fragments == {"replay buffer", "rollouts of the training tasks"}
    assert {row.method for row in suite_rows(Selection(TINY, records))} == {
        *TABLE_METHODS,
        *TABLE_REFERENCES,
    }

    again = make_plan(*arguments)
    assert (len(again.done), again.todo) == (len(plan.todo), [])
    assert len(list((tmp_path / "runs").rglob("sessions/*.json"))) == 2


def test_a_training_that_fails_is_reported_and_the_rest_is_run(tmp_path: Path) -> None:
    library, store = (
        ModelLibrary(Workplace(str(tmp_path / "runs"))),
        Store(tmp_path / "store.sqlite"),
    )
    broken = Training(600, (("gradient_stebs", 3),))
    plan = make_plan(
        TINY, library, store, None, ["poem-bayes", "poem-paper"], range(1), BUDGET, broken, 1
    )
    lines: list[str] = []
    failures = run_cells(plan.todo, library, store, lines.append)
    assert len(failures) == 2
    assert all(
        "Unknown key 'gradient_stebs'" in failure and "did you mean" in failure
        for failure in failures
    )
    assert sum(line.startswith(("training", "resuming")) for line in lines) == 1  # not tried twice
    assert store.keys() == set()


def test_cells_whose_model_another_process_trains_come_last(tmp_path: Path) -> None:
    library, store = (
        ModelLibrary(Workplace(str(tmp_path / "runs"))),
        Store(tmp_path / "store.sqlite"),
    )
    plan = make_plan(
        TINY, library, store, None, ["poem-paper", "reward-oracle"], range(1), BUDGET, TRAINING, 1
    )
    assert [cell.method for cell in plan.todo] == ["poem-paper", "reward-oracle"]
    lines: list[str] = []
    with contextlib.ExitStack() as other_process:
        other_process.enter_context(locked(library.lock_file(plan.todo[0].model_key)))

        def say(line: str) -> None:
            lines.append(line)
            assert "waiting" not in line  # this process would wait for ever
            if "reward-oracle" in line:
                other_process.close()

        assert run_cells(plan.todo, library, store, say) == []
    assert [line.split(", ")[1] for line in lines if line.startswith("[")] == [
        "reward-oracle",
        "poem-paper",
    ]
    assert len(store.keys()) == 2


def start(folder: Path) -> subprocess.Popen[str]:
    parameters = [f"{name}:{value}" for name, value in {**TINY_MODEL, "gradient_steps": 20}.items()]
    command = [
        sys.executable,
        "-m",
        "sb3_poem.cli",
        "benchmark",
        "run",
        "--suite",
        "smoke",
        "--seeds",
        "1",
    ]
    command += ["--methods", "poem-paper", "--snapshots", "1", "--tasks", "2", "--episodes", "1"]
    command += ["--timesteps", "9000", "--params", *parameters]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def wait_for(pattern: str, folder: Path, process: subprocess.Popen[str]) -> Path:
    while process.poll() is None:
        found = list(folder.rglob(pattern))
        if found:
            return found[0]
        time.sleep(0.02)
    raise AssertionError(f"no {pattern} before the end: {process.communicate()[0]}")


def test_a_killed_run_is_continued_by_two_processes_and_nothing_is_done_twice(
    tmp_path: Path,
) -> None:
    first = start(tmp_path)
    checkpoint = wait_for("checkpoint.zip", tmp_path, first)
    children = [
        int(pid)
        for pid in subprocess.run(
            ["pgrep", "-P", str(first.pid)], capture_output=True, text=True
        ).stdout.split()
    ]
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    assert children
    deadline = time.time() + 10
    while (
        any(Path(f"/proc/{child}/stat").exists() and not is_zombie(child) for child in children)
        and time.time() < deadline
    ):
        time.sleep(0.02)
    assert not any(
        Path(f"/proc/{child}/stat").exists() and not is_zombie(child) for child in children
    )
    assert not list(tmp_path.rglob("trained.json"))
    saved = checkpoint.read_bytes()

    both = [start(tmp_path) for _ in range(2)]
    outputs = [process.communicate()[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], outputs
    [trained] = tmp_path.rglob("trained.json")
    info = json.loads(trained.read_text())
    assert (info["env_steps"], info["sessions"]) == (9000, 2)
    assert info["cpu_seconds"] > 0
    log = trained.with_name("train.log").read_text()
    assert log.count("Resuming") == 1
    assert (
        checkpoint.read_bytes() == saved
    )  # the first run's own; the second went on in a folder of its own
    text = "".join(outputs)
    assert text.count("resuming PointGoal poem seed 0") == 1
    assert text.count("    0: -") == 2  # both oracles' cells, each once
    with Store(tmp_path / "benchmark.sqlite", create=False) as store:
        assert len(list(store.records())) == 2


def is_zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True
