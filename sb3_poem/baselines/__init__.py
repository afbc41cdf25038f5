"""What POEM is compared with: rules like any other."""
# ruff: noqa: F401

from sb3_poem.baselines.anole import ANOLE
from sb3_poem.baselines.fragments import replay_fragments, rollout_fragments, training_rollouts
from sb3_poem.baselines.maml_reward import (
    MAMLReward,
    MAMLRewardModel,
    MetaReward,
    meta_train_reward,
)
from sb3_poem.baselines.reward_oracle import RewardOracle
