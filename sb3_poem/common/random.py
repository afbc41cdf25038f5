"""Seeded generators that are saved and restored with a model."""

from typing import Any

import numpy as np
import torch as th


class Generators:
    """One NumPy and one torch generator from one seed; pickles with its exact state."""

    def __init__(self, seed: int | None, device: th.device | str = "cpu") -> None:
        numpy_seed, torch_seed = np.random.SeedSequence(seed).spawn(2)
        self.numpy = np.random.default_rng(numpy_seed)
        self.torch = th.Generator(device)
        self.torch.manual_seed(int(torch_seed.generate_state(1, np.uint64)[0] >> 1))

    def integer_seed(self) -> int:
        """A seed for an environment or another generator."""
        return int(self.numpy.integers(2**31 - 1))

    def child(self) -> np.random.Generator:
        """An independent NumPy generator; safe to hand to another process."""
        return np.random.default_rng(int(self.numpy.integers(2**63 - 1)))

    def __getstate__(self) -> dict[str, Any]:
        return {
            "numpy": self.numpy.bit_generator.state,
            "torch": self.torch.get_state().cpu().numpy(),
            "device": str(self.torch.device),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.numpy = np.random.default_rng()
        self.numpy.bit_generator.state = state["numpy"]
        if th.device(state["device"]).type != "cuda" or th.cuda.is_available():
            self.torch = th.Generator(state["device"])
            self.torch.set_state(th.from_numpy(np.array(state["torch"], dtype=np.uint8)))
        else:  # a state of a CUDA generator means nothing to a CPU one
            self.torch = self._seeded("cpu")

    def _seeded(self, device: th.device | str) -> th.Generator:
        return th.Generator(device).manual_seed(int(self.numpy.integers(2**63 - 1)))

    def to(self, device: th.device | str) -> "Generators":
        """Move the torch generator to another kind of device, its stream seeded by the old."""
        device = th.device(device)
        if device.type != self.torch.device.type:
            self.torch = self._seeded(device)
        return self
