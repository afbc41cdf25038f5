"""Soft actor-critic with a probabilistic task context: what POEM and its baselines share."""

import time
from collections.abc import Iterable
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn, Schedule
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.common.buffers import ContextStore, Segment, TaskBatch, TaskReplayBuffer
from sb3_poem.common.collection import collect_segment
from sb3_poem.common.family import FamilyEnv
from sb3_poem.common.precision import autocast_dtype
from sb3_poem.common.random import Generators
from sb3_poem.pearl_sac.persistence import DEFAULT_TRAIN_TASKS, PersistentSAC
from sb3_poem.pearl_sac.policies import LatentPolicy, MlpPolicy

SelfPEARLSAC = TypeVar("SelfPEARLSAC", bound="PEARLSAC")

MIN_STD = 1e-3
AGGREGATE_NEIGHBOURS = 5


class MetaBatch(NamedTuple):
    """What one gradient step sees of a meta-batch of tasks.

    task_ids (tasks,), transitions: a :class:`TaskBatch` (tasks, batch, ...), context (tasks, context_size, context_dim),
    context_rewards (tasks, context_size), returns (tasks, tasks): J[i, j], NaN where unknown.
    """

    task_ids: th.Tensor
    transitions: TaskBatch
    context: th.Tensor
    context_rewards: th.Tensor
    returns: th.Tensor


