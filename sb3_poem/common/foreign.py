"""The environment that a model's file names.

A file may come from anybody. It cannot name a module to import, nor arguments by which making the
environment reads other files or takes all memory or time.
"""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from sb3_poem.common.family_view import DRAWING_ARGUMENTS

PLAIN_ID = re.compile(r"\w[\w.-]{0,99}(/\w[\w.-]{0,99})?", re.ASCII)
WORD = re.compile(r"[\w-]{0,100}", re.ASCII)
#: Which an image depends on, or something else that only the user of a family knows
IMAGE_ARGUMENTS = DRAWING_ARGUMENTS | {"width", "height"}
#: The largest number that an argument may be, and how many it may hold
LARGEST, LONGEST = 10_000, 64


def check_env_id(env_id: Any, source: str) -> None:
    """Refuse a file's id that is not a plain one, by which no module is imported; None is none."""
    if env_id is not None and not (isinstance(env_id, str) and PLAIN_ID.fullmatch(env_id)):
        raise ValueError(
            f"{source}: env_id is {_short(env_id)}, but an id that comes from a file must be a "
            "plain one, as 'poem/PointGoal-v0', without a module to import; name modules by "
            "--gym-packages, or import them in Python"
        )


def environment_of(
    source: str,
    env_id: str | None,
    env_kwargs: Mapping[str, Any],
    given_id: str | None = None,
    given_kwargs: Mapping[str, Any] | None = None,
) -> tuple[str, dict[str, Any]]:
    """Id and arguments for ``gym.make`` of a model's environment: those that its file names, which
    are checked, unless the user gives others, which are taken as they are.

    :param source: The model's name, for the message
    :raises ValueError: if nobody names an environment, or the file's id or arguments are refused
    """
    given_kwargs = given_kwargs or {}
    chosen = given_id or env_id
    if chosen is None:
        raise ValueError(f"--env is needed: {source} does not say where it was trained")
    if chosen != env_id:
        return chosen, dict(given_kwargs)
    check_env_id(env_id, source)
    own = {name: value for name, value in env_kwargs.items() if name not in given_kwargs}
    for name, value in own.items():
        if name in IMAGE_ARGUMENTS:
            objection = "a model's file does not say how it is drawn"
        elif not _is_plain(value):
            objection = (
                f"it must be a number up to {LARGEST:,}, a word without dot or slash, or up to "
                f"{LONGEST} of these"
            )
        else:
            continue
        raise ValueError(
            f"{source} asks for {chosen} with {name}={_short(value)}, but {objection}. If you "
            f"want it so, say so yourself: --env-kwargs {name}:VALUE, or in Python make the "
            "environment with it"
        )
    own = {name: tuple(value) if isinstance(value, list) else value for name, value in own.items()}
    return chosen, {**own, **given_kwargs}


def _is_plain(value: Any) -> bool:
    """Whether a value is a number, a word, or a short list of these."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    items = value if isinstance(value, list | tuple) else [value]
    return len(items) <= LONGEST and all(
        abs(item) <= LARGEST
        if isinstance(item, int | float)
        else item is None or (isinstance(item, str) and WORD.fullmatch(item) is not None)
        for item in items
    )


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
