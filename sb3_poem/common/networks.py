"""Networks that PEARLSAC and POEMSAC are made of.

Hidden layers may run in bfloat16 (see :mod:`sb3_poem.common.precision`); every output layer runs in
float32, because values in the hundreds lose their differences in eight bits of mantissa.
"""

import hashlib
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from safetensors import SafetensorError
from safetensors.torch import load
from stable_baselines3.common.running_mean_std import RunningMeanStd
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear, softplus

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
MIN_FACTOR_VARIANCE = 1e-7
#: Of a standard normal and of tanh's slope, for each dimension of an action
LOG_DENSITY_CONSTANT = 0.5 * math.log(2.0 * math.pi) + 2.0 * math.log(2.0)
#: Rows of hidden values at once: enough to pay for a call, few enough for a core's cache
BLOCK_ROWS = 2000


class Normalised(nn.Module):
    """An activation of layer-normalised values (Ba, Kiros & Hinton, 2016), without gain or bias."""

    def __init__(self, activation: nn.Module) -> None:
        super().__init__()
        self.activation = activation

    def forward(self, x: th.Tensor) -> th.Tensor:
        return self.activation(nn.functional.layer_norm(x, x.shape[-1:]))


class RunningNorm(nn.Module):
    """Standardises rows by the mean and deviation of all that it was shown, to within ``clip``."""

    #: Deviations below it count as this
    MIN_STD = 1e-3

    mean: th.Tensor
    std: th.Tensor
    count: th.Tensor

    def __init__(self, width: int, clip: float | None = None) -> None:
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", th.zeros(width))
        self.register_buffer("std", th.ones(width))
        self.register_buffer("count", th.zeros((), dtype=th.int64))

    def update(self, rows: np.ndarray) -> None:
        """Take rows (n, width) into the statistics, as SB3's ``VecNormalize`` does."""
        running = RunningMeanStd(shape=self.mean.shape)
        running.mean, running.count = self.mean.double().cpu().numpy(), int(self.count)
        running.var = self.std.double().cpu().numpy() ** 2
        running.update(rows)
        with th.no_grad():
            self.mean.copy_(th.as_tensor(running.mean))
            self.std.copy_(th.as_tensor(np.maximum(np.sqrt(running.var), self.MIN_STD)))
            self.count += len(rows)

    def forward(self, rows: th.Tensor) -> th.Tensor:
        standardised = (rows - self.mean) / self.std
        return standardised if self.clip is None else standardised.clamp(-self.clip, self.clip)

    def inverse(self, standardised: th.Tensor) -> th.Tensor:
        """What :meth:`forward` mapped to ``standardised``, as far as it was not clipped."""
        return standardised * self.std + self.mean


class MLP(nn.Module):
    """Multi-layer perceptron; ``layer_norm`` normalises hidden layers before the activation."""

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        net_arch: Sequence[int],
        activation_fn: type[nn.Module] = nn.ReLU,
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        widths = [in_dim, *net_arch]
        activation = nn.ReLU(inplace=True) if activation_fn is nn.ReLU else activation_fn()
        self.activation = Normalised(activation) if layer_norm else activation
        self.hidden = nn.ModuleList(nn.Linear(*pair) for pair in itertools.pairwise(widths))
        self.output = nn.Linear(widths[-1], out_dim)
        #: The hidden layers in another arithmetic, while :class:`MixedPrecision` holds
        self.low_precision: Any = None

    def forward(self, *parts: th.Tensor, frozen: bool = False) -> th.Tensor:
        """Map parts of (..., in_dim) to (..., out_dim), float32; ``frozen`` trains no parameter."""
        return self.evaluate(self.inputs(*parts), frozen)

    def inputs(self, *parts: th.Tensor) -> th.Tensor:
        """Put an input together for :meth:`evaluate`; networks of one shape may share it."""
        if self.low_precision is not None:
            return self.low_precision.inputs(parts)
        return th.cat(parts, dim=-1) if len(parts) > 1 else parts[0]

    def evaluate(self, x: th.Tensor, frozen: bool = False) -> th.Tensor:
        """:meth:`forward` of an input that :meth:`inputs` has put together."""
        if self.low_precision is not None:
            return self.low_precision.evaluate(x, frozen)
        # a product of two dimensions is no view, so that activations may work in place
        h = x.reshape(math.prod(x.shape[:-1]), x.shape[-1])
        for layer in self.hidden:
            h = self.activation(_linear(h, layer, frozen))
        return _linear(h, self.output, frozen).view(*x.shape[:-1], self.output.out_features)


