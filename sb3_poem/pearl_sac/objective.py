"""What a gradient step minimises: the losses of a meta-batch, weighted and added."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch as th

from sb3_poem.common.buffers import TaskBatch
from sb3_poem.pearl_sac.policies import LatentPolicy
from sb3_poem.pearl_sac.sampler import MetaBatch

Metrics = dict[str, th.Tensor]


class TaskEmbeddings(NamedTuple):
    """Latents, and what actor and decoder see of them; each (tasks, latent_dim)."""

    latents: th.Tensor
    policy: th.Tensor
    reward: th.Tensor


def rows(latents: th.Tensor, n: int) -> th.Tensor:
    """(tasks, d) -> (tasks, n, d)."""
    return latents[:, None, :].expand(-1, n, -1)


def kl_to_prior(mean: th.Tensor, variance: th.Tensor) -> th.Tensor:
    """KL of the posteriors to N(0, I), (tasks,)."""
    return 0.5 * (mean.pow(2) + variance - 1.0 - variance.log()).sum(dim=-1)


@dataclass
class Objective:
    """PEARL's losses, of transitions that are standardised already. ``reward_scale``,
    (n_tasks,), is the factor on a task's rewards for the critics, ``reward_variance`` divides the
    decoder's squared error; other fields are PEARLSAC's.
    """

    actor_trains_encoder: ClassVar[bool] = False

    policy: LatentPolicy
    reward_scale: th.Tensor
    reward_variance: th.Tensor
    relabel_fraction: float
    kl_coef: float
    reward_coef: float
    policy_coef: float

    def loss(
        self, batch: MetaBatch, alpha: th.Tensor, whole: bool = True
    ) -> tuple[th.Tensor, Metrics]:
        """Sum of the losses, and what to log of them (Algorithm 1, lines 7 to 14). Unless
        ``whole``, those of critics and encoder alone; ``alpha`` is the entropy coefficient.
        """
        latents, kl = self.encode(batch)
        embeddings = self.embed(latents)
        transitions = self.standardised(batch.transitions)
        critic_loss = self.critic_loss(batch, transitions, embeddings, alpha)
        metrics = {"critic_loss": critic_loss, "kl": kl}
        if not whole:
            return critic_loss + self.kl_coef * kl, metrics
        actor_loss, log_prob = self.actor_loss(batch, transitions, embeddings, alpha)
        decoder_loss = self.decoder_loss(batch, transitions, embeddings)
        embedding_loss, embedding_metrics = self.embedding_loss(batch, embeddings)
        loss = critic_loss + self.policy_coef * actor_loss + self.reward_coef * decoder_loss
        loss = loss + self.kl_coef * kl + embedding_loss
        metrics |= {"actor_loss": actor_loss, "decoder_loss": decoder_loss}
        metrics |= {"entropy": -log_prob, "ent_coef": alpha}
        return loss, metrics | embedding_metrics

    def encode(self, batch: MetaBatch) -> tuple[th.Tensor, th.Tensor]:
        """Latents (tasks, latent_dim) by reparameterisation, and their posteriors' mean KL."""
        mean, variance = self.policy.encoder(batch.context)
        latents = mean + variance.sqrt() * batch.latent_noise
        return latents, kl_to_prior(mean, variance).mean()

    def embed(self, latents: th.Tensor) -> TaskEmbeddings:
        policy, seen = self.policy, latents if self.actor_trains_encoder else latents.detach()
        embeddings = policy.policy_embedding(seen), policy.reward_embedding(latents)
        return TaskEmbeddings(latents, *embeddings)

    def standardised(self, batch: TaskBatch) -> TaskBatch:
        seen = map(self.policy.standardise, (batch.observations, batch.next_observations))
        observations, next_observations = seen
        return batch._replace(observations=observations, next_observations=next_observations)

    def critic_loss(
        self, batch: MetaBatch, transitions: TaskBatch, embeddings: TaskEmbeddings, alpha: th.Tensor
    ) -> th.Tensor:
        """Half the squared soft Bellman error of all critics; it trains the encoder too."""
        policy, n = self.policy, transitions.rewards.shape[1]
        z = rows(embeddings.latents, n)
        rewards, next_obs, discounts = batch.bootstraps
        with th.no_grad():
            next_obs = policy.standardise(next_obs)
            next_embedding, noise = rows(embeddings.policy, n), batch.next_action_noise
            next_actions, next_log_prob = policy.actor(next_obs, next_embedding, noise)
            next_values = policy.critic_target(next_obs, next_actions, z).amin(dim=0)
            next_values = next_values - alpha * next_log_prob
            scale = self.reward_scale[batch.task_ids, None]
            targets = scale * rewards + discounts * next_values
        values = policy.critic(transitions.observations, transitions.actions, z)
        return 0.5 * len(values) * (values - targets).pow(2).mean()

    def actor_loss(
        self, batch: MetaBatch, transitions: TaskBatch, embeddings: TaskEmbeddings, alpha: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Soft policy improvement: the loss, and the mean log-probability of the actions."""
        obs, n = transitions.observations, transitions.rewards.shape[1]
        actions, log_prob = self.policy.actor(obs, rows(embeddings.policy, n), batch.action_noise)
        # the latent is a task here, not a decision: the actor must not raise its value by moving it
        z = rows(embeddings.latents.detach(), n)
        values = self.policy.critic(obs, actions, z, frozen=True).min(dim=0).values
        mean_log_prob = log_prob.mean()
        return alpha * mean_log_prob - values.mean(), mean_log_prob

    def decoder_loss(
        self, batch: MetaBatch, transitions: TaskBatch, embeddings: TaskEmbeddings
    ) -> th.Tensor:
        """Squared error of the decoder over ``reward_variance`` (eq. 4): on contexts or, where they
        are relabelled, on batches, which hold other tasks' policies too, as adaptation asks about.
        """
        inputs = transitions.observations, transitions.actions, transitions.next_observations
        rewards = transitions.rewards
        if self.relabel_fraction == 0:
            widths = [part.shape[-1] for part in inputs]
            inputs = batch.context[..., : sum(widths)].split(widths, dim=-1)
            rewards = batch.context_rewards
        embedding = rows(embeddings.reward, rewards.shape[1])
        error = self.policy.decode_rewards(*inputs, embedding) - rewards
        return error.pow(2).mean() / self.reward_variance

    def embedding_loss(
        self, batch: MetaBatch, embeddings: TaskEmbeddings
    ) -> tuple[th.Tensor | float, Metrics]:
        """A further, weighted demand on the latents, and what to log of it; PEARL has none."""
        return 0.0, {}
