"""Callbacks of training."""

import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from torch import nn

from sb3_poem.common.networks import MLP, dormant_units
from sb3_poem.pearl_sac.losses import rows

if TYPE_CHECKING:
    from sb3_poem.pearl_sac.pearl_sac import PEARLSAC


class EpochCallback(BaseCallback):
    """Calls :meth:`_on_epoch` between two epochs: after the gradient steps of one, before the collection of the next.

    :param every: Epochs between two calls; the end of training is always one
    :param verbose: 0 no output, 1 info
    :raises ValueError: if ``every`` is below 1
    """

    model: "PEARLSAC"

    def __init__(self, every: int = 1, verbose: int = 0) -> None:
        super().__init__(verbose)
        if every < 1:
            raise ValueError(f"every must be at least 1 epoch, got {every}")
        self.every = every
        self._last_epoch = 0

    def _on_training_start(self) -> None:
        self._last_epoch = self.model.epoch

    def _on_rollout_start(self) -> None:
        if self.model.epoch - self._last_epoch >= self.every:
            self._run()

    def _on_training_end(self) -> None:
        if self.model.epoch > self._last_epoch:
            self._run()

    def _run(self) -> None:
        self._last_epoch = self.model.epoch
        self._on_epoch()

    def _on_step(self) -> bool:
        return True

    def _on_epoch(self) -> None:
        """What to do; override."""


class TrainingCheckpointCallback(EpochCallback):
    """Writes a checkpoint from which ``load_checkpoint`` and ``resume`` continue bit for bit, always to the same file.

    A handler of Ctrl-C may call :meth:`stop`, so that nothing of what was learned is lost::

        callback = TrainingCheckpointCallback("checkpoint.zip")
        signal.signal(signal.SIGINT, lambda *_: callback.stop())
        model.learn(500_000, callback)  # raises KeyboardInterrupt once the checkpoint is written
        POEMSAC.load_checkpoint("checkpoint.zip", env).resume()  # later

    :param path: The file; it is replaced atomically
    :param every: Epochs between two checkpoints; None: at most every 50 times as long as writing one takes, and training
        goes on where it cannot be written. The end of training writes one too, unless it was stopped within an epoch
    :param verbose: 1 reports each write
    """

    def __init__(self, path: str | Path, every: int | None = 1, verbose: int = 0) -> None:
        super().__init__(1 if every is None else every, verbose)
        self.path = Path(path)
        #: Environment steps that the last checkpoint holds; None before the first
        self.saved_steps: int | None = None
        self._paced = every is None
        self._not_before = 0.0
        self._stops = self._collecting = False

    def stop(self) -> None:
        """End training after the epoch at hand with a checkpoint and a ``KeyboardInterrupt``."""
        self._stops = True

    def _on_rollout_start(self) -> None:
        if self._stops:
            self._stops = False
            super()._on_training_end()  # writes, unless this epoch's is there
            raise KeyboardInterrupt
        if time.monotonic() >= self._not_before:
            super()._on_rollout_start()
        self._collecting = True

    def _on_rollout_end(self) -> None:
        self._collecting = False

    def _on_training_end(self) -> None:
        if not self._collecting:  # half an epoch could not be continued bit for bit
            super()._on_training_end()

    def _on_epoch(self) -> None:
        started = time.monotonic()
        try:
            self.model.save_checkpoint(self.path)
        except OSError as error:
            if not self._paced:
                raise
            warnings.warn(f"no checkpoint of {self.model.num_timesteps} steps: {error}", stacklevel=2)
        else:
            self.saved_steps = self.model.num_timesteps
            if self.verbose > 0:
                print(f"Checkpoint of {self.model.num_timesteps} steps: {self.path}")
        if self._paced:
            self._not_before = time.monotonic() + 50 * (time.monotonic() - started)


