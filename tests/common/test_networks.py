"""The networks against closed forms, torch's distributions, and plain nn.Linear layers."""

import numpy as np
import pytest
import torch as th
from torch import nn
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from sb3_poem.common.networks import (
    LOG_STD_MAX,
    MIN_FACTOR_VARIANCE,
    MLP,
    ContextEncoder,
    EnsembleMLP,
    LatentActor,
    LatentCritic,
    RewardDecoder,
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
    first, second = (layer for layer in mlp.hidden if isinstance(layer, nn.Linear))
    h = np.tanh(x.numpy() @ first.weight.detach().numpy().T + first.bias.detach().numpy())
    h = np.tanh(h @ second.weight.detach().numpy().T + second.bias.detach().numpy())
    expected = h @ mlp.output.weight.detach().numpy().T + mlp.output.bias.detach().numpy()
    np.testing.assert_allclose(mlp(x).detach().numpy(), expected, atol=1e-6)


def separate_networks(ensemble: EnsembleMLP) -> list[nn.Sequential]:
    networks = []
    for member in range(ensemble.n_members):
        layers: list[nn.Module] = []
        for weight, bias in zip(ensemble.weights, ensemble.biases, strict=True):
            linear = nn.Linear(weight.shape[1], weight.shape[2])
            with th.no_grad():
                linear.weight.copy_(weight[member].T)
                linear.bias.copy_(bias[member, 0])
            layers += [linear, nn.ReLU()]
        networks.append(nn.Sequential(*layers[:-1]))
    return networks


def test_ensemble_is_separate_networks_with_their_gradients() -> None:
    ensemble = EnsembleMLP(3, 4, 2, [8, 6])
    networks = separate_networks(ensemble)
    x = th.randn(10, 4)
    values, expected = ensemble(x), th.stack([network(x) for network in networks])
    th.testing.assert_close(values, expected)
    target = th.randn(3, 10, 2)
    (values - target).pow(2).mean().backward()
    (expected - target).pow(2).mean().backward()
    for index, (weight, bias) in enumerate(zip(ensemble.weights, ensemble.biases, strict=True)):
        th.testing.assert_close(weight.grad, th.stack([network[2 * index].weight.grad.T for network in networks]))
        th.testing.assert_close(bias.grad[:, 0], th.stack([network[2 * index].bias.grad for network in networks]))


def test_ensemble_starts_like_linear_layers() -> None:
    ensemble = EnsembleMLP(2, 50, 1, [400])
    linear = nn.Linear(50, 400)
    bound = 1.0 / np.sqrt(50.0)
    for values in (ensemble.weights[0], ensemble.biases[0]):
        assert values.abs().max().item() <= bound
    assert ensemble.weights[0].std().item() == pytest.approx(linear.weight.std().item(), rel=0.05)
    assert not th.equal(ensemble.weights[0][0], ensemble.weights[0][1])


def test_frozen_gives_gradients_to_the_input_only() -> None:
    critic = LatentCritic(3, 2, 4, [8, 8])
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


def test_output_layers_stay_in_float32_under_autocast() -> None:
    mlp, ensemble = MLP(4, 3, [16]), EnsembleMLP(2, 4, 3, [16])
    x = th.randn(8, 4)
    with th.autocast("cpu", dtype=th.bfloat16):
        hidden = mlp.hidden(x)
        assert hidden.dtype == th.bfloat16  # the hidden layers do run in bfloat16
        output, outputs = mlp(x), ensemble(x)
        bare = MLP(4, 3, [])
        bare_output = bare(x)
    for value in (output, outputs, bare_output):
        assert value.dtype == th.float32
    assert th.equal(output, nn.functional.linear(hidden.float(), mlp.output.weight, mlp.output.bias))
    assert th.equal(bare_output, nn.functional.linear(x, bare.output.weight, bare.output.bias))


def test_values_in_the_hundreds_keep_their_differences_under_autocast() -> None:
    ensemble = EnsembleMLP(1, 1, 1, [])
    with th.no_grad():
        ensemble.weights[0].fill_(1.0)
        ensemble.biases[0].fill_(300.0)
    with th.autocast("cpu", dtype=th.bfloat16):
        values = ensemble(th.tensor([[0.01], [0.02]]))[0, :, 0]  # bfloat16 has steps of 2 here
    np.testing.assert_allclose(values.detach().numpy(), [300.01, 300.02], atol=1e-4)


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
        posterior, terms = Normal(mean.double(), variance.double().sqrt()), factors(encoder, context)
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
    actor = LatentActor(5, 3, 2, [16])
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
    actor = LatentActor(1, 1, 1, [])
    mean, log_std = 40.0, 0.0
    set_output(actor.mlp, [mean, log_std])
    actions, log_prob = actor(th.zeros(1, 1), th.zeros(1, 1), th.zeros(1, 1))
    # log N(0; 0, 1) - log(1 - tanh(x)^2), where 1 - tanh(x)^2 = 4 exp(-2 x) for large x
    assert log_prob.item() == pytest.approx(-0.5 * np.log(2 * np.pi) - np.log(4.0) + 2.0 * mean, rel=1e-6)
    assert actions.item() == 1.0
    log_prob.sum().backward()
    assert all(parameter.grad.isfinite().all() for parameter in actor.parameters())


def test_without_noise_the_actor_takes_the_mean() -> None:
    actor = LatentActor(5, 3, 2, [16])
    obs, embedding = th.randn(4, 5), th.randn(4, 3)
    actions, log_prob = actor(obs, embedding)
    assert log_prob is None
    th.testing.assert_close(actions, th.tanh(actor.distribution(obs, embedding)[0]))


def test_standard_deviation_is_bounded() -> None:
    actor = LatentActor(1, 1, 1, [])
    set_output(actor.mlp, [0.0, 50.0])
    draws = th.randn(10, 1)
    actions, _ = actor(th.zeros(10, 1), th.zeros(10, 1), draws)
    th.testing.assert_close(actions, th.tanh(np.exp(LOG_STD_MAX) * draws))


# ---------------------------------------------------------------- critics and decoder


def test_critics_are_different_functions_of_all_their_inputs() -> None:
    critic = LatentCritic(3, 2, 4, [32], n_critics=3)
    inputs = [th.randn(6, width, requires_grad=True) for width in (3, 2, 4)]
    values = critic(*inputs)
    assert values.shape == (3, 6)
    assert values.std(dim=0).min() > 0
    values.sum().backward()
    assert all((x.grad != 0).any() for x in inputs)


def test_decoder_broadcasts_over_leading_dimensions() -> None:
    decoder = RewardDecoder(3, 2, 4, [32])
    obs, actions, next_obs, embedding = (th.randn(5, 6, width) for width in (3, 2, 3, 4))
    rewards = decoder(obs, actions, next_obs, embedding)
    assert rewards.shape == (5, 6)
    one = decoder(obs[2, 3], actions[2, 3], next_obs[2, 3], embedding[2, 3])
    th.testing.assert_close(rewards[2, 3], one)
