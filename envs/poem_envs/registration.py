"""Ids of environments, as people write them and as Gymnasium has them."""

import difflib
import importlib

import gymnasium as gym


def family_name(env_id: str) -> str:
    """AntGoal of poem/AntGoal-v0: an id without namespace and version."""
    return env_id.split("/")[-1].rsplit("-v", 1)[0]


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
        close = difflib.get_close_matches(name, gym.registry, n=1)
        hint = f"did you mean {close[0]!r}?" if close else "nor any like it."
        raise gym.error.NameNotFound(
            f"No environment {name!r} is registered with Gymnasium, {hint} One of your own is "
            "registered by an import of its module: 'module:id', on the command line --gym-packages"
        )
    return name
