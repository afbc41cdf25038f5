"""Environment steps per second with the policy in the loop, 120 tasks.

Every contender is stepped by the same loop with the same untrained policy (one call for all
copies). "training" is what ``learn`` does: the same with relabelling features, checks, episode
infos, callbacks and storage. The limit is bare ``mujoco.rollout`` on the very states and controls
of "TaskVecEnv", with as many threads and nothing else. EnvPool (``pip install sb3_poem[bench]``)
steps its own versions of these robots.

    python benchmarks/bench_collection.py --env poem/AntVel-v0 poem/MetaWorldML1-v0
"""

from __future__ import annotations

import argparse
import functools
import importlib.util
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import common
import gymnasium as gym
import mujoco
import numpy as np
import torch as th
from mujoco.rollout import Rollout
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_poem import POEMSAC, TaskVecEnv
from sb3_poem.common.vec_env import make_task_vec_env

N_TASKS, STEPS = 120, 25
# 24 GB of memory did not hold 120 Meta-World environments of each kind.
OTHERS = {"MetaWorld": 16}
ENVPOOL = {"HalfCheetah": "HalfCheetah-v4", "Ant": "Ant-v4", "Humanoid": "Humanoid-v4"}
DEFAULT_IDS = (
    "poem/HalfCheetahVel-v0",
    "poem/AntVel-v0",
    "poem/HumanoidDir2D-v0",
    "poem/MetaWorldML1-v0",
)


class Loop:
    """Steps of a vectorised environment under a policy, going on where the last call stopped.

    :param reset: Gives the first observations
    :param step: Maps actions to observations
    :param model: Whose policy acts
    """

    def __init__(
        self,
        reset: Callable[[], np.ndarray],
        step: Callable[[np.ndarray], np.ndarray],
        model: POEMSAC,
    ) -> None:
        self.observations, self.step, self.model = reset(), step, model
        self.copies = len(self.observations)
        self.act = model.policy.acting_on(
            np.zeros((self.copies, model.latent_dim))
        )  # as collection does
        self.noise_shape = (len(self.observations), int(model.action_space.shape[0]))

    def __call__(self) -> None:
        space, policy = self.model.action_space, self.model.policy
        for _ in range(STEPS):
            noise = th.randn(self.noise_shape, generator=self.model.generators.torch)
            actions = policy.unscale_action(self.act(self.observations, noise))
            self.observations = self.step(np.clip(actions, space.low, space.high))


class Limit:
    """Bare ``mujoco.rollout`` over recorded states and controls."""

    def __init__(self, env: TaskVecEnv, nthread: int) -> None:
        family: Any = env.vector_env
        self.model, self.frame_skip = family.model, family.frame_skip
        self.recorded: list[tuple[np.ndarray, np.ndarray]] = []
        self.rollout = Rollout(nthread=nthread if nthread > 1 else 0)
        self.data = [mujoco.MjData(self.model) for _ in range(nthread)]
        shape = (env.num_envs, self.frame_skip)
        self.controls = np.empty((*shape, self.model.nu))
        self.states = np.empty((*shape, 1 + self.model.nq + self.model.nv))
        advance = family._integrator.advance

        def recording(states: np.ndarray, controls: np.ndarray) -> np.ndarray:
            self.recorded = [*self.recorded, (states.copy(), controls.copy())][-STEPS:]
            return advance(states, controls)

        family._integrator.advance = recording

    def __call__(self) -> None:
        for states, controls in self.recorded:
            self.controls[:] = controls[:, None]
            self.rollout.rollout(
                [self.model] * len(states),
                self.data,
                states,
                self.controls,
                control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
                skip_checks=True,
                nstep=self.frame_skip,
                state=self.states,
            )


def training(model: POEMSAC) -> Callable[[], None]:
    """The collection of ``learn``, ``STEPS`` steps at a time."""
    _, callback = model._setup_learn(10**9, None)
    callback.on_training_start({}, {})
    model.family.horizon = STEPS
    collector = model.make_collector(callback)
    ids, latents = np.arange(N_TASKS), np.zeros((N_TASKS, model.latent_dim))

    def collect() -> None:
        assert collector.roll_out(ids, latents) is not None

    return collect


def sb3_loop(env: Any, model: POEMSAC) -> Loop:
    return Loop(env.reset, lambda actions: env.step(actions)[0], model)


def gymnasium_loop(env: Any, model: POEMSAC, obs_dim: int) -> Loop:
    return Loop(
        lambda: env.reset()[0][:, :obs_dim],
        lambda actions: env.step(actions)[0][:, :obs_dim],
        model,
    )


