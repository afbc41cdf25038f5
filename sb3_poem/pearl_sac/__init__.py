"""PEARL on soft actor-critic."""

from sb3_poem.pearl_sac.pearl_sac import PEARLSAC
from sb3_poem.pearl_sac.policies import MlpPolicy

__all__ = ["PEARLSAC", "MlpPolicy"]