class PEARLSAC(PersistentSAC):
    """Context-based meta-RL on soft actor-critic (PEARL, https://arxiv.org/abs/1903.08254).

    Training alternates between an epoch's collection, in which every training task is rolled out under its own latest
    latent, and gradient steps on meta-batches of tasks. It keeps a replay buffer for every task and the contexts of the last
    epoch, and learns a context encoder, a latent-conditioned actor and critics, and a reward decoder together.

    :param policy: The policy model to use (MlpPolicy)
    :param env: A task family: an environment, a vectorised environment, or a registered id (which is then vectorised)
    :param learning_rate: Learning rate of all networks, a float or a schedule of the remaining progress
    :param buffer_size: Transitions kept for each training task
    :param learning_starts: Environment steps with uniformly random actions before learning
    :param batch_size: Transitions of each task in a gradient step
    :param tau: Soft update coefficient of the target critics
    :param gamma: Discount factor
    :param gradient_steps: Gradient steps after each epoch's collection; -1: as many as environment steps
    :param ent_coef: Entropy coefficient; "auto" learns it, "auto_0.1" from 0.1 on
    :param target_update_interval: Gradient steps between updates of the target critics
    :param target_entropy: Target entropy when learning ``ent_coef``
    :param n_train_tasks: Training tasks, drawn once from the family with the model's seed; None: 120, or all of a
        smaller finite family
    :param meta_batch_size: Tasks in a gradient step (all, if there are fewer)
    :param context_size: Transitions in a context
    :param trajectories_per_task: Horizons that every task collects in an epoch
    :param latent_dim: Dimension d of the latent
    :param kl_coef: Weight of KL(q(z | c) || N(0, I))
    :param reward_coef: Weight of the decoder's loss (eq. 4)
    :param policy_coef: Weight of the actor's loss
    :param relabel_fraction: Share of each task's batch that comes from other tasks' buffers, with rewards relabelled. Needs
        a family with shared dynamics
    :param reward_scale: Factor on the rewards that the critics learn; "auto" divides by the deviation of the first epoch's
    :param horizon: Steps of an episode; None takes the environment's time limit
    :param precision: "auto" (bfloat16 where the processor has it), "bf16", or "fp32"
    :param stats_window_size: Episodes that the rollout logging averages over
    :param tensorboard_log: Log location for TensorBoard
    :param policy_kwargs: Additional arguments of the policy
    :param verbose: 0 no output, 1 info, 2 debug
    :param seed: Seed of everything: tasks, networks, sampling, environments
    :param device: "auto", "cpu", "cuda"
    :param _init_setup_model: Whether to build the networks at creation
    :raises ValueError: for an environment that is no task family, and for arguments outside their range
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}
    policy: LatentPolicy
    replay_buffer: TaskReplayBuffer
    context_has_value: bool = False
    #: Constructor argument -> attribute, for what :meth:`save_pretrained` keeps
    saved_arguments: ClassVar[dict[str, str]] = {
        name: name
        for name in [
            "batch_size",
            "buffer_size",
            "tau",
            "gamma",
            "gradient_steps",
            "target_update_interval",
            "n_train_tasks",
            "meta_batch_size",
            "context_size",
            "trajectories_per_task",
            "latent_dim",
            "kl_coef",
            "reward_coef",
            "policy_coef",
            "relabel_fraction",
            "reward_scale",
            "horizon",
            "precision",
            "seed",
        ]
    }

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.99,
        gradient_steps: int = 1000,
        ent_coef: str | float = "auto",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        n_train_tasks: int | None = None,
        meta_batch_size: int = 16,
        context_size: int = 128,
        trajectories_per_task: int = 1,
        latent_dim: int = 5,
        kl_coef: float = 0.1,
        reward_coef: float = 1.0,
        policy_coef: float = 1.0,
        relabel_fraction: float = 0.0,
        reward_scale: float | str = "auto",
        horizon: int | None = None,
        precision: str = "auto",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        for name, value, low in (
            ("batch_size", batch_size, 1),
            ("meta_batch_size", meta_batch_size, 1),
            ("context_size", context_size, 1),
            ("trajectories_per_task", trajectories_per_task, 1),
            ("latent_dim", latent_dim, 1),
            ("buffer_size", buffer_size, 1),
            ("n_train_tasks", 1 if n_train_tasks is None else n_train_tasks, 1),
            ("gradient_steps", gradient_steps, -1),
            ("learning_starts", learning_starts, 0),
            ("target_update_interval", target_update_interval, 1),
            ("kl_coef", kl_coef, 0),
            ("reward_coef", reward_coef, 0),
            ("policy_coef", policy_coef, 0),
        ):
            if not value >= low:
                raise ValueError(f"{name} must be at least {low}, got {value}")
        if reward_scale != "auto" and not (isinstance(reward_scale, (int, float)) and reward_scale > 0):
            raise ValueError(f'reward_scale must be a positive number or "auto", got {reward_scale!r}')
        for name, value in (("gamma", gamma), ("tau", tau), ("relabel_fraction", relabel_fraction)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must lie in [0, 1], got {value}")
        autocast_dtype(precision, "cpu")  # refuses an unknown name now rather than at the first step
        self.n_train_tasks = n_train_tasks
        self.meta_batch_size = meta_batch_size
        self.context_size = context_size
        self.trajectories_per_task = trajectories_per_task
        self.latent_dim = latent_dim
        self.kl_coef = kl_coef
        self.reward_coef = reward_coef
        self.policy_coef = policy_coef
        self.relabel_fraction = relabel_fraction
        self.reward_scale = reward_scale
        self.horizon = horizon
        self.precision = precision
        self.train_tasks: np.ndarray | None = None
        self.latent_means: np.ndarray | None = None
        self.latent_variances: np.ndarray | None = None
        self.predicted_rewards_error = float("nan")
        self.context: ContextStore | None = None
        self.epoch = 0
        self._statistics_known = False
        self._family: FamilyEnv | None = None
        self._logs_pending = False
        super().__init__(
            policy,
            self._vectorise(env, n_train_tasks),
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            gradient_steps=gradient_steps,
            replay_buffer_class=TaskReplayBuffer,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=dict(policy_kwargs or {}),  # ours to complete, not the caller's
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    # ------------------------------------------------------------------ setting up

    def _setup_model(self) -> None:
        self.policy_kwargs.pop("use_sde", None)
        if self.env is not None:
            self._family = self._family_of(self.env)
            self.horizon = self._family.horizon
        self.generators = getattr(self, "generators", None) or Generators(self.seed, self.device)
        self.generators.to(self.device)
        if self.train_tasks is None:
            self._draw_tasks()
        assert self.train_tasks is not None
        self.policy_kwargs.update(latent_dim=self.latent_dim, context_has_value=self.context_has_value)
        self._complete_policy_kwargs()
        self.replay_buffer_kwargs = {"n_tasks": len(self.train_tasks), "feature_dim": self.reward_feature_dim}
        super()._setup_model()
        self._amp_dtype = autocast_dtype(self.precision, self.device.type)

    def _complete_policy_kwargs(self) -> None:
        """Give the policy what only a subclass knows."""

    def _draw_tasks(self) -> None:
        assert self._family is not None, "a new model needs an environment"
        family = self._family
        count = self.n_train_tasks
        if count is None:
            count = DEFAULT_TRAIN_TASKS if family.all_tasks is None else min(DEFAULT_TRAIN_TASKS, len(family.all_tasks))
        if family.all_tasks is not None and count > len(family.all_tasks):
            raise ValueError(
                f"n_train_tasks is {count}, but {family.env_id} is a finite family of {len(family.all_tasks)} tasks; "
                f"use at most {len(family.all_tasks)}, or None for all"
            )
        if self.relabel_fraction > 0 and not family.shared_dynamics:
            raise ValueError(f"relabel_fraction must be 0: the tasks of {family.env_id} do not share dynamics")
        self.env_id = family.env_id
        self.task_space = family.task_space
        self.reward_feature_dim = family.reward_feature_dim
        self.train_tasks = family.sample_tasks(count, self.generators.child())
        self.latent_means = np.zeros((count, self.latent_dim))
        self.latent_variances = np.ones((count, self.latent_dim))

    def _family_of(self, env: VecEnv) -> FamilyEnv:
        """View of an environment, which must be of the model's own family once the model has one."""
        family = FamilyEnv(env, self.horizon)
        if self.train_tasks is not None:
            family.check_same_family(self.task_space, self.reward_feature_dim)
        return family

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Change the environment, to one of the same family with any number of copies.

        :raises ValueError: if the environment is of another family; the model then keeps its own
        """
        vec_env = self._wrap_env(env, self.verbose)
        check_for_correct_spaces(vec_env, self.observation_space, self.action_space)
        family = self._family_of(vec_env)
        self.n_envs = vec_env.num_envs  # experience is kept per task, not per copy
        super().set_env(vec_env, force_reset)
        self._family = family

    @property
    def family(self) -> FamilyEnv:
        """The environment as a task family.

        :raises ValueError: if the model was loaded without an environment
        """
        if self._family is None:
            if self.env is None:
                raise ValueError("the model has no environment; give it one with set_env, or load it with env=...")
            self._family = self._family_of(self.env)
        return self._family

    @property
    def task_latents(self) -> np.ndarray:
        """Posterior means of the training tasks' latents, (n_train_tasks, latent_dim)."""
        assert self.latent_means is not None
        return self.latent_means

    @property
    def aggregate_to_prior_kl(self) -> float:
        """How far the training tasks' aggregate posterior is from N(0, I): KL of its moment-matched Gaussian, nats."""
        assert self.latent_variances is not None
        mean, second = self.task_latents.mean(axis=0), self.latent_variances.mean(axis=0) + self.task_latents.var(axis=0)
        return 0.5 * float((mean**2 + second - 1.0 - np.log(second)).sum())

    def sample_latents(self, n: int, rng: np.random.Generator, source: str = "prior") -> np.ndarray:
        """Draw latents (n, latent_dim).

        :param n: How many
        :param rng: Generator to use
        :param source: "prior": N(0, I). "aggregate": the training tasks' posteriors, and what lies between a task and its
            nearest neighbours, so that tasks between the training tasks are covered but untrained regions are not
        """
        if source == "prior":
            return rng.standard_normal((n, self.latent_dim))
        if source != "aggregate":
            raise ValueError(f'source must be "prior" or "aggregate", got {source!r}')
        means, variances = self.task_latents, self.latent_variances
        assert variances is not None
        chosen = rng.integers(len(means), size=n)
        draws = means[chosen]
        n_neighbours = min(AGGREGATE_NEIGHBOURS, len(means) // 4)  # a family of few tasks has nothing in between
        if n_neighbours:
            distances = ((means[:, None, :] - means[None, :, :]) ** 2).sum(axis=2)
            neighbours = distances.argsort(axis=1)[chosen, rng.integers(1, n_neighbours + 1, size=n)]
            draws = draws + rng.uniform(size=(n, 1)) * (means[neighbours] - draws)
        return draws + np.sqrt(variances[chosen]) * rng.standard_normal(draws.shape)

    def predicted_returns(self, latents: np.ndarray, trajectories: Iterable[Any]) -> np.ndarray:
        """Returns that the reward decoder predicts for trajectories, if each latent were the task's.

        :param latents: (m, latent_dim)
        :param trajectories: With ``observations`` (T + 1, obs_dim) and ``actions`` (T, action_dim) in the environment's units
        :return: (m, number of trajectories)
        """
        columns = []
        with th.no_grad():
            latent_tensor = th.as_tensor(np.atleast_2d(latents), dtype=th.float32, device=self.device)
            embeddings = self.policy.reward_embedding(latent_tensor)
            for trajectory in trajectories:
                obs = self.policy.standardise(th.as_tensor(trajectory.observations, dtype=th.float32, device=self.device))
                actions = th.as_tensor(trajectory.actions, dtype=th.float32, device=self.device)
                actions = self.policy.scale_action_batch(actions)
                standardised = self.policy.decoder.for_embeddings(obs[:-1], actions, obs[1:], embeddings)
                rewards = standardised * self.policy.reward_std + self.policy.reward_mean
                columns.append(rewards.double().sum(dim=1))
        return th.stack(columns, dim=1).cpu().numpy()

    # ------------------------------------------------------------------ collection

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
        if not self._statistics_known:  # after the returns, which the policies that collected the epoch must earn
            self._set_statistics(segments)
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

        def act(obs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            if self.num_timesteps < self.learning_starts:
                scaled = self.generators.numpy.uniform(-1.0, 1.0, noise_shape).astype(np.float32)
            else:
                noise = th.randn(noise_shape, generator=self.generators.torch, device=self.device)
                scaled = self.policy.act(obs, latents, noise)
            actions = np.clip(self.policy.unscale_action(scaled), self.action_space.low, self.action_space.high)  # type: ignore[attr-defined]
            return actions, scaled

        def on_step(step_locals: dict[str, Any]) -> bool:
            self.num_timesteps += family.num_envs
            callback.update_locals(step_locals)
            if not callback.on_step():
                return False
            self._update_info_buffer(step_locals["infos"], step_locals["dones"])
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._episode_num += int(step_locals["dones"].sum())
            return True

        episodes = np.full(family.num_envs, self._episode_num)
        return collect_segment(family, act, task_ids, tasks, latents, self.generators.integer_seed(), episodes, on_step)

    def _set_statistics(self, segments: list[Segment]) -> None:
        """Standardise by the first epoch's mean and deviation."""
        obs = np.concatenate([segment.observations.reshape(-1, segment.observations.shape[-1]) for segment in segments])
        rewards = np.concatenate([segment.rewards.ravel() for segment in segments])
        policy = self.policy
        with th.no_grad():
            policy.obs_mean.copy_(th.as_tensor(obs.mean(axis=0)))
            policy.obs_std.copy_(th.as_tensor(np.maximum(obs.std(axis=0), MIN_STD)))
            policy.reward_mean.fill_(float(rewards.mean()))
            policy.reward_std.fill_(max(float(rewards.std()), MIN_STD))
        self._statistics_known = True

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
            actions = th.as_tensor(epoch.actions, device=self.device)
            rewards = th.as_tensor(epoch.rewards, dtype=th.float32, device=self.device)
            parts = [obs, actions, next_obs, _standardised(rewards)[..., None]]
            if self.context_has_value:
                parts.append(_standardised(self._context_values(obs, actions, epoch.latents))[..., None])
            transitions = th.cat(parts, dim=-1)
        steps = per_task * transitions.shape[1]
        self.context = ContextStore(
            transitions.reshape(n_tasks, steps, -1),
            rewards.reshape(n_tasks, steps),
            th.as_tensor(returns, dtype=th.float32, device=self.device),
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

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """Gradient steps on meta-batches, then a refresh of every training task's posterior."""
        self.policy.set_training_mode(True)
        optimizers = [self.policy.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        started = time.perf_counter()
        history: dict[str, list[th.Tensor]] = {}
        for _ in range(gradient_steps):
            batch = self._sample_meta_batch(batch_size)
            with th.autocast(self.device.type, dtype=self._amp_dtype, enabled=self._amp_dtype is not None):
                loss, metrics = self._losses(batch)
            self._optimise(loss)
            self._update_entropy_coefficient(metrics["entropy"])
            if self._n_updates % self.target_update_interval == 0:
                self._update_targets()
            self._n_updates += 1
            for name, value in metrics.items():
                history.setdefault(name, []).append(value.detach())
        self._refresh_posteriors()
        self.logger.record("time/updates_per_second", gradient_steps / max(time.perf_counter() - started, 1e-9))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in history.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())
        self._record_latent_statistics()
        self._measure_decoder()

    def _optimise(self, loss: th.Tensor) -> None:
        if not th.isfinite(loss):
            raise ValueError(
                f"the training loss is {loss.item()} at update {self._n_updates}; no network was changed by it. "
                "A lower learning_rate or reward_scale usually helps."
            )
        self.policy.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.policy.optimizer.step()

    def _update_targets(self) -> None:
        targets: list[th.Tensor] = list(self.policy.critic_target.parameters())
        sources: list[th.Tensor] = list(self.policy.critic.parameters())
        with th.no_grad():
            th._foreach_lerp_(targets, sources, self.tau)

    def _choose_tasks(self) -> np.ndarray:
        """Indices of a meta-batch, without repetition: a repeated task would give preference pairs without a difference."""
        assert self.train_tasks is not None
        n_tasks = len(self.train_tasks)
        return self.generators.numpy.choice(n_tasks, size=min(self.meta_batch_size, n_tasks), replace=False)

    def _sample_meta_batch(self, batch_size: int) -> MetaBatch:
        assert self.context is not None
        chosen = self._choose_tasks()
        generator, device = self.generators.torch, self.device
        task_ids = th.as_tensor(chosen, device=device)
        sources = task_ids[:, None].expand(-1, batch_size)
        n_foreign = round(self.relabel_fraction * batch_size)
        if n_foreign:
            foreign = th.randint(self.replay_buffer.n_tasks, (len(chosen), n_foreign), generator=generator, device=device)
            sources = th.cat([sources[:, n_foreign:], foreign], dim=1)
        transitions = self.replay_buffer.sample_rows(sources, generator)
        if n_foreign:
            transitions = self._relabel(transitions, chosen, n_foreign)
        context = self.context
        steps = context.transitions.shape[1]
        picks = th.randint(steps, (len(chosen), self.context_size), generator=generator, device=device)
        rows = (task_ids[:, None] * steps + picks).view(-1)
        shape = (len(chosen), self.context_size)
        return MetaBatch(
            task_ids,
            transitions,
            context.transitions.view(-1, context.transitions.shape[-1]).index_select(0, rows).view(*shape, -1),
            context.rewards.view(-1).index_select(0, rows).view(shape),
            context.returns[task_ids][:, task_ids],
        )

    def _relabel(self, transitions: TaskBatch, chosen: np.ndarray, n_foreign: int) -> TaskBatch:
        """Replace the rewards of the last ``n_foreign`` transitions of every task by the task's own."""
        assert self.train_tasks is not None
        features = transitions.features[:, -n_foreign:].cpu().numpy()
        own = self.family.compute_reward(self.train_tasks[chosen][:, None, :], features)
        rewards = transitions.rewards.clone()
        rewards[:, -n_foreign:] = th.as_tensor(own, dtype=th.float32, device=self.device)
        return transitions._replace(rewards=rewards)

    def _encode(self, context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Latents (tasks, d) by reparameterisation, and the KL of their posteriors to N(0, I), (tasks,)."""
        mean, variance = self.policy.encoder(context)
        noise = th.randn(mean.shape, generator=self.generators.torch, device=self.device)
        kl = 0.5 * (mean.pow(2) + variance - 1.0 - variance.log()).sum(dim=-1)
        return mean + variance.sqrt() * noise, kl

    def _losses(self, batch: MetaBatch) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """Sum of all losses of a meta-batch, and what to log of them."""
        latents, kl = self._encode(batch.context)
        critic_loss, alpha = self._critic_loss(batch.transitions, latents)
        actor_loss, log_prob = self._actor_loss(batch.transitions, latents, alpha)
        decoder_loss = self._decoder_loss(batch, latents)
        kl_loss = kl.mean()
        embedding_loss, embedding_metrics = self._embedding_loss(batch, latents)
        loss = (
            critic_loss
            + self.policy_coef * actor_loss
            + self.reward_coef * decoder_loss
            + self.kl_coef * kl_loss
            + embedding_loss
        )
        metrics = {
            "critic_loss": critic_loss,
            "actor_loss": actor_loss,
            "decoder_loss": decoder_loss,
            "kl": kl_loss,
            "entropy": -log_prob.mean(),
            "ent_coef": alpha.squeeze(),
            **embedding_metrics,
        }
        return loss, metrics

    def _embedding_loss(self, batch: MetaBatch, latents: th.Tensor) -> tuple[th.Tensor | float, dict[str, th.Tensor]]:
        """A subclass's own demand on the latents (weighted), and what to log of it."""
        return 0.0, {}

    def _entropy_coefficient(self) -> th.Tensor:
        if self.log_ent_coef is not None:
            return self.log_ent_coef.detach().exp()
        return self.ent_coef_tensor

    def _update_entropy_coefficient(self, entropy: th.Tensor) -> None:
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            assert isinstance(self.target_entropy, float)
            loss = (self.log_ent_coef * (entropy.detach() - self.target_entropy)).sum()
            self.ent_coef_optimizer.zero_grad()
            loss.backward()
            self.ent_coef_optimizer.step()

    def _critic_latents(self, latents: th.Tensor) -> th.Tensor:
        """Latents as the critics' loss sees them: PEARL trains its encoder through them."""
        return latents

    def _actor_embedding(self, latents: th.Tensor) -> th.Tensor:
        """Policy embedding as the actor's loss sees it: PEARL's encoder learns nothing from the actor."""
        return self.policy.policy_embedding(latents.detach())

    def _critic_loss(self, batch: TaskBatch, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        policy, n = self.policy, batch.rewards.shape[1]
        obs, next_obs = policy.standardise(batch.observations), policy.standardise(batch.next_observations)
        alpha = self._entropy_coefficient()
        with th.no_grad():
            z = latents.detach()
            noise = th.randn(batch.actions.shape, generator=self.generators.torch, device=self.device)
            next_actions, next_log_prob = policy.actor(next_obs, _rows(policy.policy_embedding(z), n), noise)  # type: ignore[operator]
            next_values = policy.critic_target(_flat(next_obs), _flat(next_actions), _flat(_rows(z, n))).min(dim=0).values  # type: ignore[operator]
            next_values = next_values - alpha * _flat(next_log_prob[..., None]).squeeze(-1)
            scale = 1.0 / policy.reward_std if self.reward_scale == "auto" else self.reward_scale
            targets = scale * batch.rewards.reshape(-1)
            targets = targets + self.gamma * (1.0 - batch.terminated.reshape(-1)) * next_values
        values = policy.critic(_flat(obs), _flat(batch.actions), _flat(_rows(self._critic_latents(latents), n)))  # type: ignore[operator]
        return 0.5 * (values - targets).pow(2).mean(dim=1).sum(), alpha

    def _actor_loss(self, batch: TaskBatch, latents: th.Tensor, alpha: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        policy, n = self.policy, batch.rewards.shape[1]
        obs = policy.standardise(batch.observations)
        noise = th.randn(batch.actions.shape, generator=self.generators.torch, device=self.device)
        actions, log_prob = policy.actor(obs, _rows(self._actor_embedding(latents), n), noise)  # type: ignore[operator]
        # the latent is a task here, not a decision: the actor must not raise its value by moving it
        z = _flat(_rows(latents.detach(), n))
        values = policy.critic(_flat(obs), _flat(actions), z, frozen=True).min(dim=0).values  # type: ignore[operator]
        log_prob = log_prob.reshape(-1)
        return (alpha * log_prob - values).mean(), log_prob

    def _decoder_loss(self, batch: MetaBatch, latents: th.Tensor) -> th.Tensor:
        """Squared error of the decoder, relative to the variance of the epoch's rewards.

        On context transitions (eq. 4); with relabelling on the batch of transitions instead, which holds other tasks' policies
        too: adaptation asks the decoder about trajectories of any policy.
        """
        policy = self.policy
        if self.relabel_fraction > 0:
            data = batch.transitions
            obs, next_obs = policy.standardise(data.observations), policy.standardise(data.next_observations)
            actions, rewards = data.actions, data.rewards
        else:
            widths = [policy.obs_mean.shape[0], int(self.action_space.shape[0]), policy.obs_mean.shape[0]]  # type: ignore[index]
            obs, actions, next_obs = batch.context[..., : sum(widths)].split(widths, dim=-1)
            rewards = batch.context_rewards
        embedding = _rows(policy.reward_embedding(latents), rewards.shape[1])
        error = policy.decode_rewards(obs, actions, next_obs, embedding) - rewards
        return error.pow(2).mean() / self._reward_variance()

    def _reward_variance(self) -> th.Tensor:
        assert self.context is not None
        return self.context.rewards.var().clamp(min=MIN_STD**2)

    def _refresh_posteriors(self) -> None:
        """Posterior of every training task from its latest context: next epoch's latents, and the aggregate posterior."""
        if self.context is None:
            return
        self.policy.set_training_mode(False)
        with th.no_grad():
            steps = self.context.transitions.shape[1]
            picks = th.randperm(steps, generator=self.generators.torch, device=self.device)[: self.context_size]
            mean, variance = self.policy.encoder(self.context.transitions[:, picks])
        self.latent_means, self.latent_variances = mean.double().cpu().numpy(), variance.double().cpu().numpy()

    def _measure_decoder(self) -> None:
        """Residual deviation of the decoder, per step, on transitions of all training policies, in units of reward."""
        assert self.train_tasks is not None
        n_tasks, per_task = len(self.train_tasks), 64
        generator, device, policy = self.generators.torch, self.device, self.policy
        if self.family.shared_dynamics:
            sources = th.randint(n_tasks, (n_tasks, per_task), generator=generator, device=device)
        else:
            sources = th.arange(n_tasks, device=device)[:, None].expand(-1, per_task)
        data = self.replay_buffer.sample_rows(sources, generator)
        rewards = self.family.compute_reward(self.train_tasks[:, None, :], data.features.cpu().numpy())
        with th.no_grad():
            latents = th.as_tensor(self.task_latents, dtype=th.float32, device=device)
            obs, next_obs = policy.standardise(data.observations), policy.standardise(data.next_observations)
            embedding = _rows(policy.reward_embedding(latents), per_task)
            predicted = policy.decode_rewards(obs, data.actions, next_obs, embedding).cpu().numpy()
        self.predicted_rewards_error = float(np.sqrt(np.mean((predicted - rewards) ** 2)))
        self.logger.record("train/decoder_error", self.predicted_rewards_error)

    def _record_latent_statistics(self) -> None:
        """Log the information in the latents, and how far their aggregate is from the prior."""
        assert self.latent_means is not None
        assert self.latent_variances is not None
        self.logger.record("train/kl_ideal", float(np.log(len(self.latent_means))))
        self.logger.record("train/aggregate_to_prior_kl", self.aggregate_to_prior_kl)

    # ------------------------------------------------------------------ SB3's interface

    def learn(  # type: ignore[override]
        self: SelfPEARLSAC,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str = "PEARLSAC",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfPEARLSAC:
        """Train, in whole epochs, until at least ``total_timesteps`` environment steps are done.

        :param log_interval: Epochs between two dumps of the log; None never dumps
        """
        super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,  # type: ignore[arg-type]
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
        self._dump_pending_logs(log_interval)
        return self

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        """The last epoch may overshoot the total; a schedule must not turn negative there."""
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    def _dump_pending_logs(self, log_interval: int | None) -> None:
        if self._logs_pending and log_interval and self.epoch % log_interval == 0:
            self.dump_logs()
            self._logs_pending = False

    def resume(
        self: SelfPEARLSAC, callback: MaybeCallback = None, log_interval: int | None = 1, progress_bar: bool = False
    ) -> SelfPEARLSAC:
        """Finish the ``learn`` that a checkpoint interrupted, up to its own ``total_timesteps``."""
        remaining = max(0, self._total_timesteps - self.num_timesteps)
        return self.learn(remaining, callback, log_interval=log_interval, reset_num_timesteps=False, progress_bar=progress_bar)


def _rows(latents: th.Tensor, n: int) -> th.Tensor:
    """(tasks, d) -> (tasks, n, d)."""
    return latents[:, None, :].expand(-1, n, -1)


def _flat(x: th.Tensor) -> th.Tensor:
    """(tasks, n, d) -> (tasks * n, d)."""
    return x.reshape(-1, x.shape[-1])


def _standardised(values: th.Tensor) -> th.Tensor:
    return (values - values.mean()) / values.std().clamp(min=MIN_STD)


def _concatenate(segments: list[Segment], n: int) -> Segment:
    """The first ``n`` copies of all waves as one segment."""
    return Segment(
        **{name: np.concatenate([getattr(segment, name) for segment in segments])[:n] for name in Segment.__dataclass_fields__}
    )
