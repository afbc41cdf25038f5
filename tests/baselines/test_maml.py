"""MAML against finite differences, and on tasks where only adaptation can help."""

import numpy as np
import pytest
import torch as th
from torch.func import grad

from sb3_poem.baselines.maml import PreferencePairs, RewardNetwork, adapt_parameters, maml_loss, preference_loss


def tiny():
    th.manual_seed(0)
    network = RewardNetwork(3, (4,)).double()
    parameters = {name: value.detach().clone() for name, value in network.named_parameters()}
    return network, parameters


def pairs(tasks, n, seed, steps=5, in_dim=3):
    generator = th.Generator().manual_seed(seed)
    left, right = th.randn(2, tasks, n, steps, in_dim, generator=generator, dtype=th.float64)
    label = th.randint(0, 3, (tasks, n), generator=generator).double() / 2
    return PreferencePairs(left, right, label)


def test_the_loss_is_bradley_terrys_cross_entropy():
    network, parameters = tiny()
    some = PreferencePairs(*(part[0] for part in pairs(1, 20, 1)))
    with th.no_grad():
        left, right = (network(part).sum(dim=1).numpy() for part in some[:2])
    probability = np.exp(left) / (np.exp(left) + np.exp(right))
    label = some.label.numpy()
    expected = -(label * np.log(probability) + (1 - label) * np.log(1 - probability)).mean()
    assert float(preference_loss(network, parameters, some)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("steps", [1, 3])
def test_the_outer_gradient_against_finite_differences(steps):
    network, parameters = tiny()
    support, query = pairs(3, 6, 2), pairs(3, 6, 3)
    rate, width = 0.3, 1e-5
    slope = grad(maml_loss, argnums=1)(network, parameters, support, query, rate, steps)
    first_order = 0.0
    for name, value in parameters.items():
        for index in np.ndindex(*value.shape):
            ends = []
            for sign in (1, -1):
                moved = {key: part.clone() for key, part in parameters.items()}
                moved[name][index] += sign * width
                ends.append(float(maml_loss(network, moved, support, query, rate, steps)))
            assert float(slope[name][index]) == pytest.approx((ends[0] - ends[1]) / (2 * width), abs=1e-8)
        adapted = [
            adapt_parameters(network, parameters, PreferencePairs(*(part[i] for part in support)), rate, steps)
            for i in range(3)
        ]
        plain = sum(
            grad(preference_loss, argnums=1)(network, adapted[i], PreferencePairs(*(part[i] for part in query)))[name]
            for i in range(3)
        )
        first_order = max(first_order, float((plain / 3 - slope[name]).abs().max()))
    assert first_order > 1e-3  # the second derivatives matter here, so a first-order gradient would have failed