def _linear(x: th.Tensor, layer: nn.Module, frozen: bool) -> th.Tensor:
    assert isinstance(layer, nn.Linear)
    return linear(x, layer.weight.detach(), layer.bias.detach()) if frozen else layer(x)


class _GaussianProduct(th.autograd.Function):
    """Mean and variance, (..., d), of the product of Gaussian factors, (..., factors, 2 d)."""

    @staticmethod
    def forward(ctx: Any, raw: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        means, raw_variances = raw.chunk(2, dim=-1)
        variances = softplus(raw_variances)
        precisions = variances.clamp(min=MIN_FACTOR_VARIANCE).reciprocal_()
        variance = precisions.sum(dim=-2).reciprocal_()
        mean = (precisions * means).sum(dim=-2).mul_(variance)
        ctx.save_for_backward(means, variances, precisions, mean, variance)
        return mean, variance

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_mean: th.Tensor, of_variance: th.Tensor) -> th.Tensor:  # type: ignore[override]
        means, variances, precisions, mean, variance = ctx.saved_tensors
        by_sum = (of_mean * variance).unsqueeze(-2)
        of_precisions = (means - mean.unsqueeze(-2)).mul_(by_sum)
        of_precisions.sub_((of_variance * variance.square()).unsqueeze(-2))
        # the slope of softplus(x) = y is 1 - exp(-y); a factor at the least variance has none
        slope = th.expm1(-variances).mul_(variances >= MIN_FACTOR_VARIANCE)
        of_variances = of_precisions.mul_(precisions.square()).mul_(slope)
        return th.cat([precisions * by_sum, of_variances], dim=-1)


class ContextEncoder(nn.Module):
    """Probabilistic, permutation-invariant task encoder q_phi(z | c): the normalised product of a
    Gaussian factor of each transition (Rakelly et al. 2019; section 5.3 of Xu & Zhu 2025).
    """

    def __init__(self, in_dim: int, latent_dim: int, net_arch: Sequence[int]) -> None:
        super().__init__()
        self.mlp = MLP(in_dim, 2 * latent_dim, net_arch)

    def forward(self, context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """(tasks, transitions, in_dim) -> posteriors' means and variances, (tasks, latent_dim)."""
        return _GaussianProduct.apply(self.mlp(context))


class _SquashedGaussian(th.autograd.Function):
    """Actions and their log-probability from means and log deviations, (..., 2 action_dim)."""

    @staticmethod
    def forward(ctx: Any, raw: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        mean, raw_log_std = raw.chunk(2, dim=-1)
        log_std = raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        shift = log_std.exp().mul_(noise)
        pre_tanh = mean + shift
        # log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)) does not saturate
        terms = softplus(pre_tanh * -2.0).add_(pre_tanh).mul_(2.0)
        terms.sub_(log_std).addcmul_(noise, noise, value=-0.5)
        actions = pre_tanh.tanh_()
        ctx.save_for_backward(actions, shift, raw_log_std)
        return actions, terms.sum(dim=-1).sub_(noise.shape[-1] * LOG_DENSITY_CONSTANT)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_actions: th.Tensor, of_log_prob: th.Tensor) -> tuple[th.Tensor, None]:  # type: ignore[override]
        actions, shift, raw_log_std = ctx.saved_tensors
        of_log_prob = of_log_prob.unsqueeze(-1)
        # tanh' = 1 - tanh^2; the log-probability's derivative by the value before squashing: 2 tanh
        of_mean = of_actions.addcmul(of_actions * actions, actions, value=-1.0)
        of_mean.addcmul_(actions, of_log_prob, value=2.0)
        of_log_std = (of_mean * shift).sub_(of_log_prob)
        inside = raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX) == raw_log_std
        return th.cat([of_mean, of_log_std.mul_(inside)], dim=-1), None


