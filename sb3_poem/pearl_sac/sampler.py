"""Meta-batches: what gradient steps see of the tasks' experience."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_poem.common.buffers import ContextStore, TaskBatch, TaskReplayBuffer
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.random import Generators
from sb3_poem.pearl_sac.train_tasks import TrainTasks

#: Bytes of transitions drawn at once: few enough for the cache; on a GPU the number of draws costs
BYTES_AT_ONCE = {"cpu": 2**20, "cuda": 2**28}
#: Tasks whose policies a relabelled context comes from, as in a first estimate
FOREIGN_SOURCES = 2


class Bootstraps(NamedTuple):
    """What critics' targets that look some steps ahead are made of, (tasks, batch, ...)."""

    rewards: th.Tensor  # their discounted sum until then
    observations: th.Tensor  # after it
    discounts: th.Tensor  # of the value there, 0 where the episode terminated


class MetaBatch(NamedTuple):
    """What one gradient step sees of a meta-batch of tasks."""

    task_ids: th.Tensor  # (tasks,)
    transitions: TaskBatch  # (tasks, batch, ...)
    context: th.Tensor  # (tasks, context_size, context_dim)
    context_rewards: th.Tensor  # (tasks, context_size)
    returns: th.Tensor  # (tasks, tasks): J[i, j], NaN where unknown
    latent_noise: th.Tensor  # (tasks, latent_dim)
    action_noise: th.Tensor  # (tasks, batch, action_dim)
    next_action_noise: th.Tensor
    bootstraps: Bootstraps


def mapped(function: Callable[[th.Tensor], th.Tensor], batch: Any) -> Any:
    """A meta-batch with what a function makes of each of its tensors."""
    if isinstance(batch, tuple):
        return type(batch)(*(mapped(function, part) for part in batch))
    return function(batch)


