"""Arithmetic of hidden layers."""

import copy
from typing import Any

import torch as th
from torch import nn

from sb3_poem.common.networks import MLP

PRECISIONS = ("auto", "bf16", "fp32")


def cpu_has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 matrices in hardware."""
    return bool(th.cpu._is_avx512_bf16_supported())


def hidden_dtype(precision: str, device_type: str) -> th.dtype:
    """Type of the hidden layers' arithmetic.

    :param precision: "auto", "bf16" or "fp32"
    :param device_type: "cpu" or "cuda"
    :raises ValueError: for another name
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(map(repr, PRECISIONS))}, got {precision!r}")
    if precision == "auto":
        supported = th.cuda.is_bf16_supported() if device_type == "cuda" else cpu_has_bfloat16()
        return th.bfloat16 if supported else th.float32
    return th.bfloat16 if precision == "bf16" else th.float32


class MixedPrecision:
    """Runs the hidden layers of all perceptrons of a module in another arithmetic, on weights that stay float32.

    Within the context, copies of the layers compute; :meth:`refresh` brings them up to date, and :meth:`collect_gradients`
    takes their gradients back to the float32 weights, each for all layers at once. That takes fewer operations than autocast,
    which casts every weight, bias and gradient on its own.

    :param module: Module that holds the perceptrons
    :param dtype: Arithmetic of their hidden layers; float32 changes nothing
    """

    def __init__(self, module: nn.Module, dtype: th.dtype) -> None:
        networks = [part for part in module.modules() if isinstance(part, MLP)]
        self._networks = networks if dtype != th.float32 else []
        self._stand_ins: list[list[nn.Linear]] = [
            [copy.deepcopy(layer).to(dtype) for layer in network.hidden]  # type: ignore[misc]
            for network in self._networks
        ]
        pairs = [
            pair
            for network, layers in zip(self._networks, self._stand_ins, strict=True)
            for original, layer in zip(network.hidden, layers, strict=True)
            for pair in zip(original.parameters(), layer.parameters(), strict=True)
        ]
        self._originals: list[th.Tensor] = [original for original, _ in pairs]
        self._copies: list[th.Tensor] = [layer for _, layer in pairs]
        self._trained = [(original, layer) for original, layer in pairs if original.requires_grad]

    def __enter__(self) -> "MixedPrecision":
        for network, layers in zip(self._networks, self._stand_ins, strict=True):
            network.stand_ins = layers
        return self

    def __exit__(self, *exception: Any) -> None:
        for network in self._networks:
            network.stand_ins = None

    def refresh(self) -> None:
        """Bring the copies up to date with the float32 weights."""
        if self._copies:
            with th.no_grad():
                th._foreach_copy_(self._copies, self._originals)

    def collect_gradients(self) -> None:
        """Move the gradients of the copies to the float32 weights."""
        targets, sources = [], []
        for original, layer in self._trained:
            if layer.grad is None:
                original.grad = None
                continue
            if original.grad is None:
                original.grad = th.empty_like(original)
            targets.append(original.grad)
            sources.append(layer.grad)
            layer.grad = None
        if targets:
            th._foreach_copy_(targets, sources)
