"""A short name for what a model's numbers are."""

import hashlib
from collections.abc import Mapping

import torch as th


def digest_of(tensors: Mapping[str, th.Tensor]) -> str:
    """Hexadecimal; the same for equal numbers under equal names, of whatever device and type."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        value = tensors[name].detach().cpu().double()  # holds other types' numbers exactly
        digest.update(f"{name} {tuple(value.shape)}".encode())
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()
