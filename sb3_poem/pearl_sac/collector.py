"""The collection of an epoch: every training task is rolled out under its own latest latent."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

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
    """Rolls training tasks out and fills their replay buffers. ``explores`` tells whether actions
    are uniformly random at present, ``episode_count`` the episodes begun so far, for messages;
    other fields are PEARLSAC's.
    """

    family: FamilyView
    policy: LatentPolicy
    train_tasks: TrainTasks
    replay_buffer: TaskReplayBuffer
    generators: Generators
    trajectories_per_task: int
    noise_color: float
    explores: Callable[[], bool]
    episode_count: Callable[[], int]
    on_step: OnStep

    def collect(self) -> list[Segment] | None:
        """An epoch: a segment for each wave of copies; None if ``on_step`` ended it."""
        waves = []
        wanted = np.repeat(np.arange(len(self.train_tasks)), self.trajectories_per_task)
        for wave in in_waves(wanted, self.family.num_envs):
            latents = self.train_tasks.draw_latents(wave, self.generators.numpy)
            segment = self.roll_out(wave, latents)
            if segment is None:
                return None
            waves.append(segment)
        return waves

    def roll_out(self, task_ids: np.ndarray, latents: np.ndarray) -> Segment | None:
        """A horizon of each copy, which goes to the buffer too; None if ``on_step`` ended it."""
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
        seed, tasks = self.generators.integer_seed(), self.train_tasks.tasks[task_ids]
        segment = collect_segment(
            self.family, act, task_ids, tasks, latents, seed, episodes, self.on_step
        )
        if segment is not None:
            self.replay_buffer.extend(segment)
        return segment

    def action_noises(self, shape: tuple[int, int]) -> Iterator[th.Tensor]:
        """Standard normal noise of each step of a horizon, (copies, action_dim)."""
        device, color, rng = self.policy.device, self.noise_color, self.generators.numpy
        if color == 0:
            while True:
                yield th.randn(shape, generator=self.generators.torch, device=device)
        steps = max(2, self.family.horizon)
        noise = powerlaw_psd_gaussian(color, (*shape, steps), random_state=rng)
        yield from th.as_tensor(noise, dtype=th.float32, device=device).movedim(-1, 0)


def in_waves(rows: np.ndarray, n_envs: int) -> np.ndarray:
    """Rows in order, (waves, n_envs, ...): the last wave is filled up from the start."""
    count = -(-len(rows) // n_envs) * n_envs
    return rows[np.arange(count) % len(rows)].reshape(-1, n_envs, *rows.shape[1:])


def concatenate(segments: list[Segment], n: int) -> Segment:
    """The first ``n`` copies of all waves as one segment."""
    names = [field.name for field in fields(Segment)]
    parts = {name: [getattr(segment, name) for segment in segments] for name in names}
    return Segment(**{name: np.concatenate(values)[:n] for name, values in parts.items()})
