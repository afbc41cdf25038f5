"""What a task family is called on the page, and how its tasks are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Description:
    """
    A family in words for somebody who does not program.

    :param title: Its name.
    :param hint: What one may wish for.
    :param picture: How its tasks are drawn: "place", "speed", "direction", or "projection" of the latent.
    :param unit: Of the numbers in the picture.
    :param extent: Half the width of a "place" picture, or the largest speed.
    """

    title: str
    hint: str
    picture: str
    unit: str = ""
    extent: float = 1.0


PLACE_HINT = "Think of a place where it should go. It cannot see the place; your answers show the way."
SPEED_HINT = "Think of a speed at which it should run, from standing still to as fast as it can."
WAY_HINT = "Think of the way it should run: forward or backward."
DIRECTION_HINT = "Think of a direction in which it should walk."
REACH_HINT = "Think of a place that its hand should reach. It cannot see the place; your answers show the way."
BOX_HINT = "Think of a place where the box should lie in the end. It cannot see the place; your answers show the way."
ARM_HINT = "Think of what its hand should do, and where."

DESCRIPTIONS = {
    "PointGoal": Description("A dot that goes to a place", PLACE_HINT, "place", extent=1.35),
    "HalfCheetahVel": Description("A running cheetah: how fast?", SPEED_HINT, "speed", "m/s", 3.0),
    "HalfCheetahFwdBack": Description("A running cheetah: which way?", WAY_HINT, "direction"),
    "AntVel": Description("A four-legged robot: how fast?", SPEED_HINT, "speed", "m/s", 3.0),
    "AntFwdBack": Description("A four-legged robot: which way?", WAY_HINT, "direction"),
    "AntDir2D": Description("A four-legged robot: in which direction?", DIRECTION_HINT, "direction"),
    "HumanoidDir2D": Description("A humanoid: in which direction?", DIRECTION_HINT, "direction"),
    "AntGoal": Description("A four-legged robot that goes to a place", PLACE_HINT, "place", "m", 3.5),
    "FetchReach": Description("A robot arm that reaches for a place", REACH_HINT, "projection"),
    "FetchPush": Description("A robot arm that pushes a box", BOX_HINT, "projection"),
    "MetaWorldML1": Description("A robot arm at a table: where?", REACH_HINT, "projection"),
    "MetaWorldML10": Description("A robot arm at a table: what, and where?", ARM_HINT, "projection"),
    "AntMaze": Description("A four-legged robot in a maze", PLACE_HINT, "projection"),
}
OTHER_HINT = "Think of what it should do. Your answers show it."


def describe(env_id: str) -> Description:
    """
    The description of a family.

    :param env_id: The environment's id.
    :return: Its description; families that are not known here get a general one.
    """
    name = env_id.rpartition("/")[2].rpartition("-v")[0] or env_id
    return DESCRIPTIONS.get(name, Description(name, OTHER_HINT, "projection"))


def as_points(env_id: str, tasks: np.ndarray) -> np.ndarray:
    """
    Tasks as points that may be averaged: places, unit vectors of directions, speeds.

    :param env_id: The environment's id.
    :param tasks: (n, task_dim).
    :return: (n, 1) speeds, or (n, 2) places or unit vectors, x to the right and y upwards in the videos.
    """
    picture = describe(env_id).picture
    if picture == "speed" or (picture == "place" and tasks.shape[1] >= 2):
        return tasks[:, : 1 if picture == "speed" else 2]
    if env_id.rpartition("/")[2].startswith(("HalfCheetahFwdBack", "AntFwdBack")):
        return np.stack([tasks[:, 0], np.zeros(len(tasks))], axis=1)
    return np.stack([np.cos(tasks[:, 0]), np.sin(tasks[:, 0])], axis=1)
