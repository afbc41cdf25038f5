"""Soft actor-critic with a probabilistic task context: what POEM and its baselines share."""

import inspect
import io
import pathlib
import time
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, ClassVar, Self, TypeVar

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from stable_baselines3.common.utils import LinearSchedule, check_for_correct_spaces, get_device
from stable_baselines3.common.vec_env import VecEnv

from poem_envs.registration import plain_id
from sb3_poem.common.buffers import ContextStore, Segment, TaskReplayBuffer
from sb3_poem.common.checks import check_number, check_whole
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.files import write_atomically
from sb3_poem.common.foreign import environment_of
from sb3_poem.common.networks import RunningNorm, digest_of
from sb3_poem.common.precision import check_device, hidden_dtype
from sb3_poem.common.random import Generators
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.hub import upload
from sb3_poem.pearl_sac import saving
from sb3_poem.pearl_sac.arguments import (
    GivenEnv,
    check_arguments,
    refuse_unknown,
    vectorise,
    warn_of_idle_callbacks,
)
from sb3_poem.pearl_sac.collector import (
    CollectionStoppedError,
    EpochCollector,
    concatenate,
    in_whole_waves,
)
from sb3_poem.pearl_sac.objective import Objective, rows
from sb3_poem.pearl_sac.policies import OBSERVATION_CLIP, LatentPolicy, MlpPolicy
from sb3_poem.pearl_sac.sampler import MetaBatchSampler
from sb3_poem.pearl_sac.train_tasks import TrainTasks
from sb3_poem.pearl_sac.updater import EntropyCoefficient, Updater
from sb3_poem.resources import config_file, zoo_entry

Part = TypeVar("Part")

#: Transitions of each task on which the decoder is measured
MEASURED_PER_TASK = 64
MIN_STD = RunningNorm.MIN_STD
#: A task whose rewards are smaller than this share of another's has shown none yet: it gets the
#: scale of the largest
LEAST_REWARDS = 1e-4


