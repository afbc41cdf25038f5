"""What POEM is compared with, behind the same ask and tell."""

from sb3_poem.baselines.anole import ANOLEAdapter
from sb3_poem.baselines.fragments import replay_fragments, training_rollouts

__all__ = ["ANOLEAdapter", "replay_fragments", "training_rollouts"]
