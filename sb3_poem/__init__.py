"""Meta-RL with adaptation from human feedback, as an extension of Stable-Baselines3.

Names load on first use, so that ``import sb3_poem`` and the command line's help do not wait for
torch.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from poem_envs import set_task  # which registers the environments, too

if TYPE_CHECKING:
    from sb3_poem.adaptation import (
        BoltzmannOracle,
        HumanOracle,
        MistakeOracle,
        Preference,
        PreferenceAdapter,
        Query,
        ReturnOracle,
    )
    from sb3_poem.adaptation.callback import AdaptationEvalCallback
    from sb3_poem.baselines import ANOLEAdapter, MAMLRewardAdapter, RewardOracleAdapter
    from sb3_poem.common.vec_env import TaskVecEnv
    from sb3_poem.pearl_sac import PEARLSAC
    from sb3_poem.pearl_sac.callbacks import TrainingCheckpointCallback
    from sb3_poem.poem_sac import POEMSAC

__version__ = Path(__file__).with_name("version.txt").read_text().strip()

_HOME = {
    "POEMSAC": "sb3_poem.poem_sac",
    "PEARLSAC": "sb3_poem.pearl_sac",
    "ANOLEAdapter": "sb3_poem.baselines",
    "MAMLRewardAdapter": "sb3_poem.baselines",
    "RewardOracleAdapter": "sb3_poem.baselines",
    "PreferenceAdapter": "sb3_poem.adaptation",
    "Preference": "sb3_poem.adaptation",
    "Query": "sb3_poem.adaptation",
    "ReturnOracle": "sb3_poem.adaptation",
    "BoltzmannOracle": "sb3_poem.adaptation",
    "MistakeOracle": "sb3_poem.adaptation",
    "HumanOracle": "sb3_poem.adaptation",
    "TaskVecEnv": "sb3_poem.common.vec_env",
    "AdaptationEvalCallback": "sb3_poem.adaptation.callback",
    "TrainingCheckpointCallback": "sb3_poem.pearl_sac.callbacks",
}

__all__ = [
    "PEARLSAC",
    "POEMSAC",
    "ANOLEAdapter",
    "AdaptationEvalCallback",
    "BoltzmannOracle",
    "HumanOracle",
    "MAMLRewardAdapter",
    "MistakeOracle",
    "Preference",
    "PreferenceAdapter",
    "Query",
    "ReturnOracle",
    "RewardOracleAdapter",
    "TaskVecEnv",
    "TrainingCheckpointCallback",
    "__version__",
    "set_task",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
