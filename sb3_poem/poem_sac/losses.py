"""The preference loss, for all triples of a meta-batch at once."""

import torch as th
from torch.nn.functional import softplus


def preference_loss(similarity: th.Tensor, returns: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Bradley-Terry cross-entropy over all triples (i, j, k) of a meta-batch (eqs. 6 and 7 of Xu & Zhu 2025).

    Task i predicts that policy j is preferred over policy k with probability sigmoid(S[i, j] - S[i, k]); the truth is whether
    J[i, j] > J[i, k]. Pairs of equal or unknown return carry no order and are left out; without any pair the loss is 0.

    :param similarity: (tasks, tasks), S[i, j] = S(z_i, z_j)
    :param returns: (tasks, tasks), J[i, j], NaN where unknown
    :return: loss, and the share of pairs in the right order (NaN without pairs)
    """
    margin = similarity[:, :, None] - similarity[:, None, :]  # (tasks i, policies j, policies k)
    # every pair counts twice, as (j, k) and as (k, j), which changes neither of the means
    sign = (returns[:, :, None] - returns[:, None, :]).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).sign()
    agreement = sign * margin
    ordered = sign.abs()
    n_pairs = ordered.sum()
    loss = (ordered * softplus(-agreement)).sum() / n_pairs.clamp(min=1.0)
    return loss, (agreement > 0).sum() / n_pairs
