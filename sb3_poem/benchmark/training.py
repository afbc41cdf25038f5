"""How a family's models are trained, and the training itself: ``sb3-poem train`` as a child of the
benchmark, which ends with its parent and notes how long it took.
"""

import contextlib
import ctypes
import json
import os
import runpy
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from poem_envs.registration import family_name
from sb3_poem.benchmark.methods import VARIANTS
from sb3_poem.benchmark.suites import ModelKey, family_id
from sb3_poem.common.checks import check_whole
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.files import write_json_atomically
from sb3_poem.common.vec_env import vectorised
from sb3_poem.pearl_sac.arguments import default_copies
from sb3_poem.pearl_sac.collector import in_whole_waves
from sb3_poem.pearl_sac.saving import CHECKPOINT
from sb3_poem.pearl_sac.train_tasks import default_train_tasks
from sb3_poem.poem_sac.poem_sac import comparing_rollouts
from sb3_poem.resources import config_file

SESSIONS, LOG = "sessions", "train.log"
#: Models are saved, for curves and against interruptions, this many times in a training.
SAVES = 20
LOG_LINES = 15
LOOK_SECONDS = 2.0
PR_SET_PDEATHSIG = 1


class TrainingError(RuntimeError):
    """A training that did not end well; the message has the end of its log."""


@dataclass(frozen=True)
class FamilyFacts:
    """What must be known of a family before anything starts."""

    env_id: str
    horizon: int
    #: How many tasks are trained on unless told
    n_train_tasks: int
    shared_dynamics: bool


@cache
def family_facts(name: str) -> FamilyFacts:
    """Of an id, or of AntGoal for poem/AntGoal-v0."""
    env_id = family_id(name)
    try:
        with contextlib.closing(vectorised(gym.make(env_id))) as env:
            family = FamilyView.for_training(env)
    except gym.error.Error as error:
        own = sorted(family_name(spec) for spec in gym.registry if spec.startswith("poem/"))
        raise ValueError(
            f"--families {name}: {error} The package's own families are: {', '.join(own)}"
        ) from error
    except ValueError as error:
        raise ValueError(f"--families {name}: {error}") from error
    n_train_tasks = default_train_tasks(family.all_tasks)
    return FamilyFacts(env_id, family.horizon, n_train_tasks, family.shared_dynamics)


@dataclass(frozen=True)
class TrainingPlan:
    """A training: all that differs from the algorithm's defaults, what of it differs from the file,
    environment steps in all and of an epoch, and gradient steps.
    """

    algorithm: str
    hyperparameters: dict[str, Any]
    overrides: dict[str, Any]
    timesteps: int
    epoch_steps: int
    updates: int

    @property
    def save_steps(self) -> int:
        """Environment steps between two saved models, a whole number of epochs."""
        return max(1, round(self.timesteps / SAVES / self.epoch_steps)) * self.epoch_steps


def overrides(key: ModelKey) -> dict[str, Any]:
    """Where a variant, and this run's ``--params``, differ from the family's entry."""
    return {**VARIANTS[key.variant].hyperparameters, **dict(key.training.hyperparameters)}