def others_of(env_id: str) -> int:
    """How many copies SB3's and Gymnasium's vectorised environments step."""
    return next((copies for name, copies in OTHERS.items() if name in env_id), N_TASKS)


def measure(env_id: str, nthread: int, repeats: int) -> dict[str, Any]:
    """Steps per second of every contender, and ratios within this run."""
    th.set_num_threads(1)
    make = functools.partial(gym.make, f"poem_envs:{env_id}")
    # forked while there are no threads yet: to start so many interpreters anew takes minutes
    others = others_of(env_id)
    processes = SubprocVecEnv([make] * others, start_method="fork")
    env = make_task_vec_env(env_id, N_TASKS, nthread=nthread)
    model = POEMSAC(
        "MlpPolicy",
        env,
        n_train_tasks=N_TASKS,
        seed=0,
        buffer_size=1000,
        learning_starts=0,
        device="cpu",
    )
    contenders: dict[str, Callable[[], Any]] = {"TaskVecEnv": sb3_loop(env, model)}
    own = POEMSAC(
        "MlpPolicy",
        make_task_vec_env(env_id, N_TASKS, nthread=nthread),
        n_train_tasks=N_TASKS,
        seed=0,
        buffer_size=1000,
        device="cpu",
    )
    contenders["training (with storage)"] = training(own)
    contenders["TaskVecEnv"]()
    if hasattr(env.vector_env, "_integrator"):
        contenders["limit: bare mujoco.rollout"] = Limit(env, nthread)
    contenders["SB3 DummyVecEnv"] = sb3_loop(DummyVecEnv([make] * others), model)
    contenders["Gymnasium SyncVectorEnv"] = gymnasium_loop(
        gym.vector.SyncVectorEnv([make] * others), model, 10**6
    )
    robot = next((name for name in ENVPOOL if f"/{name}" in env_id), None)
    if robot is not None and importlib.util.find_spec("envpool") is not None:
        import envpool

        pool = envpool.make(
            ENVPOOL[robot], env_type="gymnasium", num_envs=N_TASKS, num_threads=nthread, seed=0
        )
        contenders[f"EnvPool {ENVPOOL[robot]}"] = gymnasium_loop(
            pool, model, env.observation_space.shape[0]
        )
    contenders["SB3 SubprocVecEnv"] = sb3_loop(processes, model)
    seconds = common.seconds_in_turns(contenders, repeats)
    processes.close()
    copies = {name: getattr(contender, "copies", N_TASKS) for name, contender in contenders.items()}
    rates = {
        name: STEPS * copies[name] / float(np.median(values)) for name, values in seconds.items()
    }
    shares = {
        name: common.ratio(seconds["TaskVecEnv"], values) * copies[name] / N_TASKS
        for name, values in seconds.items()
    }
    return {
        "env_id": env_id,
        "seconds": seconds,
        "steps_per_second": rates,
        "seconds_of_TaskVecEnv_over_own": shares,
    }


def main() -> None:
    """Measure and write."""

    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--env", nargs="+", default=DEFAULT_IDS)
        parser.add_argument("--threads", type=int, default=common.cores())
        parser.add_argument("--repeats", type=int, default=5)

    options = common.arguments(__doc__, add)
    settings = {
        "copies": N_TASKS,
        "threads of MuJoCo and EnvPool": options.threads,
        "threads of torch": 1,
        "steps a turn": STEPS,
        "turns": options.repeats,
        "policy": "256-256, float32, one call for all copies",
    }
    for env_id in options.env:
        if env_id not in gym.registry:
            print(f"{env_id} skipped: it is not registered in this version")
            continue
        # in a process of its own, so that a family's memory is free again for the next
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as fresh:
            result = fresh.submit(measure, env_id, options.threads, options.repeats).result()
        mine = result["seconds_of_TaskVecEnv_over_own"]
        rows = [[name, rate, 1.0 / mine[name]] for name, rate in result["steps_per_second"].items()]
        header = [
            "contender",
            "environment steps per second",
            "TaskVecEnv is so many times as fast",
        ]
        family = env_id.split("/")[-1].split("-")[0]
        common.write(
            f"collection-{family}",
            f"Collection, {env_id}",
            [common.table(header, rows)],
            result,
            options.out,
            {**settings, "copies of SB3's and Gymnasium's": others_of(env_id)},
            options.threads,
        )


if __name__ == "__main__":
    main()
