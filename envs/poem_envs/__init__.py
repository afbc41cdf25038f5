"""Task families for meta-reinforcement learning. Importing this package registers them with Gymnasium, under ``poem/``.

The MuJoCo families are loaded by the first ``gymnasium.make``, so that this import is quick.
"""

from gymnasium.envs.registration import register

from poem_envs.core import TaskDefinition, TaskFamily
from poem_envs.vector import BatchFamily, BatchTaskFamily, TaskFamilyVector

__all__ = ["BatchFamily", "BatchTaskFamily", "TaskDefinition", "TaskFamily", "TaskFamilyVector"]


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