def training_plan(key: ModelKey) -> TrainingPlan:
    """How a model is trained: by its family's entry, or the file's default."""
    variant = VARIANTS[key.variant]
    entries = yaml.safe_load(config_file(variant.algorithm).read_text())
    changes = overrides(key)
    hyperparameters = {**entries.get(key.env_id, entries["default"]), **changes}
    timesteps = int(key.training.timesteps or hyperparameters["n_timesteps"])
    # as JSON has them
    hyperparameters = json.loads(json.dumps({**hyperparameters, "n_timesteps": timesteps}))
    facts, tasks = family_facts(key.env_id), hyperparameters.get("n_train_tasks")
    if tasks is None:
        tasks = facts.n_train_tasks
    each = hyperparameters.get("trajectories_per_task", 1)
    check_whole("n_train_tasks", tasks, 1)
    check_whole("trajectories_per_task", each, 1)
    copies = int(hyperparameters.get("n_envs") or default_copies(facts.env_id, tasks, each))
    rollouts = in_whole_waves(tasks * each, copies)
    if variant.algorithm == "poem_sac" and not facts.shared_dynamics:
        rollouts += in_whole_waves(comparing_rollouts(tasks), copies)
    epoch_steps = rollouts * facts.horizon
    per_epoch = int(hyperparameters.get("gradient_steps", 1000))
    updates = -(-timesteps // epoch_steps) * (epoch_steps if per_epoch < 0 else per_epoch)
    steps = (timesteps, epoch_steps, updates)
    return TrainingPlan(variant.algorithm, hyperparameters, changes, *steps)


def train_arguments(key: ModelKey, plan: TrainingPlan, packages: Sequence[str] = ()) -> list[str]:
    """Those of ``sb3-poem`` that decide what comes out; ``packages`` register the environment."""
    arguments = ["train", "--algo", plan.algorithm, "--env", key.env_id]
    arguments += ["--seed", str(key.seed), "--eval-freq", "-1"]
    if key.training.timesteps is not None:
        arguments += ["-n", str(plan.timesteps)]
    if plan.overrides:
        arguments += ["-params", *(f"{name}:{value!r}" for name, value in plan.overrides.items())]
    if packages:
        arguments += ["--gym-packages", *packages]
    return arguments


def run_training(
    arguments: list[str], save_steps: int, folder: Path, lock: int, device: str, num_threads: int
) -> None:
    """Train, or go on with a training, in a child process. It inherits a lock's file descriptor:
    nobody else trains while it still ends.
    """
    session = folder / SESSIONS / f"{len(list(folder.glob(f'{SESSIONS}/*.json'))) + 1}.json"
    command = [sys.executable, "-m", "sb3_poem.benchmark.training", str(os.getpid()), str(session)]
    command += [*arguments, "-f", str(folder), "--resume", "--save-freq", str(save_steps)]
    command += ["--device", device, "--num-threads", str(num_threads)]
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), str(num_threads))
    with (folder / LOG).open("a") as log:
        # In a session of its own an interrupt from the keyboard does not reach it: rl_zoo3 would
        # save half a training as if it were whole.
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **threads},
            pass_fds=(lock,),
            start_new_session=True,
        )
        try:
            status = child.wait()
        finally:
            child.kill()
            child.wait()
    if status != 0:
        tail = "\n".join((folder / LOG).read_text(errors="replace").splitlines()[-LOG_LINES:])
        raise TrainingError(
            f"the training in {folder} ended with status {status}; the end of its {LOG}:\n{tail}"
        )


def end_with_parent(parent: int) -> None:
    """Have Linux kill this process when its parent, which may be gone already, is gone."""
    with contextlib.suppress(AttributeError):  # elsewhere
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit("the benchmark that started this training is gone")


@contextlib.contextmanager
def timed(session: Path) -> Iterator[None]:
    """Write to a file how long the training took, by the clock and of the processor: at each new
    checkpoint, as what comes after the last is lost with a killed process, and at its end.
    """
    started = time.monotonic()

    def note() -> None:
        times = {"seconds": time.monotonic() - started, "cpu_seconds": sum(os.times()[:4])}
        write_json_atomically(session, times)

    def checkpoints() -> list[float]:
        return [file.stat().st_mtime for file in session.parents[1].glob(f"*/*/{CHECKPOINT}")]

    def look() -> None:
        seen = checkpoints()
        while not over.wait(LOOK_SECONDS):
            if (saved := checkpoints()) != seen:
                seen = saved
                note()

    over = threading.Event()
    watcher = threading.Thread(target=look, daemon=True)
    write_json_atomically(session, {"seconds": 0.0, "cpu_seconds": 0.0})
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
        note()


if __name__ == "__main__":
    end_with_parent(int(sys.argv[1]))
    with timed(Path(sys.argv[2])):
        del sys.argv[1:3]
        runpy.run_module("sb3_poem", run_name="__main__")