class PEARLSAC(SAC):
    """Context-based meta-RL on soft actor-critic (PEARL, https://arxiv.org/abs/1903.08254).

    Training alternates between an epoch's collection, in which every training task is rolled out
    under its own latest latent, and gradient steps on meta-batches of tasks. It keeps a replay
    buffer for every task and the contexts of the last epoch, and learns a context encoder, a
    latent-conditioned actor and critics, and a reward decoder together. Observations are
    standardised by the mean and deviation of all that were collected.

    >>> model = PEARLSAC("MlpPolicy", "poem/PointGoal-v0", n_train_tasks=4, gradient_steps=1)
    >>> model = model.learn(200)  # two epochs of four episodes
    >>> observation = model.get_env().reset()
    >>> action, _ = model.predict(observation, state=model.task_latents[:1])  # for the first task

    :param policy: The policy model to use: "MlpPolicy", or a subclass of its class
    :param env: A task family: an environment, a vectorised one of SB3 or Gymnasium, or a registered
        id (which is then vectorised)
    :param learning_rate: Learning rate of all networks, a float or a schedule of the remaining
        progress
    :param buffer_size: Transitions kept for each training task
    :param learning_starts: Environment steps with uniformly random actions before learning
    :param batch_size: Transitions of each task in a gradient step
    :param tau: Share of the networks that their targets take over in a gradient step
    :param gamma: Discount factor
    :param gradient_steps: Gradient steps after each epoch's collection; -1: as many as environment
        steps
    :param ent_coef: Entropy coefficient; "auto" learns it, "auto_0.1" from 0.1 on
    :param target_update_interval: Gradient steps between two updates of the targets
    :param target_entropy: Which "auto" coefficients aim at; "auto" is minus the action's dimension
    :param n_train_tasks: Training tasks, drawn once from the family with the model's seed; None:
        120, or all of a smaller finite family
    :param meta_batch_size: Tasks in a gradient step (all, if there are fewer)
    :param context_size: Transitions in a context
    :param trajectories_per_task: Horizons that every task collects in an epoch
    :param latent_dim: Dimension d of the latent
    :param kl_coef: Weight of KL(q(z | c) || N(0, I))
    :param reward_coef: Weight of the decoder's loss (eq. 4)
    :param policy_coef: Weight of the actor's loss
    :param relabel_fraction: Share of each task's batch that comes from other tasks' buffers, with
        rewards relabelled. Needs a family with shared dynamics; None: 0.5 of those, else 0
    :param context_relabel_fraction: Share of the contexts in a gradient step that hold other tasks'
        transitions, with rewards relabelled: without any, the encoder may read a task from what its
        policy does. Needs a family with shared dynamics; None: 0.5 of those, else 0
    :param reward_scale: Factor on the rewards that the critics learn; "auto" divides by the
        deviation of the first epoch's, or leaves them as they are where these do not differ;
        "per-task" divides each task's by their root mean square in its replay buffer, so that tasks
        whose rewards are small are learned beside those whose rewards are large
    :param n_steps: Steps of rewards in the critics' targets before the value takes over; more carry
        rewards back faster, and rely more on what other policies did
    :param shaping_coef: From 0 to 1, how far the critics learn what is gained beyond staying where
        one is: their rewards are shaped (Ng, Harada & Russell, ICML 1999) with this share of the
        family's potential over 1 - ``gamma``. Which policies are best stays as it is; on the way to
        a place they are learned sooner. Action values, those in POEM's contexts too, are then
        without that share. Needs a family with a potential
    :param policy_delay: Gradient steps of critics and encoder for each of everything else, that is
        the actor, the decoder, the embeddings and the entropy coefficient (as in TD3)
    :param horizon: Steps of an episode; None takes the environment's time limit
    :param precision: "auto" (bfloat16 where the processor has it), "bf16", or "fp32"
    :param stats_window_size: Episodes that the logged means of rollouts are taken over
    :param tensorboard_log: Folder of TensorBoard's logs; None writes none
    :param policy_kwargs: Arguments of the policy: ``net_arch``, ``activation_fn``, ``layer_norm``,
        ``n_critics``, ``optimizer_class``, ``optimizer_kwargs``
    :param verbose: 0 no output, 1 how long an epoch is and a table after each, 2 debug
    :param seed: Seed of everything: tasks, networks, sampling, environments
    :param device: PyTorch device; "auto" takes a CUDA device where there is one
    :raises ValueError: For an environment that is no task family, and for arguments outside their
        range
    :raises TypeError: For arguments that it does not have; of those of SB3's SAC, the message says
        what to do instead
    """

    #: The name of the algorithm on the command line, and of its file in ``zoo_configs/``
    zoo_name: ClassVar[str] = "pearl_sac"
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}
    objective_class: ClassVar[type[Objective]] = Objective

    policy: LatentPolicy
    replay_buffer: TaskReplayBuffer
    observation_space: spaces.Box
    action_space: spaces.Box
    task_space: spaces.Box
    reward_feature_dim: int

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GivenEnv | None,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 100_000,
        learning_starts: int = 0,
        batch_size: int = 32,
        tau: float = 0.01,
        gamma: float = 0.97,
        gradient_steps: int = 1000,
        ent_coef: str | float = "auto_0.1",
        target_update_interval: int = 1,
        target_entropy: str | float = "auto",
        n_train_tasks: int | None = None,
        meta_batch_size: int = 20,
        context_size: int = 32,
        trajectories_per_task: int = 1,
        latent_dim: int = 5,
        kl_coef: float = 0.1,
        reward_coef: float = 1.0,
        policy_coef: float = 1.0,
        relabel_fraction: float | None = None,
        context_relabel_fraction: float | None = None,
        reward_scale: float | str = "auto",
        n_steps: int = 3,
        shaping_coef: float = 0.0,
        policy_delay: int = 2,
        horizon: int | None = None,
        precision: str = "auto",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        **unsupported: Any,
    ) -> None:
        refuse_unknown(unsupported, type(self))
        arguments = locals()
        self._check_arguments(arguments)
        self.n_train_tasks = n_train_tasks
        self.meta_batch_size = meta_batch_size
        self.context_size = context_size
        self.trajectories_per_task = trajectories_per_task
        self.latent_dim = latent_dim
        self.kl_coef = kl_coef
        self.reward_coef = reward_coef
        self.policy_coef = policy_coef
        self.relabel_fraction = relabel_fraction
        self.context_relabel_fraction = context_relabel_fraction
        self.reward_scale = reward_scale
        self.shaping_coef = shaping_coef
        self.policy_delay = policy_delay
        self.horizon = horizon
        self.precision = precision
        #: Whose zip it is
        self.algorithm = type(self).__name__
        self.env_id: str | None = None
        self.env_kwargs: Mapping[str, Any] = {}
        self.generators = Generators(seed, get_device(device))
        #: Drawn with the networks
        self.train_tasks = TrainTasks.of_prior(np.zeros((0, 0)), latent_dim)
        self.epoch = 0
        #: The last epoch's contexts
        self.epoch_context: ContextStore | None = None
        #: Mean and deviation by which the rewards in them are standardised; kept with the model
        self.context_reward_statistics: tuple[float, float] | None = None
        self.predicted_rewards_error = float("nan")
        self.best_adapted_return = -np.inf  # kept with the model, for AdaptationEvalCallback
        self.n_timesteps: int | None = None  # what learn takes unless told, see from_zoo
        self._family: FamilyView | None = None
        self._logs_pending = False
        self.keeps_experience = False  # in files, of which only checkpoints do
        self.policy_class = self._get_policy_from_name(policy)
        vec_env = None  # as of a model that is read from a file
        if env is not None or _init_setup_model:
            given = vectorise(env, None, n_train_tasks, trajectories_per_task)
            vec_env = self._wrap_env(given, verbose)
            self._family = self._family_of(vec_env)  # before SB3 speaks of other policies
        of_sac = arguments.keys() & inspect.signature(SAC).parameters.keys()
        inherited = {name: arguments[name] for name in of_sac} | {
            "env": vec_env,
            "replay_buffer_class": TaskReplayBuffer,
            "policy_kwargs": dict(policy_kwargs or {}),  # ours to complete, not the caller's
        }
        super().__init__(**inherited)

    def _check_arguments(self, given: Mapping[str, Any]) -> None:
        check_arguments(given, type(self))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.env_id}, {self.num_timesteps:,} steps trained)"

    def _setup_model(self) -> None:
        generators = self.generators.to(self.device)
        if self.env is not None:
            self.horizon = self.family.horizon
        if not len(self.train_tasks):
            family, rng = self.family, generators.child()
            self.env_id, self.env_kwargs = family.env_id, family.env_kwargs
            self.task_space, self.reward_feature_dim = family.task_space, family.reward_feature_dim
            self.train_tasks = TrainTasks.draw(family, self.n_train_tasks, self.latent_dim, rng)
        if self.target_entropy == "auto":  # which SAC looks up in an environment
            self.target_entropy = -float(np.prod(self.action_space.shape))
        self._complete_policy_kwargs()
        tasks, feature_dim = self.train_tasks.tasks, self.reward_feature_dim
        self.replay_buffer_kwargs = {"tasks": tasks, "feature_dim": feature_dim}
        with warnings.catch_warnings():
            # SB3 says that another replay buffer ignores n_steps; our sampler does not
            warnings.filterwarnings("ignore", "`n_steps=")
            super()._setup_model()
        self.generators = generators  # a model that is loaded goes on with its own

    def _complete_policy_kwargs(self) -> None:
        self.policy_kwargs.pop("use_sde", None)
        self.policy_kwargs["latent_dim"] = self.latent_dim

    def _get_policy_from_name(self, policy_name: str | type[BasePolicy]) -> type[BasePolicy]:
        """As SB3's, and of a class whether it is one of ours."""
        ours = self.policy_aliases["MlpPolicy"]
        if isinstance(policy_name, type) and issubclass(policy_name, ours):
            return policy_name
        if policy_name != "MlpPolicy":
            wanted = f'"MlpPolicy" or a subclass of {ours.__name__}'
            hint = (
                "observations are flat vectors. Put features of images into the family's "
                "observation; poem_envs.GoalFamily flattens those of a goal-conditioned environment"
            )
            if isinstance(policy_name, str) and policy_name in gymnasium.registry:
                hint = "the environment is the second argument"
            raise ValueError(f"policy is {policy_name!r}, but must be {wanted}: {hint}")
        return ours

    @classmethod
    def from_zoo(cls, env_id: str, **arguments: Any) -> Self:
        """A new model with the hyperparameters that ship for an environment (``zoo_configs/``), as
        ``sb3-poem train`` makes it. :meth:`learn` then knows for how many steps.

        :param arguments: What shall differ: arguments of the constructor, ``n_envs`` (copies of the
            environment) and ``n_timesteps``. With ``env``, another family is trained by this entry
        :raises ValueError: If its file has no entry for it, nor a default one
        """
        if not isinstance(env_id, str):
            given = f"is {env_id!r}: pass an environment by env=, beside the id of an entry"
            raise TypeError(f'env_id must be an id as "poem/AntGoal-v0", but {given}')
        entry = zoo_entry(config_file(cls.zoo_name), plain_id(env_id), **arguments)
        check_number("n_timesteps", entry["n_timesteps"], above=0)
        timesteps, n_envs = int(entry.pop("n_timesteps")), entry.pop("n_envs", None)
        entry.setdefault("env", env_id)
        rate = entry.get("learning_rate")
        if isinstance(rate, str) and rate.startswith("lin_"):  # rl_zoo3's syntax
            entry["learning_rate"] = LinearSchedule(float(rate.removeprefix("lin_")), 0.0, 1.0)
        if n_envs is not None:
            entry["env"] = vectorise(entry["env"], n_envs)
        model = cls(**entry)
        model.n_timesteps = timesteps
        return model

    def set_random_seed(self, seed: int | None = None) -> None:
        """As SB3's: what follows depends on the seed. The training tasks stay."""
        if seed is not None:
            check_whole("seed", seed, 0, 2**32 - 1)
            seed = int(seed)  # random takes no NumPy's
            self.generators = Generators(seed, self.device)
        super().set_random_seed(seed)

    # ------------------------------------------------------------------ learning: Algorithm 1

    def learn(
        self,
        total_timesteps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Train, in whole epochs, until at least ``total_timesteps`` environment steps are done.

        :param total_timesteps: None takes those of the entry that :meth:`from_zoo` read
        :param log_interval: Epochs between two dumps of the log; None never dumps
        :param tb_log_name: None is the algorithm's name
        :raises ValueError: If no number of steps is known
        """
        steps = self._checked_steps(total_timesteps, callback)
        ends_another = self.num_timesteps + steps == self._total_timesteps
        if steps <= self.epoch_steps and self.lr_schedule(0.0) == 0.0 and not ends_another:
            warnings.warn(
                "`learning_rate` falls to 0 at the end of the run, and a run of one epoch trains "
                f"there: nothing is learned. Learn for more than {self.epoch_steps:,} steps, or "
                "pass a constant learning_rate",
                stacklevel=2,
            )
        self.env_id, self.env_kwargs = self.family.env_id, self.family.env_kwargs
        tb_log_name = tb_log_name or self.algorithm  # which callbacks read, too
        total_timesteps, callback = self._setup_learn(
            steps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        warn_of_idle_callbacks(callback, steps, self.n_envs)
        callback.on_training_start(locals(), globals())
        while self.num_timesteps < total_timesteps:
            # between two epochs: evaluations and checkpoints belong here
            self.policy.set_training_mode(False)
            callback.on_rollout_start()
            self._dump_pending_logs(log_interval)
            # lines 2 and 16: every task's trajectories, of which the next contexts are made
            try:
                collected = self._collect_epoch(callback)
            except CollectionStoppedError:
                break
            callback.on_rollout_end()
            # lines 4 to 15
            gradient_steps = self.gradient_steps if self.gradient_steps >= 0 else collected
            if gradient_steps > 0 and self.num_timesteps > self.learning_starts:
                self.train(gradient_steps=gradient_steps, batch_size=self.batch_size)
        callback.on_training_end()
        self._dump_pending_logs(log_interval)
        return self

    def _checked_steps(self, total_timesteps: int | None, callback: MaybeCallback) -> int:
        total = self.n_timesteps if total_timesteps is None else total_timesteps
        if total is None:
            raise ValueError(
                "total_timesteps is missing, which only a model that from_zoo made knows: pass a "
                f"number of environment steps; an epoch has {self.epoch_steps:,}"
            )
        check_number("total_timesteps", total, 0)
        if isinstance(callback, list):
            known = all(isinstance(each, BaseCallback) for each in callback)
        else:
            known = callback is None or isinstance(callback, BaseCallback) or callable(callback)
        if not known or isinstance(callback, type):
            needed = "an object of a callback's class, a list of such objects or a function"
            raise TypeError(f"callback must be {needed}, but is {callback!r}")
        if self.verbose > 0:
            epoch = self.epoch_steps
            n, updates = int(-(-total // epoch)), self.gradient_steps
            updates = epoch if updates < 0 else updates
            in_all = f", {n * updates:,} in all" * (self.learning_starts == 0)
            print(
                f"Training for {total:,.0f} steps in {n:,} epoch{'s' * (n != 1)}: each has "
                f"{epoch:,} environment steps, then {updates:,} gradient steps{in_all}"
            )
        return total

    def _collect_epoch(self, callback: BaseCallback) -> int:
        """Roll out every task, and make the contexts: environment steps."""
        started, steps_before = time.perf_counter(), self.num_timesteps
        collector = self.make_collector(callback)
        waves = collector.collect()
        epoch = concatenate(waves, len(self.train_tasks) * self.trajectories_per_task)
        returns = self.measure_returns(epoch, collector)
        # after the returns, which the policies that collected the epoch must earn
        self.policy.update_statistics(waves)
        self._replace_context(epoch, returns)
        self.epoch += 1
        collected = self.num_timesteps - steps_before
        self.logger.record("time/collection_fps", collected / (time.perf_counter() - started))
        self.logger.record("rollout/train_task_return", np.nanmean(np.diagonal(returns)))
        self._logs_pending = True
        return collected

    def measure_returns(self, epoch: Segment, collector: EpochCollector) -> np.ndarray:
        """J[i, j]: the return of task j's policy on task i, (n_train_tasks, n_train_tasks); NaN
        where unknown.
        """
        n_tasks = len(self.train_tasks)
        own = (epoch.rewards * epoch.first_episode).sum(axis=1).reshape(n_tasks, -1).mean(axis=1)
        returns = np.full((n_tasks, n_tasks), np.nan)
        np.fill_diagonal(returns, own)
        return returns

    @th.no_grad()
    def _replace_context(self, epoch: Segment, returns: np.ndarray) -> None:
        policy, n_tasks, tensor = self.policy, len(returns), self.policy.tensor
        seen = map(tensor, (epoch.observations, epoch.next_observations))
        obs, next_obs = map(policy.standardise, seen)
        beyond = (obs.abs() == OBSERVATION_CLIP).any(dim=-1).float().mean()
        self.logger.record("train/clipped_observations", beyond.item())
        actions, rewards = tensor(epoch.actions), tensor(epoch.rewards)
        deviation = float(_unit(rewards, rewards.std()))
        self.context_reward_statistics = float(rewards.mean()), deviation
        parts = [obs, actions, next_obs, _standardised(rewards)[..., None]]
        if policy.context_has_value:  # eq. 8; 0 before the first update (Algorithm 1, line 2)
            values = th.zeros_like(rewards)
            if self._n_updates > 0:
                values = policy.action_values(obs, actions, epoch.latents)
            parts.append(_standardised(values)[..., None])
        transitions, features = th.cat(parts, dim=-1), None
        if self.context_relabel_fraction:
            features = th.as_tensor(epoch.features, device=self.device)
            features = features.reshape(n_tasks, -1, features.shape[-1])
        self.epoch_context = ContextStore(
            transitions.reshape(n_tasks, -1, transitions.shape[-1]),
            rewards.reshape(n_tasks, -1),
            tensor(returns),
            features,
        )

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """Gradient steps on meta-batches (Algorithm 1, lines 4 to 15); then new posteriors."""
        self.policy.set_training_mode(True)
        updater = self.make_updater()
        self._update_learning_rate(updater.optimizers)
        started = time.perf_counter()
        history: dict[str, list[th.Tensor]] = {}
        with updater.precision:
            for block in self.make_sampler().blocks(gradient_steps, batch_size):
                first = updater.n_updates
                for batch in block:
                    for name, value in updater.step(batch).items():
                        history.setdefault(name, []).append(value)
                    self._n_updates = updater.n_updates
                updater.check_finite(history["gradient_norm"][-len(block) :], first)
        self._refresh_posteriors()
        seconds = time.perf_counter() - started
        self.logger.record("time/updates_per_second", gradient_steps / seconds)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in history.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())
        self.logger.record("train/kl_ideal", float(np.log(len(self.train_tasks))))
        self.logger.record("train/aggregate_to_prior_kl", self.aggregate_to_prior_kl)
        self._measure_decoder()

    @th.no_grad()
    def _refresh_posteriors(self) -> None:
        """Every training task's posterior from its latest context, for the next epoch's latents."""
        self.policy.set_training_mode(False)
        transitions, generator = self._known_context.transitions, self.generators.torch
        picks = th.randperm(transitions.shape[1], generator=generator, device=self.device)
        posteriors = self.policy.encoder(transitions[:, picks[: self.context_size]])
        means, variances = (part.double().cpu().numpy() for part in posteriors)
        self.train_tasks.latent_means, self.train_tasks.latent_variances = means, variances

    @th.no_grad()
    def _measure_decoder(self) -> None:
        """The decoder's residual deviation, per step, in units of reward, where dynamics agree."""
        if not self.family.shared_dynamics:
            return
        tasks, policy, device = self.train_tasks.tasks, self.policy, self.device
        shape, generator = (len(tasks), MEASURED_PER_TASK), self.generators.torch
        sources = th.randint(len(tasks), shape, generator=generator, device=device)
        data = self.replay_buffer.sample_rows(sources, generator)
        rewards = self.family.compute_rewards(tasks[:, None, :], data.features.cpu().numpy())
        embedding = policy.reward_embedding(policy.tensor(self.task_latents))
        embedding = rows(embedding, MEASURED_PER_TASK)
        obs, next_obs = map(policy.standardise, (data.observations, data.next_observations))
        predicted = policy.decode_rewards(obs, data.actions, next_obs, embedding)
        errors = predicted.cpu().numpy() - rewards
        self.predicted_rewards_error = float(np.sqrt(np.mean(errors**2)))
        self.logger.record("train/decoder_error", self.predicted_rewards_error)

    def resume(
        self,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        progress_bar: bool = False,
    ) -> Self:
        """Finish the ``learn`` that a checkpoint interrupted, up to its own ``total_timesteps``."""
        remaining = self._total_timesteps - self.num_timesteps
        if remaining <= 0:
            return self
        return self.learn(remaining, callback, log_interval, None, False, progress_bar)

    def _dump_pending_logs(self, log_interval: int | None) -> None:
        if self._logs_pending and log_interval and self.epoch % log_interval == 0:
            self.dump_logs()
            self._logs_pending = False

    # ------------------------------------------------------------------ the parts

    def _part(self, kind: type[Part], **others: Any) -> Part:
        """A part of the model, whose fields are the model's attributes of these names."""
        names = [field.name for field in fields(kind) if field.name not in others]  # type: ignore[arg-type]
        return kind(**{name: getattr(self, name) for name in names}, **others)

    def make_collector(self, callback: BaseCallback) -> EpochCollector:
        num_envs = self.family.num_envs

        def on_step(step_locals: dict[str, Any]) -> bool:
            self.num_timesteps += num_envs
            callback.update_locals({**step_locals, "self": self})
            if not callback.on_step():
                return False
            dones = step_locals["dones"]
            if dones.any():  # what it looks for comes with an episode's end
                self._update_info_buffer(step_locals["infos"], dones)
            total = self._total_timesteps  # which the last epoch may overshoot
            self._update_current_progress_remaining(min(self.num_timesteps, total), total)
            self._episode_num += int(dones.sum())
            return True

        return self._part(
            EpochCollector,
            explores=lambda: self.num_timesteps < self.learning_starts,
            episode_count=lambda: self._episode_num,
            on_step=on_step,
        )

    def make_sampler(self) -> MetaBatchSampler:
        return self._part(MetaBatchSampler, epoch_context=self._known_context)

    def make_objective(self) -> Objective:
        rewards = self._known_context.rewards
        if self.reward_scale == "per-task":
            sizes = self.replay_buffer.reward_magnitudes()
            largest = sizes.max()
            known = th.where(sizes > LEAST_REWARDS * largest, sizes, largest)
            scale = th.where(largest > 0, 1.0 / known, 1.0)
        elif self.reward_scale == "auto":
            scale = (1.0 / self.policy.reward_norm.std).expand(len(rewards))
        else:
            scale = th.full((len(rewards),), float(self.reward_scale), device=self.device)
        variance = _unit(rewards, rewards.var(), MIN_STD**2)
        return self._part(self.objective_class, reward_scale=scale, reward_variance=variance)

    def make_updater(self) -> Updater:
        return self._part(Updater, objective=self.make_objective(), n_updates=self._n_updates)

    @property
    def entropy_coefficient(self) -> EntropyCoefficient:
        tensor = self.ent_coef_tensor if self.log_ent_coef is None else self.log_ent_coef
        return EntropyCoefficient(tensor, self.ent_coef_optimizer, float(self.target_entropy))

    @property
    def hidden_dtype(self) -> th.dtype:
        return hidden_dtype(self.precision, self.device.type)

    @property
    def _known_context(self) -> ContextStore:
        if self.epoch_context is None:
            raise ValueError("the model has no contexts before its first epoch: call learn")
        return self.epoch_context

    # ------------------------------------------------------------------ the task family

    @property
    def family(self) -> FamilyView:
        """The environment as a task family; refused if the model was loaded without one."""
        if self._family is None:
            own = "..." if self.env_id is None else repr(self.env_id)
            needed = f"give it one with set_env, or load it with env={own}"
            raise ValueError(f"the model has no environment; {needed}")
        return self._family

    def _family_of(self, env: VecEnv) -> FamilyView:
        """View of an environment, which must be of the model's own family once it has one."""
        family = FamilyView.for_training(env, self.horizon)
        self._check_family(family)
        if len(self.train_tasks):
            family.check_same_family(self.task_space, self.reward_feature_dim)
        return family

    def _check_family(self, family: FamilyView) -> None:
        """:raises ValueError: If the model's arguments need what the family does not have"""
        for name in ("relabel_fraction", "context_relabel_fraction"):
            if getattr(self, name) is None:
                setattr(self, name, 0.5 if family.shared_dynamics else 0.0)
            if getattr(self, name) > 0 and not family.shared_dynamics:
                raise ValueError(
                    f"{name} must be 0: the tasks of {family.env_id} do not share dynamics"
                )
        if self.shaping_coef > 0 and not family.has_potential:
            raise ValueError(
                f"shaping_coef must be 0: {family.env_id} has no potential; a family defines one "
                "by _potential(tasks, observations)"
            )

    def set_env(self, env: GivenEnv, force_reset: bool = True) -> None:
        """Train on another environment of the family. An id gets as many copies as before, and the
        model's own id the arguments with which it was trained.
        """
        own: dict[str, Any] = {}
        if isinstance(env, str):
            _, own = environment_of(repr(self), self.env_id, self.env_kwargs, plain_id(env))
        vec_env = self._wrap_env(vectorise(env, self.n_envs, **own), self.verbose)
        check_for_correct_spaces(vec_env, self.observation_space, self.action_space)
        family = self._family_of(vec_env)
        self.n_envs = vec_env.num_envs  # experience is kept per task, not per copy
        super().set_env(vec_env, force_reset)
        self._family = family

    @property
    def epoch_steps(self) -> int:
        """Environment steps of an epoch's collection."""
        return self._steps_of(len(self.train_tasks) * self.trajectories_per_task)

    def _steps_of(self, rollouts: int) -> int:
        """Environment steps of so many rollouts, all copies of the environment at a time."""
        return in_whole_waves(rollouts, self.family.num_envs) * self.family.horizon

    # ------------------------------------------------------------------ what adaptation asks

    @property
    def task_latents(self) -> np.ndarray:
        """Posterior means of the training tasks' latents, (n_train_tasks, latent_dim)."""
        return self.train_tasks.latent_means

    @property
    def aggregate_to_prior_kl(self) -> float:
        """How far the training tasks' aggregate posterior is from N(0, I), nats."""
        return self.train_tasks.aggregate_to_prior_kl

    def sample_latents(self, n: int, rng: np.random.Generator, source: str = "prior") -> np.ndarray:
        """Draw latents (n, latent_dim), see :meth:`TrainTasks.sample_latents`."""
        return self.train_tasks.sample_latents(n, rng, source)

    def predicted_returns(
        self, latents: np.ndarray, trajectories: Iterable[Trajectory], max_steps: int | None = None
    ) -> np.ndarray:
        """Returns that the reward decoder predicts for trajectories, if each latent were the
        task's: (m, latent_dim) -> (m, number of trajectories).

        :param max_steps: Of a longer trajectory only so many steps are decoded, evenly spaced, and
            the sum is scaled up; None decodes all
        """
        return self.policy.predicted_returns(latents, trajectories, max_steps, self.hidden_dtype)

    @property
    def digest(self) -> str:
        """Of what adaptation uses: all networks but the critics, and the tasks' latents."""
        state = self.policy.state_dict().items()
        used = {name: value for name, value in state if not name.startswith("critic")}
        used["latent_means"] = th.as_tensor(self.train_tasks.latent_means)
        used["latent_variances"] = th.as_tensor(self.train_tasks.latent_variances)
        return digest_of(used)

    # ------------------------------------------------------------------ files

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """As SB3's, but a file is written completely or not at all."""
        if not isinstance(path, io.BufferedIOBase):
            path = pathlib.Path(path)
            path = path if path.suffix else path.with_suffix(".zip")
            write_atomically(path, lambda file: self.save(file, exclude, include))
            return
        try:
            super().save(path, exclude, include)
        except RuntimeError as error:
            # torch raises its own over what stopped its writing
            if isinstance(error.__context__, (OSError, KeyboardInterrupt)):
                raise error.__context__ from None
            raise

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True
    ) -> None:
        """As SB3's.

        :raises ValueError: If it is truncated or foreign, or the experience of other tasks than
            this model's
        """
        own = self.replay_buffer
        try:
            super().load_replay_buffer(path, truncate_last_traj)
        except OSError:
            raise
        except Exception as error:  # what foreign data may raise is no closed list
            self.replay_buffer = own
            what = "is truncated, or no replay buffer that save_replay_buffer wrote"
            raise ValueError(f"{path} {what}: {error}") from error
        tasks, widths = getattr(self.replay_buffer, "tasks", ()), own.widths
        if not np.array_equal(tasks, own.tasks) or self.replay_buffer.widths != widths:
            self.replay_buffer = own
            raise ValueError(
                f"{path} is the experience of other tasks than this model's training tasks, which "
                "have rewards of their own: load what was saved with the model"
            )
        self.replay_buffer.load_state(self.replay_buffer.state())  # on this model's device

    @classmethod
    def load(
        cls,
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GivenEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """As SB3's. ``env`` may be a registered id too, see :meth:`set_env`. Further arguments are
        the constructor's; a ``seed`` begins new random streams.

        :raises ValueError: If it is a folder, the file is truncated or holds another algorithm's
            model, env is of another family, or an argument would change what the networks are
        """
        refuse_unknown(kwargs.keys() - inspect.signature(cls).parameters.keys(), cls)
        check_device(device)
        file = saving.check_archive(path, cls, kwargs, custom_objects)
        with saving.reading(path, cls):
            model = super().load(file, None, device, custom_objects, print_system_info, **kwargs)
        model._check_arguments(vars(model))
        if env is not None:
            model.set_env(env, force_reset)
        if kwargs.get("seed") is not None:
            model.set_random_seed(kwargs["seed"])
        return model

    def save_checkpoint(self, path: str | pathlib.Path) -> None:
        """Write everything to one file, between two epochs only, from which :meth:`load_checkpoint`
        continues bit for bit. Where it fails, a previous checkpoint stays whole.
        """
        self.keeps_experience = True
        try:
            write_atomically(path, self.save)
        finally:
            self.keeps_experience = False

    @classmethod
    def load_checkpoint(
        cls,
        path: str | pathlib.Path,
        env: GivenEnv | None = None,
        device: th.device | str = "auto",
    ) -> Self:
        """Read what :meth:`save_checkpoint` or :class:`TrainingCheckpointCallback` wrote;
        :meth:`resume` then continues the run, in an environment with as many copies.

        :raises ValueError: If the file is truncated or foreign, or env of another family
        """
        facts = saving.facts_of(path)
        found = facts.get("algorithm")
        if not facts.get("keeps_experience"):
            what = "is truncated, or no checkpoint of sb3_poem"
            if found:
                what = f"is a model, no checkpoint: use {cls.__name__}.load"
            raise ValueError(f"{path} {what}")
        if found != cls.__name__:
            raise ValueError(f"{path} holds a {found}; load it with {found}.load_checkpoint")
        with open(path, "rb") as file:
            model = cls.load(file, env, device)
        model.keeps_experience = False
        return model

    def save_pretrained(
        self, folder: str | pathlib.Path, card: dict[str, Any] | None = None
    ) -> None:
        """Write safetensors, JSON and a model card, which :meth:`from_pretrained` reads.

        :param folder: Where; made if missing
        :param card: What the card should say: ``command``, ``seed``, ``commit``, ``machine``,
            ``note``, ``license`` (default: MIT), ``results``: any JSON
        :raises OSError: If the folder cannot be written
        :raises ValueError: If the policy's activation is none of torch.nn's or its optimiser none
            of torch.optim's, which JSON could not name
        """
        for name, content in saving.pretrained_files(self, card).items():
            write_atomically(pathlib.Path(folder) / name, content)

    def push_to_hub(
        self, repo_id: str, card: dict[str, Any] | None = None, private: bool | None = None
    ) -> str:
        """Write what :meth:`save_pretrained` writes to the Hugging Face Hub; needs the extra
        ``[hub]`` and a token (``hf auth login``, or ``HF_TOKEN``).

        :param repo_id: ``"user/name"``, by which :meth:`from_pretrained` then finds it; made if
            missing
        :param private: Of a repository that is made; None takes the account's default
        :return: Its address
        :raises ImportError: If the extra is not installed
        :raises ValueError: If the name is none that the Hub takes
        :raises OSError: If the Hub refuses it or cannot be reached
        """
        return upload(repo_id, saving.pretrained_files(self, card, repo_id), private)

    @classmethod
    def from_pretrained(
        cls,
        folder: str | pathlib.Path,
        env: GivenEnv | None = None,
        device: th.device | str = "auto",
    ) -> Self:
        """Read what :meth:`save_pretrained` or :meth:`push_to_hub` wrote.

        :param folder: The folder, the name of a shipped model, or ``"user/name"`` on the Hugging
            Face Hub (extra ``[hub]``), if there is no such folder
        :param env: An environment of the model's family, if it shall be trained on
        :raises FileNotFoundError: If there is no such model; the message lists those that ship
        :raises ValueError: If a file is truncated or foreign, the model is of another algorithm, or
            env of another family
        """
        model = saving.from_pretrained(cls, folder, device)
        if env is not None:
            model.set_env(env)
        return model

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_family", "epoch_context", "_logs_pending"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        kept = [name for name in state_dicts if name not in ("actor.optimizer", "critic.optimizer")]
        kept += ["policy.optimizer"] + ["experience"] * self.keeps_experience
        return kept, variables

    @property
    def experience(self) -> saving.Experience:
        """What a checkpoint holds beside the model."""
        return saving.Experience(self)


def _standardised(values: th.Tensor) -> th.Tensor:
    return (values - values.mean()) / _unit(values, values.std())


def _unit(values: th.Tensor, spread: th.Tensor, least: float = MIN_STD) -> th.Tensor:
    """What to divide values by: their spread or, where they do not differ, 1."""
    return th.where(values.max() > values.min(), spread.clamp(min=least), 1.0)