@dataclass
class MetaBatchSampler:
    """Draws meta-batches, several at once, which costs as much as one; fields are PEARLSAC's."""

    family: FamilyView
    train_tasks: TrainTasks
    replay_buffer: TaskReplayBuffer
    epoch_context: ContextStore
    context_reward_statistics: tuple[float, float]
    generators: Generators
    latent_dim: int
    meta_batch_size: int
    context_size: int
    gamma: float
    n_steps: int
    relabel_fraction: float
    context_relabel_fraction: float
    shaping_coef: float

    @property
    def device(self) -> th.device:
        return self.replay_buffer.device

    def blocks(self, n: int, batch_size: int) -> Iterator[list[MetaBatch]]:
        """``n`` meta-batches of ``batch_size`` transitions a task, in blocks drawn at once."""
        step_bytes = self.meta_batch_size * batch_size * 4 * sum(self.replay_buffer.widths)
        at_once = max(1, BYTES_AT_ONCE.get(self.device.type, BYTES_AT_ONCE["cpu"]) // step_bytes)
        for start in range(0, n, at_once):
            yield self.sample(min(at_once, n - start), batch_size)

    def sample(self, n: int, batch_size: int) -> list[MetaBatch]:
        """Draw ``n`` meta-batches of ``batch_size`` transitions a task."""
        rng, n_tasks = self.generators.numpy, len(self.train_tasks)
        size = min(self.meta_batch_size, n_tasks)
        # each once: a task twice is a pair without a difference
        choices = [rng.choice(n_tasks, size=size, replace=False) for _ in range(n)]
        chosen = np.concatenate(choices)
        task_ids = th.as_tensor(chosen, device=self.device)  # (n * tasks,)
        transitions, bootstraps = self._transitions(task_ids, chosen, batch_size)
        context, context_rewards = self.contexts(task_ids)
        returns = self.epoch_context.returns[task_ids]
        action_dim = transitions.actions.shape[-1]
        widths = [self.latent_dim, batch_size * action_dim, batch_size * action_dim]
        shape = (len(chosen), sum(widths))
        noise = th.randn(shape, generator=self.generators.torch, device=self.device)
        of_latents, *parts = noise.split(widths, dim=1)
        of_actions, of_next = (part.reshape(-1, batch_size, action_dim) for part in parts)
        known = (task_ids, transitions, context, context_rewards, returns)
        whole = MetaBatch(*known, of_latents, of_actions, of_next, bootstraps)
        rows = (slice(start, start + size) for start in range(0, len(chosen), size))
        batches = (mapped(itemgetter(some), whole) for some in rows)
        return [batch._replace(returns=batch.returns[:, batch.task_ids]) for batch in batches]

    def _transitions(
        self, task_ids: th.Tensor, chosen: np.ndarray, batch_size: int
    ) -> tuple[TaskBatch, Bootstraps]:
        """Transitions, ``relabel_fraction`` of them relabelled; what targets need beyond."""
        generator, buffer = self.generators.torch, self.replay_buffer
        sources = task_ids[:, None].expand(-1, batch_size)
        n_foreign = round(self.relabel_fraction * batch_size)
        if n_foreign:
            shape = (len(chosen), n_foreign)
            foreign = th.randint(buffer.n_tasks, shape, generator=generator, device=self.device)
            sources = th.cat([sources[:, n_foreign:], foreign], dim=1)
        slots = buffer.draw_slots(sources, generator)

        def seen(slots: th.Tensor) -> TaskBatch:
            batch = buffer.at(sources, slots)
            if not n_foreign:
                return batch
            rewards = batch.rewards.clone()
            rewards[:, -n_foreign:] = self._rewards(chosen, batch.features[:, -n_foreign:])
            return batch._replace(rewards=rewards)

        transitions = last = seen(slots)
        rewards, going_on = transitions.rewards.clone(), ~transitions.ended
        discounts = th.full_like(rewards, self.gamma)
        for _ in range(self.n_steps - 1):
            slots = th.where(going_on, (slots + 1) % buffer.capacity, slots)
            following = seen(slots)
            rewards += going_on * discounts * following.rewards
            discounts = th.where(going_on, self.gamma * discounts, discounts)
            last, going_on = following, going_on & ~following.ended
        discounts *= 1.0 - last.terminated
        if self.shaping_coef > 0:  # the potentials between first and last cancel each other
            potential = self._potential(transitions.observations, chosen)
            rewards += discounts * self._potential(last.next_observations, chosen) - potential
        return transitions, Bootstraps(rewards, last.next_observations, discounts)

    def _potential(self, observations: th.Tensor, chosen: np.ndarray) -> th.Tensor:
        """What staying at observations (tasks, batch, obs_dim) would be worth, (tasks, batch)."""
        potential = self._of_tasks(self.family.compute_potential, chosen, observations)
        return potential * (self.shaping_coef / (1.0 - self.gamma))

    def _rewards(self, chosen: np.ndarray, features: th.Tensor) -> th.Tensor:
        return self._of_tasks(self.family.compute_rewards, chosen, features)

    def _of_tasks(
        self,
        compute: Callable[[np.ndarray, np.ndarray], np.ndarray],
        chosen: np.ndarray,
        of: th.Tensor,
    ) -> th.Tensor:
        """What the family computes for chosen tasks of (tasks, batch, ...): (tasks, batch)."""
        computed = compute(self.train_tasks.tasks[chosen][:, None, :], of.cpu().numpy())
        return th.as_tensor(computed, dtype=th.float32, device=self.device)

    def contexts(self, task_ids: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """``context_size`` transitions of the last epoch for each task, and their rewards."""
        transitions, rewards = self.epoch_context.transitions, self.epoch_context.rewards
        steps = transitions.shape[1]
        shape = (len(task_ids), self.context_size)
        picks = th.randint(steps, shape, generator=self.generators.torch, device=self.device)
        relabels = self.context_relabel_fraction > 0
        sources = self._context_sources(task_ids) if relabels else task_ids[:, None]
        rows = (sources * steps + picks).view(-1)

        def picked(values: th.Tensor) -> th.Tensor:
            return values.flatten(0, 1).index_select(0, rows).view(*shape, *values.shape[2:])

        context, features = picked(transitions), self.epoch_context.features
        if features is None:
            return context, picked(rewards)
        own = self._rewards(task_ids.cpu().numpy(), picked(features))
        centre, deviation = self.context_reward_statistics
        context[..., -1] = (own - centre) / deviation
        return context, own

    def _context_sources(self, task_ids: th.Tensor) -> th.Tensor:
        """Whose transitions contexts hold, (tasks, context_size): some mix two random tasks'."""
        generator, device, n = self.generators.torch, self.device, len(task_ids)
        n_tasks, picked = len(self.train_tasks), (n, self.context_size)
        pool = th.randint(n_tasks, (n, FOREIGN_SOURCES), generator=generator, device=device)
        picks = th.randint(FOREIGN_SOURCES, picked, generator=generator, device=device)
        uniform = th.rand((n, 1), generator=generator, device=device)
        foreign = uniform < self.context_relabel_fraction
        return th.where(foreign, pool.gather(1, picks), task_ids[:, None])
