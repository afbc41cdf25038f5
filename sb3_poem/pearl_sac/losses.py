"""The losses of context-based soft actor-critic on a meta-batch of tasks.

Observations are standardised here already, actions lie in [-1, 1].
"""

from typing import NamedTuple

import torch as th

from sb3_poem.common.buffers import TaskBatch
from sb3_poem.pearl_sac.policies import LatentPolicy


class Bootstraps(NamedTuple):
    """What the critics' targets are made of where they look some steps ahead.

    rewards (tasks, batch), their discounted sum until then; observations (tasks, batch, obs_dim)
    after it; discounts (tasks, batch) of the value there, 0 where the episode terminated.
    """

    rewards: th.Tensor
    observations: th.Tensor
    discounts: th.Tensor


class MetaBatch(NamedTuple):
    """What one gradient step sees of a meta-batch of tasks.

    task_ids (tasks,), transitions: a :class:`TaskBatch` (tasks, batch, ...), context (tasks,
    context_size, context_dim), context_rewards (tasks, context_size), returns (tasks, tasks): J[i,
    j], NaN where unknown; standard normal draws for the latents (tasks, latent_dim), the actions
    and the next actions (tasks, batch, action_dim); bootstraps, None where targets look one step
    ahead, which ``transitions`` tell.
    """

    task_ids: th.Tensor
    transitions: TaskBatch
    context: th.Tensor
    context_rewards: th.Tensor
    returns: th.Tensor
    latent_noise: th.Tensor
    action_noise: th.Tensor
    next_action_noise: th.Tensor
    bootstraps: Bootstraps | None = None


class TaskEmbeddings(NamedTuple):
    """Latents z of the tasks of a meta-batch, and what actor and decoder see of them; each (tasks,
    latent_dim).
    """

    latents: th.Tensor
    policy: th.Tensor
    reward: th.Tensor


def rows(latents: th.Tensor, n: int) -> th.Tensor:
    """(tasks, d) -> (tasks, n, d)."""
    return latents[:, None, :].expand(-1, n, -1)


def kl_to_prior(mean: th.Tensor, variance: th.Tensor) -> th.Tensor:
    """KL of the posteriors to N(0, I), (tasks,)."""
    return 0.5 * (mean.pow(2) + variance - 1.0 - variance.log()).sum(dim=-1)


def critic_loss(
    policy: LatentPolicy,
    batch: TaskBatch,
    embeddings: TaskEmbeddings,
    alpha: th.Tensor,
    gamma: float,
    reward_scale: th.Tensor | float,
    noise: th.Tensor,
    bootstraps: Bootstraps | None = None,
) -> th.Tensor:
    """Half the squared soft Bellman error, summed over the critics; it trains the encoder too, as
    in PEARL.

    :param noise: (tasks, batch, action_dim) standard normal draws for the next actions
    :param bootstraps: Where targets look further ahead than one step
    """
    n = batch.rewards.shape[1]
    if bootstraps is None:
        bootstraps = Bootstraps(
            batch.rewards, batch.next_observations, gamma * (1.0 - batch.terminated)
        )
    with th.no_grad():
        next_obs, z = bootstraps.observations, embeddings.latents
        next_actions, next_log_prob = policy.actor(next_obs, rows(embeddings.policy, n), noise)
        next_values = (
            policy.critic_target(next_obs, next_actions, rows(z, n)).amin(dim=0)
            - alpha * next_log_prob
        )
        targets = reward_scale * bootstraps.rewards + bootstraps.discounts * next_values
    values = policy.critic(batch.observations, batch.actions, rows(embeddings.latents, n))
    return 0.5 * len(values) * (values - targets).pow(2).mean()


def actor_loss(
    policy: LatentPolicy,
    batch: TaskBatch,
    embeddings: TaskEmbeddings,
    alpha: th.Tensor,
    noise: th.Tensor,
) -> tuple[th.Tensor, th.Tensor]:
    """Soft policy improvement: the loss, and the mean log-probability of the actions.

    :param noise: (tasks, batch, action_dim) standard normal draws for the actions
    """
    n = batch.rewards.shape[1]
    actions, log_prob = policy.actor(batch.observations, rows(embeddings.policy, n), noise)
    # the latent is a task here, not a decision: the actor must not raise its value by moving it
    z = rows(embeddings.latents.detach(), n)
    values = policy.critic(batch.observations, actions, z, frozen=True).amin(dim=0)
    mean_log_prob = log_prob.mean()
    return alpha * mean_log_prob - values.mean(), mean_log_prob


def decoder_loss(
    policy: LatentPolicy,
    obs: th.Tensor,
    actions: th.Tensor,
    next_obs: th.Tensor,
    rewards: th.Tensor,
    embedding: th.Tensor,
    variance: th.Tensor,
) -> th.Tensor:
    """Squared error of the decoder on transitions (tasks, n, ...), relative to ``variance`` (eq.
    4).
    """
    error = (
        policy.decode_rewards(obs, actions, next_obs, rows(embedding, rewards.shape[1])) - rewards
    )
    return error.pow(2).mean() / variance
