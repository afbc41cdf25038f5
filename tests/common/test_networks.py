"""The networks against closed forms, torch's distributions, and plain nn.Linear layers."""

import numpy as np
import pytest
import torch as th
from torch import nn
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from sb3_poem.common.networks import (
    LOG_STD_MAX,
    LOG_STD_MIN,
    MIN_FACTOR_VARIANCE,
    MLP,
    ContextEncoder,
    LatentActor,
    LatentCritic,
    RewardDecoder,
    _GaussianProduct,
    _SquashedGaussian,
)


@pytest.fixture(autouse=True)
def _seed() -> None:
    th.manual_seed(0)


def set_output(mlp: MLP, bias: list[float]) -> None:
    """Make a network constant."""
    with th.no_grad():
        mlp.output.weight.zero_()
        mlp.output.bias.copy_(th.tensor(bias))


# ---------------------------------------------------------------- perceptrons


def test_mlp_is_linear_layers_and_activations() -> None:
    mlp = MLP(4, 3, [8, 7], nn.Tanh)
    x = th.randn(2, 5, 4)
    first, second = mlp.hidden
    h = np.tanh(x.numpy() @ first.weight.detach().numpy().T + first.bias.detach().numpy())
    h = np.tanh(h @ second.weight.detach().numpy().T + second.bias.detach().numpy())
    expected = h @ mlp.output.weight.detach().numpy().T + mlp.output.bias.detach().numpy()
    np.testing.assert_allclose(mlp(x).detach().numpy(), expected, atol=1e-6)


def test_rectified_mlp_is_torchs_own_with_its_gradients() -> None:
    mlp = MLP(4, 3, [8, 7])
    twin = nn.Sequential(nn.Linear(4, 8), nn.ReLU(), nn.Linear(8, 7), nn.ReLU(), nn.Linear(7, 3))
    layers = [*mlp.hidden, mlp.output]
    with th.no_grad():
        for ours, theirs in zip(layers, twin[::2], strict=True):
            theirs.weight.copy_(ours.weight)
            theirs.bias.copy_(ours.bias)
    x, y = (th.randn(2, 5, 4).requires_grad_() for _ in range(2))
    y.data.copy_(x.data)
    values, expected = mlp(x), twin(y)
    th.testing.assert_close(values, expected)
    for out in (values, expected):
        out.pow(2).mean().backward()
    th.testing.assert_close(x.grad, y.grad)
    for ours, theirs in zip(layers, twin[::2], strict=True):
        th.testing.assert_close(ours.weight.grad, theirs.weight.grad)
        th.testing.assert_close(ours.bias.grad, theirs.bias.grad)


