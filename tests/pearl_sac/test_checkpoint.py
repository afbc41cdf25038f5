"""Runs that were interrupted, killed with SIGKILL too, end with the same bits as runs that were
not.
"""

from __future__ import annotations

import errno
import os
import re
import resource
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from meta_toys import EPOCH, POINT_GOAL, WindyWalk, differing, parameters, small, walks
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_poem import PEARLSAC, POEMSAC, TrainingCheckpointCallback
from sb3_poem.loading import load_model

TESTS = Path(__file__).parents[1]


def assert_same_run(one: PEARLSAC, two: PEARLSAC) -> None:
    """Everything that training depends on, bit for bit."""
    assert not differing(parameters(one), parameters(two))
    for name in ("num_timesteps", "epoch", "_n_updates", "_episode_num", "_total_timesteps"):
        assert getattr(one, name) == getattr(two, name), name
    assert np.array_equal(one.predicted_rewards_error, two.predicted_rewards_error, equal_nan=True)
    for name, value in vars(one.train_tasks).items():
        assert np.array_equal(value, getattr(two.train_tasks, name)), name
    first, second = one.generators.__getstate__(), two.generators.__getstate__()
    assert first["numpy"] == second["numpy"]
    assert np.array_equal(first["torch"], second["torch"])
    first, second = one.replay_buffer.state(), two.replay_buffer.state()
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    first, second = (
        {k: v for k, v in vars(model.epoch_context).items() if v is not None}
        for model in (one, two)
    )
    assert not differing(first, second)
    assert [episode["r"] for episode in one.ep_info_buffer] == [
        episode["r"] for episode in two.ep_info_buffer
    ]


class StopAt(BaseCallback):
    """Interrupts training as Ctrl-C does."""

    def __init__(self, calls: int) -> None:
        super().__init__()
        self.last = calls

    def _on_step(self) -> bool:
        if self.n_calls == self.last:
            raise KeyboardInterrupt
        return True


def schedule(remaining: float) -> float:
    return 1e-3 * remaining


