"""What POEM is compared with, behind the same ask and tell."""

from sb3_poem.baselines.anole import ANOLEAdapter
from sb3_poem.baselines.fragments import replay_fragments, training_rollouts
from sb3_poem.baselines.reward_oracle import RewardOracleAdapter

__all__ = ["ANOLEAdapter", "RewardOracleAdapter", "replay_fragments", "training_rollouts"]
