"""Wrappers around a task family: which ones change it, and what to say of them."""

import re

import gymnasium as gym
from stable_baselines3.common import vec_env as sb3_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

#: These leave alone what is seen, done and paid; the patched one is rl_zoo3's.
HARMLESS = frozenset(
    {
        *("HumanRendering", "Monitor", "OrderEnforcing", "PassiveEnvChecker", "PatchedTimeLimit"),
        *("RecordEpisodeStatistics", "RecordVideo", "RenderCollection", "TimeLimit"),
        *("VecCheckNan", "VecMonitor", "VecVideoRecorder"),
    }
)
#: All others of Gymnasium and Stable-Baselines3 may change it, as may these kinds.
CHANGING = frozenset({*gym.wrappers.__all__, *sb3_vec_env.__all__}) - HARMLESS
CHANGING_KINDS = (gym.ObservationWrapper, gym.RewardWrapper, gym.ActionWrapper)


class WrapperError(ValueError):
    """Something stands between a family and the model, and changes what is seen, done or paid."""

    def __init__(self, what: str) -> None:
        super().__init__(
            f"{what}: the model standardises observations and rewards itself, and relabels rewards "
            "by the family's own function. Pass the environment without it (in YAML: no `normalize`, "
            "`frame_stack`, `env_wrapper`, `vec_env_wrapper`), or change the family itself"
        )


def wrapper_names(env: VecEnv) -> list[str]:
    """The wrappers around a vectorised environment and around its copies, outermost first."""
    names = []
    while isinstance(env, VecEnvWrapper):
        names.append(type(env).__name__)
        env = env.venv
    for chain in dict.fromkeys(env.env_method("__str__")):  # which SubprocVecEnv's workers give too
        words = re.findall(r"<([^<>]+)", chain)
        names += words[: -1 if words and words[-1].endswith(" instance") else -2]
    return list(dict.fromkeys(names))


def unknown_wrappers(env: VecEnv) -> list[str]:
    """The names of those wrappers of which it is not known whether they change the family.

    :param env: Vectorised environment of a family
    :raises WrapperError: if there are such as do
    """
    names = wrapper_names(env)
    changing = [name for name in names if name in CHANGING]
    changing += [kind.__name__ for kind in CHANGING_KINDS if any(env.env_is_wrapped(kind))]
    if changing:
        raise WrapperError(
            f"env must not be wrapped in {changing[0]} (its wrappers: {', '.join(names)})"
        )
    unknown = [name for name in names if name not in HARMLESS]
    for space in ("observation_space", "action_space") if unknown else ():
        own = getattr(env.get_attr("unwrapped", indices=[0])[0], space)
        if own != getattr(env, space):
            raise WrapperError(
                f"env's wrappers ({', '.join(names)}) must leave {space} {own}, but make it {getattr(env, space)}"
            )
    return unknown
