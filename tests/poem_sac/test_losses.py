"""The preference loss against a loop over triples, and Proposition 1."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_poem.poem_sac.poem_sac import preference_loss
from sb3_poem.poem_sac.policies import POEMPolicy


def brute_force(similarity: np.ndarray, returns: np.ndarray) -> tuple[float, float]:
    """Cross-entropy and accuracy over all (i, j, k) with j != k whose order is known: eqs. 6 and 7,
    word by word.
    """
    losses, right = [], []
    n = len(similarity)
    for i in range(n):
        for j in range(n):
            for k in range(n):
                if (
                    j == k
                    or not np.isfinite(returns[i, j] - returns[i, k])
                    or returns[i, j] == returns[i, k]
                ):
                    continue
                probability = 1.0 / (1.0 + math.exp(-(similarity[i, j] - similarity[i, k])))
                preferred = float(returns[i, j] > returns[i, k])
                losses.append(
                    -preferred * math.log(probability)
                    - (1.0 - preferred) * math.log(1.0 - probability)
                )
                right.append((probability > 0.5) == (preferred == 1.0) and probability != 0.5)
    return (float(np.mean(losses)), float(np.mean(right))) if losses else (0.0, float("nan"))


def make(n: int) -> tuple[th.Tensor, th.Tensor]:
    rng = np.random.default_rng(0)
    return th.from_numpy(rng.normal(size=(n, n)) * 3.0), th.from_numpy(
        rng.normal(size=(n, n)) * 100.0
    )


@pytest.mark.parametrize("n", [2, 7])
def test_loss_and_accuracy_are_those_of_all_triples(n: int) -> None:
    similarity, returns = make(n)
    loss, accuracy = preference_loss(similarity, returns)
    expected = brute_force(similarity.numpy(), returns.numpy())
    assert (loss.item(), accuracy.item()) == pytest.approx(expected, rel=1e-6)


def test_gradient_is_that_of_finite_differences() -> None:
    similarity, returns = make(5)
    returns[0, 1] = returns[0, 4]
    returns[1, 2] = math.nan
    similarity.requires_grad_()
    assert th.autograd.gradcheck(lambda x: 3.0 * preference_loss(x, returns)[0], (similarity,))


def test_ties_and_unknown_returns_are_left_out() -> None:
    similarity, returns = make(6)
    returns[0, 1] = returns[0, 4] = returns[0, 5]
    returns[1] = math.nan
    returns[2, 3] = math.nan
    returns[3, 0] = math.inf  # an overflow is not an order either
    returns[4, 2] = -math.inf
    returns[5] = 7.0
    similarity.requires_grad_()
    loss, accuracy = preference_loss(similarity, returns)
    expected = brute_force(similarity.detach().numpy(), returns.numpy())
    assert (loss.item(), accuracy.item()) == pytest.approx(expected, rel=1e-6)
    loss.backward()
    assert similarity.grad.isfinite().all()
    assert (similarity.grad[[1, 5]] == 0).all()
    assert similarity.grad[3, 0] == similarity.grad[4, 2] == similarity.grad[2, 3] == 0


def test_equal_similarities_are_not_right() -> None:
    returns = th.tensor([[2.0, 1.0], [1.0, 2.0]])
    loss, accuracy = preference_loss(th.zeros(2, 2), returns)
    assert loss.item() == pytest.approx(math.log(2.0))
    assert accuracy.item() == 0.0


@pytest.mark.parametrize(
    "returns", [th.tensor([[3.0]]), th.full((2, 2), 5.0), th.full((3, 3), math.nan)]
)
def test_without_any_pair_the_loss_is_zero_and_gradients_are_finite(returns: th.Tensor) -> None:
    """One task in the batch; policies that are the same; nothing measured."""
    latents = th.randn(len(returns), 4, requires_grad=True)
    loss, accuracy = preference_loss(latents @ latents.T, returns)
    assert loss.item() == 0.0
    assert accuracy.isnan()
    loss.backward()
    assert (latents.grad == 0).all()


def test_margins_in_the_thousands_do_not_overflow() -> None:
    similarity = th.tensor([[1e4, -1e4], [1e4, -1e4]], requires_grad=True)
    loss, accuracy = preference_loss(similarity, th.tensor([[1.0, 0.0], [0.0, 1.0]]))
    assert loss.item() == pytest.approx(0.5 * 2e4)
    assert accuracy.item() == 0.5
    loss.backward()
    assert similarity.grad.isfinite().all()


# ---------------------------------------------------------------- Proposition 1

# Three goals on a circle that is only walked one way: overshooting by a third is a detour of two
# thirds. So task i prefers its own policy to that of i + 1, and that to the one of i + 2.
ANGLES = np.array([0.0, 120.0, 240.0])
CYCLIC_RETURNS = th.from_numpy(-((ANGLES[None, :] - ANGLES[:, None]) % 360.0))


def train_embedding(two_encoder: bool) -> tuple[float, th.Tensor]:
    """Fit latents and embeddings to the preferences of the three tasks alone; returns the accuracy
    and S.
    """
    th.manual_seed(0)
    latent_dim = 5
    box = spaces.Box(-1.0, 1.0, (1,))
    policy = POEMPolicy(
        box,
        box,
        lambda _: 1e-3,
        net_arch={"embedding": [16]},
        latent_dim=latent_dim,
        two_encoder=two_encoder,
    )
    latents = nn.Parameter(th.randn(3, latent_dim))
    optimizer = th.optim.Adam([latents, *policy.parameters()], lr=0.03)
    for _ in range(150):
        loss, _ = preference_loss(policy.similarity(latents, latents), CYCLIC_RETURNS)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    similarity = policy.similarity(latents, latents).detach()
    return preference_loss(similarity, CYCLIC_RETURNS)[1].item(), similarity


def test_two_encoders_order_what_no_symmetric_similarity_can() -> None:
    """The preferences demand S12 > S13, S23 > S21, S31 > S32. With S symmetric: S12 > S13 = S31 >
    S32 = S23 > S21 = S12. So an inner product of one embedding, of any dimension, misses one pair
    in nine at least; two embeddings need miss none.
    """
    accuracy, similarity = train_embedding(two_encoder=False)
    th.testing.assert_close(similarity, similarity.T)
    assert accuracy <= 8 / 9 + 1e-6
    accuracy, similarity = train_embedding(two_encoder=True)
    assert not th.allclose(similarity, similarity.T)
    assert accuracy == 1.0
