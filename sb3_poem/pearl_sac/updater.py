"""One optimiser step, in mixed precision, with a look at the gradient; on a GPU as one graph."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import torch as th
from torch import nn

from sb3_poem.common.precision import MixedPrecision
from sb3_poem.pearl_sac.objective import Metrics, Objective
from sb3_poem.pearl_sac.policies import LatentPolicy
from sb3_poem.pearl_sac.sampler import MetaBatch, mapped

EAGER_STEPS = 3


@dataclass
class EntropyCoefficient:
    """SAC's entropy coefficient: fixed, or learned by an optimizer as its logarithm, (1,)."""

    tensor: th.Tensor
    optimizer: th.optim.Optimizer | None
    target: float

    @property
    def value(self) -> th.Tensor:
        """The coefficient, a scalar without a graph."""
        return self.tensor if self.optimizer is None else self.tensor.detach().exp().squeeze()

    def update(self, entropy: th.Tensor) -> None:
        """A step along the gradient of log * (entropy - target), of a meta-batch's entropy."""
        if self.optimizer is not None:
            gradient = (entropy.detach() - self.target).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
            self.tensor.grad = gradient.view_as(self.tensor)
            self.optimizer.step()


@dataclass
class Updater:
    """Changes the networks, in the context of its ``precision``, that of the hidden layers."""

    policy: LatentPolicy
    objective: Objective
    entropy_coefficient: EntropyCoefficient
    hidden_dtype: th.dtype
    tau: float
    target_update_interval: int
    policy_delay: int
    n_updates: int

    def __post_init__(self) -> None:
        policy, on_gpu = self.policy, self.policy.device.type == "cuda"
        optimizers = policy.optimizer, self.entropy_coefficient.optimizer
        self.optimizers = [optimizer for optimizer in optimizers if optimizer is not None]
        for optimizer in self.optimizers:
            prepare_for_graphs(optimizer, on_gpu)
        learning = policy.encoder, policy.decoder, policy.actor, policy.critic, policy.critic_target
        self.precision = MixedPrecision(nn.ModuleList(learning), self.hidden_dtype)
        #: By whether everything learns
        self._steps: dict[bool, Callable[[MetaBatch], Metrics]]
        self._steps = {whole: partial(self._step, whole) for whole in (True, False)}
        fused = all(group.get("fused") for group in policy.optimizer.param_groups)
        #: For the gradient's norm, before the step: only fused optimisers leave a bad one out
        self.waits = not (on_gpu and fused)
        if not self.waits and self.target_update_interval == 1:
            self._steps = {whole: GraphedStep(step) for whole, step in self._steps.items()}

    def step(self, batch: MetaBatch) -> Metrics:
        """A step of everything or, in between, of critics and encoder. Returns what to log."""
        metrics = self._steps[self.n_updates % self.policy_delay == 0](batch)
        self.n_updates += 1
        return metrics

    def _step(self, whole: bool, batch: MetaBatch) -> Metrics:
        self.precision.refresh()
        loss, metrics = self.objective.loss(batch, self.entropy_coefficient.value, whole)
        metrics["gradient_norm"] = self._descend(loss)
        if whole:
            self.entropy_coefficient.update(metrics["entropy"])
        if self.n_updates % self.target_update_interval == 0:
            targets, critics = self.policy.critic_target, self.policy.critic
            pair = tuple(targets.parameters()), tuple(critics.parameters())
            with th.no_grad():
                th._foreach_lerp_(*pair, self.tau)
        return {name: value.detach() for name, value in metrics.items()}

    def _descend(self, loss: th.Tensor) -> th.Tensor:
        """Step along the gradient; returns its norm, not finite where the loss is not."""
        optimizer: Any = self.policy.optimizer
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        groups = optimizer.param_groups
        gradients = [p.grad for group in groups for p in group["params"] if p.grad is not None]
        # the loss is looked at as well, because a ReLU may turn NaN to 0 on the way to the gradient
        norm = nn.utils.get_total_norm(gradients, foreach=True) + 0.0 * loss.detach()
        if self.waits:
            self.check_finite([norm], self.n_updates)
        else:  # nobody waits for the device: it leaves out the step, and the block's end tells
            optimizer.found_inf = (~th.isfinite(norm)).float()
        optimizer.step()
        return norm

    def check_finite(self, gradient_norms: list[th.Tensor], first: int) -> None:
        """Refuse norms of successive steps, the first of this number, that are not finite."""
        finite = th.isfinite(th.stack(gradient_norms))
        if not finite.all():
            raise ValueError(
                "the training loss or its gradient is not finite at update "
                f"{first + int(finite.int().argmin())}; no network was changed by it. "
                "A lower learning_rate or reward_scale usually helps."
            )


class GraphedStep:
    """Runs a step, which maps a meta-batch to scalar metrics without waiting for the device, and
    from the fourth on replays it: thousands of small kernels then cost one launch.

    Everything that the step reads must stay where it is between calls, but for the meta-batch,
    which is copied to where the graph reads it.
    """

    def __init__(self, step: Callable[[MetaBatch], Metrics]) -> None:
        self._step = step
        self._calls = 0
        self._stream = th.cuda.Stream()
        self._graph = th.cuda.CUDAGraph()
        #: What the graph reads, and what it writes
        self._inputs: list[th.Tensor] = []
        self._names: tuple[str, ...] = ()
        self._values = th.empty(0)

    def __call__(self, batch: MetaBatch) -> Metrics:
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


def prepare_for_graphs(optimizer: th.optim.Optimizer, on_gpu: bool) -> None:
    """Keep an optimiser's state where parameters are; only on a GPU may a graph capture it."""
    for group in optimizer.param_groups:
        if "capturable" in group:
            group["capturable"] = on_gpu
    for parameter, state in optimizer.state.items():
        if "step" in state:
            steps = th.as_tensor(state["step"], dtype=th.float32, device=parameter.device)
            state["step"] = steps


def tensors(batch: tuple[Any, ...]) -> list[th.Tensor]:
    """All tensors of a meta-batch."""
    return list(chain(*(tensors(part) if isinstance(part, tuple) else [part] for part in batch)))
