"""Networks that PEARLSAC and POEMSAC are made of.

Hidden layers may run in bfloat16 under autocast; every output layer runs in float32, because values in the hundreds lose
their differences in eight bits of mantissa.
"""

import itertools
from collections.abc import Sequence

import numpy as np
import torch as th
from torch import nn
from torch.nn.functional import softplus

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
MIN_FACTOR_VARIANCE = 1e-7


def _full_precision(x: th.Tensor) -> th.autocast:
    return th.autocast(x.device.type, enabled=False)


class MLP(nn.Module):
    """Multi-layer perceptron with a float32 output layer.

    :param in_dim: Width of the input
    :param out_dim: Width of the output
    :param net_arch: Widths of the hidden layers
    :param activation_fn: Activation between layers
    """

    def __init__(self, in_dim: int, out_dim: int, net_arch: Sequence[int], activation_fn: type[nn.Module] = nn.ReLU) -> None:
        super().__init__()
        widths = [in_dim, *net_arch]
        layers: list[nn.Module] = []
        for width, next_width in itertools.pairwise(widths):
            layers += [nn.Linear(width, next_width), activation_fn()]
        self.hidden = nn.Sequential(*layers)
        self.output = nn.Linear(widths[-1], out_dim)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Map (..., in_dim) to (..., out_dim), float32."""
        x = self.hidden(x)
        with _full_precision(x):
            return self.output(x.float())


class EnsembleMLP(nn.Module):
    """Several perceptrons of one shape, evaluated in one batched product.

    :param n_members: Number of networks
    :param in_dim: Width of the input, shared by all
    :param out_dim: Width of the output of each
    :param net_arch: Widths of the hidden layers
    :param activation_fn: Activation between layers
    """

    def __init__(
        self,
        n_members: int,
        in_dim: int,
        out_dim: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
    ) -> None:
        super().__init__()
        widths = [in_dim, *net_arch, out_dim]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise(widths):
            bound = 1.0 / np.sqrt(fan_in)  # nn.Linear's own initialisation
            self.weights.append(nn.Parameter(th.empty(n_members, fan_in, fan_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(th.empty(n_members, 1, fan_out).uniform_(-bound, bound)))
        self.activation = activation_fn()
        self.n_members = n_members

    def forward(self, x: th.Tensor, frozen: bool = False) -> th.Tensor:
        """Evaluate all members on the same input.

        :param x: (batch, in_dim)
        :param frozen: Do not build a graph to the parameters; gradients still reach ``x``
        :return: (n_members, batch, out_dim), float32
        """
        weights = [w.detach() for w in self.weights] if frozen else list(self.weights)
        biases = [b.detach() for b in self.biases] if frozen else list(self.biases)
        h = x.expand(self.n_members, *x.shape)
        for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
            h = self.activation(th.baddbmm(bias, h, weight))
        with _full_precision(h):
            return th.baddbmm(biases[-1], h.float(), weights[-1])


class ContextEncoder(nn.Module):
    """Probabilistic, permutation-invariant task encoder q_phi(z | c).

    Each transition of the context gives one Gaussian factor; their normalised product is the posterior, as in
    Rakelly et al. (2019), which section 5.3 of Xu & Zhu (2025) takes over.

    :param in_dim: Width of one context transition
    :param latent_dim: Dimension d of the latent
    :param net_arch: Widths of the hidden layers
    """

    def __init__(self, in_dim: int, latent_dim: int, net_arch: Sequence[int] = (200, 200, 200)) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.mlp = MLP(in_dim, 2 * latent_dim, net_arch)

    def forward(self, context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Posterior of every task.

        :param context: (tasks, transitions, in_dim)
        :return: mean and variance, each (tasks, latent_dim)
        """
        mean, raw_variance = self.mlp(context).chunk(2, dim=-1)
        precision = 1.0 / softplus(raw_variance).clamp(min=MIN_FACTOR_VARIANCE)
        variance = 1.0 / precision.sum(dim=-2)
        return variance * (precision * mean).sum(dim=-2), variance


