"""The collection of an epoch: every training task is rolled out under its own latest latent."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch as th
from colorednoise import powerlaw_psd_gaussian

from sb3_poem.common.buffers import Segment, TaskReplayBuffer
from sb3_poem.common.collection import OnStep, collect_segment
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.random import Generators
from sb3_poem.pearl_sac.policies import LatentPolicy
from sb3_poem.pearl_sac.train_tasks import TrainTasks


@dataclass
class EpochCollector:
    """Rolls training tasks out and fills their replay buffers.

    :param family: The environment
    :param policy: Acts, given a latent
    :param tasks: The training tasks
    :param buffer: Takes all transitions
    :param generators: Latents, noise and seeds come from them
    :param trajectories_per_task: Horizons of each task in an epoch
    :param noise_color: Exponent of the power spectrum of the actions' noise
    :param explores: Whether actions are uniformly random at present
    :param episode_count: Episodes begun so far; for messages
    :param on_step: See :func:`collect_segment`
    """

    family: FamilyView
    policy: LatentPolicy
    tasks: TrainTasks
    buffer: TaskReplayBuffer
    generators: Generators
    trajectories_per_task: int
    noise_color: float
    explores: Callable[[], bool]
    episode_count: Callable[[], int]
    on_step: OnStep

    def collect(self) -> list[Segment] | None:
        """One epoch: ``trajectories_per_task`` horizons of every task, one segment for each wave of
        copies.

        :return: The waves, or None if ``on_step`` ended the collection
        """
        waves = []
        wanted = np.repeat(np.arange(len(self.tasks)), self.trajectories_per_task)
        for wave in in_waves(wanted, self.family.num_envs):
            segment = self.roll_out(wave, self.tasks.draw_latents(wave, self.generators.numpy))
            if segment is None:
                return None
            waves.append(segment)
        return waves

    def roll_out(self, task_ids: np.ndarray, latents: np.ndarray) -> Segment | None:
        """One horizon of each copy under a latent of its own; what happens goes to the buffer as
        well.

        :param task_ids: (copies,)
        :param latents: (copies, latent_dim)
        :return: The experience, or None if ``on_step`` ended the collection
        """
        space = self.policy.action_space
        shape = (len(latents), int(space.shape[0]))
        policy_action, noises = self.policy.acting_on(latents), self.action_noises(shape)

        def act(obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            if self.explores():
                scaled = self.generators.numpy.uniform(-1.0, 1.0, shape).astype(np.float32)
            else:
                scaled = policy_action(obs, next(noises))
            return np.clip(self.policy.unscale_action(scaled), space.low, space.high), scaled

        episodes = np.full(self.family.num_envs, self.episode_count())
        seed, tasks = self.generators.integer_seed(), self.tasks.tasks[task_ids]
        segment = collect_segment(
            self.family, act, task_ids, tasks, latents, seed, episodes, self.on_step
        )
        if segment is not None:
            self.buffer.extend(segment)
        return segment

    def action_noises(self, shape: tuple[int, int]) -> Iterator[th.Tensor]:
        """Standard normal noise of each step of a horizon, (copies, action_dim)."""
        device = self.policy.device
        if self.noise_color == 0:
            while True:
                yield th.randn(shape, generator=self.generators.torch, device=device)
        steps = max(2, self.family.horizon)
        noise = powerlaw_psd_gaussian(
            self.noise_color, (*shape, steps), random_state=self.generators.numpy
        )
        yield from th.as_tensor(noise, dtype=th.float32, device=device).movedim(-1, 0)


def in_waves(rows: np.ndarray, n_envs: int) -> np.ndarray:
    """Rows in order, (waves, n_envs, ...): the last wave is filled up from the start, as its copies
    are stepped anyway.
    """
    count = -(-len(rows) // n_envs) * n_envs
    return rows[np.arange(count) % len(rows)].reshape(-1, n_envs, *rows.shape[1:])


def concatenate(segments: list[Segment], n: int) -> Segment:
    """The first ``n`` copies of all waves as one segment."""
    return Segment(
        **{
            name: np.concatenate([getattr(segment, name) for segment in segments])[:n]
            for name in Segment.__dataclass_fields__
        }
    )