class LatentActor(nn.Module):
    """Squashed Gaussian policy pi_theta(a | s, z_pi)."""

    def __init__(self, in_dim: int, action_dim: int, *architecture: Any, **more: Any) -> None:
        super().__init__()
        self.mlp = MLP(in_dim, 2 * action_dim, *architecture, **more)

    def distribution(self, obs: th.Tensor, embedding: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Mean and log standard deviation before squashing, each (..., action_dim)."""
        mean, log_std = self.mlp(obs, embedding).chunk(2, dim=-1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def forward(
        self, obs: th.Tensor, embedding: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Actions (..., action_dim) in [-1, 1] and their log-probability (...), of standardised
        observations, policy embeddings z_pi and standard normal draws, each (..., dim).
        """
        return _SquashedGaussian.apply(self.mlp(obs, embedding), noise)


class LatentCritic(nn.Module):
    """Action values Q(s, a, z) of several critics at once."""

    def __init__(self, in_dim: int, n_critics: int, *architecture: Any, **more: Any) -> None:
        super().__init__()
        members = (MLP(in_dim, 1, *architecture, **more) for _ in range(n_critics))
        self.members = nn.ModuleList(members)

    def forward(
        self, obs: th.Tensor, actions: th.Tensor, latents: th.Tensor, frozen: bool = False
    ) -> th.Tensor:
        """Values of (..., obs_dim), (..., action_dim), (..., latent_dim) -> (n_critics, ...)."""
        members: list[MLP] = list(self.members)  # type: ignore[arg-type]
        x = members[0].inputs(obs, actions, latents)
        return th.stack([member.evaluate(x, frozen) for member in members]).squeeze(-1)


class RewardDecoder(nn.Module):
    """Reward model r_theta_r(s, a, s', z_r), in standardised units of reward."""

    def __init__(self, in_dim: int, *architecture: Any, **more: Any) -> None:
        super().__init__()
        self.mlp = MLP(in_dim, 1, *architecture, **more)

    def forward(
        self, obs: th.Tensor, actions: th.Tensor, next_obs: th.Tensor, embedding: th.Tensor
    ) -> th.Tensor:
        """Predicted standardised rewards (...) of transitions (..., dim)."""
        return self.mlp(obs, actions, next_obs, embedding).squeeze(-1)

    @th.no_grad()
    def sums(
        self,
        transitions: th.Tensor,
        lengths: Sequence[int],
        embeddings: th.Tensor,
        dtype: th.dtype,
    ) -> th.Tensor:
        """Predictions, summed over each trajectory, under each embedding (m, latent_dim): (m,
        trajectories). The first layer sees the transitions once.

        :param transitions: (steps of all trajectories, transition_dim), in order
        :param lengths: Steps of each trajectory
        :param dtype: Arithmetic of the hidden layers
        """
        groups: list[list[int]] = [[]]
        for length in lengths:
            if groups[-1] and sum(groups[-1]) + length > BLOCK_ROWS:
                groups.append([])
            groups[-1].append(length)
        parts = zip(transitions.split([sum(group) for group in groups]), groups, strict=True)
        return th.cat([self._sums(*part, embeddings, dtype) for part in parts], dim=1)

    def _sums(
        self, transitions: th.Tensor, lengths: list[int], embeddings: th.Tensor, dtype: th.dtype
    ) -> th.Tensor:
        mlp = self.mlp
        layers: list[Any] = [*mlp.hidden, mlp.output]
        first, *others = layers
        widths = [transitions.shape[-1], embeddings.shape[-1]]
        of_transitions, of_embeddings = first.weight.split(widths, dim=1)
        base = (transitions @ of_transitions.T + first.bias).to(dtype)  # (rows, width)
        shifts = (embeddings @ of_embeddings.T).to(dtype)  # (m, width)
        middle = [(layer.weight.T.to(dtype), layer.bias.to(dtype)) for layer in others[:-1]]
        last = mlp.output.weight[0].to(dtype)
        block = max(1, BLOCK_ROWS // len(base))
        # the same memory for every block: new pages from the system take longer than to fill them
        rows = min(block, len(shifts)) * len(base)
        biases = [first.bias, *(bias for _, bias in middle)]
        buffers = [base.new_empty(rows, len(bias)) for bias in biases]
        sums = []
        for some in shifts.split(block):
            rows = len(some) * len(base)
            x = buffers[0][:rows]
            th.add(base, some[:, None], out=x.view(len(some), *base.shape))
            for (weight, bias), buffer in zip(middle, buffers[1:], strict=True):
                x = th.addmm(bias, mlp.activation(x), weight, out=buffer[:rows])
            if others:
                x = mlp.activation(x) @ last
            parts = x.view(len(some), -1).float().split(lengths, dim=1)
            sums.append(th.stack([part.sum(dim=1) for part in parts], dim=1))
        result = th.cat(sums)
        return result + mlp.output.bias * result.new_tensor(lengths) if others else result


def digest_of(tensors: Mapping[str, th.Tensor]) -> str:
    """Hexadecimal; the same for equal numbers under equal names, of whatever device and type."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().double()  # holds other types' numbers exactly
        digest.update(f"{name} {tuple(value.shape)}".encode())
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()


def parse_tensors(content: bytes, source: str | Path) -> dict[str, th.Tensor]:
    """Tensors by name, of safetensors; a ``ValueError`` that names ``source`` if it is none."""
    try:
        return load(content)
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"{source} is truncated, or no safetensors file: {error}") from error
