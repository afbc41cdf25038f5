"""A plain implementation of POEM's gradient step, to measure against: the same mathematics in eager
float32.

It is written as public code of context-based meta-RL is organised: a numpy buffer for each task and
a Python loop that samples from them, a module for each critic, a loss and an optimiser for each
network, one after another.
"""

import copy
from dataclasses import replace

import numpy as np
import torch as th
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, mse_loss, softplus

from sb3_poem import POEMSAC
from sb3_poem.pearl_sac.sampler import MetaBatch

TRANSITIONS_PER_TASK = 2_000


def fields(model: POEMSAC, batch: MetaBatch) -> list[th.Tensor]:
    """Observations, actions, next observations and rewards; then what the critics' targets are made
    of: rewards, observations and discounts. Observations are standardised.
    """
    data, ahead, standardise = batch.transitions, batch.bootstraps, model.policy.standardise
    seen = standardise(data.observations), data.actions, standardise(data.next_observations)
    return [*seen, data.rewards, ahead.rewards, standardise(ahead.observations), ahead.discounts]


class TaskData:
    """What one task has collected, as numpy arrays: the transitions of a meta-batch of all tasks,
    standardised, relabelled and with their bootstraps already.
    """

    def __init__(self, model: POEMSAC, task: int, batch: MetaBatch, row: int) -> None:
        self.fields = [field[row].cpu().numpy().copy() for field in fields(model, batch)]
        assert model.epoch_context is not None
        self.context = model.epoch_context.transitions[task].cpu().numpy().copy()
        self.context_rewards = model.epoch_context.rewards[task].cpu().numpy().copy()

    def sample(self, rng: np.random.Generator, batch_size: int) -> list[th.Tensor]:
        picks = rng.integers(len(self.fields[0]), size=batch_size)
        return [th.from_numpy(field[picks]) for field in self.fields]

    def sample_context(self, rng: np.random.Generator, size: int) -> tuple[th.Tensor, th.Tensor]:
        picks = rng.integers(len(self.context), size=size)
        return th.from_numpy(self.context[picks]), th.from_numpy(self.context_rewards[picks])


