"""Environment steps per second with the policy in the loop, 120 tasks.

Every contender is stepped by the same loop with the same untrained policy (one call for all
copies). "training" is what ``learn`` does: the same with relabelling features, checks, episode
infos, callbacks and storage. The limit, which Meta-World does not have, is bare ``mujoco.rollout``
on states and controls of "TaskVecEnv", with as many threads and nothing else. EnvPool (``pip
install '.[bench]'``) steps its own versions of these robots.

    python benchmarks/bench_collection.py --env poem/AntVel-v0 poem/MetaWorldML1-v0
"""

import functools
import importlib.util
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any
from unittest import mock

import common
import gymnasium as gym
import mujoco
import numpy as np
import torch as th
from mujoco.rollout import Rollout
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from poem_envs.mujoco_family import MujocoFamily
from poem_envs.registration import family_name
from poem_envs.vector import available_cores
from sb3_poem import POEMSAC
from sb3_poem.common.vec_env import make_task_vec_env

N_TASKS, STEPS = 120, 25
ENVPOOL = {"HalfCheetah": "HalfCheetah-v4", "Ant": "Ant-v4", "Humanoid": "Humanoid-v4"}
DEFAULT_IDS = [
    f"poem/{name}-v0" for name in ("HalfCheetahVel", "AntVel", "HumanoidDir2D", "MetaWorldML1")
]


class Loop:
    """Steps of SB3's or Gymnasium's vectorised environment under a model's policy, going on where
    the last call stopped.
    """

    def __init__(self, env: Any, model: POEMSAC) -> None:
        self.env, self.model = env, model
        self.observations = self._only_ours(env.reset())
        self.copies = len(self.observations)
        # as collection does
        self.act = model.policy.acting_on(np.zeros((self.copies, model.latent_dim)))
        self.noise_shape = (self.copies, int(model.action_space.shape[0]))

    def __call__(self) -> None:
        space, policy = self.model.action_space, self.model.policy
        for _ in range(STEPS):
            noise = th.randn(self.noise_shape, generator=self.model.generators.torch)
            actions = policy.unscale_action(self.act(self.observations, noise))
            stepped = self.env.step(np.clip(actions, space.low, space.high))
            self.observations = self._only_ours(stepped[0])

    def _only_ours(self, found: Any) -> np.ndarray:
        """Gymnasium's reset has infos too, and EnvPool's robots observe more."""
        observations = found[0] if isinstance(found, tuple) else found
        return observations[:, : self.model.observation_space.shape[0]]


class Limit:
    """Bare ``mujoco.rollout`` over the states and controls of a few steps of a MuJoCo family."""

    def __init__(self, loop: Loop, family: MujocoFamily, nthread: int) -> None:
        self.model, self.frame_skip = family.model, family.frame_skip
        self.rollout = Rollout(nthread=nthread if nthread > 1 else 0)
        self.data = [mujoco.MjData(self.model) for _ in range(nthread)]
        shape = (loop.copies, self.frame_skip)
        self.controls = np.empty((*shape, self.model.nu))
        self.states = np.empty((*shape, family.states.shape[1]))
        self.recorded: list[tuple[np.ndarray, np.ndarray]] = []
        integrate = family._integrate

        def recording(actions: np.ndarray) -> np.ndarray:
            self.recorded.append((family.states.copy(), actions.copy()))
            return integrate(actions)

        with mock.patch.object(family, "_integrate", recording):
            loop()

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


def others_of(env_id: str) -> int:
    """How many copies SB3's and Gymnasium's vectorised environments step: 24 GB of memory did not
    hold 120 of Meta-World of each kind.
    """
    return 16 if "MetaWorld" in env_id else N_TASKS


def measure(env_id: str, nthread: int, repeats: int) -> dict[str, Any]:
    """Steps per second of every contender, and ratios within this run."""
    th.set_num_threads(1)
    make = functools.partial(gym.make, f"poem_envs:{env_id}")
    # forked while there are no threads yet: to start so many interpreters anew takes minutes
    others = others_of(env_id)
    processes = SubprocVecEnv([make] * others, start_method="fork")
    settings: dict[str, Any] = {"n_train_tasks": N_TASKS, "seed": 0, "device": "cpu"}
    settings |= {"buffer_size": 1000, "learning_starts": 0}
    env, own_env = (make_task_vec_env(env_id, N_TASKS, nthread=nthread) for _ in range(2))
    model, own = (POEMSAC("MlpPolicy", each, **settings) for each in (env, own_env))
    loop = Loop(env, model)
    contenders: dict[str, Callable[[], Any]] = {"TaskVecEnv": loop}
    contenders["training (with storage)"] = training(own)
    loop()
    if isinstance(family := env.vector_env.family, MujocoFamily):
        contenders["limit: bare mujoco.rollout"] = Limit(loop, family, nthread)
    contenders["SB3 DummyVecEnv"] = Loop(DummyVecEnv([make] * others), model)
    gymnasium = gym.vector.SyncVectorEnv([make] * others)
    contenders["Gymnasium SyncVectorEnv"] = Loop(gymnasium, model)
    robot = next((name for name in ENVPOOL if f"/{name}" in env_id), None)
    if robot is not None and importlib.util.find_spec("envpool") is not None:
        import envpool

        pool = envpool.make(
            ENVPOOL[robot], env_type="gymnasium", num_envs=N_TASKS, num_threads=nthread, seed=0
        )
        contenders[f"EnvPool {ENVPOOL[robot]}"] = Loop(pool, model)
    contenders["SB3 SubprocVecEnv"] = Loop(processes, model)
    seconds = common.seconds_in_turns(contenders, repeats)
    processes.close()
    copies = {name: getattr(contender, "copies", N_TASKS) for name, contender in contenders.items()}
    ours = seconds["TaskVecEnv"]
    return {
        "env_id": env_id,
        "seconds": seconds,
        "steps_per_second": {
            name: STEPS * copies[name] / float(np.median(values))
            for name, values in seconds.items()
        },
        "seconds_of_TaskVecEnv_over_own": {
            name: common.ratio(ours, values) * copies[name] / N_TASKS
            for name, values in seconds.items()
        },
    }


def main() -> None:
    given = common.arguments(__doc__, env=DEFAULT_IDS, threads=available_cores(), repeats=5)
    settings = {
        "copies": N_TASKS,
        "threads of MuJoCo and EnvPool": given.threads,
        "threads of torch": 1,
        "steps a turn": STEPS,
        "turns": given.repeats,
        "policy": "256-256, float32, one call for all copies",
    }
    header = ["contender", "environment steps per second", "TaskVecEnv is so many times as fast"]
    for env_id in given.env:
        # in a process of its own, so that a family's memory is free again for the next
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as fresh:
            result = fresh.submit(measure, env_id, given.threads, given.repeats).result()
        mine = result["seconds_of_TaskVecEnv_over_own"]
        rows = [[name, rate, 1.0 / mine[name]] for name, rate in result["steps_per_second"].items()]
        settings["copies of SB3's and Gymnasium's"] = others_of(env_id)
        name, title = f"collection-{family_name(env_id)}", f"Collection, {env_id}"
        sections = [common.table(header, rows)]
        common.write(name, title, sections, result, given.out, settings, given.threads)


if __name__ == "__main__":
    main()
