"""Task families for meta-reinforcement learning. Importing this package registers them with
Gymnasium, under ``poem/``.

MuJoCo, Meta-World and gymnasium-robotics are loaded by the first ``gymnasium.make``, so that this
import is quick.
"""

import functools
from importlib import import_module
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import load_env_creator, register, registry

from poem_envs.family import TaskFamily
from poem_envs.vector import BatchFamily, TaskFamilyVector, set_task

if TYPE_CHECKING:
    from poem_envs.goal_family import GoalFamily

__all__ = ["BatchFamily", "GoalFamily", "TaskFamily", "TaskFamilyVector", "set_task"]


def __getattr__(name: str) -> Any:
    if name == "GoalFamily":
        return import_module("poem_envs.goal_family").GoalFamily
    spec = registry.get(f"poem/{name.removesuffix('VectorEnv')}-v0")
    if spec is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    family: Any = load_env_creator(str(spec.entry_point))
    return functools.partial(TaskFamilyVector, family)


def _register(module: str, max_episode_steps: int, *names: str) -> None:
    for name in names:
        register(
            id=f"poem/{name}-v0",
            entry_point=f"poem_envs.{module}:{name}Env",
            vector_entry_point=f"poem_envs:{name}VectorEnv",
            max_episode_steps=max_episode_steps,
        )


_register("point_goal", 25, "PointGoal")
_register("half_cheetah", 200, "HalfCheetahVel", "HalfCheetahFwdBack")
_register("ant", 200, "AntVel", "AntFwdBack", "AntDir2D", "AntGoal")
_register("humanoid", 200, "HumanoidDir2D")
_register("meta_world", 200, "MetaWorldML1", "MetaWorldML10")
_register("robotics", 50, "FetchReach", "FetchPush")
_register("robotics", 700, "AntMaze")