def test_normalised_layers_are_linear_layers_less_their_mean_over_their_deviation() -> None:
    mlp = MLP(4, 3, [8, 7], layer_norm=True)
    h = th.randn(2, 5, 4)
    x = h.numpy().astype(np.float64)
    for layer in mlp.hidden:
        x = x @ layer.weight.detach().numpy().T + layer.bias.detach().numpy()
        x = (x - x.mean(axis=-1, keepdims=True)) / np.sqrt(x.var(axis=-1, keepdims=True) + 1e-5)
        x = np.maximum(x, 0.0)
    expected = x @ mlp.output.weight.detach().numpy().T + mlp.output.bias.detach().numpy()
    np.testing.assert_allclose(mlp(h).detach().numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_actor_critics_and_decoder_normalise_when_asked(layer_norm: bool) -> None:
    actor = LatentActor(5, 2, [8], layer_norm=layer_norm)
    critic = LatentCritic(7, 2, [8], layer_norm=layer_norm)
    decoder = RewardDecoder(10, [8], layer_norm=layer_norm)
    obs, two = th.randn(5, 3), th.randn(5, 2)
    networks = {
        "actor": (actor.mlp, lambda: actor(obs, two, th.zeros(5, 2))[0]),
        "critic": (critic.members[1], lambda: critic(obs, two, two)[1]),
        "decoder": (decoder.mlp, lambda: decoder(obs, two, obs, two)),
    }
    for name, (mlp, output) in networks.items():
        before = output()
        with th.no_grad():  # a factor on the layer is what normalisation takes away
            mlp.hidden[0].weight.mul_(100.0)
            mlp.hidden[0].bias.mul_(100.0)
        assert th.allclose(output(), before, atol=1e-3) == layer_norm, name


@pytest.mark.parametrize("layer_norm", [False, True])
def test_frozen_gives_gradients_to_the_input_only(layer_norm: bool) -> None:
    critic = LatentCritic(9, 2, [8, 8], layer_norm=layer_norm)
    obs, actions, latents = (th.randn(6, width, requires_grad=True) for width in (3, 2, 4))
    critic(obs, actions, latents, frozen=True).sum().backward()
    assert all(parameter.grad is None for parameter in critic.parameters())
    frozen = [x.grad.clone() for x in (obs, actions, latents)]
    for x in (obs, actions, latents):
        x.grad = None
    critic(obs, actions, latents).sum().backward()
    assert all(parameter.grad is not None for parameter in critic.parameters())
    for x, gradient in zip((obs, actions, latents), frozen, strict=True):
        th.testing.assert_close(x.grad, gradient)


# ---------------------------------------------------------------- encoder


def factors(encoder: ContextEncoder, context: th.Tensor) -> Normal:
    mean, raw = encoder.mlp(context).double().chunk(2, dim=-1)
    return Normal(mean, nn.functional.softplus(raw).clamp(min=MIN_FACTOR_VARIANCE).sqrt())


def test_posterior_is_the_normalised_product_of_the_factors() -> None:
    encoder = ContextEncoder(6, 3, [16])
    context = th.randn(4, 7, 6)
    with th.no_grad():
        mean, variance = encoder(context)
        assert mean.shape == variance.shape == (4, 3)
        posterior, terms = (
            Normal(mean.double(), variance.double().sqrt()),
            factors(encoder, context),
        )
        points = th.linspace(-2.0, 2.0, 9, dtype=th.float64)[:, None, None]  # (points, 1, 1)
        product = terms.log_prob(points[..., None]).sum(dim=2)  # (points, tasks, d), not normalised
        constant = product - posterior.log_prob(points)
    assert product.std(dim=0).min() > 0.1
    th.testing.assert_close(constant, constant[:1].expand_as(constant), rtol=0, atol=1e-4)


def test_encoder_does_not_see_the_order() -> None:
    encoder = ContextEncoder(6, 3, [16])
    context = th.randn(4, 50, 6)
    shuffled = context[:, th.randperm(50)]
    for one, two in zip(encoder(context), encoder(shuffled), strict=True):
        th.testing.assert_close(one, two)


def test_repeated_evidence_counts_again() -> None:
    encoder = ContextEncoder(6, 3, [16])
    context = th.randn(4, 5, 6)
    mean, variance = encoder(context)
    mean_of_four, variance_of_four = encoder(context.repeat(1, 4, 1))
    th.testing.assert_close(mean_of_four, mean)
    th.testing.assert_close(variance_of_four, variance / 4.0)


def test_overconfident_factors_stay_finite() -> None:
    encoder = ContextEncoder(6, 2, [16])
    set_output(encoder.mlp, [1.0, -2.0, -1e4, -1e4])
    mean, variance = encoder(th.randn(3, 100, 6))
    np.testing.assert_allclose(mean.detach().numpy(), [[1.0, -2.0]] * 3, rtol=1e-5)
    np.testing.assert_allclose(variance.detach().numpy(), MIN_FACTOR_VARIANCE / 100, rtol=1e-4)


# ---------------------------------------------------------------- actor


def test_log_probability_is_that_of_a_transformed_distribution() -> None:
    actor = LatentActor(8, 2, [16])
    obs, embedding, noise = (th.randn(4, 6, width) for width in (5, 3, 2))
    with th.no_grad():
        mean, log_std = (x.double() for x in actor.distribution(obs, embedding))
        actions, log_prob = actor(obs, embedding, noise)
    truth = Independent(TransformedDistribution(Normal(mean, log_std.exp()), TanhTransform()), 1)
    expected_actions = th.tanh(mean + log_std.exp() * noise)  # float64
    assert log_prob.shape == (4, 6)
    th.testing.assert_close(actions.double(), expected_actions, rtol=0, atol=1e-6)
    th.testing.assert_close(log_prob.double(), truth.log_prob(expected_actions), rtol=0, atol=1e-4)


def test_log_probability_does_not_saturate() -> None:
    actor = LatentActor(2, 1, [])
    mean, log_std = 40.0, 0.0
    set_output(actor.mlp, [mean, log_std])
    actions, log_prob = actor(th.zeros(1, 1), th.zeros(1, 1), th.zeros(1, 1))
    # log N(0; 0, 1) - log(1 - tanh(x)^2), where 1 - tanh(x)^2 = 4 exp(-2 x) for large x
    assert log_prob.item() == pytest.approx(
        -0.5 * np.log(2 * np.pi) - np.log(4.0) + 2.0 * mean, rel=1e-6
    )
    assert actions.item() == 1.0
    log_prob.sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in actor.parameters())


