"""Wrappers around a task family: which ones change it, and what to say of them."""

import gymnasium as gym
from stable_baselines3.common import vec_env as sb3_vec_env

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
            "by the family's own function. Pass the environment without it (in YAML: no "
            "`normalize`, `frame_stack`, `env_wrapper`, `vec_env_wrapper`), or change the family "
            "itself"
        )
