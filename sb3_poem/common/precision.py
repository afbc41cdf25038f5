"""Arithmetic of hidden layers: float32, or bfloat16 as one node of the graph.

Three things make it faster than a cast around every operation. Bias and ReLU ride on the matrix
product, where oneDNN offers it. Layers are padded to widths that matrix units like; a spare unit is
held at 1, so that the product which gives the gradient of the weights gives the bias's too. And no
value is cast twice. Layers that are normalised before the ReLU have only the last of these.
"""

from collections.abc import Sequence
from functools import partial
from itertools import chain
from typing import Any

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import linear

from sb3_poem.common.checks import check_choice
from sb3_poem.common.networks import MLP, Normalised

ALIGNMENT = 16
LAYER_NORM_EPS = 1e-5  # of torch's layer_norm


def check_device(device: th.device | str, name: str = "device") -> None:
    """Refuse what PyTorch does not know as a device; it may not be there."""
    try:
        th.device("cpu" if device == "auto" else device)
    except (RuntimeError, TypeError):
        known = "there are auto, cpu and cuda"
        raise ValueError(f"{name} {device}: there is no such device; {known}") from None


def hidden_dtype(precision: str, device_type: str) -> th.dtype:
    """Type of the hidden layers' arithmetic on a device, "cpu" or "cuda"."""
    check_choice("precision", precision, ("auto", "bf16", "fp32"))
    if precision == "auto":
        on_gpu = device_type == "cuda"
        has = th.cuda.is_bf16_supported if on_gpu else th.cpu._is_avx512_bf16_supported
        return th.bfloat16 if has() else th.float32
    return th.bfloat16 if precision == "bf16" else th.float32


class MixedPrecision:
    """Runs the hidden layers of all rectified perceptrons of a module in another arithmetic, on
    weights that stay float32: within the context, copies of the layers compute, and give the
    weights their gradients. Float32 changes nothing.
    """

    def __init__(self, module: nn.Module, dtype: th.dtype) -> None:
        self._networks: list[LowPrecisionMLP] = []
        for part in module.modules() if dtype != th.float32 else ():
            if not isinstance(part, MLP) or not len(part.hidden):
                continue
            if isinstance(getattr(part.activation, "activation", part.activation), nn.ReLU):
                self._networks.append(LowPrecisionMLP(part, dtype))
        self._originals = [each for network in self._networks for each in network.originals]
        self._copies = [each for network in self._networks for each in network.copies]

    def __enter__(self) -> "MixedPrecision":
        for network in self._networks:
            network.mlp.low_precision = network
        return self

    def __exit__(self, *exception: Any) -> None:
        for network in self._networks:
            network.mlp.low_precision = None

    def refresh(self) -> None:
        """Bring the copies up to date with the float32 weights."""
        if self._copies:
            with th.no_grad():
                th._foreach_copy_(self._copies, self._originals)
        for network in self._networks:
            network.collected = False


