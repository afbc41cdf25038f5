"""What POEM is compared with, behind the same ask and tell."""

from sb3_poem.baselines.anole import ANOLEAdapter
from sb3_poem.baselines.fragments import replay_fragments, rollout_fragments, training_rollouts
from sb3_poem.baselines.maml_adapter import MAMLRewardAdapter, MAMLRewardModel
from sb3_poem.baselines.maml_reward import MetaReward, meta_train_reward
from sb3_poem.baselines.reward_oracle import RewardOracleAdapter

__all__ = [
    "ANOLEAdapter",
    "MAMLRewardAdapter",
    "MAMLRewardModel",
    "MetaReward",
    "RewardOracleAdapter",
    "meta_train_reward",
    "replay_fragments",
    "rollout_fragments",
    "training_rollouts",
]