class PlainPOEM:
    """POEM's update without any of the library's machinery.

    :param model: A model with data; its networks' weights, its data and its settings are copied
    """

    def __init__(self, model: POEMSAC, seed: int = 0) -> None:
        policy = model.policy
        self.settings = model
        networks = [policy.encoder.mlp, policy.decoder.mlp, policy.actor.mlp]
        networks += [policy.policy_mapping, policy.reward_mapping]
        plain = list(map(perceptron, networks))
        self.encoder, self.decoder, self.actor, self.policy_embedding, self.reward_embedding = plain
        self.critics = [perceptron(member) for member in policy.critic.members]
        self.targets = copy.deepcopy(self.critics)
        assert model.log_ent_coef is not None
        self.log_alpha = model.log_ent_coef.detach().clone().requires_grad_()
        rate = model.policy.optimizer.param_groups[0]["lr"]
        trained = [*plain, *self.critics]
        self.optimizers = [th.optim.Adam(network.parameters(), lr=rate) for network in trained]
        self.alpha_optimizer = th.optim.Adam([self.log_alpha], lr=rate)
        assert model.epoch_context is not None
        self.returns = model.epoch_context.returns.cpu()
        n_tasks = len(self.returns)
        sampler = replace(model.make_sampler(), meta_batch_size=n_tasks)
        (whole,) = sampler.sample(1, TRANSITIONS_PER_TASK)
        rows = whole.task_ids.argsort().tolist()
        self.data = [TaskData(model, task, whole, row) for task, row in enumerate(rows)]
        self.n_updates = 0
        self.rng = np.random.default_rng(seed)
        self.reward_mean = policy.reward_norm.mean.cpu()
        self.reward_std = policy.reward_norm.std.cpu()
        self.reward_variance = model.epoch_context.rewards.var().cpu()

    def step(self, n_tasks: int, batch_size: int) -> None:
        """Sample a meta-batch, and update the networks whose turn it is."""
        tasks = self.rng.choice(len(self.data), size=n_tasks, replace=False)
        batches = [self.data[task].sample(self.rng, batch_size) for task in tasks]
        size = self.settings.context_size
        contexts = [self.data[task].sample_context(self.rng, size) for task in tasks]
        self.n_updates += 1
        batch = [th.stack(field) for field in zip(*batches, strict=True)]
        context, context_rewards = (th.stack(field) for field in zip(*contexts, strict=True))
        noises = [th.randn(n_tasks, self.settings.latent_dim)]
        noises += [th.randn(batch[1].shape) for _ in range(2)]
        self.update(batch, context, context_rewards, self.returns[tasks][:, tasks], noises)

    def losses(
        self,
        batch: list[th.Tensor],
        context: th.Tensor,
        context_rewards: th.Tensor,
        returns: th.Tensor,
        noises: list[th.Tensor],
        whole: bool = True,
    ) -> tuple[th.Tensor, ...]:
        """Losses of the critics and KL; if ``whole``, of actor, decoder and preferences, too, and
        the actions' mean log-probability.

        :param batch: What :func:`fields` gives
        """
        n_tasks, batch_size = batch[3].shape
        obs, acts, next_obs, rewards, ahead, ahead_obs, discounts = (
            field.flatten(0, 1) for field in batch
        )
        alpha = self.log_alpha.detach().exp()
        # posterior: a product of Gaussian factors
        mean, raw = self.encoder(context).chunk(2, dim=-1)
        precision = 1.0 / softplus(raw).clamp(min=1e-7)
        variance = 1.0 / precision.sum(dim=1)
        mean = variance * (precision * mean).sum(dim=1)
        kl = 0.5 * (mean**2 + variance - 1.0 - variance.log()).sum(dim=-1).mean()
        z = mean + variance.sqrt() * noises[0]
        z_rows = z.repeat_interleave(batch_size, dim=0)
        # critics
        with th.no_grad():
            z_pi = self.policy_embedding(z_rows)
            next_actions, next_log_prob = self.act(ahead_obs, z_pi, noises[1].flatten(0, 1))
            inputs = th.cat([ahead_obs, next_actions, z_rows], dim=1)
            next_values = [target(inputs) for target in self.targets]
            next_value = th.min(*next_values).squeeze(1) - alpha * next_log_prob
            wanted = ahead / self.reward_std + discounts * next_value
        values = [critic(th.cat([obs, acts, z_rows], dim=1)).squeeze(1) for critic in self.critics]
        critic_loss = sum((0.5 * mse_loss(value, wanted) for value in values), th.zeros(()))
        if not whole:
            return critic_loss, kl
        # actor
        z_pi = self.policy_embedding(z_rows)
        new_actions, log_prob = self.act(obs, z_pi, noises[2].flatten(0, 1))
        inputs = th.cat([obs, new_actions, z_rows.detach()], dim=1)
        new_values = [critic(inputs) for critic in self.critics]
        actor_loss = (alpha * log_prob - th.min(*new_values).squeeze(1)).mean()
        # decoder (eq. 4), on transitions that are relabelled or else on contexts
        inputs, seen = th.cat([obs, acts, next_obs], dim=1), rewards
        if self.settings.relabel_fraction == 0:
            inputs = context[..., : inputs.shape[1]].flatten(0, 1)
            seen = context_rewards.flatten()
        z_r = self.reward_embedding(z).repeat_interleave(len(seen) // n_tasks, dim=0)
        decoded = self.decoder(th.cat([inputs, z_r], dim=1)).squeeze(1)
        decoded = decoded * self.reward_std + self.reward_mean
        decoder_loss = mse_loss(decoded, seen) / self.reward_variance
        # preferences (eqs. 6 and 7), task by task
        z_r, z_pi = self.reward_embedding(z), self.policy_embedding(z)
        first, second = th.triu_indices(n_tasks, n_tasks, offset=1)
        terms = []
        for earned, scores in zip(returns, z_r @ z_pi.T, strict=True):
            label = (earned[first] > earned[second]).float()
            distinct = earned[first] != earned[second]
            margin = scores[first] - scores[second]
            loss = binary_cross_entropy_with_logits
            terms.append(loss(margin[distinct], label[distinct], reduction="none"))
        return critic_loss, kl, actor_loss, decoder_loss, th.cat(terms).mean(), log_prob.mean()

    def update(
        self,
        batch: list[th.Tensor],
        context: th.Tensor,
        context_rewards: th.Tensor,
        returns: th.Tensor,
        noises: list[th.Tensor],
    ) -> None:
        """One loss after another, one optimiser after another."""
        settings, whole = self.settings, self.n_updates % self.settings.policy_delay == 0
        critic, kl, *others = self.losses(batch, context, context_rewards, returns, noises, whole)
        for optimizer in self.optimizers:
            optimizer.zero_grad()
        if whole:
            actor, decoder, preference, log_prob = others
            (settings.policy_coef * actor).backward(retain_graph=True)
            for network in self.critics:  # the actor's loss must not move the critics
                network.zero_grad()
            (settings.reward_coef * decoder).backward(retain_graph=True)
            (settings.preference_coef * preference).backward(retain_graph=True)
        (settings.kl_coef * kl).backward(retain_graph=True)
        critic.backward()
        for optimizer in self.optimizers:
            optimizer.step()
        if whole:
            self.alpha_optimizer.zero_grad()
            assert isinstance(settings.target_entropy, float)
            (-self.log_alpha * (log_prob.detach() + settings.target_entropy)).sum().backward()
            self.alpha_optimizer.step()
        with th.no_grad():
            for target, source in zip(self.targets, self.critics, strict=True):
                for old, new in zip(target.parameters(), source.parameters(), strict=True):
                    old.mul_(1.0 - settings.tau).add_(settings.tau * new)

    def act(self, obs: th.Tensor, z_pi: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """A squashed Gaussian action and its log-probability."""
        mean, log_std = self.actor(th.cat([obs, z_pi], dim=1)).chunk(2, dim=1)
        std = log_std.clamp(-20.0, 2.0).exp()
        raw = mean + std * noise
        normal = th.distributions.Normal(mean, std)
        jacobian = 2.0 * (np.log(2.0) - raw - softplus(-2.0 * raw))
        return th.tanh(raw), (normal.log_prob(raw) - jacobian).sum(dim=1)


def perceptron(mlp: nn.Module) -> nn.Sequential:
    """The same weights as an ordinary float32 network."""
    layers: list[nn.Module] = []
    for hidden in mlp.hidden:  # type: ignore[union-attr]
        layers += [copy.deepcopy(hidden), nn.ReLU()]
    return nn.Sequential(*layers, copy.deepcopy(mlp.output)).float().requires_grad_()  # type: ignore[arg-type]
