"""The collection of an epoch: every training task is rolled out under its own latest latent."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from colorednoise import powerlaw_psd_gaussian
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.common.buffers import ContextStore, Segment, TaskReplayBuffer
from sb3_poem.common.collection import collect_segment
from sb3_poem.pearl_sac.policies import OBSERVATION_CLIP
from sb3_poem.pearl_sac.tasks import TaskSAC

MIN_STD = 1e-3


class CollectingSAC(TaskSAC):
    """Fills the tasks' replay buffers and replaces their contexts, epoch by epoch; a base of :class:`PEARLSAC`."""

    replay_buffer: TaskReplayBuffer
    context: ContextStore | None
    #: Mean and deviation by which the rewards in ``context`` are standardised; kept with the model, other than the context
    context_reward_statistics: tuple[float, float] | None
    context_has_value: bool = False
    context_relabel_fraction: float
    noise_color: float = 0.0  # models of before it have white noise
    epoch: int
    trajectories_per_task: int
    #: Observations that are in the policy's mean and deviation; None where that is not known, and these stay as they are
    obs_count: int | None
    _logs_pending: bool

    def collect_rollouts(  # type: ignore[override]
        self, env: VecEnv, callback: BaseCallback, *args: Any, log_interval: int | None = None, **kwargs: Any
    ) -> RolloutReturn:
        """Collect one epoch: ``trajectories_per_task`` horizons of every training task under its own latest latent."""
        assert self.train_tasks is not None
        assert self.latent_means is not None
        assert self.latent_variances is not None
        self.policy.set_training_mode(False)
        callback.on_rollout_start()  # between two epochs: evaluations and checkpoints belong here
        self._dump_pending_logs(log_interval)
        started, steps_before = time.perf_counter(), self.num_timesteps
        n_tasks, n_envs = len(self.train_tasks), env.num_envs
        wanted = np.repeat(np.arange(n_tasks), self.trajectories_per_task)
        # the last wave is filled up: its copies are stepped anyway, so let them add to the replay buffers
        slots = np.resize(wanted, -(-len(wanted) // n_envs) * n_envs)
        segments: list[Segment] = []
        for wave in slots.reshape(-1, n_envs):
            draws = self.generators.numpy.standard_normal((n_envs, self.latent_dim))
            latents = self.latent_means[wave] + np.sqrt(self.latent_variances[wave]) * draws
            segment = self._collect(callback, wave, self.train_tasks[wave], latents)
            if segment is None:
                return RolloutReturn(self.num_timesteps - steps_before, 0, continue_training=False)
            self.replay_buffer.extend(segment)
            segments.append(segment)
        epoch = _concatenate(segments, len(wanted))
        returns = self._measure_returns(epoch, callback)
        if returns is None:
            return RolloutReturn(self.num_timesteps - steps_before, 0, continue_training=False)
        self._update_statistics(segments)  # after the returns, which the policies that collected the epoch must earn
        self._replace_context(epoch, returns)
        self.epoch += 1
        collected = self.num_timesteps - steps_before
        self.logger.record("time/collection_fps", collected / (time.perf_counter() - started))
        own_returns = np.nanmean(np.diagonal(returns))
        self.logger.record("rollout/train_task_return", own_returns)
        self._logs_pending = True
        callback.on_rollout_end()
        return RolloutReturn(collected, 0, continue_training=True)

    def _collect(self, callback: BaseCallback, task_ids: np.ndarray, tasks: np.ndarray, latents: np.ndarray) -> Segment | None:
        family, noise_shape = self.family, (len(latents), int(self.action_space.shape[0]))  # type: ignore[index]
        policy_action = self.policy.acting_on(latents)
        noises = self._action_noises(noise_shape)

        def act(obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            if self.num_timesteps < self.learning_starts:
                scaled = self.generators.numpy.uniform(-1.0, 1.0, noise_shape).astype(np.float32)
            else:
                scaled = policy_action(obs, next(noises))
            actions = np.clip(self.policy.unscale_action(scaled), self.action_space.low, self.action_space.high)  # type: ignore[attr-defined]
            return actions, scaled

        def on_step(step_locals: dict[str, Any]) -> bool:
            self.num_timesteps += family.num_envs
            callback.update_locals(step_locals)
            if not callback.on_step():
                return False
            if step_locals["dones"].any():  # what it looks for comes with an episode's end
                self._update_info_buffer(step_locals["infos"], step_locals["dones"])
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._episode_num += int(step_locals["dones"].sum())
            return True

        episodes = np.full(family.num_envs, self._episode_num)
        return collect_segment(family, act, task_ids, tasks, latents, self.generators.integer_seed(), episodes, on_step)

    def _action_noises(self, shape: tuple[int, int]) -> Iterator[th.Tensor]:
        """The policy's standard normal noise of each step of a horizon, (copies, action_dim)."""
        if self.noise_color == 0:
            while True:
                yield th.randn(shape, generator=self.generators.torch, device=self.device)
        steps = max(2, self.family.horizon)
        noise = powerlaw_psd_gaussian(self.noise_color, (*shape, steps), random_state=self.generators.numpy)
        yield from th.as_tensor(noise, dtype=th.float32, device=self.device).movedim(-1, 0)

    def _update_statistics(self, segments: list[Segment]) -> None:
        """Standardise observations by the mean and deviation of all so far, as SB3's VecNormalize does: a robot that has
        learned to run is far from what the first epoch's random actions showed. Rewards keep the first epoch's, in whose
        units the critics learn.
        """
        if self.obs_count is None:
            return
        policy = self.policy
        running = RunningMeanStd(shape=policy.obs_mean.shape)
        running.mean, running.count = policy.obs_mean.double().cpu().numpy(), self.obs_count
        running.var = policy.obs_std.double().cpu().numpy() ** 2
        running.update(np.concatenate([segment.observations.reshape(-1, *running.mean.shape) for segment in segments]))
        with th.no_grad():
            policy.obs_mean.copy_(th.as_tensor(running.mean))
            policy.obs_std.copy_(th.as_tensor(np.maximum(np.sqrt(running.var), MIN_STD)))
            if self.obs_count == 0:
                rewards = np.concatenate([segment.rewards.ravel() for segment in segments])
                policy.reward_mean.fill_(float(rewards.mean()))
                policy.reward_std.fill_(max(float(rewards.std()), MIN_STD))
        self.obs_count = int(running.count)

    def _measure_returns(self, epoch: Segment, callback: BaseCallback) -> np.ndarray | None:
        """J[i, j]: the return of task j's policy on task i, (n_train_tasks, n_train_tasks); NaN where unknown."""
        assert self.train_tasks is not None
        n_tasks = len(self.train_tasks)
        own = (epoch.rewards * epoch.first_episode).sum(axis=1).reshape(n_tasks, -1).mean(axis=1)
        returns = np.full((n_tasks, n_tasks), np.nan)
        np.fill_diagonal(returns, own)
        return returns

    def _replace_context(self, epoch: Segment, returns: np.ndarray) -> None:
        n_tasks, per_task = len(returns), self.trajectories_per_task
        with th.no_grad():
            obs, next_obs = (
                self.policy.standardise(th.as_tensor(values, device=self.device))
                for values in (epoch.observations, epoch.next_observations)
            )
            beyond = (obs.abs() == OBSERVATION_CLIP).any(dim=-1).float().mean()
            self.logger.record("train/clipped_observations", beyond.item())
            actions = th.as_tensor(epoch.actions, device=self.device)
            rewards = th.as_tensor(epoch.rewards, dtype=th.float32, device=self.device)
            self.context_reward_statistics = (float(rewards.mean()), max(float(rewards.std()), MIN_STD))
            parts = [obs, actions, next_obs, _standardised(rewards)[..., None]]
            if self.context_has_value:
                parts.append(_standardised(self._context_values(obs, actions, epoch.latents))[..., None])
            transitions = th.cat(parts, dim=-1)
        steps = per_task * transitions.shape[1]
        features = None
        if self.context_relabel_fraction > 0:
            features = th.as_tensor(epoch.features, device=self.device).reshape(n_tasks, steps, -1)
        self.context = ContextStore(
            transitions.reshape(n_tasks, steps, -1),
            rewards.reshape(n_tasks, steps),
            th.as_tensor(returns, dtype=th.float32, device=self.device),
            features,
        )

    def _context_values(self, obs: th.Tensor, actions: th.Tensor, latents: np.ndarray) -> th.Tensor:
        """Q(s, a) of the current critics along the context (eq. 8); 0 before the first update (Algorithm 1, line 2)."""
        if self._n_updates == 0:
            return th.zeros(obs.shape[:2], device=self.device)
        z = th.as_tensor(latents, dtype=th.float32, device=self.device)
        rows = [
            self.policy.critic(o, a, zi.expand(o.shape[0], -1)).min(dim=0).values  # type: ignore[operator]
            for o, a, zi in zip(obs, actions, z, strict=True)
        ]
        return th.stack(rows)

    def _dump_pending_logs(self, log_interval: int | None) -> None:
        if self._logs_pending and log_interval and self.epoch % log_interval == 0:
            self.dump_logs()
            self._logs_pending = False


def _standardised(values: th.Tensor) -> th.Tensor:
    return (values - values.mean()) / values.std().clamp(min=MIN_STD)


def _concatenate(segments: list[Segment], n: int) -> Segment:
    """The first ``n`` copies of all waves as one segment."""
    return Segment(
        **{name: np.concatenate([getattr(segment, name) for segment in segments])[:n] for name in Segment.__dataclass_fields__}
    )
