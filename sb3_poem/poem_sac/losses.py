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
    first, second = th.triu_indices(similarity.shape[0], similarity.shape[1], offset=1, device=similarity.device)
    margin = similarity[:, first] - similarity[:, second]  # (tasks, pairs)
    difference = returns[:, first] - returns[:, second]
    ordered = difference.isfinite() & (difference != 0)
    sign = difference.nan_to_num().sign()
    losses = th.where(ordered, softplus(-sign * margin), 0.0)
    n_pairs = ordered.sum()
    accuracy = ((sign * margin > 0) & ordered).sum() / n_pairs
    return losses.sum() / n_pairs.clamp(min=1), accuracy
