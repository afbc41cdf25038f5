"""What a task family is called on the page, and how its tasks are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class View:
    """Where a camera sees places in space.

    :param origin: (3,) the place in the middle of the picture: where the hand begins.
    :param right: (3,) unit vector to the right in the video.
    :param up: (3,) unit vector upwards in the video.
    """

    origin: tuple[float, float, float]
    right: tuple[float, float, float]
    up: tuple[float, float, float]


@dataclass(frozen=True)
class Description:
    """A family in words for somebody who does not program.

    :param title: Its name.
    :param hint: What one may wish for.
    :param picture: How its tasks are drawn: "place", "speed", "direction", or "projection" of the
        latent.
    :param unit: Of the numbers in the picture.
    :param extent: Half the width of a "place" picture, or the largest speed.
    :param view: How places in space are seen; None for places in the plane.
    """

    title: str
    hint: str
    picture: str
    unit: str = ""
    extent: float = 1.0
    view: View | None = None


PLACE_HINT = (
    "Think of a place where it should go. It cannot see the place; your answers show the way."
)
SPEED_HINT = "Think of a speed at which it should run, from standing still to as fast as it can."
WAY_HINT = "Think of the way it should run: forward or backward."
DIRECTION_HINT = "Think of a direction in which it should walk."
REACH_HINT = "Think of a place that its hand should reach. It cannot see the place; your answers show the way."
BOX_HINT = "Think of a place where the box should lie in the end. It cannot see the place; your answers show the way."
ARM_HINT = "Think of what its hand should do, and where."

# The cameras of gymnasium-robotics' Fetch (azimuth 132 and elevation -14 degrees) and of Meta-World
# ("corner2").
FETCH_VIEW = View((1.342, 0.749, 0.535), (0.743, 0.669, 0.0), (-0.162, 0.180, 0.970))
SAWYER_VIEW = View((0.0, 0.6, 0.2), (0.550, 0.833, -0.058), (-0.376, 0.310, 0.873))

DESCRIPTIONS = {
    "PointGoal": Description("A dot that goes to a place", PLACE_HINT, "place", extent=1.35),
    "HalfCheetahVel": Description("A running cheetah: how fast?", SPEED_HINT, "speed", "m/s", 3.0),
    "HalfCheetahFwdBack": Description("A running cheetah: which way?", WAY_HINT, "direction"),
    "AntVel": Description("A four-legged robot: how fast?", SPEED_HINT, "speed", "m/s", 3.0),
    "AntFwdBack": Description("A four-legged robot: which way?", WAY_HINT, "direction"),
    "AntDir2D": Description(
        "A four-legged robot: in which direction?", DIRECTION_HINT, "direction"
    ),
    "HumanoidDir2D": Description("A humanoid: in which direction?", DIRECTION_HINT, "direction"),
    "AntGoal": Description(
        "A four-legged robot that goes to a place", PLACE_HINT, "place", "m", 3.5
    ),
    "FetchReach": Description(
        "A robot arm that reaches for a place", REACH_HINT, "place", "m", 0.3, FETCH_VIEW
    ),
    "FetchPush": Description(
        "A robot arm that pushes a box", BOX_HINT, "place", "m", 0.3, FETCH_VIEW
    ),
    "MetaWorldML1": Description(
        "A robot arm at a table: where?", REACH_HINT, "place", "m", 0.4, SAWYER_VIEW
    ),
    "MetaWorldML10": Description(
        "A robot arm at a table: what, and where?", ARM_HINT, "projection"
    ),
    "AntMaze": Description("A four-legged robot in a maze", PLACE_HINT, "place", "m", 6.5),
}
OTHER_HINT = "Think of what it should do. Your answers show it."


def describe(env_id: str, task_dim: int | None = None) -> Description:
    """The description of a family.

    :param env_id: The environment's id.
    :param task_dim: Of its tasks, if known: those of some of Meta-World's manipulations are more
        than a place.
    :return: Its description; families that are not known here get a general one.
    """
    name = env_id.rpartition("/")[2].rpartition("-v")[0] or env_id
    description = DESCRIPTIONS.get(name, Description(name, OTHER_HINT, "projection"))
    if description.view is not None and task_dim not in (None, 3):
        return Description(description.title, ARM_HINT, "projection")
    return description


def as_points(env_id: str, tasks: np.ndarray) -> np.ndarray:
    """Tasks as points that may be averaged: places, unit vectors of directions, speeds.

    :param env_id: The environment's id.
    :param tasks: (n, task_dim).
    :return: (n, 1) speeds, or (n, 2) places or unit vectors, x to the right and y upwards in the
        videos.
    """
    description = describe(env_id, tasks.shape[1])
    picture, view = description.picture, description.view
    if view is not None:
        return (tasks - view.origin) @ np.array([view.right, view.up]).T
    if picture == "speed" or (picture == "place" and tasks.shape[1] >= 2):
        return tasks[:, : 1 if picture == "speed" else 2]
    if env_id.rpartition("/")[2].startswith(("HalfCheetahFwdBack", "AntFwdBack")):
        return np.stack([tasks[:, 0], np.zeros(len(tasks))], axis=1)
    return np.stack([np.cos(tasks[:, 0]), np.sin(tasks[:, 0])], axis=1)