class LowPrecisionMLP:
    """Copies of a perceptron's hidden layers, each with a ReLU; its output is float32's own."""

    def __init__(self, mlp: MLP, dtype: th.dtype) -> None:
        hidden: list[nn.Linear] = list(mlp.hidden)  # type: ignore[arg-type]
        self.mlp, self.hidden, self.output, self.dtype = mlp, hidden, mlp.output, dtype
        self.layer_norm = isinstance(mlp.activation, Normalised)
        output, alignment = mlp.output, 1 if self.layer_norm else ALIGNMENT
        widths = [*(layer.in_features for layer in hidden), output.in_features]
        padded = [-(-width // alignment) * alignment for width in widths]
        #: Column of each layer's input that is constantly 1, None without padding
        self.ones = [w if w < room else None for w, room in zip(widths, padded, strict=True)]
        new = partial(output.weight.new_zeros, dtype=dtype)
        self.weights = [new(*shape) for shape in zip(padded[1:], padded, strict=False)]
        self.biases = [new(rows) for rows in padded[1:]]
        self.out_weight = new(output.out_features, padded[-1])
        for bias, spare in zip(self.biases, self.ones[1:], strict=True):
            if spare is not None:
                bias[spare] = 1.0
        weights = [layer.weight.detach() for layer in [*hidden, output]]
        #: The float32 parameters, and the parts of the copies that follow them
        self.originals = weights + [layer.bias.detach() for layer in hidden]
        followers = zip(self.originals, [*self.weights, self.out_weight, *self.biases], strict=True)
        self.copies = [copy[tuple(map(slice, original.shape))] for original, copy in followers]
        #: Whether the float32 parameters have a gradient already
        self.collected = False
        self._constant = th.zeros(padded[0] - widths[0], device=output.weight.device)
        self._constant[:1] = 1.0

    def inputs(self, parts: Sequence[th.Tensor]) -> th.Tensor:
        """Concatenate (..., width) tensors into what :meth:`evaluate` takes, (..., padded)."""
        if self.ones[0] is not None:
            parts = [*parts, self._constant.expand(*parts[0].shape[:-1], -1)]
        return th.cat(list(parts), dim=-1).to(self.dtype)

    def evaluate(self, x: th.Tensor, frozen: bool) -> th.Tensor:
        """Outputs (..., out_dim), float32, of :meth:`inputs`."""
        rows = x.reshape(-1, x.shape[-1])
        if th.is_grad_enabled():
            weight = self.output.weight
            out = _Perceptron.apply(rows, self, weight.detach() if frozen else weight)
        else:
            out = self.layers(rows)[0]
        return out.view(*x.shape[:-1], -1)

    def layers(self, x: th.Tensor) -> tuple[th.Tensor, list[th.Tensor], list[list[th.Tensor]]]:
        """Outputs of rows (n, padded), every layer's input, and what normalisation remembers."""
        values, norms = [x], []
        for weight, bias in zip(self.weights, self.biases, strict=True):
            if self.layer_norm:
                h = linear(values[-1], weight, bias)
                y, *moments = th.native_layer_norm(h, bias.shape, None, None, LAYER_NORM_EPS)
                norms.append([h, *moments])
                values.append(th.relu_(y))
            else:
                values.append(_linear_relu(values[-1], weight, bias))
        output = self.output
        out = linear(values[-1][:, : output.in_features].float(), output.weight, output.bias)
        return out, values, norms

    def gradient(
        self,
        grad: th.Tensor,
        values: Sequence[th.Tensor],
        norms: Sequence[Sequence[th.Tensor]],
        trained: bool,
        wanted: bool,
    ) -> th.Tensor | None:
        """From an output's gradient the input's, if ``wanted``; where ``trained``, parameters get
        theirs.
        """
        g, last, weight = grad.to(self.dtype), values[-1], self.out_weight
        if self.layer_norm:
            g, last, weight = grad, last.float(), self.output.weight
        if trained:
            self._collect(self.output, th.mm(g.t(), last), grad.sum(dim=0))
        g = th.mm(g, weight).to(self.dtype)
        for index in reversed(range(len(self.weights))):
            g = th.ops.aten.threshold_backward(g, values[index + 1], 0)
            if self.layer_norm:
                h, *moments = norms[index]
                like = (h, h.shape[1:], *moments, None, None, [True, False, False])
                g = th.ops.aten.native_layer_norm_backward(g, *like)[0]
            if trained:
                one, of_weight = self.ones[index], th.mm(g.t(), values[index])
                of_bias = g.sum(dim=0) if one is None else of_weight[:, one]
                self._collect(self.hidden[index], of_weight, of_bias)
            if index or wanted:
                g = th.mm(g, self.weights[index])
        self.collected |= trained
        return g if wanted else None

    def _collect(self, layer: nn.Linear, *gradients: th.Tensor) -> None:
        """Give a layer's weight and bias their gradients, of which padding is left out."""
        for parameter, gradient in zip((layer.weight, layer.bias), gradients, strict=True):
            if gradient.shape != parameter.shape:
                gradient = gradient[tuple(map(slice, parameter.shape))]
            if parameter.grad is None:
                parameter.grad = th.empty_like(parameter)
            if self.collected:
                parameter.grad += gradient
            else:  # as fast again
                parameter.grad.copy_(gradient)


class _Perceptron(th.autograd.Function):
    """A network's outputs; parameters get their gradients on the way back, if ``weight`` does."""

    @staticmethod
    def forward(ctx: Any, x: th.Tensor, network: LowPrecisionMLP, weight: th.Tensor) -> th.Tensor:
        out, values, norms = network.layers(x)
        ctx.network, ctx.n_values = network, len(values)
        ctx.save_for_backward(*values, *chain(*norms))
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: th.Tensor) -> tuple[th.Tensor | None, None, None]:  # type: ignore[override]
        values, kept = ctx.saved_tensors[: ctx.n_values], ctx.saved_tensors[ctx.n_values :]
        norms = [kept[start : start + 3] for start in range(0, len(kept), 3)]
        wanted, _, trained = ctx.needs_input_grad
        return ctx.network.gradient(grad, values, norms, trained, wanted), None, None


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
