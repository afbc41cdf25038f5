"""Soft actor-critic with a probabilistic task context: what POEM and its baselines share."""

import time
import warnings
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium.vector import VectorEnv
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import LinearSchedule
from torch import nn

from poem_envs.registration import plain_id
from sb3_poem.common.buffers import ContextStore, TaskBatch, TaskReplayBuffer
from sb3_poem.common.checks import check_number, check_number_or_auto, check_whole
from sb3_poem.common.family import FamilyEnv
from sb3_poem.common.precision import MixedPrecision, hidden_dtype
from sb3_poem.common.random import Generators
from sb3_poem.pearl_sac import losses
from sb3_poem.pearl_sac.collecting import MIN_STD
from sb3_poem.pearl_sac.cuda_graph import GraphedStep, Step, prepare_optimizers
from sb3_poem.pearl_sac.losses import MetaBatch, TaskEmbeddings
from sb3_poem.pearl_sac.policies import LatentPolicy, MlpPolicy
from sb3_poem.pearl_sac.sampling import SamplingSAC
from sb3_poem.pearl_sac.unsupported import refuse_unknown, refuse_unsupported
from sb3_poem.resources import config_file, zoo_entry

SelfPEARLSAC = TypeVar("SelfPEARLSAC", bound="PEARLSAC")


