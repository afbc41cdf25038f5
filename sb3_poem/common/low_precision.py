"""A perceptron with its hidden layers in bfloat16, as one node of the graph.

Three things make it faster than a cast around every operation. Bias and ReLU ride on the matrix
product, where oneDNN offers it. Layers are padded to widths that matrix units like; a spare unit is
held at 1, so that the product which gives the gradient of the weights gives the bias's too. And no
value is cast twice. Layers that are normalised before the ReLU have only the last of these.
"""

from collections.abc import Sequence
from typing import Any

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

ALIGNMENT = 16


class LowPrecisionMLP:
    """Copies of a perceptron's hidden layers, each with a ReLU; its output is float32's own."""

    def __init__(
        self, hidden: Sequence[nn.Linear], output: nn.Linear, dtype: th.dtype, layer_norm: bool
    ) -> None:
        self.output, self.layer_norm, self.dtype = output, layer_norm, dtype
        alignment = 1 if layer_norm else ALIGNMENT
        widths = [*(layer.in_features for layer in hidden), output.in_features]
        padded = [-(-width // alignment) * alignment for width in widths]
        #: Column of each layer's input that is constantly 1, None without padding
        self.ones = [w if w < room else None for w, room in zip(widths, padded, strict=True)]
        self.parameters: list[th.Tensor] = []
        #: The float32 parameters and where their copies are
        self.pairs: list[tuple[th.Tensor, th.Tensor, tuple[slice, ...]]] = []
        sizes = zip(hidden, padded, padded[1:], self.ones[1:], strict=False)
        for layer, columns, rows, spare in sizes:
            weight = layer.weight.new_zeros(rows, columns, dtype=dtype)
            bias = layer.weight.new_zeros(rows, dtype=dtype)
            if spare is not None:
                bias[spare] = 1.0
            for original, copy in ((layer.weight, weight), (layer.bias, bias)):
                place = tuple(slice(size) for size in original.shape)
                copy.requires_grad_(original.requires_grad)
                self.parameters.append(copy)
                self.pairs.append((original, copy, place))
        self._constant = th.zeros(padded[0] - widths[0], device=output.weight.device)
        self._constant[:1] = 1.0

    def inputs(self, parts: Sequence[th.Tensor]) -> th.Tensor:
        """Concatenate (..., width) tensors into what :meth:`evaluate` takes, (..., padded)."""
        if self.ones[0] is not None:
            parts = [*parts, self._constant.expand(*parts[0].shape[:-1], -1)]
        return th.cat(list(parts), dim=-1).to(self.dtype)

    def evaluate(self, x: th.Tensor, frozen: bool) -> th.Tensor:
        """Outputs (..., out_dim), float32, of :meth:`inputs`."""
        parameters = [self.output.weight, self.output.bias, *self.parameters]
        if frozen:
            parameters = [parameter.detach() for parameter in parameters]
        rows = x.reshape(-1, x.shape[-1])
        if self.layer_norm:
            out = _normalised_perceptron(rows, *parameters)
        else:
            out = _Perceptron.apply(rows, self.ones, *parameters)
        return out.view(*x.shape[:-1], -1)


def _normalised_perceptron(
    x: th.Tensor, out_weight: th.Tensor, out_bias: th.Tensor, *hidden: th.Tensor
) -> th.Tensor:
    for weight, bias in zip(hidden[::2], hidden[1::2], strict=True):
        x = th.relu_(nn.functional.layer_norm(linear(x, weight, bias), bias.shape))
    return linear(x.float(), out_weight, out_bias)


class _Perceptron(th.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: th.Tensor,
        ones: list[int | None],
        out_weight: th.Tensor,
        out_bias: th.Tensor,
        *hidden: th.Tensor,
    ) -> th.Tensor:
        weights, biases = hidden[::2], hidden[1::2]
        values = [x]
        for weight, bias in zip(weights, biases, strict=True):
            values.append(_linear_relu(values[-1], weight, bias))
        ctx.save_for_backward(out_weight, *weights, *values)
        ctx.ones = ones
        return linear(values[-1][:, : out_weight.shape[1]].float(), out_weight, out_bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        out_weight, *saved = ctx.saved_tensors
        n_layers = (len(saved) - 1) // 2
        weights, values = saved[:n_layers], saved[n_layers:]
        width, room = out_weight.shape[1], values[-1].shape[1]
        low = grad.to(values[0].dtype)
        of_parameters: list[th.Tensor | None] = [None] * (2 + 2 * n_layers)
        trained = ctx.needs_input_grad[2]
        if trained:
            of_parameters[0] = (values[-1].t() @ low)[:width].t().float()
            of_parameters[1] = grad.sum(dim=0)
        g = low @ nn.functional.pad(out_weight.to(low.dtype), (0, room - width))
        for index in reversed(range(n_layers)):
            g = th.ops.aten.threshold_backward(g, values[index + 1], 0)
            if trained:
                # (x^T g)^T rather than g^T x: the former is the faster of the two
                of_weight = (values[index].t() @ g).t()
                one = ctx.ones[index]
                of_parameters[2 + 2 * index] = of_weight
                of_parameters[3 + 2 * index] = g.sum(dim=0) if one is None else of_weight[:, one]
            if index or ctx.needs_input_grad[0]:
                g = g @ weights[index]
        return g if ctx.needs_input_grad[0] else None, None, *of_parameters


def _fused_linear_is_available() -> bool:
    operations = th.ops.mkldnn
    names = ("_linear_pointwise", "_is_mkldnn_bf16_supported")
    if not (th.backends.mkldnn.is_available() and all(hasattr(operations, name) for name in names)):
        return False
    return bool(operations._is_mkldnn_bf16_supported())


_FUSED_LINEAR = _fused_linear_is_available()


def _linear_relu(x: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    if _FUSED_LINEAR and x.device.type == "cpu":
        return th.ops.mkldnn._linear_pointwise(x, weight, bias, "relu", [], "")
    return th.relu_(linear(x, weight, bias))
