"""What adaptation accepts as an environment, and whether a model fits it."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import gymnasium as gym

from poem_envs.registration import plain_id
from sb3_poem.common.family_view import FamilyView, vectorised

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

Env: TypeAlias = Union[gym.Env, gym.vector.VectorEnv, str, "VecEnv"]
#: How many copies an id makes where many tasks are rolled out together.
COPIES = 60


def model_and_env(
    model: Any, env: Env, n_copies: int = COPIES, render: bool = False
) -> tuple[Any, VecEnv]:
    """What adaptation is given, as it works with it.

    :param model: A model, a file or folder of one, or the name of one that ships.
    :param env: A ``gym.Env``, its id, a Gymnasium ``VectorEnv`` or an SB3 ``VecEnv``; the latter
        stays as it is. The id on which the model was trained makes it with the same arguments.
    :param n_copies: How many copies an id makes.
    :param render: Whether they render RGB images.
    :return: The model, and a vector environment.
    :raises TypeError: If one of them is something else.
    :raises FileNotFoundError: If there is no such model.
    :raises ValueError: If the model's file asks for what it may not, see
        :func:`sb3_poem.common.foreign.environment_of`.
    """
    from stable_baselines3.common.vec_env import VecEnv

    from sb3_poem.common.foreign import environment_of
    from sb3_poem.common.vec_env import as_task_vec_env, make_task_vec_env
    from sb3_poem.loading import as_model

    model = as_model(model)
    if isinstance(env, VecEnv):
        return model, env
    if isinstance(env, str):
        own = getattr(model, "env_id", None), getattr(model, "env_kwargs", {})
        _, arguments = environment_of(describe_model(model), *own, plain_id(env))
        if render:
            arguments["render_mode"] = "rgb_array"
        return model, make_task_vec_env(env, n_copies, **arguments)
    if isinstance(env, gym.Env):
        return model, vectorised(env)
    if isinstance(env, gym.vector.VectorEnv):
        return model, as_task_vec_env(env)
    raise TypeError(
        f"`env` must be a gymnasium.Env, an id, a Gymnasium VectorEnv or an SB3 VecEnv, but is {env!r}"
    )


def check_model_fits(model: Any, vec_env: VecEnv) -> None:
    """Refuse a model of other observations, actions or tasks.

    :raises ValueError: If a space differs, or a wrapper changes what is seen, done or paid.
    """
    names = ["observation_space", "action_space"]
    family = FamilyView.of(vec_env)
    if family is not None:
        family.unknown_wrappers()  # refuses those that change what is seen, done or paid
    if hasattr(model, "task_space") and family is not None:
        names.append("task_space")
    for name in names:
        expected, given = getattr(model, name), getattr(vec_env if family is None else family, name)
        if expected != given:
            raise ValueError(
                f"the model does not belong to this environment: its {name} is {expected} ({describe_model(model)}), but "
                f"the environment's is {given}"
            )


def warn_if_untrained(model: Any) -> None:
    """Warn of a model that no adaptation can help."""
    if getattr(model, "num_timesteps", None) == 0:
        warnings.warn(
            f"{describe_model(model)} has not been trained (num_timesteps is 0), so that its policies differ by chance "
            "alone; call learn(), or load a trained one",
            stacklevel=4,
        )


def describe_model(model: Any) -> str:
    """A model in a few words: its class, and the environment that it was trained on."""
    env_id = getattr(model, "env_id", None)
    return type(model).__name__ + ("" if env_id is None else f" on {env_id}")
