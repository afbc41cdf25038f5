"""Trajectories as rows that the networks take."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_poem.common.trajectory import Trajectory
from sb3_poem.pearl_sac.policies import LatentPolicy


def standardised(policy: LatentPolicy, trajectory: Trajectory) -> th.Tensor:
    with th.no_grad():
        return policy.standardise(_tensor(policy, trajectory.observations))


def transition_rows(
    policy: LatentPolicy, trajectory: Trajectory, last: np.ndarray | float
) -> th.Tensor:
    """(T, ...) standardised (s, a, s') and a last column."""
    obs = standardised(policy, trajectory)
    actions = policy.scale_action_batch(_tensor(policy, trajectory.actions))
    column = _tensor(policy, np.full(len(actions), last))[:, None]
    return th.cat([obs[:-1], actions, obs[1:], column], dim=1)


def _tensor(policy: LatentPolicy, array: np.ndarray) -> th.Tensor:
    return th.as_tensor(array, dtype=th.float32, device=policy.device)