class DormantUnitsCallback(EpochCallback):
    """Counts the hidden units of actor and critics that are active on no transition, and gives them new weights.

    A unit with ReLU that is 0 everywhere gets no gradient and stays so; high learning rates and large values can leave a
    network with a fraction of its width (Sokar et al., The Dormant Neuron Phenomenon in Deep Reinforcement Learning, ICML
    2023; here their threshold is 0). Such a unit gets the incoming weights of a new one and outgoing weights of 0, so
    that no output changes, and the optimiser forgets its past. Logs their share, before that, as ``train/dormant_units``.

    :param every: Epochs between two counts; the end of training is always one
    :param recycle: Whether to give new weights; if not, the callback changes nothing
    :param transitions: Of each training task, from the replay buffer, on which units are looked at
    :param verbose: 1 reports each count
    :raises ValueError: if ``every`` or ``transitions`` is below 1
    """

    def __init__(self, every: int = 1, recycle: bool = True, transitions: int = 256, verbose: int = 0) -> None:
        super().__init__(every, verbose)
        if transitions < 1:
            raise ValueError(f"transitions must be at least 1 of each training task, got {transitions}")
        self.recycle, self.transitions = recycle, transitions
        #: Dormant units and all units of each hidden layer at the last count, by the layer's name in the policy
        self.counts: dict[str, tuple[int, int]] = {}

    def _on_epoch(self) -> None:
        # draws of its own, so that counting leaves training as it is, and a resumed training repeats them
        generator = th.Generator(self.model.device).manual_seed(self.model.epoch)
        self.counts = {}
        for name, network, inputs in self._networks(generator):
            for layer, dormant in enumerate(dormant_units(network, inputs)):
                self.counts[f"{name}.hidden.{layer}"] = int(dormant.sum()), len(dormant)
                if self.recycle:
                    self._renew(name, layer, dormant, generator)
        total, units = (sum(counts[i] for counts in self.counts.values()) for i in (0, 1))
        self.logger.record("train/dormant_units", total / max(units, 1))  # networks may have no hidden layer
        if self.verbose > 0:
            print(f"Dormant units at {self.model.num_timesteps} steps: {self.counts}")

    def _networks(self, generator: th.Generator) -> Iterator[tuple[str, MLP, th.Tensor]]:
        """Actor and critics by name, and inputs to each, (tasks * transitions, width)."""
        model, policy = self.model, self.model.policy
        latents = th.as_tensor(model.task_latents, dtype=th.float32, device=model.device)
        sources = th.arange(len(latents), device=model.device)[:, None].expand(-1, self.transitions)
        data = model.replay_buffer.sample_rows(sources, generator)
        with th.no_grad():
            obs, embedding = policy.standardise(data.observations), policy.policy_embedding(latents)
        yield "actor.mlp", cast(MLP, policy.actor.mlp), th.cat([obs, rows(embedding, self.transitions)], dim=-1).flatten(0, -2)
        inputs = th.cat([obs, data.actions, rows(latents, self.transitions)], dim=-1).flatten(0, -2)
        for i, member in enumerate(cast(list[MLP], policy.critic.members)):
            yield f"critic.members.{i}", member, inputs

    @th.no_grad()
    def _renew(self, name: str, layer: int, dormant: th.Tensor, generator: th.Generator) -> None:
        """New incoming weights, as PyTorch draws them for a new layer, for units of a network and of its target."""
        policy, units = self.model.policy, dormant.nonzero().squeeze(-1)
        incoming, outgoing = _layers(policy, name)[layer : layer + 2]
        bound = incoming.in_features**-0.5
        for parameter in (incoming.weight, incoming.bias):
            parameter[units] = th.empty_like(parameter[units]).uniform_(-bound, bound, generator=generator)
        outgoing.weight.index_fill_(1, units, 0.0)
        for parameter, dim in ((incoming.weight, 0), (incoming.bias, 0), (outgoing.weight, 1)):
            for moment in policy.optimizer.state.get(parameter, {}).values():
                if th.is_tensor(moment) and moment.shape == parameter.shape:
                    moment.index_fill_(dim, units, 0.0)
        if name.startswith("critic."):
            target_incoming, target_outgoing = _layers(policy, name.replace("critic.", "critic_target.", 1))[layer : layer + 2]
            target_incoming.weight[units], target_incoming.bias[units] = incoming.weight[units], incoming.bias[units]
            target_outgoing.weight.index_fill_(1, units, 0.0)


def _layers(policy: nn.Module, name: str) -> list[nn.Linear]:
    network = policy.get_submodule(name)
    assert isinstance(network, MLP)
    return network.layers
