"""A plain implementation of POEM's gradient step, to measure against: the same mathematics in eager
float32.

It is written as public code of context-based meta-RL is organised: a numpy buffer for each task and
a Python loop that samples from them, a module for each critic, a loss and an optimiser for each
network, one after another.
"""

import copy

import numpy as np
import torch as th
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits, mse_loss, softplus

from sb3_poem import POEMSAC

TRANSITIONS_PER_TASK = 2_000


class TaskData:
    """What one task has collected, as numpy arrays."""

    def __init__(self, model: POEMSAC, task: int) -> None:
        sources = th.full((1, TRANSITIONS_PER_TASK), task, device=model.device)
        stored = model.replay_buffer.sample_rows(sources, model.generators.torch)
        self.fields = [field[0].cpu().numpy().copy() for field in stored[:5]]
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
        self.data = [TaskData(model, task) for task in range(len(self.returns))]
        self.rng = np.random.default_rng(seed)
        self.obs_mean, self.obs_std = policy.obs_norm.mean.cpu(), policy.obs_norm.std.cpu()
        self.reward_mean = policy.reward_norm.mean.cpu()
        self.reward_std = policy.reward_norm.std.cpu()
        self.reward_variance = model.epoch_context.rewards.var().cpu()

    def step(self, n_tasks: int, batch_size: int) -> None:
        """Sample a meta-batch, and update every network once."""
        tasks = self.rng.choice(len(self.data), size=n_tasks, replace=False)
        batches = [self.data[task].sample(self.rng, batch_size) for task in tasks]
        size = self.settings.context_size
        contexts = [self.data[task].sample_context(self.rng, size) for task in tasks]
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
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Losses of the critics, actor, decoder, KL and preferences, and the actions' mean
        log-probability.
        """
        observations, actions, next_observations, rewards, terminated = batch
        n_tasks, batch_size = rewards.shape
        alpha = self.log_alpha.detach().exp()
        # posterior: a product of Gaussian factors
        mean, raw = self.encoder(context).chunk(2, dim=-1)
        precision = 1.0 / softplus(raw).clamp(min=1e-7)
        variance = 1.0 / precision.sum(dim=1)
        mean = variance * (precision * mean).sum(dim=1)
        kl = 0.5 * (mean**2 + variance - 1.0 - variance.log()).sum(dim=-1).mean()
        z = mean + variance.sqrt() * noises[0]
        z_rows = z.repeat_interleave(batch_size, dim=0)
        obs, next_obs = (
            self.standardise(values).flatten(0, 1) for values in (observations, next_observations)
        )
        acts, rews, ends = actions.flatten(0, 1), rewards.flatten(), terminated.flatten()
        # critics
        with th.no_grad():
            z_pi = self.policy_embedding(z_rows)
            next_actions, next_log_prob = self.act(next_obs, z_pi, noises[1].flatten(0, 1))
            inputs = th.cat([next_obs, next_actions, z_rows], dim=1)
            next_values = [target(inputs) for target in self.targets]
            next_value = th.min(*next_values).squeeze(1) - alpha * next_log_prob
            wanted = rews / self.reward_std + self.settings.gamma * (1.0 - ends) * next_value
        values = [critic(th.cat([obs, acts, z_rows], dim=1)).squeeze(1) for critic in self.critics]
        critic_loss = sum((0.5 * mse_loss(value, wanted) for value in values), th.zeros(()))
        # actor
        z_pi = self.policy_embedding(z_rows)
        new_actions, log_prob = self.act(obs, z_pi, noises[2].flatten(0, 1))
        inputs = th.cat([obs, new_actions, z_rows.detach()], dim=1)
        new_values = [critic(inputs) for critic in self.critics]
        actor_loss = (alpha * log_prob - th.min(*new_values).squeeze(1)).mean()
        # decoder, on the context (eq. 4)
        obs_dim, action_dim = obs.shape[1], acts.shape[1]
        z_context = self.reward_embedding(z)[:, None].expand(-1, context.shape[1], -1)
        inputs = th.cat([context[..., : 2 * obs_dim + action_dim], z_context], dim=-1)
        decoded = self.decoder(inputs).squeeze(-1)
        decoded = decoded * self.reward_std + self.reward_mean
        decoder_loss = mse_loss(decoded, context_rewards) / self.reward_variance
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
        return critic_loss, actor_loss, decoder_loss, kl, th.cat(terms).mean(), log_prob.mean()

    def update(
        self,
        batch: list[th.Tensor],
        context: th.Tensor,
        context_rewards: th.Tensor,
        returns: th.Tensor,
        noises: list[th.Tensor],
    ) -> None:
        """One loss after another, one optimiser after another."""
        settings = self.settings
        critic, actor, decoder, kl, preference, log_prob = self.losses(
            batch, context, context_rewards, returns, noises
        )
        for optimizer in self.optimizers:
            optimizer.zero_grad()
        (settings.policy_coef * actor).backward(retain_graph=True)
        for network in self.critics:  # the actor's loss must not move the critics
            network.zero_grad()
        coefs = (settings.kl_coef, settings.reward_coef, settings.preference_coef)
        for coef, loss in zip(coefs, (kl, decoder, preference), strict=True):
            (coef * loss).backward(retain_graph=True)
        critic.backward()
        for optimizer in self.optimizers:
            optimizer.step()
        self.alpha_optimizer.zero_grad()
        assert isinstance(settings.target_entropy, float)
        (-self.log_alpha * (log_prob.detach() + settings.target_entropy)).sum().backward()
        self.alpha_optimizer.step()
        with th.no_grad():
            for target, source in zip(self.targets, self.critics, strict=True):
                for old, new in zip(target.parameters(), source.parameters(), strict=True):
                    old.mul_(1.0 - settings.tau).add_(settings.tau * new)

    def standardise(self, obs: th.Tensor) -> th.Tensor:
        return ((obs - self.obs_mean) / self.obs_std).clamp(-10.0, 10.0)

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
