"""Meta-batches: what gradient steps see of the tasks' experience."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch as th

from poem_envs import SignedPermutation
from sb3_poem.common.buffers import TaskBatch
from sb3_poem.pearl_sac import losses
from sb3_poem.pearl_sac.collecting import CollectingSAC
from sb3_poem.pearl_sac.losses import MetaBatch

#: Bytes of transitions that are drawn at once: few enough to stay in the cache; on a GPU the number of draws is what costs
BYTES_AT_ONCE = {"cpu": 2**20, "cuda": 2**28}
#: Tasks whose policies a relabelled context comes from, as many as there are trajectories before adaptation's first estimate
FOREIGN_SOURCES = 2


class SamplingSAC(CollectingSAC):
    """Draws meta-batches from replay buffers and contexts; a base of :class:`PEARLSAC`.

    Several are drawn at once: indices, relabelled rewards and noise then cost as many operations as for one.
    """

    meta_batch_size: int
    context_size: int
    relabel_fraction: float
    target_steps: int = 1  # models of before it looked one step ahead

    def _choose_tasks(self) -> np.ndarray:
        """Indices of a meta-batch, without repetition: a repeated task would give preference pairs without a difference."""
        assert self.train_tasks is not None
        n_tasks = len(self.train_tasks)
        return self.generators.numpy.choice(n_tasks, size=min(self.meta_batch_size, n_tasks), replace=False)

    def _meta_batch_blocks(self, n: int, batch_size: int) -> Iterator[list[MetaBatch]]:
        """``n`` meta-batches, in blocks that are drawn at once."""
        step_bytes = self.meta_batch_size * batch_size * 4 * sum(self.replay_buffer.widths)
        at_once = max(1, BYTES_AT_ONCE.get(self.device.type, BYTES_AT_ONCE["cpu"]) // step_bytes)
        for start in range(0, n, at_once):
            yield self._sample_meta_batches(min(at_once, n - start), batch_size)

    def _sample_meta_batches(self, n: int, batch_size: int) -> list[MetaBatch]:
        """Draw ``n`` meta-batches of ``batch_size`` transitions a task."""
        assert self.context is not None
        choices = [self._choose_tasks() for _ in range(n)]
        sizes = [len(choice) for choice in choices]
        chosen = np.concatenate(choices)
        task_ids = th.as_tensor(chosen, device=self.device)  # (n * tasks,)
        transitions, bootstraps = self._sample_transitions(task_ids, chosen, batch_size)
        context, context_rewards = self._sample_contexts(task_ids)
        action_dim = transitions.actions.shape[-1]
        noise = self._standard_normal(len(chosen), 2 * batch_size * action_dim + self.latent_dim)
        latent_noise, *action_noises = noise.split([self.latent_dim, batch_size * action_dim, batch_size * action_dim], dim=1)
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
            transitions, rest = TaskBatch(*rest[:n_fields]), rest[n_fields:]
            context, context_rewards, latent_noise, action_noise, next_noise, *ahead = rest
            returns = self.context.returns[ids][:, ids]
            bootstraps = losses.Bootstraps(*ahead) if ahead else None
            noises = latent_noise, action_noise, next_noise
            batches.append(MetaBatch(ids, transitions, context, context_rewards, returns, *noises, bootstraps))
        return batches

    def _sample_transitions(
        self, task_ids: th.Tensor, chosen: np.ndarray, batch_size: int
    ) -> tuple[TaskBatch, losses.Bootstraps | None]:
        """``batch_size`` transitions for each task, ``relabel_fraction`` of them other tasks' with the task's own rewards and
        ``mirror_fraction`` seen in a symmetry; and what the critics' targets are made of, if that is more than these.
        """
        generator, buffer = self.generators.torch, self.replay_buffer
        sources = task_ids[:, None].expand(-1, batch_size)
        n_foreign = round(self.relabel_fraction * batch_size)
        if n_foreign:
            foreign = th.randint(buffer.n_tasks, (len(chosen), n_foreign), generator=generator, device=self.device)
            sources = th.cat([sources[:, n_foreign:], foreign], dim=1)
        slots = buffer.draw_slots(sources, generator)
        mirrored = self._draw_mirror(sources.shape) if self.mirror_fraction > 0 else None

        def seen(slots: th.Tensor) -> TaskBatch:
            stored = buffer.at(sources, slots)
            if mirrored is None:
                return self._relabelled(stored, chosen, n_foreign)
            return self._relabelled(mirrored(stored), chosen, batch_size)

        transitions = seen(slots)
        if self.target_steps == 1 and self.shaping_coef == 0:
            return transitions, None
        last, rewards, going_on = transitions, transitions.rewards.clone(), ~transitions.ended
        discounts = th.full_like(rewards, self.gamma)
        for _ in range(self.target_steps - 1):
            slots = th.where(going_on, (slots + 1) % buffer.capacity, slots)
            following = seen(slots)
            rewards += going_on * discounts * following.rewards
            discounts = th.where(going_on, self.gamma * discounts, discounts)
            last, going_on = following, going_on & ~following.ended
        discounts *= 1.0 - last.terminated
        if self.shaping_coef > 0:  # the potentials between first and last cancel each other
            potential = self._potential(transitions.observations, chosen)
            rewards += discounts * self._potential(last.next_observations, chosen) - potential
        return transitions, losses.Bootstraps(rewards, last.next_observations, discounts)

    def _draw_mirror(self, shape: th.Size) -> Callable[[TaskBatch], TaskBatch]:
        """A function that sees ``mirror_fraction`` of transitions (tasks, batch) in a symmetry, each always in the same; their
        rewards stay as they were.
        """
        generator, device, symmetries = self.generators.torch, self.device, self.family.symmetries
        which = th.randint(1, len(symmetries) + 1, shape, generator=generator, device=device)
        which *= th.rand(shape, generator=generator, device=device) < self.mirror_fraction  # 0 is no symmetry

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
        assert self.train_tasks is not None
        potential = self.family.compute_potential(self.train_tasks[chosen][:, None, :], observations.cpu().numpy())
        return th.as_tensor(potential, dtype=th.float32, device=self.device) * (self.shaping_coef / (1.0 - self.gamma))

    def _relabelled(self, transitions: TaskBatch, chosen: np.ndarray, n_foreign: int) -> TaskBatch:
        """With the tasks' own rewards in the last ``n_foreign`` transitions of each."""
        if not n_foreign:
            return transitions
        assert self.train_tasks is not None
        features = transitions.features[:, -n_foreign:].cpu().numpy()
        own = self.family.compute_rewards(self.train_tasks[chosen][:, None, :], features)
        rewards = transitions.rewards.clone()
        rewards[:, -n_foreign:] = th.as_tensor(own, dtype=th.float32, device=self.device)
        return transitions._replace(rewards=rewards)

    def _sample_contexts(self, task_ids: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """``context_size`` transitions of the last epoch for each task, and their rewards."""
        assert self.context is not None
        transitions, rewards = self.context.transitions, self.context.rewards
        steps = transitions.shape[1]
        shape = (len(task_ids), self.context_size)
        picks = th.randint(steps, shape, generator=self.generators.torch, device=self.device)
        relabels = self.context_relabel_fraction > 0
        sources = self._context_sources(task_ids) if relabels else task_ids[:, None]
        rows = (sources * steps + picks).view(-1)
        context = transitions.view(-1, transitions.shape[-1]).index_select(0, rows).view(*shape, -1)
        if not relabels:
            return context, rewards.view(-1).index_select(0, rows).view(shape)
        assert self.train_tasks is not None
        assert self.context.features is not None
        assert self.context_reward_statistics is not None
        features = self.context.features.view(len(rewards) * steps, -1).index_select(0, rows).view(*shape, -1)
        tasks = self.train_tasks[task_ids.cpu().numpy()][:, None, :]
        own = th.as_tensor(self.family.compute_rewards(tasks, features.cpu().numpy()), dtype=th.float32, device=self.device)
        centre, deviation = self.context_reward_statistics
        context[..., -1] = (own - centre) / deviation
        return context, own

    def _context_sources(self, task_ids: th.Tensor) -> th.Tensor:
        """Whose transitions a context holds, (tasks, context_size): the task's own, or for ``context_relabel_fraction`` of the
        contexts a mixture of those of two random tasks.
        """
        generator, device, n = self.generators.torch, self.device, len(task_ids)
        assert self.context is not None
        pool = th.randint(len(self.context.rewards), (n, FOREIGN_SOURCES), generator=generator, device=device)
        picks = th.randint(FOREIGN_SOURCES, (n, self.context_size), generator=generator, device=device)
        foreign = th.rand((n, 1), generator=generator, device=device) < self.context_relabel_fraction
        return th.where(foreign, pool.gather(1, picks), task_ids[:, None])

    def _standard_normal(self, *shape: int) -> th.Tensor:
        return th.randn(shape, generator=self.generators.torch, device=self.device)
