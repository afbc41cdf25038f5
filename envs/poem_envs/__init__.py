"""Task families for meta-reinforcement learning. Importing this package registers them with
Gymnasium, under ``poem/``.

MuJoCo, Meta-World and gymnasium-robotics are loaded by the first ``gymnasium.make``, so that this
import is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from gymnasium.envs.registration import register

from poem_envs.family import SignedPermutation, Symmetry, TaskDefinition, TaskFamily
from poem_envs.vector import BatchFamily, BatchTaskFamily, TaskFamilyVector, set_task

if TYPE_CHECKING:
    from poem_envs.goal_family import GoalFamily
    from poem_envs.process_vector import ProcessFamilyVector

__all__ = [
    "BatchFamily",
    "BatchTaskFamily",
    "GoalFamily",
    "ProcessFamilyVector",
    "SignedPermutation",
    "Symmetry",
    "TaskDefinition",
    "TaskFamily",
    "TaskFamilyVector",
    "set_task",
]


def __getattr__(name: str) -> Any:
    homes = {"GoalFamily": "goal_family", "ProcessFamilyVector": "process_vector"}
    if name not in homes:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"poem_envs.{homes[name]}"), name)


def _register(name: str, module: str, max_episode_steps: int) -> None:
    register(
        id=f"poem/{name}-v0",
        entry_point=f"poem_envs.{module}:{name}Env",
        vector_entry_point=f"poem_envs.{module}:{name}VectorEnv",
        max_episode_steps=max_episode_steps,
    )


_register("PointGoal", "point_goal", max_episode_steps=25)
_register("HalfCheetahVel", "half_cheetah", max_episode_steps=200)
_register("HalfCheetahFwdBack", "half_cheetah", max_episode_steps=200)
_register("AntVel", "ant", max_episode_steps=200)
_register("AntFwdBack", "ant", max_episode_steps=200)
_register("AntDir2D", "ant", max_episode_steps=200)
_register("AntGoal", "ant", max_episode_steps=200)
_register("HumanoidDir2D", "humanoid", max_episode_steps=200)
_register("MetaWorldML1", "meta_world", max_episode_steps=200)
_register("MetaWorldML10", "meta_world", max_episode_steps=200)
_register("FetchReach", "robotics", max_episode_steps=50)
_register("FetchPush", "robotics", max_episode_steps=50)
_register("AntMaze", "robotics", max_episode_steps=700)