def test_where_the_noise_is_zero_the_actor_takes_the_mean() -> None:
    actor = LatentActor(8, 2, [16])
    obs, embedding = th.randn(4, 5), th.randn(4, 3)
    actions, _ = actor(obs, embedding, th.zeros(4, 2))
    th.testing.assert_close(actions, th.tanh(actor.distribution(obs, embedding)[0]))


def test_standard_deviation_is_bounded() -> None:
    actor = LatentActor(2, 1, [])
    set_output(actor.mlp, [0.0, 50.0])
    draws = th.randn(10, 1)
    actions, _ = actor(th.zeros(10, 1), th.zeros(10, 1), draws)
    th.testing.assert_close(actions, th.tanh(np.exp(LOG_STD_MAX) * draws))


# ---------------------------------------------------------------- critics and decoder


def test_critics_are_different_functions_of_all_their_inputs() -> None:
    critic = LatentCritic(9, 3, [32])
    inputs = [th.randn(6, width, requires_grad=True) for width in (3, 2, 4)]
    values = critic(*inputs)
    assert values.shape == (3, 6)
    assert values.std(dim=0).min() > 0
    values.sum().backward()
    assert all((x.grad != 0).any() for x in inputs)


def test_decoder_broadcasts_over_leading_dimensions() -> None:
    decoder = RewardDecoder(12, [32])
    obs, actions, next_obs, embedding = (th.randn(5, 6, width) for width in (3, 2, 3, 4))
    rewards = decoder(obs, actions, next_obs, embedding)
    assert rewards.shape == (5, 6)
    one = decoder(obs[2, 3], actions[2, 3], next_obs[2, 3], embedding[2, 3])
    th.testing.assert_close(rewards[2, 3], one)


# ---------------------------------------------------------------- gradients worked out by hand,
# against finite differences


def test_gradient_of_actions_and_their_log_probability() -> None:
    raw = th.randn(3, 4, 6, dtype=th.float64)
    raw[0, 0, 3], raw[0, 1, 4] = (
        LOG_STD_MAX + 1.0,
        LOG_STD_MIN - 1.0,
    )  # beyond the bounds nothing changes
    raw.requires_grad_()
    noise = th.randn(3, 4, 3, dtype=th.float64)
    assert th.autograd.gradcheck(lambda x: _SquashedGaussian.apply(x, noise), (raw,))
    actions, log_prob = _SquashedGaussian.apply(raw, noise)
    (of_raw,) = th.autograd.grad(actions.sum() + log_prob.sum(), raw)
    assert of_raw[0, 0, 3] == 0.0
    assert of_raw[0, 1, 4] == 0.0


def test_gradient_of_the_posterior() -> None:
    raw = th.randn(3, 5, 4, dtype=th.float64)
    raw[0, 1, 2] = -20.0  # at the least variance, where its own raw value changes nothing
    raw.requires_grad_()

    def away_from_the_bound(x: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return _GaussianProduct.apply(x[1:])

    assert th.autograd.gradcheck(away_from_the_bound, (raw,))
    mean, variance = _GaussianProduct.apply(raw)
    (of_raw,) = th.autograd.grad(mean.sum() + variance.sum(), raw)
    assert of_raw[0, 1, 2] == 0.0
    assert of_raw.isfinite().all()
