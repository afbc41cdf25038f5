"""What adaptation accepts as an environment, and whether a model fits it."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, cast

import gymnasium as gym

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


def as_vec_env(env: gym.Env | str | VecEnv, render: bool = False) -> tuple[VecEnv, bool]:
    """
    Any environment as an SB3 vector environment.

    :param env: A ``gym.Env``, its id, or an SB3 ``VecEnv``, which stays as it is.
    :param render: Whether an environment that is made from its id renders RGB images.
    :return: The vector environment, and whether it was made here from an id (and should be closed here).
    :raises TypeError: If it is something else.
    """
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

    if isinstance(env, VecEnv):
        return env, False
    if isinstance(env, str):
        made = gym.make(env, render_mode="rgb_array" if render else None)
        return DummyVecEnv([lambda: made]), True
    if isinstance(env, gym.Env):
        given = cast(gym.Env, env)
        return DummyVecEnv([lambda: given]), False
    raise TypeError(f"`env` must be a gymnasium.Env, an id, or an SB3 VecEnv, but is of type {type(env).__name__}")


def check_model_fits(model: Any, vec_env: VecEnv) -> None:
    """
    Refuse a model of other observations or actions, and warn of one that was not trained.

    :param model: The model.
    :param vec_env: The environment.
    :raises ValueError: If a space differs.
    """
    for name in ("observation_space", "action_space"):
        expected, given = getattr(model, name), getattr(vec_env, name)
        if expected != given:
            raise ValueError(
                f"the model does not belong to this environment: its {name} is {expected} ({describe_model(model)}), but "
                f"the environment's is {given}"
            )
    if getattr(model, "num_timesteps", None) == 0:
        warnings.warn(
            f"{describe_model(model)} has not been trained (num_timesteps is 0), so that its policies differ by chance "
            "alone; call learn(), or load a trained one",
            stacklevel=5,  # where the adapter is made
        )


def describe_model(model: Any) -> str:
    """A model in a few words: its class, and the environment that it was trained on."""
    env_id = getattr(model, "env_id", None)
    return type(model).__name__ + ("" if env_id is None else f" on {env_id}")
