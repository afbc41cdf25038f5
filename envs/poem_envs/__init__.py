"""Task families for meta-reinforcement learning. Importing this package registers them with
Gymnasium, under ``poem/``.

MuJoCo, Meta-World and gymnasium-robotics are loaded by the first ``gymnasium.make``, so that this
import is quick.
"""

import functools
from importlib import import_module
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

from poem_envs.family import TaskFamily
from poem_envs.vector import BatchFamily, TaskFamilyVector, set_task

if TYPE_CHECKING:
    from poem_envs.goal_family import GoalFamily

__all__ = ["BatchFamily", "GoalFamily", "TaskFamily", "TaskFamilyVector", "set_task"]
#: Where what is loaded on first use is
_MODULES = {"GoalFamily": "goal_family"}


def __getattr__(name: str) -> Any:
    single = name.replace("VectorEnv", "Env")
    if single not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    family = getattr(import_module(f"poem_envs.{_MODULES[single]}"), single)
    return family if single == name else functools.partial(TaskFamilyVector, family)


def _register(module: str, max_episode_steps: int, *names: str) -> None:
    for name in names:
        _MODULES[f"{name}Env"] = module
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
