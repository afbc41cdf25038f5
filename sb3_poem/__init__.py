"""Meta-RL with adaptation from human feedback, as an extension of Stable-Baselines3.

Names load on first use, so that ``import sb3_poem`` and the command line's help do not wait for
torch.
"""
# ruff: noqa: F401

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from poem_envs import set_task  # which registers the environments, too

if TYPE_CHECKING:
    from sb3_poem.adaptation import (
        Bayes,
        BoltzmannOracle,
        HumanOracle,
        MistakeOracle,
        Paper,
        Preference,
        PreferenceAdapter,
        Query,
        ReturnOracle,
    )
    from sb3_poem.adaptation.callback import AdaptationEvalCallback
    from sb3_poem.baselines import ANOLE, MAMLReward, RewardOracle
    from sb3_poem.common.vec_env import TaskVecEnv
    from sb3_poem.pearl_sac import PEARLSAC
    from sb3_poem.pearl_sac.callbacks import TrainingCheckpointCallback
    from sb3_poem.poem_sac import POEMSAC

__version__ = Path(__file__).with_name("version.txt").read_text().strip()

_HOME = {
    "sb3_poem.poem_sac": ("POEMSAC",),
    "sb3_poem.pearl_sac": ("PEARLSAC",),
    "sb3_poem.pearl_sac.callbacks": ("TrainingCheckpointCallback",),
    "sb3_poem.common.vec_env": ("TaskVecEnv",),
    "sb3_poem.baselines": ("ANOLE", "MAMLReward", "RewardOracle"),
    "sb3_poem.adaptation": (
        *("PreferenceAdapter", "Bayes", "Paper", "Preference", "Query"),
        *("ReturnOracle", "BoltzmannOracle", "MistakeOracle", "HumanOracle"),
    ),
    "sb3_poem.adaptation.callback": ("AdaptationEvalCallback",),
}
_MODULE = {name: module for module, names in _HOME.items() for name in names}

__all__ = [*_MODULE, "__version__", "set_task"]


def __getattr__(name: str) -> Any:
    if name not in _MODULE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULE[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