class LatentActor(nn.Module):
    """Squashed Gaussian policy pi_theta(a | s, z_pi).

    :param obs_dim: Width of a (standardised) observation
    :param latent_dim: Width of the policy embedding
    :param action_dim: Width of an action
    :param net_arch: Widths of the hidden layers
    """

    def __init__(
        self,
        obs_dim: int,
        latent_dim: int,
        action_dim: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
    ) -> None:
        super().__init__()
        self.mlp = MLP(obs_dim + latent_dim, 2 * action_dim, net_arch, activation_fn)

    def distribution(self, obs: th.Tensor, embedding: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Mean and log standard deviation before squashing, each (..., action_dim)."""
        mean, log_std = self.mlp(th.cat([obs, embedding], dim=-1)).chunk(2, dim=-1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def forward(
        self, obs: th.Tensor, embedding: th.Tensor, noise: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor | None]:
        """Sample actions in [-1, 1].

        :param obs: (..., obs_dim), standardised
        :param embedding: (..., latent_dim), the policy embedding z_pi
        :param noise: (..., action_dim) standard normal draws; None takes the mean action
        :return: actions (..., action_dim), and their log-probability (...), None without noise
        """
        mean, log_std = self.distribution(obs, embedding)
        if noise is None:
            return th.tanh(mean), None
        pre_tanh = mean + log_std.exp() * noise
        # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)) does not saturate
        log_jacobian = 2.0 * (np.log(2.0) - pre_tanh - softplus(-2.0 * pre_tanh))
        log_prob = -0.5 * noise.pow(2) - log_std - 0.5 * np.log(2.0 * np.pi) - log_jacobian
        return th.tanh(pre_tanh), log_prob.sum(dim=-1)


class LatentCritic(nn.Module):
    """Action values Q(s, a, z) of several critics at once.

    :param obs_dim: Width of a (standardised) observation
    :param action_dim: Width of an action
    :param latent_dim: Width of the latent
    :param net_arch: Widths of the hidden layers
    :param n_critics: Number of critics
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        latent_dim: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        n_critics: int = 2,
    ) -> None:
        super().__init__()
        self.ensemble = EnsembleMLP(n_critics, obs_dim + action_dim + latent_dim, 1, net_arch, activation_fn)

    def forward(self, obs: th.Tensor, actions: th.Tensor, latents: th.Tensor, frozen: bool = False) -> th.Tensor:
        """Values of (batch, obs_dim), (batch, action_dim), (batch, latent_dim) -> (n_critics, batch)."""
        return self.ensemble(th.cat([obs, actions, latents], dim=-1), frozen).squeeze(-1)


class RewardDecoder(nn.Module):
    """Reward model r_theta_r(s, a, s', z_r), in standardised units of reward.

    :param obs_dim: Width of a (standardised) observation
    :param action_dim: Width of an action
    :param latent_dim: Width of the reward embedding
    :param net_arch: Widths of the hidden layers
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        latent_dim: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
    ) -> None:
        super().__init__()
        self.mlp = MLP(2 * obs_dim + action_dim + latent_dim, 1, net_arch, activation_fn)

    def forward(self, obs: th.Tensor, actions: th.Tensor, next_obs: th.Tensor, embedding: th.Tensor) -> th.Tensor:
        """Predicted standardised rewards (...) of transitions (..., dim)."""
        return self.mlp(th.cat([obs, actions, next_obs, embedding], dim=-1)).squeeze(-1)

    def for_embeddings(
        self, obs: th.Tensor, actions: th.Tensor, next_obs: th.Tensor, embeddings: th.Tensor, chunk_size: int = 4
    ) -> th.Tensor:
        """Predicted standardised rewards (m, steps) of the same transitions (steps, dim) under each of m embeddings (m, d).

        The first layer sees the transitions once, not m times, and few embeddings at a time stay in the cache.
        """
        first, rest = self.mlp.hidden[0], self.mlp.hidden[1:]
        assert isinstance(first, nn.Linear)
        transitions = th.cat([obs, actions, next_obs], dim=-1)
        of_transitions, of_embeddings = first.weight.split([transitions.shape[-1], embeddings.shape[-1]], dim=1)
        base = transitions @ of_transitions.T + first.bias  # (steps, width)
        shifts = (embeddings @ of_embeddings.T)[:, None, :]  # (m, 1, width)
        rewards = [self.mlp.output(rest(base + shift)).squeeze(-1) for shift in shifts.split(chunk_size)]
        return th.cat(rewards)
