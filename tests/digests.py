"""Digests of what training and adaptation come to: equal before and after a change that should
change no number.

    python -P tests/digests.py before.json            # on the tree as it was
    python -P tests/digests.py after.json before.json # on the changed tree: names what differs, and fails if anything does

Digests compare one machine with itself: another processor rounds otherwise. All arithmetic is on
one thread.
"""

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_poem import (
    ANOLE,
    PEARLSAC,
    POEMSAC,
    Bayes,
    MAMLReward,
    Paper,
    ReturnOracle,
    RewardOracle,
)
from sb3_poem.adaptation import Rule, adapt_tasks
from sb3_poem.baselines import MAMLRewardModel, meta_train_reward, rollout_fragments
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.loading import load_model
from sb3_poem.resources import pretrained_names

POINT_GOAL, HALF_CHEETAH = "poem/PointGoal-v0", "poem/HalfCheetahVel-v0"
STEPS = {POINT_GOAL: 25, HALF_CHEETAH: 200}
EPOCHS = 3
SMALL: dict[str, Any] = {
    "n_train_tasks": 8,
    "meta_batch_size": 5,
    "batch_size": 16,
    "context_size": 20,
    "gradient_steps": 20,
    "seed": 3,
    "device": "cpu",
}
VARIANTS: dict[str, tuple[type[PEARLSAC], str, dict[str, Any]]] = {
    "POEMSAC PointGoal": (POEMSAC, POINT_GOAL, {}),
    "POEMSAC PointGoal fp32": (POEMSAC, POINT_GOAL, {"precision": "fp32", "policy_delay": 2}),
    "POEMSAC PointGoal n_steps": (POEMSAC, POINT_GOAL, {"n_steps": 1, "relabel_fraction": 0.2}),
    "POEMSAC PointGoal rollouts": (POEMSAC, POINT_GOAL, {}),
    "POEMSAC PointGoal ablations": (
        POEMSAC,
        POINT_GOAL,
        {"similarity": "inner", "context": "pearl"},
    ),
    "POEMSAC HalfCheetahVel": (POEMSAC, HALF_CHEETAH, {}),
    "PEARLSAC PointGoal": (PEARLSAC, POINT_GOAL, {}),
    "PEARLSAC PointGoal contexts": (
        PEARLSAC,
        POINT_GOAL,
        {"context_relabel_fraction": 0.0, "relabel_fraction": 0.2},
    ),
    "PEARLSAC HalfCheetahVel n_steps": (PEARLSAC, HALF_CHEETAH, {"n_steps": 5}),
}


def digest(arrays: Iterable[Any]) -> str:
    """One digest of arrays, whose order does not matter."""
    parts = sorted(
        hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest() for array in arrays
    )
    return hashlib.sha256("".join(parts).encode()).hexdigest()[:16]


def of_model(model: PEARLSAC) -> str:
    """The digest of a model's weights, tasks and latents, and of what it does."""
    rng = np.random.default_rng(1)
    latents = rng.normal(size=(6, model.latent_dim))
    observations = rng.normal(size=(6, *model.observation_space.shape)).astype(np.float32)
    arrays = [parameter.detach().numpy() for parameter in model.policy.parameters()]
    arrays += [model.predict(observations, latents, deterministic=True)[0]]
    arrays += [
        model.sample_latents(9, np.random.default_rng(4), source)
        for source in ("prior", "aggregate")
    ]
    if isinstance(model, POEMSAC):
        arrays.append(model.similarities(latents, latents))
    return digest([*arrays, model.train_tasks.tasks, model.task_latents])


def trained(name: str) -> PEARLSAC:
    """One of :data:`VARIANTS` after three epochs."""
    algorithm, env_id, arguments = VARIANTS[name]
    model = algorithm("MlpPolicy", env_id, **SMALL, **arguments)
    if name.endswith("rollouts"):
        model.family.shared_dynamics = False
    return model.learn(EPOCHS * SMALL["n_train_tasks"] * STEPS[env_id])