class PEARLSAC(SamplingSAC):
    """Context-based meta-RL on soft actor-critic (PEARL, https://arxiv.org/abs/1903.08254).

    Training alternates between an epoch's collection, in which every training task is rolled out under its own latest
    latent, and gradient steps on meta-batches of tasks. It keeps a replay buffer for every task and the contexts of the last
    epoch, and learns a context encoder, a latent-conditioned actor and critics, and a reward decoder together.
    Observations are standardised by the mean and deviation of all that were collected.

    :param policy: The policy model to use: "MlpPolicy", or a subclass of its class
    :param env: A task family: an environment, a vectorised one of SB3 or Gymnasium, or a registered
        id (which is then vectorised)
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
    :param context_relabel_fraction: Share of the contexts in a gradient step that hold other tasks' transitions, with rewards
        relabelled. Without any, the encoder may read a task from what its policy does rather than from the rewards, and is
        then at a loss when it sees a new task's first rollouts. Needs a family with shared dynamics
    :param reward_scale: Factor on the rewards that the critics learn; "auto" divides by the deviation of the first epoch's
    :param n_steps: Steps of rewards in the critics' targets before the value takes over; more carry rewards back faster, and
        rely more on what older policies, and with ``relabel_fraction`` other tasks', did
    :param shaping_coef: From 0 to 1, how far the critics learn what is gained beyond staying where one is: their rewards are
        shaped (Ng, Harada & Russell, ICML 1999) with this share of the family's potential over 1 - ``gamma``. Which policies
        are best stays as it is; where an action changes values by a small part of their spread, as on the way to a place,
        they are learned sooner. Action values, those in POEM's contexts too, are then without that share. Needs a family with
        a potential
    :param mirror_fraction: Share of each task's batch that is seen in a symmetry of the family's dynamics, drawn among those
        that it names, with rewards computed for what is then seen. What a robot learned to do in one direction, it then has
        examples of in others. Needs a family with symmetries, and with shared dynamics
    :param noise_color: Exponent b of the power spectrum 1 / f^b of the policy's noise in training rollouts: 0 white, as in
        SAC; 1 pink, 2 red (Eberhard et al., ICLR 2023). Noise that keeps a direction for some steps moves a robot farther
    :param policy_delay: Gradient steps of critics and encoder for each of everything else, that is the actor, the decoder, the
        embeddings and the entropy coefficient (as in TD3)
    :param horizon: Steps of an episode; None takes the environment's time limit
    :param precision: "auto" (bfloat16 where the processor has it), "bf16", or "fp32"
    :param stats_window_size: Episodes that the rollout logging averages over
    :param tensorboard_log: Log location for TensorBoard
    :param policy_kwargs: Additional arguments of the policy
    :param verbose: 0 no output, 1 how long an epoch is and a table after each, 2 debug
    :param seed: Seed of everything: tasks, networks, sampling, environments
    :param device: "auto", "cpu", "cuda"
    :param _init_setup_model: Whether to build the networks at creation
    :param unsupported: Nothing: what SB3's SAC takes beyond these is refused
    :raises ValueError: for an environment that is no task family, and for arguments outside their range
    :raises TypeError: for arguments that only SB3's SAC takes; the message says what to do instead
    """

    #: The name of the algorithm on the command line, and of its file in ``zoo_configs/``
    zoo_name: ClassVar[str] = "pearl_sac"
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}
    saved_arguments: ClassVar[dict[str, str]] = {
        **SamplingSAC.saved_arguments,
        "context_relabel_fraction": "context_relabel_fraction",
        "n_steps": "target_steps",
    }

    policy_delay: int = 1  # models of before it

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GymEnv | VectorEnv | str,
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
        context_relabel_fraction: float = 0.0,
        reward_scale: float | str = "auto",
        n_steps: int = 1,
        shaping_coef: float = 0.0,
        mirror_fraction: float = 0.0,
        noise_color: float = 0.0,
        policy_delay: int = 1,
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
        if not isinstance(policy_kwargs, dict | None):
            raise TypeError(f"policy_kwargs must be a dictionary of the policy's arguments, but is {policy_kwargs!r}")
        refuse_unsupported(policy_kwargs or (), f"{type(self).__name__}'s policy")
        for name, value, least in (
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
            ("n_steps", n_steps, 1),
            ("policy_delay", policy_delay, 1),
            ("seed", 0 if seed is None else seed, 0),
        ):
            check_whole(name, value, least)
        for name, number, high in (
            ("learning_rate", 0.0 if callable(learning_rate) else learning_rate, np.inf),
            ("kl_coef", kl_coef, np.inf),
            ("reward_coef", reward_coef, np.inf),
            ("policy_coef", policy_coef, np.inf),
            ("noise_color", noise_color, np.inf),
            ("gamma", gamma, 1.0),
            ("tau", tau, 1.0),
            ("relabel_fraction", relabel_fraction, 1.0),
            ("context_relabel_fraction", context_relabel_fraction, 1.0),
            ("shaping_coef", shaping_coef, 1.0),
            ("mirror_fraction", mirror_fraction, 1.0),
        ):
            check_number(name, number, 0.0, high)
        check_number_or_auto("ent_coef", ent_coef, 0.0)
        check_number_or_auto("target_entropy", target_entropy)
        if reward_scale != "auto" and not (isinstance(reward_scale, (int, float)) and reward_scale > 0):
            raise ValueError(f'reward_scale must be a positive number or "auto", got {reward_scale!r}')
        hidden_dtype(precision, "cpu")  # refuses an unknown name now rather than at the first step
        if str(device).startswith("cuda") and not th.cuda.is_available():  # which SB3 says nothing of
            warnings.warn(f"device is {device!r}, but torch sees no CUDA device: the CPU is used", stacklevel=2)
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
        self.target_steps = n_steps  # SB3's attribute n_steps goes with its own replay buffer
        if shaping_coef > 0 and gamma == 1:
            raise ValueError("shaping_coef must be 0 with gamma=1: staying somewhere has no finite value then")
        self.shaping_coef = shaping_coef
        self.mirror_fraction = mirror_fraction
        self.noise_color = noise_color
        self.policy_delay = policy_delay
        self.horizon = horizon
        self.precision = precision
        self.train_tasks: np.ndarray | None = None
        self.latent_means: np.ndarray | None = None
        self.latent_variances: np.ndarray | None = None
        self.predicted_rewards_error = float("nan")
        self.context: ContextStore | None = None
        self.context_reward_statistics: tuple[float, float] | None = None
        self.epoch = 0
        self.obs_count: int | None = 0
        self._family: FamilyEnv | None = None
        self._logs_pending = False
        self.best_adapted_return = -np.inf  # kept with the model, for AdaptationEvalCallback
        self.n_timesteps: int | None = None  # what learn takes unless told, see from_zoo
        self.policy_class = self._get_policy_from_name(policy)
        given = self._vectorise(env, n_train_tasks, trajectories_per_task)
        if _init_setup_model:
            if given is None:
                raise TypeError(
                    "env is None, but must be an environment of a task family, a vectorised one, or a registered id"
                )
            given = self._wrap_env(given, verbose)
            self._family = self._family_of(given)  # before SB3 speaks of other policies
        super().__init__(
            policy,
            given,  # type: ignore[arg-type]
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

    def __repr__(self) -> str:
        return f"{type(self).__name__}({getattr(self, 'env_id', None)}, {self.num_timesteps:,} steps trained)"

    def _setup_model(self) -> None:
        if self.env is not None:
            self.horizon = self.family.horizon
        self.generators = getattr(self, "generators", None) or Generators(self.seed, self.device)
        self.generators.to(self.device)
        if self.train_tasks is None:
            self._draw_tasks()
        assert self.train_tasks is not None
        self._complete_policy_kwargs()
        self.replay_buffer_kwargs = {"n_tasks": len(self.train_tasks), "feature_dim": self.reward_feature_dim}
        generators = self.generators
        super()._setup_model()
        self.generators = generators  # a model that is loaded goes on with its own

    def _get_policy_from_name(self, policy_name: str | type[BasePolicy]) -> type[BasePolicy]:
        """As SB3's, and of a class whether it is one of ours."""
        ours = self.policy_aliases["MlpPolicy"]
        if isinstance(policy_name, type) and issubclass(policy_name, ours):
            return policy_name
        if policy_name != "MlpPolicy":
            raise ValueError(
                f'policy is {policy_name!r}, but must be "MlpPolicy" or a subclass of {ours.__name__}: '
                "observations are flat vectors. Put features of images into the family's observation; "
                "poem_envs.GoalFamily flattens those of a goal-conditioned environment"
            )
        return ours

    @classmethod
    def from_zoo(cls: type[SelfPEARLSAC], env_id: str, **arguments: Any) -> SelfPEARLSAC:
        """A new model with the hyperparameters that ship for an environment (``zoo_configs/``), as
        ``sb3-poem train`` makes it. :meth:`learn` then knows for how many steps.

        :param env_id: A registered id that has an entry
        :param arguments: What shall differ: arguments of the constructor, ``n_envs`` (copies of the
            environment) and ``n_timesteps``. With ``env``, another family is trained by this entry
        :raises ValueError: if there is no entry; the message lists those that there are
        """
        entry = zoo_entry(config_file(cls.zoo_name), plain_id(env_id), **arguments)
        timesteps, n_envs = int(entry.pop("n_timesteps")), entry.pop("n_envs")
        rate = entry.get("learning_rate")
        if isinstance(rate, str):  # rl_zoo3's syntax
            entry["learning_rate"] = LinearSchedule(float(rate.removeprefix("lin_")), 0.0, 1.0)
        entry["env"] = cls._vectorise(entry.get("env", env_id), None, 1, n_envs)
        model = cls(**entry)
        model.n_timesteps = timesteps
        return model

    def set_random_seed(self, seed: int | None = None) -> None:
        """As SB3's: what follows depends on the seed. The training tasks stay."""
        super().set_random_seed(seed)
        if seed is not None:
            self.generators = Generators(seed, self.device)

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """As SB3's. By what observations and rewards are standardised comes with the policy."""
        super().set_parameters(load_path_or_dict, exact_match, device)
        untouched = (self.policy.obs_mean == 0).all() & (self.policy.obs_std == 1).all()
        if untouched:
            self.obs_count = 0
        elif self.obs_count == 0:
            self.obs_count = None

    def _complete_policy_kwargs(self) -> None:
        """Give the policy what follows from the model's own arguments."""
        self.policy_kwargs.pop("use_sde", None)
        self.policy_kwargs.update(latent_dim=self.latent_dim, context_has_value=self.context_has_value)

    # ------------------------------------------------------------------ learning

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        """Gradient steps on meta-batches, then a refresh of every training task's posterior."""
        self.policy.set_training_mode(True)
        optimizers = [self.policy.optimizer]
        if self.ent_coef_optimizer is not None:
            optimizers.append(self.ent_coef_optimizer)
        self._update_learning_rate(optimizers)
        prepare_optimizers(optimizers, self.device)
        started = time.perf_counter()
        history: dict[str, list[th.Tensor]] = {}
        policy = self.policy
        networks = nn.ModuleList([policy.encoder, policy.decoder, policy.actor, policy.critic, policy.critic_target])
        with MixedPrecision(networks, self.hidden_dtype) as precision:
            # whether everything learns or, in between, critics and encoder only
            steps: dict[bool, Step] = {whole: partial(self._gradient_step, precision, whole) for whole in (True, False)}
            if self.device.type == "cuda" and self.target_update_interval == 1:
                steps = {whole: GraphedStep(step) for whole, step in steps.items()}
            for block in self._meta_batch_blocks(gradient_steps, batch_size):
                for batch in block:
                    step = steps[self._n_updates % self.policy_delay == 0]
                    for name, value in step(batch).items():
                        history.setdefault(name, []).append(value)
                    self._n_updates += 1
                self._check_finite(history["gradient_norm"][-len(block) :])
        self._refresh_posteriors()
        self.logger.record("time/updates_per_second", gradient_steps / max(time.perf_counter() - started, 1e-9))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in history.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())
        self._record_latent_statistics()
        self._measure_decoder()

    def _gradient_step(self, precision: MixedPrecision, whole: bool, batch: MetaBatch) -> dict[str, th.Tensor]:
        """One step on a meta-batch, of all networks or, unless ``whole``, of critics and encoder; returns what to log."""
        precision.refresh()
        loss, metrics = self._losses(batch, whole)
        metrics["gradient_norm"] = self._optimise(loss, precision)
        if whole:
            self._update_entropy_coefficient(metrics["entropy"])
        if self._n_updates % self.target_update_interval == 0:
            self._update_targets()
        return {name: value.detach() for name, value in metrics.items()}

    @property
    def hidden_dtype(self) -> th.dtype:
        """Type of the hidden layers' arithmetic in training."""
        return hidden_dtype(self.precision, self.device.type)

    def _optimise(self, loss: th.Tensor, precision: MixedPrecision) -> th.Tensor:
        """One step of the optimiser; returns the norm of the gradient, not finite where the loss is not."""
        optimizer = self.policy.optimizer
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        precision.collect_gradients()
        gradients = [p.grad for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        # the gradient is looked at as well as the loss, because a ReLU may turn NaN to 0 on the way there
        norm = nn.utils.get_total_norm(gradients, foreach=True) + 0.0 * loss.detach()
        if self.device.type == "cpu":
            self._check_finite([norm], done=0)
        else:  # the device is not waited for: it leaves out the step itself, and the block's end tells
            optimizer.found_inf = (~th.isfinite(norm)).float()  # type: ignore[attr-defined]
        optimizer.step()
        return norm

    def _check_finite(self, gradient_norms: list[th.Tensor], done: int | None = None) -> None:
        """
        :param gradient_norms: Of the latest updates
        :param done: How many of them are counted in ``_n_updates``; None: all
        :raises ValueError: if one is not finite
        """
        finite = th.isfinite(th.stack(gradient_norms))
        if not finite.all():
            first = self._n_updates - (len(gradient_norms) if done is None else done) + int(finite.int().argmin())
            raise ValueError(
                f"the training loss or its gradient is not finite at update {first}; no network was changed by it. "
                "A lower learning_rate or reward_scale usually helps."
            )

    def _update_targets(self) -> None:
        targets: list[th.Tensor] = list(self.policy.critic_target.parameters())
        sources: list[th.Tensor] = list(self.policy.critic.parameters())
        with th.no_grad():
            th._foreach_lerp_(targets, sources, self.tau)

    def _encode(self, context: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Latents (tasks, d) by reparameterisation, and the KL of their posteriors to N(0, I), (tasks,)."""
        mean, variance = self.policy.encoder(context)
        return mean + variance.sqrt() * noise, losses.kl_to_prior(mean, variance)

    def _embed(self, latents: th.Tensor) -> TaskEmbeddings:
        """What actor and decoder see of the latents. PEARL's encoder learns nothing from the actor."""
        return TaskEmbeddings(latents, self.policy.policy_embedding(latents.detach()), self.policy.reward_embedding(latents))

    def _losses(self, batch: MetaBatch, whole: bool = True) -> tuple[th.Tensor, dict[str, th.Tensor]]:
        """Sum of all losses of a meta-batch or, unless ``whole``, of critics' and encoder's; and what to log of them."""
        latents, kl = self._encode(batch.context, batch.latent_noise)
        embeddings = self._embed(latents)
        transitions = self._standardise(batch.transitions)
        alpha = self._entropy_coefficient()
        bootstraps = batch.bootstraps
        if bootstraps is not None:
            bootstraps = bootstraps._replace(observations=self.policy.standardise(bootstraps.observations))
        critic_loss = self._critic_loss(transitions, embeddings, alpha, batch.next_action_noise, bootstraps)
        kl_loss = kl.mean()
        metrics = {"critic_loss": critic_loss, "kl": kl_loss}
        if not whole:
            return critic_loss + self.kl_coef * kl_loss, metrics
        actor_loss, log_prob = losses.actor_loss(self.policy, transitions, embeddings, alpha, batch.action_noise)
        decoder_loss = self._decoder_loss(batch, transitions, embeddings)
        embedding_loss, embedding_metrics = self._embedding_loss(batch, embeddings)
        loss = (
            critic_loss
            + self.policy_coef * actor_loss
            + self.reward_coef * decoder_loss
            + self.kl_coef * kl_loss
            + embedding_loss
        )
        metrics |= {
            "actor_loss": actor_loss,
            "decoder_loss": decoder_loss,
            "entropy": -log_prob,
            "ent_coef": alpha,
            **embedding_metrics,
        }
        return loss, metrics

    def _embedding_loss(self, batch: MetaBatch, embeddings: TaskEmbeddings) -> tuple[th.Tensor | float, dict[str, th.Tensor]]:
        """A subclass's own demand on the latents (weighted), and what to log of it."""
        return 0.0, {}

    def _entropy_coefficient(self) -> th.Tensor:
        if self.log_ent_coef is not None:
            return self.log_ent_coef.detach().exp().squeeze()
        return self.ent_coef_tensor

    def _update_entropy_coefficient(self, entropy: th.Tensor) -> None:
        if self.ent_coef_optimizer is not None and self.log_ent_coef is not None:
            assert isinstance(self.target_entropy, float)
            # the gradient of log_ent_coef * (entropy - target_entropy)
            gradient = (entropy.detach() - self.target_entropy).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
            self.log_ent_coef.grad = gradient.view_as(self.log_ent_coef)
            self.ent_coef_optimizer.step()

    def _standardise(self, batch: TaskBatch) -> TaskBatch:
        standardise = self.policy.standardise
        return batch._replace(
            observations=standardise(batch.observations), next_observations=standardise(batch.next_observations)
        )

    def _critic_loss(
        self,
        batch: TaskBatch,
        embeddings: TaskEmbeddings,
        alpha: th.Tensor,
        noise: th.Tensor,
        bootstraps: losses.Bootstraps | None = None,
    ) -> th.Tensor:
        scale = 1.0 / self.policy.reward_std if self.reward_scale == "auto" else self.reward_scale
        return losses.critic_loss(self.policy, batch, embeddings, alpha, self.gamma, scale, noise, bootstraps)  # type: ignore[arg-type]

    def _decoder_loss(self, batch: MetaBatch, transitions: TaskBatch, embeddings: TaskEmbeddings) -> th.Tensor:
        """On context transitions (eq. 4); with relabelling on the batch of transitions instead, which holds other tasks'
        policies too: adaptation asks the decoder about trajectories of any policy.
        """
        if self.relabel_fraction > 0:
            obs, actions, next_obs = transitions.observations, transitions.actions, transitions.next_observations
            rewards = transitions.rewards
        else:
            obs_dim, action_dim = transitions.observations.shape[-1], transitions.actions.shape[-1]
            widths = [obs_dim, action_dim, obs_dim]
            obs, actions, next_obs = batch.context[..., : sum(widths)].split(widths, dim=-1)
            rewards = batch.context_rewards
        variance = self._reward_variance()
        return losses.decoder_loss(self.policy, obs, actions, next_obs, rewards, embeddings.reward, variance)

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
        """Residual deviation of the decoder, per step, on transitions of all training policies, in units of reward. Where
        tasks do not share their dynamics it stays unknown: the decoder has seen no rewards for what others' policies do.
        """
        assert self.train_tasks is not None
        if not self.family.shared_dynamics:
            return
        n_tasks, per_task = len(self.train_tasks), 64
        generator, device, policy = self.generators.torch, self.device, self.policy
        sources = th.randint(n_tasks, (n_tasks, per_task), generator=generator, device=device)
        data = self.replay_buffer.sample_rows(sources, generator)
        rewards = self.family.compute_rewards(self.train_tasks[:, None, :], data.features.cpu().numpy())
        with th.no_grad():
            latents = th.as_tensor(self.task_latents, dtype=th.float32, device=device)
            obs, next_obs = policy.standardise(data.observations), policy.standardise(data.next_observations)
            embedding = losses.rows(policy.reward_embedding(latents), per_task)
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
        total_timesteps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int | None = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfPEARLSAC:
        """Train, in whole epochs, until at least ``total_timesteps`` environment steps are done.

        :param total_timesteps: None takes those of the entry that :meth:`from_zoo` read
        :param callback: As SB3's
        :param log_interval: Epochs between two dumps of the log; None never dumps
        :param tb_log_name: None is the algorithm's name
        :raises ValueError: if the number of steps is not known
        """
        total_timesteps = self.n_timesteps if total_timesteps is None else total_timesteps
        if total_timesteps is None:
            raise ValueError(
                "total_timesteps is missing, which only a model that from_zoo made knows: pass a "
                f"number of environment steps; an epoch has {self.epoch_steps:,}"
            )
        check_number("total_timesteps", total_timesteps, 0)
        if isinstance(callback, type):
            raise TypeError(f"callback is the class {callback.__name__}, but must be an object: {callback.__name__}(...)")
        if self.verbose > 0:
            epoch, updates = self.epoch_steps, self.gradient_steps
            print(
                f"Training for {total_timesteps:,.0f} steps in {-(-total_timesteps // epoch):,.0f} epochs: "
                f"each has {epoch:,} environment steps, then {updates if updates >= 0 else epoch:,} "
                "gradient steps"
            )
        super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,  # type: ignore[arg-type]
            tb_log_name=tb_log_name or type(self).__name__,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
        self._dump_pending_logs(log_interval)
        return self

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        """The last epoch may overshoot the total; a schedule must not turn negative there."""
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    def resume(
        self: SelfPEARLSAC, callback: MaybeCallback = None, log_interval: int | None = 1, progress_bar: bool = False
    ) -> SelfPEARLSAC:
        """Finish the ``learn`` that a checkpoint interrupted, up to its own ``total_timesteps``."""
        remaining = self._total_timesteps - self.num_timesteps
        if remaining <= 0:
            return self
        return self.learn(remaining, callback, log_interval=log_interval, reset_num_timesteps=False, progress_bar=progress_bar)
