"""The Ray backend: a cluster of two workers that loses one of them in the middle of a trial."""

from __future__ import annotations

import contextlib
import pickle
import threading
import time
from pathlib import Path

import pytest

from sb3_poem.benchmark.models import ModelLibrary, Workplace
from sb3_poem.benchmark.ray_backend import run_with_ray
from sb3_poem.benchmark.running import make_plan
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import SUITES, Budget, Entry, Suite, Training

POEMS = ("poem-bayes", "poem-paper")
TINY = Suite(
    "tiny",
    "Two questions",
    ("PointGoal",),
    (Entry("methods", "Methods", POEMS, record_at=(0, 1, 2)),),
    ("known-task",),
)
MODEL = {
    "n_train_tasks": 12,
    "n_envs": 12,
    "gradient_steps": 40,
    "batch_size": 8,
    "meta_batch_size": 6,
}
TRAINING = Training(9000, tuple(sorted(MODEL.items())))


def test_cells_survive_the_journey_to_a_worker() -> None:
    for suite in SUITES.values():
        for cell in suite.cells(["poem/PointGoal-v0"], [0], training=TRAINING):
            assert pickle.loads(pickle.dumps(cell)) == cell


@pytest.mark.slow
def test_a_lost_worker_costs_no_cell_and_counts_none_twice(tmp_path: Path) -> None:
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False}
    )
    workers = [cluster.add_node(num_cpus=1) for _ in range(2)]
    ray.init(address=cluster.address, log_to_driver=False, include_dashboard=False)
    cluster.wait_for_nodes()
    library, store = (
        ModelLibrary(Workplace(str(tmp_path / "runs"))),
        Store(tmp_path / "store.sqlite"),
    )
    plan = make_plan(
        TINY, library, store, None, None, range(2), Budget(tasks=2, episodes=1), TRAINING, 1
    )
    lost, over = threading.Event(), threading.Event()

    def lose_a_worker() -> None:
        """As soon as a training has a checkpoint, the node goes that it runs on."""
        while not (lost.is_set() or over.is_set()):
            for checkpoint in (tmp_path / "runs").rglob("checkpoint.zip"):
                raylet = parent(parent(training_process(checkpoint.parents[2])))
                node = next(
                    node
                    for node in workers
                    if node.all_processes["raylet"][0].process.pid == raylet
                )
                cluster.remove_node(node, allow_graceful=False)
                lost.set()
                return
            time.sleep(0.05)

    watcher = threading.Thread(target=lose_a_worker)
    watcher.start()
    lines: list[str] = []
    try:
        trial = {"cpu": 1.0, "gpu": 0.0}
        failures = run_with_ray(plan, library, store, None, trial, 3, lines.append)
    finally:
        over.set()
        watcher.join()
        ray.shutdown()
        cluster.shutdown()
    assert lost.is_set()
    assert failures == []
    records = list(store.records())
    assert sorted((record.method, record.seed) for record in records) == sorted(
        (m, s) for m in (*POEMS, "known-task") for s in (0, 1)
    )
    # A trial that is tried again may be told of twice; in the store each cell stands once.
    assert len(set(lines)) == 2 + len(records)
    # The one that was lost went on from its checkpoint.
    counts = [
        record.provenance["model"]["sessions"]
        for record in records
        if record.method == "known-task"
    ]
    assert sorted(counts) == [1, 2]
    assert sum("Resuming" in log.read_text() for log in (tmp_path / "runs").rglob("train.log")) == 1
    assert all(record.provenance["model"]["env_steps"] == 9000 for record in records)

    # The same command finds nothing to do.
    again = make_plan(
        TINY, library, store, None, None, range(2), Budget(tasks=2, episodes=1), TRAINING, 1
    )
    assert again.todo == []


def training_process(folder: Path) -> int:
    """The process that trains in a folder."""
    for process in Path("/proc").iterdir():
        if process.name.isdigit():
            with contextlib.suppress(OSError):
                command = (process / "cmdline").read_bytes()
                if b"sb3_poem.benchmark.training" in command and str(folder).encode() in command:
                    return int(process.name)
    raise AssertionError(f"nobody trains in {folder}")


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[1])
