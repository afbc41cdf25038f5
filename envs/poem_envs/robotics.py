"""Environments of gymnasium-robotics as task families."""

from typing import Any

import mujoco

from poem_envs.films import Look, MujocoFilms
from poem_envs.goal_family import GoalFamily

#: Filmed by a camera that stays, with the way where the body was.
IN_SPACE: dict[str, Any] = {"follows": False, "on_floor": False}


class _RoboticsFamily(MujocoFilms, GoalFamily):
    """A goal-conditioned environment whose reward is dense or sparse."""

    def __init__(self, env: str, *, reward_type: str = "dense", **kwargs: Any) -> None:
        if reward_type not in ("dense", "sparse"):
            raise ValueError(f"reward_type={reward_type!r} must be 'dense' or 'sparse'")
        super().__init__(f"gymnasium_robotics:{env}", reward_type=reward_type, **kwargs)

    def _simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        robot: Any = getattr(self.env, "ant_env", self.env).unwrapped  # a maze's is one deeper
        return robot.model, robot.data

    def close(self) -> None:
        self._close_films()
        super().close()


class FetchReachEnv(_RoboticsFamily):
    r"""
    ## Description
    The gripper of a Fetch arm is to reach a place in the air that it cannot see: `FetchReach-v4` of
    gymnasium-robotics, with its desired goal as the hidden task.

    ## Task
    The goal `(x, y, z)` in metres, drawn as the environment does: within 0.15 of the gripper's
    start in each direction.

    ## Action Space
    The action space is a `Box(-1, 1, (4,), float32)`: movements of the gripper in x, y and z, and
    of its fingers, which are blocked.

    ## Observation Space
    The `"observation"` of `FetchReach-v4`, a `Box(-Inf, Inf, (10,), float64)`: position and
    velocity of gripper and fingers.

    ## Rewards
    `reward_type="dense"`: minus the distance to the goal; `"sparse"`: 0 within 0.05 of it, else -1.
    The reward features are the gripper's position, and `success` of the info is whether it is
    within 0.05.

    ## Episode End
    There is no early end. `gymnasium.make` truncates episodes after 50 steps.

    ## Arguments
    `reward_type` (`"dense"` or `"sparse"`), `render_mode`, `render_task`, and those of
    `FetchReach-v4`, such as `width`.
    """

    look = Look(132.0, -14.0, 0.8, (1.342, 0.749, 0.56), site="robot0:grip", **IN_SPACE)

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            "FetchReach-v4",
            observe_achieved_goal=False,  # it is in the observation already
            goal_low=(1.19, 0.59, 0.38),
            goal_high=(1.50, 0.90, 0.69),
            **kwargs,
        )


class FetchPushEnv(_RoboticsFamily):
    r"""
    ## Description
    A Fetch arm is to push a box on a table to a place that it cannot see: `FetchPush-v4` of
    gymnasium-robotics, with its desired goal as the hidden task. The box starts anew in every
    episode.

    ## Task
    The goal `(x, y, z)` in metres, drawn as the environment does: within 0.15 of the gripper's
    start in x and y, on the table.

    ## Action Space, Episode End, Arguments
    As :class:`FetchReachEnv`.

    ## Observation Space
    The `"observation"` of `FetchPush-v4`, a `Box(-Inf, Inf, (25,), float64)`: positions and
    velocities of gripper, fingers and box.

    ## Rewards
    `reward_type="dense"`: minus the distance of the box to the goal; `"sparse"`: 0 within 0.05 of
    it, else -1. The reward features are the box's position, and `success` of the info is whether it
    is within 0.05.
    """

    look = Look(132.0, -35.0, 1.0, (1.342, 0.749, 0.45), body="object0", **IN_SPACE)

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            "FetchPush-v4",
            observe_achieved_goal=False,
            goal_low=(1.19, 0.59, 0.42),
            goal_high=(1.52, 0.90, 0.43),
            **kwargs,
        )


class AntMazeEnv(_RoboticsFamily):
    r"""
    ## Description
    An ant in a U-shaped maze is to walk to a place that it cannot see: `AntMaze_UMaze-v5` of
    gymnasium-robotics, with its desired goal as the hidden task. The ant starts anew in every
    episode, wherever the goal is.

    ## Task
    The goal `(x, y)` in metres, drawn as the environment does: in a free cell of the maze.

    ## Action Space
    The action space is a `Box(-1, 1, (8,), float32)`, the torques of Ant.

    ## Observation Space
    A `Box(-Inf, Inf, (107,), float64)`: the 105 numbers of Ant-v5 without its position, and the
    position `(x, y)` behind them.

    ## Rewards
    `reward_type="dense"`: `exp(-distance to the goal)`; `"sparse"`: 1 within 0.45 of it, else 0.
    The reward features are the ant's position, and `success` of the info is whether it is within
    0.45.

    ## Episode End
    There is no early end. `gymnasium.make` truncates episodes after 700 steps.

    ## Arguments
    As :class:`FetchReachEnv`; further ones are those of `AntMaze_UMaze-v5`. A larger `maze_map`
    needs bounds of its goals: `goal_low` (-6 by default) and `goal_high` (6).
    """

    look = Look(90.0, -90.0, 25.0, (0.0, 0.0, 0.0), body="torso", follows=False)

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("AntMaze_UMaze-v5", **{"goal_low": -6.0, "goal_high": 6.0, **kwargs})
