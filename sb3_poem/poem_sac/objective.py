"""PEARL's losses and the preference loss."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch as th
from torch.autograd.function import once_differentiable
from torch.nn.functional import softplus

from sb3_poem.pearl_sac.objective import Metrics, Objective, TaskEmbeddings
from sb3_poem.pearl_sac.sampler import MetaBatch
from sb3_poem.poem_sac.policies import POEMPolicy


@dataclass
class POEMObjective(Objective):
    """PEARL's losses and, weighted with ``preference_coef``, the preference loss."""

    actor_trains_encoder: ClassVar[bool] = True  # L_policy trains both (section 5.3)

    policy: POEMPolicy
    preference_coef: float

    def embedding_loss(
        self, batch: MetaBatch, embeddings: TaskEmbeddings
    ) -> tuple[th.Tensor, Metrics]:
        """The preference loss (eqs. 6, 7), weighted."""
        similarities = self.policy.compare(embeddings.reward, embeddings.policy)  # eq. 3
        loss, accuracy = preference_loss(similarities, batch.returns)
        metrics = {"preference_loss": loss, "preference_accuracy": accuracy}
        return self.preference_coef * loss, metrics


def preference_loss(similarity: th.Tensor, returns: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Bradley-Terry cross-entropy over all triples (i, j, k) of a meta-batch (eqs. 6 and 7 of Xu &
    Zhu 2025).

    Task i predicts that policy j is preferred over policy k with probability sigmoid(S[i, j] - S[i,
    k]); the truth is whether J[i, j] > J[i, k]. Pairs of equal or unknown return carry no order and
    are left out; without any pair the loss is 0.

    :param similarity: (tasks, tasks), S[i, j] = S(z_i, z_j)
    :param returns: (tasks, tasks), J[i, j], NaN where unknown
    :return: loss, and the share of pairs in the right order (NaN without pairs)
    """
    return _PreferenceLoss.apply(similarity, returns)


class _PreferenceLoss(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, similarity: th.Tensor, returns: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        # (tasks i, policies j, policies k)
        margin, difference = (x[:, :, None] - x[:, None, :] for x in (similarity, returns))
        # every pair counts twice, as (j, k) and as (k, j), which changes neither of the means
        sign = difference.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0).sign_()
        agreement = margin.mul_(sign)
        ordered = sign.abs()
        n_pairs = ordered.sum()
        counted = n_pairs.clamp(min=1.0)
        # of j's similarity, over all k: (j, k) and (k, j) give the same
        ctx.gradient = (sign * th.sigmoid(-agreement)).sum(dim=2).mul_(-2.0 / counted)
        accuracy = (agreement > 0).sum() / n_pairs
        ctx.mark_non_differentiable(accuracy)
        return ordered.mul_(softplus(-agreement)).sum() / counted, accuracy

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_loss: th.Tensor, _: th.Tensor) -> tuple[th.Tensor, None]:  # type: ignore[override]
        return ctx.gradient * of_loss, None
