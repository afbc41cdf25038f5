"""A gradient step as one CUDA graph."""

from collections.abc import Callable
from typing import Any

import torch as th

from sb3_poem.pearl_sac.losses import MetaBatch

EAGER_STEPS = 3

Step = Callable[[MetaBatch], dict[str, th.Tensor]]


class GraphedStep:
    """Runs a step, and from the fourth on replays it: thousands of small kernels then cost one
    launch.

    Everything that the step reads and does not change must stay where it is between calls, but for
    the meta-batch, which is copied to where the graph reads it. Its optimisers must be
    :func:`prepared <prepare_optimizers>`.

    :param step: Maps a meta-batch to metrics, all scalars, without waiting for the device
    """

    def __init__(self, step: Step) -> None:
        self._step = step
        self._calls = 0
        self._stream = th.cuda.Stream()
        self._graph = th.cuda.CUDAGraph()
        self._batch: MetaBatch | None = None
        self._names: tuple[str, ...] = ()
        self._values: th.Tensor | None = None

    def __call__(self, batch: MetaBatch) -> dict[str, th.Tensor]:
        self._calls += 1
        if self._batch is not None and any(
            old.shape != new.shape
            for old, new in zip(tensors(self._batch), tensors(batch), strict=True)
        ):
            return self._step(batch)
        if (
            self._calls <= EAGER_STEPS
        ):  # capture demands that libraries have been set up on a stream other than the default
            self._stream.wait_stream(th.cuda.current_stream())
            with th.cuda.stream(self._stream):
                metrics = self._step(batch)
            th.cuda.current_stream().wait_stream(self._stream)
            return metrics
        if self._batch is None:
            self._batch = _cloned(batch)
            with th.cuda.graph(self._graph):
                metrics = self._step(self._batch)
                self._names, self._values = tuple(metrics), th.stack(list(metrics.values()))
        else:
            th._foreach_copy_(tensors(self._batch), tensors(batch))
        self._graph.replay()
        assert self._values is not None
        return dict(zip(self._names, self._values.clone().unbind(), strict=True))


def prepare_optimizers(optimizers: list[th.optim.Optimizer], device: th.device) -> None:
    """Keep the state of optimisers where their parameters are, and tell them whether a graph may
    capture them: on a processor, where a model that was trained on a GPU may go on, they refuse
    that.
    """
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            if "capturable" in group:
                group["capturable"] = device.type == "cuda"
        for parameter, state in optimizer.state.items():
            if "step" in state:
                state["step"] = th.as_tensor(
                    state["step"], dtype=th.float32, device=parameter.device
                )


def tensors(batch: tuple[Any, ...]) -> list[th.Tensor]:
    """All tensors of a meta-batch."""
    parts = (
        tensors(field) if isinstance(field, tuple) else [field]
        for field in batch
        if field is not None
    )
    return [tensor for part in parts for tensor in part]


def _cloned(batch: Any) -> Any:
    if isinstance(batch, tuple):
        return type(batch)(*map(_cloned, batch))
    return None if batch is None else batch.clone()
