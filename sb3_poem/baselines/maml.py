"""Meta-learning a reward from preferences by MAML (Finn et al. 2017; Hejna & Sadigh 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch as th
from torch import nn
from torch.func import functional_call, grad, vmap
from torch.nn.functional import softplus

from sb3_poem.common.networks import MLP

Parameters = dict[str, th.Tensor]


class PreferencePairs(NamedTuple):
    """Pairs of fragments, (..., pairs, steps, in_dim + 1) transitions as :class:`RewardNetwork`
    takes them, and ``label`` (..., pairs): 1 where the left one is better, 0 where the right one
    is, 0.5 where neither is.
    """

    left: th.Tensor
    right: th.Tensor
    label: th.Tensor


class RewardNetwork(nn.Module):
    """Reward of a transition (s, a, s') of width ``in_dim``, unknown up to scale."""

    def __init__(self, in_dim: int, net_arch: Sequence[int] = (64, 64)) -> None:
        super().__init__()
        # A smooth activation: MAML differentiates the gradient.
        self.mlp = MLP(in_dim, 1, net_arch, nn.Tanh)

    def forward(self, transitions: th.Tensor) -> th.Tensor:
        """(..., in_dim + 1), the last entry 1, or 0 for what only fills up an episode that ended
        early -> (...).
        """
        return self.mlp(transitions[..., :-1]).squeeze(-1) * transitions[..., -1]


def preference_loss(
    network: nn.Module, parameters: Parameters, pairs: PreferencePairs
) -> th.Tensor:
    """Bradley-Terry cross-entropy of the sums of predicted rewards; the mean over one
    task's pairs.
    """
    both = functional_call(network, parameters, (th.stack([pairs.left, pairs.right]),)).sum(dim=-1)
    logit = both[0] - both[1]
    return (softplus(logit) - pairs.label * logit).mean()


def adapt_parameters(
    network: nn.Module,
    parameters: Parameters,
    pairs: PreferencePairs,
    learning_rate: float,
    steps: int,
) -> Parameters:
    """MAML's inner loop: gradient steps on one task's preferences. It can be differentiated, and
    mapped over tasks.
    """
    slope = grad(preference_loss, argnums=1)
    for _ in range(steps):
        gradients = slope(network, parameters, pairs)
        parameters = {
            name: value - learning_rate * gradients[name] for name, value in parameters.items()
        }
    return parameters


def maml_loss(
    network: nn.Module,
    parameters: Parameters,
    support: PreferencePairs,
    query: PreferencePairs,
    learning_rate: float,
    steps: int,
) -> th.Tensor:
    """MAML's outer objective: how well the adapted networks predict other preferences of their
    tasks. Its gradient passes through the inner loop.

    :param support: (tasks, pairs, ...) what each task adapts to.
    :param query: (tasks, pairs, ...) what it is judged by.
    :return: The mean over the tasks.
    """

    def task_loss(some: PreferencePairs, others: PreferencePairs) -> th.Tensor:
        adapted = adapt_parameters(network, parameters, some, learning_rate, steps)
        return preference_loss(network, adapted, others)

    return vmap(task_loss)(support, query).mean()
