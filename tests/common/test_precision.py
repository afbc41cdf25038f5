"""The hidden layers' arithmetic: its choice, and mixed precision against float32 and against
autocast.
"""

import pytest
import torch as th
from torch import nn

from sb3_poem.common.networks import MLP, LatentCritic, Normalised
from sb3_poem.common.precision import MixedPrecision, hidden_dtype


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_named_precisions(device: str) -> None:
    assert hidden_dtype("fp32", device) is th.float32
    assert hidden_dtype("bf16", device) is th.bfloat16


@pytest.mark.parametrize(("supported", "expected"), [(True, th.bfloat16), (False, th.float32)])
def test_auto_asks_the_processor(
    supported: bool, expected: th.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(th.cpu, "_is_avx512_bf16_supported", lambda: supported)
    monkeypatch.setattr(th.cuda, "is_bf16_supported", lambda: not supported)
    assert hidden_dtype("auto", "cpu") is expected
    assert hidden_dtype("auto", "cuda") is (th.float32 if supported else th.bfloat16)


@pytest.mark.parametrize("name", ["fp16", None])
def test_another_name_is_refused(name: str) -> None:
    with pytest.raises(
        ValueError, match=r"`precision` must be one of \('auto', 'bf16', 'fp32'\), but is"
    ):
        hidden_dtype(name, "cpu")


@pytest.fixture(
    params=[(6, [64, 64], False), (16, [20, 50], False), (6, [20, 64], True)], ids=str
)  # widths that are padded, and that are not; normalised layers, which never are
def mlp(request: pytest.FixtureRequest) -> MLP:
    th.manual_seed(0)
    in_dim, widths, layer_norm = request.param
    return MLP(in_dim, 3, widths, layer_norm=layer_norm)


def gradients(network: nn.Module) -> dict[str, th.Tensor]:
    return {name: parameter.grad.clone() for name, parameter in network.named_parameters()}


def test_bfloat16_is_close_to_float32_and_is_not_it(mlp: MLP) -> None:
    x = th.randn(100, mlp.hidden[0].in_features)
    exact = mlp(x)
    exact.pow(2).sum().backward()
    expected = gradients(mlp)
    mlp.zero_grad(set_to_none=True)
    with MixedPrecision(mlp, th.bfloat16) as precision:
        precision.refresh()
        rounded = mlp(x)
        rounded.pow(2).sum().backward()
    assert rounded.dtype == th.float32
    assert 0 < (rounded - exact).norm() < 0.02 * exact.norm()
    for name, gradient in gradients(mlp).items():
        assert gradient.dtype == th.float32
        assert 0 < (gradient - expected[name]).norm() < 0.06 * expected[name].norm(), name


def test_gradients_of_several_evaluations_add_up_until_the_weights_change(mlp: MLP) -> None:
    x = th.randn(100, mlp.hidden[0].in_features)
    with MixedPrecision(mlp, th.bfloat16) as precision:
        precision.refresh()
        (mlp(x[:50]).pow(2).sum() + mlp(x[50:]).pow(2).sum()).backward()
        in_parts = gradients(mlp)
        precision.refresh()
        mlp(x).pow(2).sum().backward()
    for name, gradient in gradients(mlp).items():
        assert (gradient - in_parts[name]).norm() < 0.01 * gradient.norm(), name


def test_hidden_layers_are_those_of_autocast(mlp: MLP) -> None:
    x = th.randn(100, mlp.hidden[0].in_features)
    norms = [
        nn.LayerNorm(layer.out_features)
        if isinstance(mlp.activation, Normalised)
        else nn.Identity()
        for layer in mlp.hidden
    ]
    hidden = nn.Sequential(mlp.hidden[0], norms[0], nn.ReLU(), mlp.hidden[1], norms[1], nn.ReLU())
    with th.autocast("cpu", dtype=th.bfloat16):
        expected = hidden(x)
    expected = nn.functional.linear(expected.float(), mlp.output.weight, mlp.output.bias)
    with MixedPrecision(mlp, th.bfloat16) as precision:
        precision.refresh()
        assert th.equal(mlp(x), expected)
    assert not th.equal(mlp(x), expected)  # outside the context everything is float32


def test_values_in_the_hundreds_keep_their_differences() -> None:
    mlp = MLP(1, 1, [1])
    with th.no_grad():
        for parameter in mlp.parameters():
            parameter.fill_(1.0)
        mlp.output.bias.fill_(300.0)
    with MixedPrecision(mlp, th.bfloat16) as precision:
        precision.refresh()
        values = mlp(th.tensor([[0.0], [0.0625]]))[:, 0]  # bfloat16 has steps of 2 here
    assert values.tolist() == [301.0, 301.0625]


def test_copies_follow_the_weights(mlp: MLP) -> None:
    x = th.randn(10, mlp.hidden[0].in_features)
    with MixedPrecision(mlp, th.bfloat16) as precision:
        precision.refresh()
        before = mlp(x)
        with th.no_grad():
            mlp.hidden[0].weight.mul_(2.0)
        assert th.equal(mlp(x), before)
        precision.refresh()
        assert not th.equal(mlp(x), before)


def test_float32_changes_nothing(mlp: MLP) -> None:
    x = th.randn(10, mlp.hidden[0].in_features)
    expected = mlp(x)
    with MixedPrecision(mlp, th.float32) as precision:
        precision.refresh()
        assert th.equal(mlp(x), expected)
        mlp(x).sum().backward()
        gradient = mlp.hidden[0].weight.grad.clone()
    assert th.equal(mlp.hidden[0].weight.grad, gradient)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_frozen_and_unused_networks_get_no_gradient(layer_norm: bool) -> None:
    networks = nn.ModuleList(
        [MLP(6, 3, [8], layer_norm=layer_norm), LatentCritic(6, 2, [8], layer_norm=layer_norm)]
    )
    obs = th.randn(4, 2, requires_grad=True)
    for _ in range(2):
        with MixedPrecision(networks, th.bfloat16) as precision:
            precision.refresh()
            networks[0](th.randn(4, 6)).sum().backward()  # the critic is left out
            assert all(parameter.grad is None for parameter in networks[1].parameters())
        networks.zero_grad(set_to_none=True)
        with MixedPrecision(networks, th.bfloat16) as precision:
            precision.refresh()
            networks[1](obs, obs, obs, frozen=True).sum().backward()
            assert all(parameter.grad is None for parameter in networks.parameters())
    assert (obs.grad != 0).all()
