"""What a gradient step minimises: the losses of a meta-batch, weighted and added."""

from dataclasses import dataclass

import torch as th

from sb3_poem.common.buffers import TaskBatch
from sb3_poem.pearl_sac import losses
from sb3_poem.pearl_sac.losses import MetaBatch, TaskEmbeddings
from sb3_poem.pearl_sac.policies import LatentPolicy

Metrics = dict[str, th.Tensor]


@dataclass
class Objective:
    """PEARL's losses.

    :param policy: The networks
    :param gamma: Discount factor
    :param reward_scale: Factor on the rewards that the critics learn
    :param reward_variance: By which the decoder's squared error is divided
    :param decodes_replay: Whether the decoder learns on transitions of the replay buffer, which
        hold other tasks' policies too, as adaptation asks it about; else on contexts
    :param kl_coef: Weight of the posteriors' KL to the prior
    :param reward_coef: Weight of the decoder's loss
    :param policy_coef: Weight of the actor's loss
    """

    policy: LatentPolicy
    gamma: float
    reward_scale: th.Tensor | float
    reward_variance: th.Tensor
    decodes_replay: bool
    kl_coef: float
    reward_coef: float
    policy_coef: float

    def loss(
        self, batch: MetaBatch, alpha: th.Tensor, whole: bool = True
    ) -> tuple[th.Tensor, Metrics]:
        """Sum of the losses of a meta-batch, and what to log of them.

        :param alpha: Entropy coefficient
        :param whole: False leaves out all but critics and encoder
        """
        latents, kl = self.encode(batch)
        embeddings = self.embed(latents)
        transitions = self.standardised(batch.transitions)
        critic_loss = self.critic_loss(batch, transitions, embeddings, alpha)
        loss, metrics = critic_loss + self.kl_coef * kl, {"critic_loss": critic_loss, "kl": kl}
        if not whole:
            return loss, metrics
        actor_loss, log_prob = losses.actor_loss(
            self.policy, transitions, embeddings, alpha, batch.action_noise
        )
        decoder_loss = self.decoder_loss(batch, transitions, embeddings)
        embedding_loss, embedding_metrics = self.embedding_loss(batch, embeddings)
        loss = (
            critic_loss
            + self.policy_coef * actor_loss
            + self.reward_coef * decoder_loss
            + self.kl_coef * kl
            + embedding_loss
        )
        metrics |= {
            "actor_loss": actor_loss,
            "decoder_loss": decoder_loss,
            "entropy": -log_prob,
            "ent_coef": alpha,
            **embedding_metrics,
        }
        return loss, metrics

    def encode(self, batch: MetaBatch) -> tuple[th.Tensor, th.Tensor]:
        """Latents (tasks, latent_dim) by reparameterisation, and the mean KL of their posteriors to
        N(0, I).
        """
        mean, variance = self.policy.encoder(batch.context)
        latents = mean + variance.sqrt() * batch.latent_noise
        return latents, losses.kl_to_prior(mean, variance).mean()

    def embed(self, latents: th.Tensor) -> TaskEmbeddings:
        """What actor and decoder see of latents (tasks, latent_dim). PEARL's encoder learns nothing
        from the actor.
        """
        policy = self.policy
        return TaskEmbeddings(
            latents, policy.policy_embedding(latents.detach()), policy.reward_embedding(latents)
        )

    def embedding_loss(
        self, batch: MetaBatch, embeddings: TaskEmbeddings
    ) -> tuple[th.Tensor | float, Metrics]:
        """A further, weighted demand on the latents, and what to log of it; PEARL has none."""
        return 0.0, {}

    def critic_loss(
        self, batch: MetaBatch, transitions: TaskBatch, embeddings: TaskEmbeddings, alpha: th.Tensor
    ) -> th.Tensor:
        bootstraps = batch.bootstraps
        if bootstraps is not None:
            ahead = self.policy.standardise(bootstraps.observations)
            bootstraps = bootstraps._replace(observations=ahead)
        return losses.critic_loss(
            self.policy,
            transitions,
            embeddings,
            alpha,
            self.gamma,
            self.reward_scale,
            batch.next_action_noise,
            bootstraps,
        )

    def decoder_loss(
        self, batch: MetaBatch, transitions: TaskBatch, embeddings: TaskEmbeddings
    ) -> th.Tensor:
        if self.decodes_replay:
            inputs = transitions.observations, transitions.actions, transitions.next_observations
            rewards = transitions.rewards
        else:
            obs_dim, action_dim = transitions.observations.shape[-1], transitions.actions.shape[-1]
            widths = [obs_dim, action_dim, obs_dim]
            inputs = batch.context[..., : sum(widths)].split(widths, dim=-1)
            rewards = batch.context_rewards
        return losses.decoder_loss(
            self.policy, *inputs, rewards, embeddings.reward, self.reward_variance
        )

    def standardised(self, batch: TaskBatch) -> TaskBatch:
        standardise = self.policy.standardise
        return batch._replace(
            observations=standardise(batch.observations),
            next_observations=standardise(batch.next_observations),
        )
