"""Meta-batches: what gradient steps see of the tasks' experience."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch as th

from poem_envs import SignedPermutation
from sb3_poem.common.buffers import ContextStore, TaskBatch, TaskReplayBuffer
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.networks import RunningNorm
from sb3_poem.common.random import Generators
from sb3_poem.pearl_sac.losses import Bootstraps, MetaBatch

#: Bytes of transitions drawn at once: few enough for the cache; on a GPU the number of draws costs
BYTES_AT_ONCE = {"cpu": 2**20, "cuda": 2**28}
#: Tasks whose policies a relabelled context comes from, as many as there are trajectories before
#: adaptation's first estimate
FOREIGN_SOURCES = 2


@dataclass
class MetaBatchSampler:
    """Draws meta-batches from replay buffers and contexts.

    Several are drawn at once: indices, relabelled rewards and noise then cost as many operations as
    for one.

    :param family: The environment, for relabelled rewards
    :param tasks: The training tasks, (n, task_dim)
    :param buffer: The tasks' transitions
    :param context: The last epoch's contexts
    :param generators: All draws come from them
    :param latent_dim: Dimension of the latent
    :param meta_batch_size: Tasks in a meta-batch
    :param context_size: Transitions in a context
    :param gamma: Discount factor
    :param n_steps: Steps of rewards in the critics' targets
    :param relabel_fraction: Share of a task's batch that is other tasks'
    :param context_relabel_fraction: Share of contexts that are other tasks'
    :param shaping_coef: Share of the family's potential in the critics' rewards
    :param mirror_fraction: Share of a task's batch that is seen in a symmetry
    """

    family: FamilyView
    tasks: np.ndarray
    buffer: TaskReplayBuffer
    context: ContextStore
    generators: Generators
    latent_dim: int
    meta_batch_size: int
    context_size: int
    gamma: float
    n_steps: int = 1
    relabel_fraction: float = 0.0
    context_relabel_fraction: float = 0.0
    shaping_coef: float = 0.0
    mirror_fraction: float = 0.0

    @property
    def device(self) -> th.device:
        return self.buffer.device

    def blocks(self, n: int, batch_size: int) -> Iterator[list[MetaBatch]]:
        """``n`` meta-batches of ``batch_size`` transitions a task, in blocks that are drawn at
        once.
        """
        step_bytes = self.meta_batch_size * batch_size * 4 * sum(self.buffer.widths)
        at_once = max(1, BYTES_AT_ONCE.get(self.device.type, BYTES_AT_ONCE["cpu"]) // step_bytes)
        for start in range(0, n, at_once):
            yield self.sample(min(at_once, n - start), batch_size)

    def sample(self, n: int, batch_size: int) -> list[MetaBatch]:
        """Draw ``n`` meta-batches of ``batch_size`` transitions a task."""
        choices = [self.choose_tasks() for _ in range(n)]
        sizes = [len(choice) for choice in choices]
        chosen = np.concatenate(choices)
        task_ids = th.as_tensor(chosen, device=self.device)  # (n * tasks,)
        transitions, bootstraps = self._transitions(task_ids, chosen, batch_size)
        context, context_rewards = self.contexts(task_ids)
        action_dim = transitions.actions.shape[-1]
        widths = [self.latent_dim, batch_size * action_dim, batch_size * action_dim]
        shape = (len(chosen), sum(widths))
        noise = th.randn(shape, generator=self.generators.torch, device=self.device)
        latent_noise, *action_noises = noise.split(widths, dim=1)
        split = (
            field.split(sizes)
            for field in (
                task_ids,
                *transitions,
                context,
                context_rewards,
                latent_noise,
                *(part.reshape(-1, batch_size, action_dim) for part in action_noises),
                *(bootstraps or ()),
            )
        )
        n_fields = len(TaskBatch._fields)
        batches = []
        for ids, *rest in zip(*split, strict=True):
            one, rest = TaskBatch(*rest[:n_fields]), rest[n_fields:]
            own_context, own_rewards, of_latents, of_actions, of_next_actions, *ahead = rest
            batches.append(
                MetaBatch(
                    ids,
                    one,
                    own_context,
                    own_rewards,
                    self.context.returns[ids][:, ids],
                    of_latents,
                    of_actions,
                    of_next_actions,
                    Bootstraps(*ahead) if ahead else None,
                )
            )
        return batches

    def choose_tasks(self) -> np.ndarray:
        """Indices of a meta-batch, without repetition: a task twice would be a pair without a
        difference.
        """
        size = min(self.meta_batch_size, len(self.tasks))
        return self.generators.numpy.choice(len(self.tasks), size=size, replace=False)

    def _transitions(
        self, task_ids: th.Tensor, chosen: np.ndarray, batch_size: int
    ) -> tuple[TaskBatch, Bootstraps | None]:
        """``batch_size`` transitions for each task, ``relabel_fraction`` of them other tasks' with
        the task's own rewards and ``mirror_fraction`` seen in a symmetry; and what the critics'
        targets are made of, if that is more than these.
        """
        generator, buffer = self.generators.torch, self.buffer
        sources = task_ids[:, None].expand(-1, batch_size)
        n_foreign = round(self.relabel_fraction * batch_size)
        if n_foreign:
            shape = (len(chosen), n_foreign)
            foreign = th.randint(buffer.n_tasks, shape, generator=generator, device=self.device)
            sources = th.cat([sources[:, n_foreign:], foreign], dim=1)
        slots = buffer.draw_slots(sources, generator)
        mirrored = self._draw_mirror(sources.shape) if self.mirror_fraction > 0 else None

        def seen(slots: th.Tensor) -> TaskBatch:
            stored = buffer.at(sources, slots)
            if mirrored is None:
                return self._relabelled(stored, chosen, n_foreign)
            return self._relabelled(mirrored(stored), chosen, batch_size)

        transitions = seen(slots)
        if self.n_steps == 1 and self.shaping_coef == 0:
            return transitions, None
        last, rewards, going_on = transitions, transitions.rewards.clone(), ~transitions.ended
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

    def _draw_mirror(self, shape: th.Size) -> Callable[[TaskBatch], TaskBatch]:
        """A function that sees ``mirror_fraction`` of transitions (tasks, batch) in a symmetry,
        each always in the same; their rewards stay as they were.
        """
        generator, device, symmetries = self.generators.torch, self.device, self.family.symmetries
        which = th.randint(1, len(symmetries) + 1, shape, generator=generator, device=device)
        # 0 is no symmetry
        which *= th.rand(shape, generator=generator, device=device) < self.mirror_fraction

        def chosen(permutations: Sequence[SignedPermutation]) -> tuple[th.Tensor, th.Tensor]:
            width = len(permutations[0].order)
            order = th.tensor([list(range(width)), *(p.order for p in permutations)], device=device)
            signs = th.tensor([[1.0] * width, *(p.signs for p in permutations)], device=device)
            return order[which], signs[which]

        of_observations, of_actions, of_features = map(chosen, zip(*symmetries, strict=True))

        def seen(values: th.Tensor, order: th.Tensor, signs: th.Tensor) -> th.Tensor:
            return values.gather(-1, order) * signs

        return lambda transitions: transitions._replace(
            observations=seen(transitions.observations, *of_observations),
            actions=seen(transitions.actions, *of_actions),
            next_observations=seen(transitions.next_observations, *of_observations),
            features=seen(transitions.features, *of_features),
        )

    def _potential(self, observations: th.Tensor, chosen: np.ndarray) -> th.Tensor:
        """What staying at observations (tasks, batch, obs_dim) would be worth, (tasks, batch)."""
        tasks = self.tasks[chosen][:, None, :]
        potential = self.family.compute_potential(tasks, observations.cpu().numpy())
        values = th.as_tensor(potential, dtype=th.float32, device=self.device)
        return values * (self.shaping_coef / (1.0 - self.gamma))

    def _relabelled(self, transitions: TaskBatch, chosen: np.ndarray, n_foreign: int) -> TaskBatch:
        """With the tasks' own rewards in the last ``n_foreign`` transitions of each."""
        if not n_foreign:
            return transitions
        own = self._rewards(self.tasks[chosen], transitions.features[:, -n_foreign:])
        rewards = transitions.rewards.clone()
        rewards[:, -n_foreign:] = own
        return transitions._replace(rewards=rewards)

    def _rewards(self, tasks: np.ndarray, features: th.Tensor) -> th.Tensor:
        """Rewards (tasks, batch) of features (tasks, batch, feat_dim)."""
        rewards = self.family.compute_rewards(tasks[:, None, :], features.cpu().numpy())
        return th.as_tensor(rewards, dtype=th.float32, device=self.device)

    def contexts(self, task_ids: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """``context_size`` transitions of the last epoch for each task, and their rewards."""
        transitions, rewards = self.context.transitions, self.context.rewards
        steps = transitions.shape[1]
        shape = (len(task_ids), self.context_size)
        picks = th.randint(steps, shape, generator=self.generators.torch, device=self.device)
        relabels = self.context_relabel_fraction > 0
        sources = self._context_sources(task_ids) if relabels else task_ids[:, None]
        rows = (sources * steps + picks).view(-1)
        context = transitions.view(-1, transitions.shape[-1]).index_select(0, rows).view(*shape, -1)
        features = self.context.features
        if features is None:
            return context, rewards.view(-1).index_select(0, rows).view(shape)
        chosen = features.view(len(rewards) * steps, -1).index_select(0, rows).view(*shape, -1)
        own = self._rewards(self.tasks[task_ids.cpu().numpy()], chosen)
        centre, deviation = self._reward_statistics
        context[..., -1] = (own - centre) / deviation
        return context, own

    @cached_property
    def _reward_statistics(self) -> tuple[float, float]:
        """Mean and deviation by which rewards in contexts are standardised."""
        rewards = self.context.rewards
        return float(rewards.mean()), max(float(rewards.std()), RunningNorm.MIN_STD)

    def _context_sources(self, task_ids: th.Tensor) -> th.Tensor:
        """Whose transitions a context holds, (tasks, context_size): the task's own, or for
        ``context_relabel_fraction`` of the contexts a mixture of those of two random tasks.
        """
        generator, device, n = self.generators.torch, self.device, len(task_ids)
        n_tasks, picked = len(self.tasks), (n, self.context_size)
        pool = th.randint(n_tasks, (n, FOREIGN_SOURCES), generator=generator, device=device)
        picks = th.randint(FOREIGN_SOURCES, picked, generator=generator, device=device)
        foreign = (
            th.rand((n, 1), generator=generator, device=device) < self.context_relabel_fraction
        )
        return th.where(foreign, pool.gather(1, picks), task_ids[:, None])
