"""The collection of an epoch: every training task is rolled out under its own latest latent."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th

from sb3_poem.common.buffers import Segment, TaskReplayBuffer
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.random import Generators
from sb3_poem.pearl_sac.policies import LatentPolicy
from sb3_poem.pearl_sac.train_tasks import TrainTasks


class CollectionStoppedError(Exception):
    """A callback ended training."""


@dataclass
class EpochCollector:
    """Rolls training tasks out and fills their replay buffers. ``explores`` tells whether actions
    are uniformly random at present, ``episode_count`` the episodes begun so far, for messages;
    ``on_step`` is given the local variables of a step, and ends the collection by False; other
    fields are PEARLSAC's.
    """

    family: FamilyView
    policy: LatentPolicy
    train_tasks: TrainTasks
    replay_buffer: TaskReplayBuffer
    generators: Generators
    trajectories_per_task: int
    explores: Callable[[], bool]
    episode_count: Callable[[], int]
    on_step: Callable[[dict[str, Any]], bool]

    def collect(self) -> list[Segment]:
        """An epoch: a segment for each wave of copies."""
        wanted = np.repeat(np.arange(len(self.train_tasks)), self.trajectories_per_task)
        return [
            self.roll_out(wave, self.train_tasks.draw_latents(wave, self.generators.numpy))
            for wave in in_waves(wanted, self.family.num_envs)
        ]

    def roll_out(self, task_ids: np.ndarray, latents: np.ndarray) -> Segment:
        """A horizon of each copy on its task, (copies,), under its latent, (copies, latent_dim),
        which goes to the buffer too. An episode that ends early is followed by another of the same
        task.

        :raises ValueError: For NaN and infinity, and as :meth:`FamilyView.check_experience`
        :raises CollectionStoppedError: If ``on_step`` ended it
        """
        family, tasks = self.family, self.train_tasks.tasks[task_ids]
        n, seed, steps = family.num_envs, self.generators.integer_seed(), []
        episodes, in_first_episode = np.full(n, self.episode_count()), np.ones(n, dtype=bool)

        def check(name: str, values: np.ndarray, step: int) -> None:
            # then all are; the sum of large finite values may overflow, which is sorted out here
            if np.isfinite(values.sum()):
                return
            finite = np.isfinite(values).reshape(n, -1).all(axis=1)
            if not finite.all():
                copy = int(np.argmin(finite))
                raise ValueError(
                    f"the environment returned {name} that are NaN or infinite: copy {copy}, "
                    f"training task {int(task_ids[copy])}, episode {int(episodes[copy])}, step "
                    f"{step}: {values[copy]}. Training stops here, before the networks see them."
                )

        act, obs = self.policy.acting_on(latents), family.reset(tasks, seed)
        space = self.policy.action_space
        check("observations", obs, 0)
        for step in range(family.horizon):
            scaled_actions = self._act(act, obs)
            actions = np.clip(self.policy.unscale_action(scaled_actions), space.low, space.high)
            check("actions (of the policy)", actions, step)
            new_obs, rewards, dones, infos = family.env.step(actions)
            assert isinstance(new_obs, np.ndarray)
            if not self.on_step(locals()):
                raise CollectionStoppedError
            next_obs, terminated = new_obs, np.zeros(n, dtype=np.float32)
            if dones.any():
                next_obs = new_obs.copy()
                for copy in np.flatnonzero(dones):
                    next_obs[copy] = infos[copy]["terminal_observation"]
                    terminated[copy] = not infos[copy].get("TimeLimit.truncated", False)
            features = family.features_of(infos)
            check("observations", next_obs, step)
            check("rewards", rewards, step)
            check("reward features", features, step)
            seen, then = obs.astype(np.float32), next_obs.astype(np.float32)
            # rewards as most VecEnvs give them; SubprocVecEnv does not round
            paid = rewards.astype(np.float32).astype(np.float64)
            steps.append((seen, scaled_actions, then, paid, terminated, features, in_first_episode))
            in_first_episode = in_first_episode & ~dones
            episodes += dones
            obs = new_obs
        stacked = (np.stack(rows, axis=1) for rows in zip(*steps, strict=True))
        segment = Segment(task_ids, latents, *stacked)
        family.check_experience(tasks, seed, segment)
        self.replay_buffer.extend(segment)
        return segment

    def _act(
        self, act: Callable[[np.ndarray, th.Tensor | None], np.ndarray], obs: np.ndarray
    ) -> np.ndarray:
        """Actions in [-1, 1], (copies, action_dim), at random or by the policy with its noise."""
        shape = (len(obs), *self.policy.action_space.shape)
        if self.explores():
            return self.generators.numpy.uniform(-1.0, 1.0, shape).astype(np.float32)
        noise = th.randn(shape, generator=self.generators.torch, device=self.policy.device)
        return act(obs, noise)


def in_whole_waves(n: int, n_envs: int) -> int:
    """How many rollouts are made where ``n`` are wanted: every copy makes one in each wave."""
    return -(-n // n_envs) * n_envs


def in_waves(rows: np.ndarray, n_envs: int) -> np.ndarray:
    """Rows in order, (waves, n_envs, ...): the last wave is filled up from the start."""
    count = in_whole_waves(len(rows), n_envs)
    return rows[np.arange(count) % len(rows)].reshape(-1, n_envs, *rows.shape[1:])


def concatenate(segments: list[Segment], n: int) -> Segment:
    """The first ``n`` copies of all waves as one segment."""
    parts = zip(*(vars(segment).values() for segment in segments), strict=True)
    return Segment(*(np.concatenate(values)[:n] for values in parts))


def relabelled_returns(
    compute_rewards: Callable[[np.ndarray, np.ndarray], np.ndarray],
    tasks: np.ndarray,
    features: np.ndarray,
    mask: np.ndarray,
) -> np.ndarray:
    """Returns (tasks, trajectories) of features (trajectories, steps, feat_dim), over the steps of
    a mask (trajectories, steps).
    """
    # one row at a time bounds the memory at trajectories x steps
    return np.array([(compute_rewards(task, features) * mask).sum(axis=1) for task in tasks])
