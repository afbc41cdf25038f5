"""The environment that a model's file names.

A file may come from anybody. It cannot name a module to import, nor arguments by which making the
environment reads other files or takes all memory or time.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator

from sb3_poem.common.family_view import DRAWING_ARGUMENTS

PLAIN_ID = re.compile(r"\w[\w.-]{0,99}(/\w[\w.-]{0,99})?", re.ASCII)
WORD = re.compile(r"[\w-]{0,100}", re.ASCII)
#: Which an image depends on, or something else that only the user of a family knows
IMAGE_ARGUMENTS = DRAWING_ARGUMENTS | {"width", "height"}
# How far an argument may be from its default, and how many numbers it may hold.
TIMES_DEFAULT, LONGEST = 100, 64


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
    :raises ValueError: If nobody names an environment, or the file's id or arguments are refused
    :raises gymnasium.error.Error: If the file's environment is not registered
    """
    given_kwargs = given_kwargs or {}
    chosen = given_id or env_id
    if chosen is None:
        raise ValueError(f"--env is needed: {source} does not say where it was trained")
    if chosen != env_id:
        return chosen, dict(given_kwargs)
    check_env_id(env_id, source)
    own = {name: value for name, value in env_kwargs.items() if name not in given_kwargs}
    defaults = _defaults(gym.spec(chosen).entry_point) if own else {}
    for name, value in own.items():
        objection = _objection(name, value, defaults)
        if objection is not None:
            raise ValueError(
                f"{source} asks for {chosen} with {name}={_short(value)}, but {objection}. If you "
                f"want it so, say so yourself: --env-kwargs {name}:VALUE, or in Python make the "
                "environment with it"
            )
    own = {name: tuple(value) if isinstance(value, list) else value for name, value in own.items()}
    return chosen, {**own, **given_kwargs}


def _defaults(entry_point: str | Callable[..., Any] | None) -> dict[str, Any]:
    """Arguments with defaults of an environment's class and of the bases to which it passes on."""
    creator: Any = load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    kinds = creator.__mro__ if isinstance(creator, type) else ()
    makers = [vars(kind)["__init__"] for kind in kinds if "__init__" in vars(kind)] or [creator]
    defaults: dict[str, Any] = {}
    for maker in makers:
        parameters = inspect.signature(maker).parameters.values()
        for parameter in parameters:
            if parameter.default is not parameter.empty:
                defaults.setdefault(parameter.name, parameter.default)
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            break
    return defaults


def _objection(name: str, value: Any, defaults: dict[str, Any]) -> str | None:
    """Why a file may not give an argument; None if it may."""
    if isinstance(value, tuple | np.ndarray | np.generic):
        value = np.asarray(value).tolist()
    if name in IMAGE_ARGUMENTS:
        return "a model's file does not say how it is drawn"
    if name not in defaults:
        known = ", ".join(sorted(set(defaults) - IMAGE_ARGUMENTS)) or "none"
        return f"its class has no such argument, it has {known}"
    default = defaults[name]
    if isinstance(default, str) and not WORD.fullmatch(default):
        return "it names another file"
    if value is None or _fits(value, default):
        return None
    wanted = "numbers or words" if default is None else f"the like of {default!r}"
    return (
        f"it must be {wanted}: at most {LONGEST}, no number more than {TIMES_DEFAULT} times the "
        "default (or 1), no word with a dot or a slash"
    )


def _fits(value: Any, default: Any) -> bool:
    """Whether a value is of its default's kind (None: of any), and in proportion to it."""
    if isinstance(value, list):
        if not isinstance(default, list | tuple | np.ndarray | None):
            return False
        kinds = [None] if default is None else np.ravel(default).tolist()
        short = len(value) <= LONGEST and not any(isinstance(item, list) for item in value)
        return short and all(any(_fits(item, kind) for kind in kinds) for item in value)
    if isinstance(value, str):
        return isinstance(default, str | None) and WORD.fullmatch(value) is not None
    if isinstance(value, bool) or isinstance(default, bool):
        return isinstance(value, bool) and isinstance(default, bool | None)
    kind = int if type(default) is int else int | float
    if not isinstance(value, kind) or not isinstance(default, int | float | None):
        return False
    return abs(value) <= TIMES_DEFAULT * max(1, abs(default or 1))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
