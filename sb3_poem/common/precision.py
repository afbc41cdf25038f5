"""Arithmetic of hidden layers."""

from typing import Any

import torch as th
from torch import nn

from sb3_poem.common.low_precision import LowPrecisionMLP
from sb3_poem.common.networks import MLP, Normalised

PRECISIONS = ("auto", "bf16", "fp32")


def cpu_has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 matrices in hardware."""
    return bool(th.cpu._is_avx512_bf16_supported())


def hidden_dtype(precision: str, device_type: str) -> th.dtype:
    """Type of the hidden layers' arithmetic on a device, "cpu" or "cuda"."""
    if precision not in PRECISIONS:
        known = ", ".join(map(repr, PRECISIONS))
        raise ValueError(f"precision must be one of {known}, got {precision!r}")
    if precision == "auto":
        supported = th.cuda.is_bf16_supported() if device_type == "cuda" else cpu_has_bfloat16()
        return th.bfloat16 if supported else th.float32
    return th.bfloat16 if precision == "bf16" else th.float32


class MixedPrecision:
    """Runs the hidden layers of all rectified perceptrons of a module in another arithmetic, on
    weights that stay float32.

    Within the context, copies of the layers compute; :meth:`refresh` brings them up to date. Their
    gradients are added to those of the weights. Float32 changes nothing.
    """

    def __init__(self, module: nn.Module, dtype: th.dtype) -> None:
        self._networks: list[tuple[MLP, LowPrecisionMLP]] = []
        for part in module.modules() if dtype != th.float32 else ():
            if not isinstance(part, MLP) or not len(part.hidden):
                continue
            norm = isinstance(part.activation, Normalised)
            activation = part.activation.activation if norm else part.activation
            if isinstance(activation, nn.ReLU):
                hidden: list[nn.Linear] = list(part.hidden)  # type: ignore[arg-type]
                low = LowPrecisionMLP(hidden, part.output, dtype, norm)
                self._networks.append((part, low))
        pairs = [pair for _, network in self._networks for pair in network.pairs]
        self._originals = [original for original, _ in pairs]
        self._copies = [copy for _, copy in pairs]

    def __enter__(self) -> "MixedPrecision":
        for part, network in self._networks:
            part.low_precision = network
        return self

    def __exit__(self, *exception: Any) -> None:
        for part, _ in self._networks:
            part.low_precision = None

    def refresh(self) -> None:
        """Bring the copies up to date with the float32 weights."""
        if self._copies:
            with th.no_grad():
                th._foreach_copy_(self._copies, self._originals)
        for _, network in self._networks:
            network.collected = False
