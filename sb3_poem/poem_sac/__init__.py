"""POEM on soft actor-critic."""

from sb3_poem.poem_sac.poem_sac import POEMSAC
from sb3_poem.poem_sac.policies import MlpPolicy

__all__ = ["POEMSAC", "MlpPolicy"]
