"""Stores of experience: a replay buffer per task, and the context of the current epoch."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.utils import get_device

INITIAL_ROWS_PER_TASK = 1024


@dataclass
class Segment:
    """Experience of several environment copies over the same number of steps.

    :param task_ids: (copies,) index of each copy's training task
    :param observations: (copies, steps, obs_dim)
    :param actions: (copies, steps, action_dim), scaled to [-1, 1]
    :param next_observations: (copies, steps, obs_dim), the last one of an episode included
    :param rewards: (copies, steps)
    :param terminated: (copies, steps), 1 where the episode ended other than by the time limit
    :param features: (copies, steps, feat_dim), reward features
    :param first_episode: (copies, steps), True up to the end of each copy's first episode
    :param latents: (copies, latent_dim), which policy acted
    """

    task_ids: np.ndarray
    observations: np.ndarray
    actions: np.ndarray
    next_observations: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    features: np.ndarray
    first_episode: np.ndarray
    latents: np.ndarray


class TaskBatch(NamedTuple):
    """Transitions of several tasks.

    observations (tasks, batch, obs_dim), actions (tasks, batch, action_dim), next_observations (tasks, batch, obs_dim),
    rewards (tasks, batch), terminated (tasks, batch), features (tasks, batch, feat_dim).
    """

    observations: th.Tensor
    actions: th.Tensor
    next_observations: th.Tensor
    rewards: th.Tensor
    terminated: th.Tensor
    features: th.Tensor


class TaskReplayBuffer(ReplayBuffer):
    """Replay buffer with a ring of transitions for every training task.

    All fields of a transition are one row of one tensor, so that a batch of any tasks is a single gather. Memory is taken as
    it fills.

    :param buffer_size: Transitions kept per task
    :param observation_space: Flat Box
    :param action_space: Flat Box
    :param device: Where the transitions live
    :param n_tasks: Number of training tasks
    :param feature_dim: Width of the reward features
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        n_tasks: int = 1,
        feature_dim: int = 1,
    ) -> None:
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, get_device(device), n_envs=n_tasks)
        self.n_tasks = n_tasks
        self.optimize_memory_usage = False
        self.handle_timeout_termination = True
        assert isinstance(observation_space, spaces.Box)
        obs_dim = int(observation_space.shape[0])
        self.widths = [obs_dim, self.action_dim, obs_dim, 1, 1, feature_dim]
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self.rows = th.zeros(self.n_tasks, 0, sum(self.widths), device=self.device)
        self.counts = np.zeros(self.n_tasks, dtype=np.int64)
        self.positions = np.zeros(self.n_tasks, dtype=np.int64)
        self._counts_on_device = th.zeros(self.n_tasks, device=self.device)

    def size(self) -> int:
        """Transitions stored, over all tasks."""
        return int(self.counts.sum())

    def _reserve(self, rows_per_task: int) -> None:
        capacity = self.rows.shape[1]
        if rows_per_task > capacity:
            new_capacity = min(self.buffer_size, max(INITIAL_ROWS_PER_TASK, 2 * capacity, rows_per_task))
            grown = th.zeros(self.n_tasks, new_capacity, self.rows.shape[2], device=self.device)
            grown[:, :capacity] = self.rows
            self.rows = grown

    def extend(self, segment: Segment) -> None:
        """Store a segment; the oldest transitions of a full task make room."""
        rows = th.from_numpy(
            np.concatenate(
                [
                    segment.observations,
                    segment.actions,
                    segment.next_observations,
                    segment.rewards[..., None],
                    segment.terminated[..., None],
                    segment.features,
                ],
                axis=-1,
            ).astype(np.float32)
        ).to(self.device)
        steps = min(rows.shape[1], self.buffer_size)
        for task, task_rows in zip(segment.task_ids, rows[:, -steps:], strict=True):
            start = int(self.positions[task])
            self._reserve(min(start + steps, self.buffer_size))
            head = min(steps, self.buffer_size - start)
            self.rows[task, start : start + head] = task_rows[:head]
            self.rows[task, : steps - head] = task_rows[head:]
            self.positions[task] = (start + steps) % self.buffer_size
            self.counts[task] = min(self.counts[task] + steps, self.buffer_size)
        self._counts_on_device = th.as_tensor(self.counts, dtype=th.float32, device=self.device)
        self.full = bool((self.counts == self.buffer_size).all())

    def sample_rows(self, source_tasks: th.Tensor, generator: th.Generator) -> TaskBatch:
        """Draw one stored transition for each entry, uniformly from its task's own.

        :param source_tasks: (tasks, batch) indices of the tasks to draw from
        :param generator: torch generator on this buffer's device
        """
        uniform = th.rand(source_tasks.shape, generator=generator, device=self.device)
        slots = (uniform * self._counts_on_device[source_tasks]).long()
        flat = source_tasks * self.rows.shape[1] + slots
        rows = self.rows.view(-1, self.rows.shape[2]).index_select(0, flat.view(-1)).view(*flat.shape, -1)
        obs, actions, next_obs, rewards, terminated, features = rows.split(self.widths, dim=-1)
        return TaskBatch(obs, actions, next_obs, rewards.squeeze(-1), terminated.squeeze(-1), features)

    def state(self) -> dict[str, Any]:
        """Everything needed to continue, without unused room."""
        used = int(self.counts.max()) if self.n_tasks else 0
        return {"rows": self.rows[:, :used].clone(), "counts": self.counts.copy(), "positions": self.positions.copy()}

    def load_state(self, state: dict[str, Any]) -> None:
        """Continue from what :meth:`state` returned."""
        self.reset()
        used = state["rows"].shape[1]
        if used:
            self._reserve(used)
            self.rows[:, :used] = state["rows"].to(self.device)
        self.counts, self.positions = state["counts"].copy(), state["positions"].copy()
        self._counts_on_device = th.as_tensor(self.counts, dtype=th.float32, device=self.device)
        self.full = bool((self.counts == self.buffer_size).all())


@dataclass
class ContextStore:
    """What the last epoch collected: the encoder's contexts and the preference labels. Replaced every epoch.

    :param transitions: (tasks, steps, context_dim) standardised (s, a, s', r[, Q])
    :param rewards: (tasks, steps) in the environment's units
    :param returns: (tasks, tasks), J[i, j] of task j's policy on task i; NaN where it was not measured
    """

    transitions: th.Tensor
    rewards: th.Tensor
    returns: th.Tensor