def killed_and_resumed() -> str:
    """A run that is killed after an epoch's checkpoint and continued by another process."""
    with tempfile.TemporaryDirectory() as folder:
        flags = "--seed 3 --eval-freq -1 --save-freq 1500 -n 9000 --num-threads 1 --resume"
        command = [sys.executable, "-m", "sb3_poem", "train", "--env", POINT_GOAL, "-f", folder]
        command += [*flags.split(), "-params", "gradient_steps:20", "--device", "cpu"]
        quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        first = subprocess.Popen(command, **quiet)
        while not list(Path(folder).glob("*/*/checkpoint.zip")):
            if first.poll() is not None:
                raise RuntimeError("the run ended before its first checkpoint")
            time.sleep(0.002)
        os.kill(first.pid, signal.SIGKILL)
        first.wait()
        subprocess.run(command, check=True, **quiet)
        (file,) = Path(folder).glob("*/*/poem-PointGoal-v0.zip")
        return of_model(load_model(file, "cpu"))


def adapted(model: Any, env_id: str, env_kwargs: dict[str, Any], **options: Any) -> str:
    """The latents and answers of two tasks."""
    env = make_task_vec_env(env_id, 4, **env_kwargs)
    tasks = np.asarray(env.env_method("sample_tasks", 2, np.random.default_rng(7), indices=[0])[0])
    result = adapt_tasks(
        model, env, tasks, ReturnOracle, n_queries=options.pop("n_queries", 5), seed=2, **options
    )
    env.close()
    answers = "".join(answer.value for answers in result.preferences for answer in answers)
    return digest([result.latents, np.frombuffer(answers.encode(), dtype=np.uint8)])


def shipped(name: str, rule: Rule) -> str:
    """Adaptation of a model that ships."""
    model = load_model(name, "cpu")
    return adapted(model, model.env_id, model.env_kwargs, rule=rule)


def baseline(name: str) -> str:
    """Adaptation of a small PEARL on PointGoal by a baseline."""
    model = trained("PEARLSAC PointGoal contexts")
    env = make_task_vec_env(POINT_GOAL, 4)
    run = partial(adapted, env_id=POINT_GOAL, env_kwargs={})
    if name in ("berlekamp", "greedy", "random"):
        fragments = rollout_fragments(model, env, 40, 8, seed=1)
        return run(model, rule=ANOLE(strategy=name), library=fragments)
    if name == "reward oracle":
        return run(model, rule=RewardOracle())
    reward = meta_train_reward(model, n_iterations=20, seed=1)
    return run(MAMLRewardModel(reward, model), rule=MAMLReward(gradient_steps=5), n_queries=2)


def measures() -> Iterator[tuple[str, Callable[[], str]]]:
    """All digests by name."""
    for name in VARIANTS:
        yield f"train {name}", lambda name=name: of_model(trained(name))  # type: ignore[misc]
    yield "train, kill, resume", killed_and_resumed
    for name in ("berlekamp", "greedy", "random", "reward oracle", "MAML-reward"):
        yield f"baseline {name}", partial(baseline, name)
    for name in pretrained_names():
        for rule in (Bayes(), Paper()):
            yield f"adapt {name} {type(rule).__name__.lower()}", partial(shipped, name, rule)


def main() -> None:
    """Write the digests, and compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("reference", type=Path, nargs="?")
    given = parser.parse_args()
    th.set_num_threads(1)
    reference = json.loads(given.reference.read_text()) if given.reference else {}
    found: dict[str, str] = {}
    for name, measure in measures():
        started = time.perf_counter()
        found[name] = measure()
        mark = "" if reference.get(name, found[name]) == found[name] else "   DIFFERS"
        print(f"{name:40} {found[name]} {time.perf_counter() - started:5.1f} s{mark}", flush=True)
        given.out.write_text(json.dumps(found, indent=1))
    different = sorted(name for name in reference if found.get(name) != reference[name])
    if different:
        sys.exit("Different: " + ", ".join(different))


if __name__ == "__main__":
    main()
