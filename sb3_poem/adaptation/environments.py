"""What adaptation accepts as an environment, and whether a model fits it."""

import sys
import warnings
from pathlib import Path
from typing import TypeAlias

import gymnasium as gym
from stable_baselines3.common.vec_env import VecEnv

from poem_envs.registration import plain_id
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.foreign import environment_of
from sb3_poem.common.vec_env import make_task_vec_env, vectorised
from sb3_poem.loading import as_model

Env: TypeAlias = gym.Env | gym.vector.VectorEnv | str | VecEnv
#: How many copies an id makes where many tasks are rolled out together.
COPIES = 60


def model_and_env(
    model: MetaModel | str | Path, env: Env, n_copies: int = COPIES, render: bool = False
) -> tuple[MetaModel, VecEnv]:
    """A model, and a vector environment, of what adaptation accepts as such; an id makes
    ``n_copies``, that on which the model was trained with the same arguments.

    :raises TypeError, FileNotFoundError: If one of them is something else, or there is none.
    :raises ValueError: If the model's file asks for what :func:`environment_of` refuses.
    """
    found: MetaModel = as_model(model)
    if isinstance(env, str):
        source, own = describe_model(found), (found.env_id, found.env_kwargs)
        _, arguments = environment_of(source, *own, plain_id(env))
        if render:
            arguments["render_mode"] = "rgb_array"
        return found, make_task_vec_env(env, n_copies, **arguments)
    if isinstance(env, gym.Env | gym.vector.VectorEnv | VecEnv):
        return found, vectorised(env)
    kinds = "a gymnasium.Env, an id, a Gymnasium VectorEnv or an SB3 VecEnv"
    raise TypeError(f"`env` must be {kinds}, but is {env!r}")


def check_model_fits(model: MetaModel, vec_env: VecEnv) -> None:
    """Refuse a model of other observations, actions or tasks, or a wrapper that changes them."""
    family, names = FamilyView.of(vec_env), ["observation_space", "action_space"]
    if family is not None:
        family.unknown_wrappers()  # refuses those that change what is seen, done or paid
        names += ["task_space"] * (model.task_space is not None)
    for name in names:
        expected, given = getattr(model, name), getattr(family or vec_env, name)
        if expected != given:
            raise ValueError(
                f"the model does not belong to this environment: its {name} is {expected} "
                f"({describe_model(model)}), but the environment's is {given}"
            )


def warn_if_untrained(model: MetaModel) -> None:
    """Warn of a model that no adaptation can help, at the line of the caller's own that gave it."""
    if model.num_timesteps != 0:
        return
    frame, level = sys._getframe(), 1
    while frame.f_back and frame.f_globals["__name__"].startswith("sb3_poem."):
        frame, level = frame.f_back, level + 1
    warnings.warn(
        f"{describe_model(model)} has not been trained (num_timesteps is 0), so that its policies "
        "differ by chance alone; call learn(), or load a trained one",
        stacklevel=level,
    )


def describe_model(model: MetaModel) -> str:
    """A model in a few words: its class, and the environment that it was trained on."""
    return type(model).__name__ + ("" if model.env_id is None else f" on {model.env_id}")