VARIANTS: dict[str, tuple[type[PEARLSAC], Any, dict[str, Any]]] = {
    "pearl": (PEARLSAC, lambda: make_vec_env(POINT_GOAL, 5), {}),
    "poem": (
        POEMSAC,
        lambda: make_vec_env(POINT_GOAL, 5),
        {"learning_rate": schedule, "ent_coef": 0.1},
    ),
    "measured-preferences": (
        POEMSAC,
        lambda: walks(4, WindyWalk),
        {"horizon": 10, "trajectories_per_task": 2},
    ),
    "full-buffers": (
        PEARLSAC,
        lambda: walks(4, edge=0.4),
        {"horizon": 10, "buffer_size": 25, "learning_starts": 120},
    ),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_resumed_run_ends_as_the_uninterrupted_one(variant: str, tmp_path: Path) -> None:
    algorithm, make_env, arguments = VARIANTS[variant]
    total, path = 1000, tmp_path / "checkpoint.pt"
    whole = small(algorithm, make_env(), **arguments).learn(total)
    interrupted = small(algorithm, make_env(), **arguments)
    steps_a_call = interrupted.env.num_envs
    with pytest.raises(KeyboardInterrupt):
        interrupted.learn(
            total, [TrainingCheckpointCallback(path), StopAt(int(0.7 * total / steps_a_call))]
        )
    del interrupted
    resumed = algorithm.load_checkpoint(path, make_env())
    assert 0 < resumed.num_timesteps < 0.7 * total
    th.manual_seed(12345)  # the global generators are no part of a run
    np.random.seed(12345)  # noqa: NPY002
    resumed.resume()
    assert_same_run(whole, resumed)
    assert resumed.num_timesteps >= total
    # a finished run has nothing left
    assert resumed.resume().num_timesteps == whole.num_timesteps


@pytest.mark.parametrize("read", [POEMSAC.load_checkpoint, load_model])
def test_a_checkpoint_is_read_once(
    read: Callable[[Path], PEARLSAC], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may hold gigabytes of experience."""
    small(POEMSAC).learn(EPOCH).save_checkpoint(tmp_path / "c.zip")
    load, files = th.load, []
    monkeypatch.setattr(
        th, "load", lambda file, **how: files.append(file.name) or load(file, **how)
    )
    read(tmp_path / "c.zip")
    with zipfile.ZipFile(tmp_path / "c.zip") as archive:
        assert sorted(files) == sorted(n for n in archive.namelist() if n.endswith(".pth"))
    assert "experience.pth" in files


def test_resuming_twice(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    whole = small(POEMSAC).learn(4 * EPOCH)
    model = small(POEMSAC)
    with pytest.raises(KeyboardInterrupt):
        model.learn(4 * EPOCH, [TrainingCheckpointCallback(path), StopAt(30)])
    model = POEMSAC.load_checkpoint(path, POINT_GOAL)
    with pytest.raises(KeyboardInterrupt):
        model.resume([TrainingCheckpointCallback(path), StopAt(60)])
    resumed = POEMSAC.load_checkpoint(path, POINT_GOAL)
    assert resumed.epoch == 3
    assert_same_run(whole, resumed.resume())


CHILDREN = """
import errno, os, signal, sys, time
from stable_baselines3.common.callbacks import BaseCallback
from meta_toys import EPOCH, small
from sb3_poem import POEMSAC, TrainingCheckpointCallback
from sb3_poem.pearl_sac.updater import Updater

folder, moments = sys.argv[1], sys.argv[2:]

class KillAt(BaseCallback):
    def __init__(self, calls):
        super().__init__()
        self.last = calls

    def _on_step(self):
        if self.n_calls == self.last:
            os.kill(os.getpid(), signal.SIGKILL)
        return True

def count_down(function, calls):
    def counted(*args, **kwargs):
        counted.calls -= 1
        if counted.calls == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)
    counted.calls = calls
    return counted

def run(kind, number, path):
    model = small(POEMSAC)
    callbacks = [TrainingCheckpointCallback(path)]
    if kind == "collecting":
        callbacks.append(KillAt(number))
    elif kind == "learning":
        Updater.step = count_down(Updater.step, number)
    elif kind == "writing":  # the temporary file is there, the checkpoint not yet replaced
        os.fsync = count_down(os.fsync, number)
    elif kind == "replacing":
        os.replace = count_down(os.replace, number)
    model.learn(4 * EPOCH, callbacks)

small(POEMSAC)  # torch imports much at its first optimiser; gradients would not survive a fork, so none yet
for moment in moments:  # forked: the imports take longer than the runs
    kind, number = moment.split("-")
    path = os.path.join(folder, moment + ".pt")
    pid = os.fork()
    if pid == 0:
        run(kind, int(number), path)
        os._exit(7)
    if kind == "outside":
        while not os.path.exists(path):
            time.sleep(0.001)
        time.sleep(int(number) / 1000)
        os.kill(pid, signal.SIGKILL)
    _, status = os.waitpid(pid, 0)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL, (moment, status)
"""

# fsync is called for the file and for its folder
MOMENTS = (
    "collecting-30",
    "learning-13",
    "writing-5",
    "replacing-3",
    "outside-40",
)


def test_a_run_killed_at_any_moment_continues_as_if_nothing_had_happened(tmp_path: Path) -> None:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([*sys.path, str(TESTS)]),
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-c", CHILDREN, str(tmp_path), *MOMENTS]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    whole = small(POEMSAC).learn(4 * EPOCH)
    epochs = {}
    for moment in MOMENTS:
        resumed = POEMSAC.load_checkpoint(tmp_path / f"{moment}.pt", POINT_GOAL)
        epochs[moment] = resumed.epoch
        assert_same_run(whole, resumed.resume())
    # where the moment is known, the checkpoint is the last one before it
    known = {moment: epoch for moment, epoch in epochs.items() if not moment.startswith("outside")}
    assert known == {
        "collecting-30": 1,
        "learning-13": 2,
        "writing-5": 2,
        "replacing-3": 2,
    }


# ---------------------------------------------------------------- what a checkpoint holds


def test_a_checkpoint_is_a_model_with_its_experience(tmp_path: Path) -> None:
    model = small(PEARLSAC).learn(2 * EPOCH)
    model.save_checkpoint(tmp_path / "deep" / "checkpoint.pt")
    loaded = PEARLSAC.load_checkpoint(str(tmp_path / "deep" / "checkpoint.pt"))
    assert_same_run(model, loaded)
    assert loaded.env is None
    loaded.set_env(make_vec_env(POINT_GOAL, 12))
    loaded.learn(EPOCH, reset_num_timesteps=False)
    assert loaded.replay_buffer.size() == 3 * EPOCH


def test_a_checkpoint_before_training(tmp_path: Path) -> None:
    small(PEARLSAC).save_checkpoint(tmp_path / "checkpoint.pt")
    loaded = PEARLSAC.load_checkpoint(tmp_path / "checkpoint.pt", POINT_GOAL)
    assert loaded.epoch_context is None
    assert not differing(parameters(loaded.learn(EPOCH)), parameters(small(PEARLSAC).learn(EPOCH)))


# ---------------------------------------------------------------- full disks and bad files


def test_a_disk_that_is_full_half_way_is_named(tmp_path: Path) -> None:
    model = small(PEARLSAC).learn(EPOCH)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limit[1]))
    try:
        with pytest.raises(OSError, match=r"could not write .*c\.pt \(File too large\)"):
            model.save_checkpoint(tmp_path / "c.pt")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_the_previous_checkpoint_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, model = tmp_path / "checkpoint.pt", small(POEMSAC)
    model.learn(EPOCH, TrainingCheckpointCallback(path))
    before = path.read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(
            OSError, match=r"could not write .*checkpoint\.pt \(No space left on device\)"
        ):
            model.learn(EPOCH, TrainingCheckpointCallback(path), reset_num_timesteps=False)
        with pytest.raises(OSError, match=r"could not write .*model\.zip"):
            model.save(tmp_path / "model")
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == [path.name]
    resumed = POEMSAC.load_checkpoint(path, POINT_GOAL).learn(EPOCH, reset_num_timesteps=False)
    assert resumed.num_timesteps == 2 * EPOCH


def foreign_files(folder: Path) -> dict[str, Path]:
    """Files that are no checkpoints, by name."""
    model = small(POEMSAC)
    model.save_checkpoint(folder / "whole.pt")
    content = (folder / "whole.pt").read_bytes()
    rng = np.random.default_rng(0)
    files = {
        "half.pt": content[: len(content) // 2],
        "all-but-the-end.pt": content[:-1],
        "start.pt": content[:3],
        "empty.pt": b"",
        "text.pt": b"learning_rate: 3e-4\n",
        **{
            f"noise{i}.pt": bytes([first]) + rng.bytes(300)
            for i, first in enumerate(b"\x80(]}cRqKNI\x00PX.")
        },
    }
    for name, data in files.items():
        (folder / name).write_bytes(data)
    model.save(folder / "model.zip")
    th.save({"weights": th.zeros(3)}, folder / "other.pt")
    th.save([1, 2], folder / "list.pt")
    SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]}, buffer_size=10).save(
        folder / "sac.zip"
    )
    np.savez(folder / "arrays.npz", a=np.zeros(3))
    return {path.name: path for path in folder.iterdir() if path.name != "whole.pt"}


def test_files_that_are_no_checkpoints(tmp_path: Path) -> None:
    files = foreign_files(tmp_path)
    assert len(files) > 15
    for name, path in files.items():
        with pytest.raises(
            ValueError, match=r"truncated, or no checkpoint of|is a model, no checkpoint: use POEM"
        ) as caught:
            POEMSAC.load_checkpoint(path)
        assert name in str(caught.value)
    with pytest.raises(FileNotFoundError):
        POEMSAC.load_checkpoint(tmp_path / "nothing.pt")


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.zip"
    small(POEMSAC).save_checkpoint(path)
    with pytest.raises(ValueError, match=r"checkpoint\.zip is a checkpoint: use POEMSAC"):
        POEMSAC.load(tmp_path / "checkpoint")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"^{re.escape(str(path))} is truncated, or no model"):
        POEMSAC.load_checkpoint(path)


def test_a_pickle_in_place_of_a_checkpoint_does_not_run(tmp_path: Path) -> None:
    import pickle

    class Payload:
        def __reduce__(self) -> tuple[Any, tuple[str]]:
            return os.mkdir, (str(tmp_path / "ran"),)

    (tmp_path / "evil.pt").write_bytes(pickle.dumps(Payload()))
    with pytest.raises(ValueError, match="no checkpoint of sb3_poem"):
        POEMSAC.load_checkpoint(tmp_path / "evil.pt")
    assert not (tmp_path / "ran").exists()


def test_another_algorithm_or_family(tmp_path: Path) -> None:
    small(POEMSAC).save_checkpoint(tmp_path / "c.pt")
    with pytest.raises(
        ValueError, match=r"c\.pt holds a POEMSAC; load it with POEMSAC\.load_checkpoint"
    ):
        PEARLSAC.load_checkpoint(tmp_path / "c.pt")
    with pytest.raises(ValueError, match=r"own family|[Oo]bservation spaces do not match"):
        POEMSAC.load_checkpoint(tmp_path / "c.pt", "poem/HalfCheetahVel-v0")
