"""Models that a person may choose from, their families in words, and how tasks are drawn."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from poem_envs.ant import AntDir2DEnv, AntGoalEnv
from poem_envs.films import Look
from poem_envs.humanoid import HumanoidDir2DEnv
from poem_envs.meta_world import MetaWorldEnv
from poem_envs.registration import family_name
from poem_envs.robotics import AntMazeEnv, FetchPushEnv, FetchReachEnv
from sb3_poem.common.foreign import environment_of
from sb3_poem.pearl_sac.saving import CONFIG, read_config
from sb3_poem.resources import find_folder, shipped_folder

#: What can be taught.
GROUPS = (
    *("How fast should it run?", "Which way should it go?", "Where should it go?"),
    *("Where should its hand go?", "What should it do?"),
)
FROM_THE_SIDE = Look()


@dataclass(frozen=True)
class Description:
    """A family in words for somebody who does not program."""

    title: str
    hint: str  # what one may wish for
    picture: str  # of tasks: "place", "speed", "direction", or "projection" of the latent
    unit: str = ""  # of the numbers in the picture
    extent: float = 1.0  # half the width of a "place" picture, or the largest speed
    look: Look = FROM_THE_SIDE  # of the films, whose directions are those of the picture
    origin: tuple[float, float, float] | None = None  # of places in space; None for the plane

    @property
    def words(self) -> tuple[str, str, str, str]:
        """What people call right, upwards, left and downwards in the films."""
        if self.look.marks in ("compass", "circles"):
            return ("right", "ahead", "left", "back")
        return ("right", "up", "left", "down")

    @property
    def race(self) -> bool:
        """Whether one picture of both robots tells more than two: on the floor, not in space."""
        return self.picture != "projection" and self.origin is None

    @property
    def group(self) -> str:
        """What can be taught, one of :data:`GROUPS`."""
        if self.picture == "place":
            return GROUPS[2 if self.origin is None else 3]
        return GROUPS[{"speed": 0, "direction": 1}.get(self.picture, 4)]


BLIND = "It cannot see the place; your answers show the way."
PLACE_HINT = f"Think of a place where it should go. {BLIND}"
SPEED_HINT = "Think of a speed at which it should run, from standing still to as fast as it can."
WAY_HINT = "Think of the way it should run: forward or backward."
DIRECTION_HINT = "Think of a direction in which it should walk."
REACH_HINT = f"Think of a place that its hand should reach. {BLIND}"
BOX_HINT = f"Think of a place where the box should lie in the end. {BLIND}"
ARM_HINT = "Think of what its hand should do, and where."
OTHER_HINT = "Think of what it should do. Your answers show it."

# Where hands begin.
FETCH_HAND, SAWYER_HAND = (1.342, 0.749, 0.535), (0.0, 0.6, 0.2)

ANT, CHEETAH, ARM = "A four-legged robot", "A running cheetah", "A robot arm"


def _speed(title: str) -> Description:
    return Description(f"{title}: how fast?", SPEED_HINT, "speed", "m/s", 3.0)


def _direction(title: str, look: Look) -> Description:
    return Description(f"{title}: in which direction?", DIRECTION_HINT, "direction", look=look)


def _place(title: str, hint: str, extent: float, look: Look, origin: Any = None) -> Description:
    return Description(title, hint, "place", "m", extent, look, origin)


DESCRIPTIONS = {
    "PointGoal": Description("A dot that goes to a place", PLACE_HINT, "place", extent=1.35),
    "HalfCheetahVel": _speed(CHEETAH),
    "HalfCheetahFwdBack": Description(f"{CHEETAH}: which way?", WAY_HINT, "direction"),
    "AntVel": _speed(ANT),
    "AntFwdBack": Description(f"{ANT}: which way?", WAY_HINT, "direction"),
    "AntDir2D": _direction(ANT, AntDir2DEnv.look),
    "HumanoidDir2D": _direction("A humanoid", HumanoidDir2DEnv.look),
    "AntGoal": _place(f"{ANT} that goes to a place", PLACE_HINT, 3.5, AntGoalEnv.look),
    "FetchReach": _place(
        f"{ARM} that reaches for a place", REACH_HINT, 0.3, FetchReachEnv.look, FETCH_HAND
    ),
    "FetchPush": _place(f"{ARM} that pushes a box", BOX_HINT, 0.3, FetchPushEnv.look, FETCH_HAND),
    "MetaWorldML1": _place(
        f"{ARM} at a table: where?", REACH_HINT, 0.4, MetaWorldEnv.look, SAWYER_HAND
    ),
    "MetaWorldML10": Description(f"{ARM} at a table: what, and where?", ARM_HINT, "projection"),
    "AntMaze": _place(f"{ANT} in a maze", PLACE_HINT, 6.5, AntMazeEnv.look),
}


def describe(env_id: str, task_dim: int | None = None) -> Description:
    """The description of a family, of which one that is not known here gets a general one, as do
    those of Meta-World whose tasks (task_dim,) are more than a place.
    """
    name = family_name(env_id)
    description = DESCRIPTIONS.get(name, Description(name, OTHER_HINT, "projection"))
    if description.origin is not None and task_dim not in (None, 3):
        return Description(description.title, ARM_HINT, "projection")
    return description


def as_points(env_id: str, tasks: np.ndarray) -> np.ndarray:
    """Tasks (n, task_dim) as points that may be averaged: (n, 1) speeds, or (n, 2) places or unit
    vectors, x to the right and y upwards in the films; of places in space (n, 3), the third of them
    away from who looks.
    """
    description = describe(env_id, tasks.shape[1])
    picture, look = description.picture, description.look
    if picture == "speed":
        return tasks[:, :1]
    if description.origin is not None:
        return (tasks - description.origin) @ look.axes.T
    if picture == "place" and tasks.shape[1] >= 2:
        points = tasks[:, :2]
    elif family_name(env_id) == "HalfCheetahFwdBack":
        points = np.stack([tasks[:, 0], np.zeros(len(tasks))], axis=1)
    else:
        points = np.stack([np.cos(tasks[:, 0]), np.sin(tasks[:, 0])], axis=1)
    return points @ np.array([look.right[:2], look.ahead[:2]]).T


@dataclass(frozen=True)
class ModelInfo:
    """A trained model that a person may choose, by its name: a browser never names a file."""

    name: str
    folder: Path
    env_id: str
    env_kwargs: tuple[tuple[str, Any], ...] = field(default=(), hash=False)  # may be lists

    @property
    def description(self) -> Description:
        return describe(self.env_id)

    @property
    def family(self) -> str:
        return family_name(self.env_id)


def find_models(
    model: str | None = None, env_id: str | None = None, env_kwargs: dict[str, Any] | None = None
) -> list[ModelInfo]:
    """The models of a folder, by name.

    :param model: A pretrained model's folder, a folder of such folders, the name of a shipped
        model, or of one on the Hugging Face Hub; None takes all that are shipped.
    :param env_id: The environment in which they are shown; None takes each model's own.
    :param env_kwargs: Arguments of the environment, over those that each model was trained with.
    :raises FileNotFoundError: If there is none.
    :raises ValueError: If a model is broken, or does not say its environment.
    """
    root = shipped_folder("pretrained") if model is None else find_folder(model)
    configs = [root / CONFIG] if (root / CONFIG).is_file() else sorted(root.glob(f"*/{CONFIG}"))
    if not configs:
        raise FileNotFoundError(
            f"--model {model}: {root} holds no pretrained model (a folder with {CONFIG})"
        )
    models = []
    for folder in (file.parent for file in configs):
        config = read_config(folder)
        own = config["env_id"], config["env_kwargs"]
        shown_in, arguments = environment_of(str(folder), *own, env_id, env_kwargs)
        folder = folder.resolve()
        # the Hub's cache names a folder by a hash
        named = folder.name if model is None or Path(model).exists() else Path(model).name
        models.append(ModelInfo(named, folder, shown_in, tuple(sorted(arguments.items()))))
    return models
