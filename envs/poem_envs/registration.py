"""Ids of environments, as people write them and as Gymnasium has them."""

import difflib
import importlib
from collections.abc import Iterable

import gymnasium as gym


def family_name(env_id: str) -> str:
    """AntGoal of poem/AntGoal-v0: an id without namespace and version."""
    return env_id.split("/")[-1].rsplit("-v", 1)[0]


def did_you_mean(name: str, known: Iterable[str], n: int = 1, cutoff: float = 0.6) -> str:
    """The end of a message that refuses a name: up to ``n`` known ones like it; empty if none is.

    >>> did_you_mean("AntGaol", ["AntGoal", "AntVel"])
    "; did you mean 'AntGoal'?"
    """
    close = difflib.get_close_matches(name, list(known), n, cutoff)
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def ids_like(name: str) -> str:
    """The end of a message that refuses an id: the registered one that is like it, whole or by its
    family's name; empty if none is.

    >>> ids_like("HalfCheetahVel")
    "; did you mean 'poem/HalfCheetahVel-v0'?"
    """
    ids = {known: env_id for env_id in gym.registry for known in (env_id, family_name(env_id))}
    close = difflib.get_close_matches(name, ids, n=1)
    return f"; did you mean {ids[close[0]]!r}?" if close else ""


def plain_id(env_id: str) -> str:
    """An environment's id as the registry has it.

    :param env_id: As for ``gym.make``: an id, or ``"module:id"``, whose module is imported first
    :raises ModuleNotFoundError: If there is no such module
    :raises gymnasium.error.NameNotFound: If there is no such id; the message names one like it
    """
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)
    if name not in gym.registry:
        hint = ids_like(name) or ", nor any like it."
        raise gym.error.NameNotFound(
            f"No environment {name!r} is registered with Gymnasium{hint} One of your own is "
            "registered by an import of its module: 'module:id', on the command line --gym-packages"
        )
    return name
