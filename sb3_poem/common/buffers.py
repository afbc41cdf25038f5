"""Stores of experience: a replay buffer per task, and the context of the current epoch."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.utils import get_device

INITIAL_ROWS_PER_TASK = 1024
# Steps of an action's 16-bit scale between 0 and 1.
ACTION_UNITS = 2**15 - 1


@dataclass
class Segment:
    """Experience of several environment copies over the same number of steps."""

    task_ids: np.ndarray  # (copies,) index of each copy's training task
    latents: np.ndarray  # (copies, latent_dim), which policy acted
    observations: np.ndarray  # (copies, steps, obs_dim)
    actions: np.ndarray  # (copies, steps, action_dim), scaled to [-1, 1]
    next_observations: np.ndarray  # (copies, steps, obs_dim), the last of an episode included
    rewards: np.ndarray  # (copies, steps)
    terminated: np.ndarray  # (copies, steps), 1 where an episode ended other than by the time limit
    features: np.ndarray  # (copies, steps, feat_dim), reward features
    first_episode: np.ndarray  # (copies, steps), True up to the end of each copy's first episode


class TaskBatch(NamedTuple):
    """Transitions of several tasks."""

    observations: th.Tensor  # (tasks, batch, obs_dim)
    actions: th.Tensor  # (tasks, batch, action_dim)
    next_observations: th.Tensor  # (tasks, batch, obs_dim)
    rewards: th.Tensor  # (tasks, batch)
    terminated: th.Tensor  # (tasks, batch)
    features: th.Tensor  # (tasks, batch, feat_dim)
    ended: th.Tensor  # (tasks, batch), whether the episode or its recording ends there


class TaskReplayBuffer(ReplayBuffer):
    """Replay buffer with a ring of transitions for every training task, of flat boxes.

    A transition's next observation is, but at the end of an episode or of a segment, the
    observation of the row that follows. So it is stored once; a batch of any tasks is still a
    single gather, of rows that reach into their successors. What follows an end is kept apart.
    Actions are stored in 16 bits (to within 1.6e-5 of their range from -1 to 1), all else as
    float32. ``buffer_size`` transitions are kept per task; memory is taken as it fills.

    :param tasks: Whose experience it is, ``(n_tasks, task_dim)``
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        *,
        tasks: np.ndarray,
        feature_dim: int,
    ) -> None:
        place = get_device(device)
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, place, len(tasks))
        self.tasks, self.n_tasks = tasks, len(tasks)
        self.handle_timeout_termination = True  # SB3 looks for it in what it loads
        assert isinstance(observation_space, spaces.Box)
        self.obs_dim = int(observation_space.shape[0])
        #: Words of a row: observation, features, reward, mark of an end, actions (two a word)
        self.widths = [self.obs_dim, feature_dim, 1, 1, (self.action_dim + 1) // 2]
        self.reset()

    def reset(self) -> None:
        super().reset()
        # One row more than there is room for, in which the first is repeated: it follows the last.
        self.rows = th.zeros(self.n_tasks, 1, sum(self.widths), dtype=th.int32, device=self.device)
        self.counts = np.zeros(self.n_tasks, dtype=np.int64)
        self.positions = np.zeros(self.n_tasks, dtype=np.int64)
        self._counts_on_device = th.zeros(self.n_tasks, device=self.device)
        # Observations after an end; a row's mark is its number here, negative if it terminated.
        self.ends = th.zeros(1, self.obs_dim, device=self.device)
        self._free_ends = np.zeros(0, dtype=np.int32)

    @property
    def capacity(self) -> int:
        """Transitions of a task that there is memory for."""
        return self.rows.shape[1] - 1

    def size(self) -> int:
        """Transitions stored, over all tasks."""
        return int(self.counts.sum())

    def extend(self, segment: Segment) -> None:
        """Store a segment; the oldest transitions of a full task make room."""
        steps = min(segment.observations.shape[1], self.buffer_size)
        rows, is_end, terminated = self._pack(segment, steps)
        next_observations = segment.next_observations[:, -steps:]
        for copy, task in enumerate(segment.task_ids):
            start, count = int(self.positions[task]), int(self.counts[task])
            self._reserve(min(count + steps, self.buffer_size))
            slots = th.from_numpy((start + np.arange(steps)) % self.buffer_size).to(self.device)
            marked = self.rows[task, slots[self.buffer_size - count :], self._mark].cpu().numpy()
            self._free_ends = np.concatenate([self._free_ends, np.abs(marked[marked != 0])])
            own_ends = np.flatnonzero(is_end[copy])
            numbers = self._store_ends(next_observations[copy, own_ends])
            marks = np.zeros(steps, dtype=np.int32)
            marks[own_ends] = np.where(terminated[copy, own_ends], -numbers, numbers)
            rows[copy, :, self._mark] = th.from_numpy(marks).to(self.device)
            self.rows[task, slots] = rows[copy]
            self.rows[task, -1] = self.rows[task, 0]
            self.positions[task] = (start + steps) % self.buffer_size
            self.counts[task] = min(count + steps, self.buffer_size)
        self._note_counts()

    def draw_slots(self, source_tasks: th.Tensor, generator: th.Generator) -> th.Tensor:
        """Draw a slot for each of (tasks, batch) indices of tasks, uniformly from its own."""
        uniform = th.rand(source_tasks.shape, generator=generator, device=self.device)
        return (uniform * self._counts_on_device[source_tasks]).long()

    def sample_rows(self, source_tasks: th.Tensor, generator: th.Generator) -> TaskBatch:
        """The transitions in slots that are drawn so."""
        return self.at(source_tasks, self.draw_slots(source_tasks, generator))

    def at(self, tasks: th.Tensor, slots: th.Tensor) -> TaskBatch:
        """The transitions in slots (...) of tasks (...); next steps follow, round the ring."""
        words, obs_dim, mark = sum(self.widths), self.obs_dim, self._mark
        # the very last row repeats another and is never drawn, so that every row has a successor
        drawable = self.rows.shape[0] * self.rows.shape[1] - 1
        with_successor = self.rows.as_strided((drawable, words + obs_dim), (words, 1))
        flat = tasks * self.rows.shape[1] + slots
        rows = with_successor.index_select(0, flat.reshape(-1))
        floats = rows.view(th.float32)
        # what is dense is converted and searched several times as fast
        marks = rows[:, mark].contiguous()
        ends = marks.nonzero().view(-1)
        after_ends = self.ends.index_select(0, marks.index_select(0, ends).abs())
        floats[:, words:].index_copy_(0, ends, after_ends)
        ended, terminated = marks != 0, (marks < 0).float()
        units = rows[:, mark + 1 : words].contiguous().view(th.int16)
        actions = (units * (1.0 / ACTION_UNITS))[:, : self.action_dim]
        floats, shape = floats.unflatten(0, flat.shape), flat.shape
        return TaskBatch(
            floats[..., :obs_dim],
            actions.unflatten(0, shape),
            floats[..., words:],
            floats[..., mark - 1],
            terminated.view(shape),
            floats[..., obs_dim : mark - 1],
            ended.view(shape),
        )

    def reward_magnitudes(self) -> th.Tensor:
        """(n_tasks,) root mean square of each task's rewards; NaN of a task without any."""
        rewards = self.rows[..., self._mark - 1].contiguous().view(th.float32)
        kept = zip(rewards, self.counts.tolist(), strict=True)
        return th.stack([each[:count].square().mean().sqrt() for each, count in kept])

    def state(self) -> dict[str, th.Tensor]:
        """What :meth:`load_state` continues from, without unused room."""
        used = int(self.counts.max()) if self.n_tasks else 0
        rows = self.rows[:, :used].clone()
        for task_rows, count in zip(rows, self.counts.tolist(), strict=True):
            task_rows[count:] = 0  # instead of whatever stood in this memory
        return {
            "rows": rows,
            "counts": th.from_numpy(self.counts.copy()),
            "positions": th.from_numpy(self.positions.copy()),
            "ends": self.ends.clone(),
            "free_ends": th.from_numpy(self._free_ends.copy()),
        }

    def load_state(self, state: dict[str, th.Tensor]) -> None:
        self.reset()
        used = state["rows"].shape[1]
        if used:
            self._reserve(used)
            self.rows[:, :used] = state["rows"].to(self.device)
            self.rows[:, -1] = self.rows[:, 0]
        kept = (state[name].cpu() for name in ("counts", "positions", "free_ends"))
        self.counts, self.positions, self._free_ends = (each.numpy().copy() for each in kept)
        self.ends = state["ends"].to(self.device, copy=True)
        self._note_counts()

    def _note_counts(self) -> None:
        self._counts_on_device = th.as_tensor(self.counts, dtype=th.float32, device=self.device)
        self.full = bool((self.counts == self.buffer_size).all())

    @property
    def _mark(self) -> int:
        return sum(self.widths[:3])

    def _pack(self, segment: Segment, steps: int) -> tuple[th.Tensor, np.ndarray, np.ndarray]:
        """Rows (copies, steps, words) without marks; which are ends, and which terminated."""
        obs = segment.observations[:, -steps:].astype(np.float32, copy=False)
        next_obs = segment.next_observations[:, -steps:].astype(np.float32, copy=False)
        terminated = segment.terminated[:, -steps:] > 0
        is_end = terminated.copy()
        is_end[:, -1] = True
        is_end[:, :-1] |= (next_obs[:, :-1] != obs[:, 1:]).any(axis=-1)
        packed = np.zeros((*obs.shape[:2], sum(self.widths)), dtype=np.int32)
        floats, mark = packed.view(np.float32), self._mark
        floats[..., : self.obs_dim] = obs
        floats[..., self.obs_dim : mark - 1] = segment.features[:, -steps:]
        floats[..., mark - 1] = segment.rewards[:, -steps:]
        units = np.clip(segment.actions[:, -steps:], -1.0, 1.0) * ACTION_UNITS
        actions = packed.view(np.int16)[..., 2 * (mark + 1) :][..., : self.action_dim]
        np.rint(units, out=actions, casting="unsafe")
        return th.from_numpy(packed).to(self.device), is_end, terminated

    def _reserve(self, rows_per_task: int) -> None:
        capacity = self.capacity
        if rows_per_task <= capacity:
            return
        wanted = max(INITIAL_ROWS_PER_TASK, 2 * capacity, rows_per_task)
        # not zeros: the system gives pages that nobody writes to no memory
        shape = (self.n_tasks, min(self.buffer_size, wanted) + 1, self.rows.shape[2])
        grown = self.rows.new_empty(shape)
        grown[:, :capacity] = self.rows[:, :capacity]
        self.rows = grown

    def _store_ends(self, observations: np.ndarray) -> np.ndarray:
        """Keep (n, obs_dim) in free places, and return their numbers."""
        missing = len(observations) - len(self._free_ends)
        if missing > 0:
            used = len(self.ends)
            added = max(missing, used // 4, INITIAL_ROWS_PER_TASK)
            self.ends = th.cat([self.ends, self.ends.new_zeros(added, self.obs_dim)])
            new = np.arange(used, used + added, dtype=np.int32)
            self._free_ends = np.concatenate([self._free_ends, new])
        numbers, self._free_ends = np.split(self._free_ends, [len(observations)])
        kept = th.as_tensor(observations, dtype=th.float32, device=self.device)
        self.ends[th.from_numpy(numbers).to(self.device)] = kept
        return numbers


@dataclass
class ContextStore:
    """What the last epoch collected: the encoder's contexts and the preference labels."""

    #: (tasks, steps, context_dim) standardised (s, a, s', r[, Q])
    transitions: th.Tensor
    #: (tasks, steps) in the environment's units
    rewards: th.Tensor
    #: (tasks, tasks), J[i, j] of task j's policy on task i; NaN where it was not measured
    returns: th.Tensor
    #: (tasks, steps, feat_dim) reward features, where contexts are relabelled
    features: th.Tensor | None = None
