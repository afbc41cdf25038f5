"""What a model may be given as its environment."""

import contextlib
from typing import Any

import gymnasium as gym
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from poem_envs.registration import plain_id
from sb3_poem.common.vec_env import as_task_vec_env, make_task_vec_env
from sb3_poem.pearl_sac.train_tasks import DEFAULT_TRAIN_TASKS, default_train_tasks

GivenEnv = GymEnv | gym.vector.VectorEnv | str


def vectorise(
    env: GivenEnv | None,
    n_copies: int | None = None,
    n_train_tasks: int | None = None,
    trajectories_per_task: int = 1,
    **env_kwargs: Any,
) -> GymEnv | None:
    """An environment as SB3 takes it. A registered id becomes ``n_copies`` with these arguments:
    unless given, :func:`default_copies`; of a family without a vectorised version, as many as
    :func:`make_task_vec_env` steps in turn.
    """
    if isinstance(env, gym.vector.VectorEnv):
        return as_task_vec_env(env)
    if env is None or isinstance(env, gym.Env | VecEnv):
        return env
    if not isinstance(env, str):
        what = f"the class {env.__name__}" if isinstance(env, type) else f"a {type(env).__name__}"
        raise TypeError(
            f"env is {what}, but must be an environment, a vectorised one (DummyVecEnv, "
            "SubprocVecEnv, TaskVecEnv), or a registered id"
        )
    env = plain_id(env)
    if n_copies is not None:
        return make_task_vec_env(env, n_copies, max_sequential=n_copies, **env_kwargs)
    return make_task_vec_env(env, default_copies(env, n_train_tasks, trajectories_per_task))


def default_copies(env_id: str, n_train_tasks: int | None, trajectories_per_task: int) -> int:
    """How many copies of an environment to step unless told: one for each trajectory of an epoch,
    up to one per task or :data:`DEFAULT_TRAIN_TASKS`, whichever is more.
    """
    if n_train_tasks is None:
        with contextlib.closing(gym.make(env_id)) as probe:
            n_train_tasks = default_train_tasks(getattr(probe.unwrapped, "all_tasks", None))
    return min(n_train_tasks * trajectories_per_task, max(n_train_tasks, DEFAULT_TRAIN_TASKS))
