"""A gradient step as one CUDA graph."""

from collections.abc import Callable
from itertools import chain
from typing import Any

import torch as th

from sb3_poem.pearl_sac.sampler import MetaBatch, mapped

EAGER_STEPS = 3

Step = Callable[[MetaBatch], dict[str, th.Tensor]]


class GraphedStep:
    """Runs a step, which maps a meta-batch to scalar metrics without waiting for the device, and
    from the fourth on replays it: thousands of small kernels then cost one launch.

    Everything that the step reads and does not change must stay where it is between calls, but for
    the meta-batch, which is copied to where the graph reads it. Its optimisers must be
    :func:`prepared <prepare_optimizers>`.
    """

    def __init__(self, step: Step) -> None:
        self._step = step
        self._calls = 0
        self._stream = th.cuda.Stream()
        self._graph = th.cuda.CUDAGraph()
        #: What the graph reads, and what it writes
        self._inputs: list[th.Tensor] = []
        self._names: tuple[str, ...] = ()
        self._values = th.empty(0)

    def __call__(self, batch: MetaBatch) -> dict[str, th.Tensor]:
        self._calls += 1
        inputs = tensors(batch)
        if self._calls <= EAGER_STEPS:
            # capture demands that libraries have been set up on a stream other than the default
            self._stream.wait_stream(th.cuda.current_stream())
            with th.cuda.stream(self._stream):
                metrics = self._step(batch)
            th.cuda.current_stream().wait_stream(self._stream)
            return metrics
        if not self._inputs:
            kept = mapped(th.clone, batch)
            self._inputs = tensors(kept)
            with th.cuda.graph(self._graph):
                metrics = self._step(kept)
                self._names, self._values = tuple(metrics), th.stack(list(metrics.values()))
        elif [part.shape for part in inputs] != [part.shape for part in self._inputs]:
            return self._step(batch)
        else:
            th._foreach_copy_(self._inputs, inputs)
        self._graph.replay()
        return dict(zip(self._names, self._values.clone().unbind(), strict=True))


def prepare_optimizers(optimizers: list[th.optim.Optimizer], device: th.device) -> None:
    """Keep optimisers' state where parameters are; only on a GPU may a graph capture them."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            if "capturable" in group:
                group["capturable"] = device.type == "cuda"
        for parameter, state in optimizer.state.items():
            if "step" in state:
                steps, place = state["step"], parameter.device
                state["step"] = th.as_tensor(steps, dtype=th.float32, device=place)


def tensors(batch: tuple[Any, ...]) -> list[th.Tensor]:
    """All tensors of a meta-batch."""
    parts = (tensors(part) if isinstance(part, tuple) else [part] for part in batch)
    return [tensor for tensor in chain(*parts) if tensor is not None]
