"""Choice of the arithmetic of hidden layers."""

import torch as th

PRECISIONS = ("auto", "bf16", "fp32")


def cpu_has_bfloat16() -> bool:
    """Whether the processor multiplies bfloat16 matrices in hardware."""
    return bool(th.cpu._is_avx512_bf16_supported())


def autocast_dtype(precision: str, device_type: str) -> th.dtype | None:
    """Type for autocast, None for float32 throughout.

    :param precision: "auto", "bf16" or "fp32"
    :param device_type: "cpu" or "cuda"
    :raises ValueError: for another name
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(map(repr, PRECISIONS))}, got {precision!r}")
    if precision == "auto":
        supported = th.cuda.is_bf16_supported() if device_type == "cuda" else cpu_has_bfloat16()
        return th.bfloat16 if supported else None
    return th.bfloat16 if precision == "bf16" else None
