"""PEARL's losses and the preference loss."""

from dataclasses import dataclass

import torch as th

from sb3_poem.pearl_sac.losses import MetaBatch, TaskEmbeddings
from sb3_poem.pearl_sac.objective import Metrics, Objective
from sb3_poem.poem_sac.losses import preference_loss


@dataclass
class POEMObjective(Objective):
    """POEM's losses.

    :param preference_coef: Weight of the preference loss
    """

    preference_coef: float

    def embed(self, latents: th.Tensor) -> TaskEmbeddings:
        """L_policy trains f_pi and the encoder (section 5.3)."""
        policy = self.policy
        return TaskEmbeddings(
            latents, policy.policy_embedding(latents), policy.reward_embedding(latents)
        )

    def embedding_loss(
        self, batch: MetaBatch, embeddings: TaskEmbeddings
    ) -> tuple[th.Tensor, Metrics]:
        """The preference loss (eqs. 6, 7), weighted."""
        similarities = embeddings.reward @ embeddings.policy.T  # eq. 3
        loss, accuracy = preference_loss(similarities, batch.returns)
        return self.preference_coef * loss, {
            "preference_loss": loss,
            "preference_accuracy": accuracy,
        }
