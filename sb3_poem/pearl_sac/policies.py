"""Policy of PEARLSAC: an actor, critics, a context encoder and a reward decoder of one latent."""

import inspect
import itertools
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_poem.common.buffers import Segment
from sb3_poem.common.checks import as_observations, check_whole
from sb3_poem.common.networks import (
    ContextEncoder,
    LatentActor,
    LatentCritic,
    RewardDecoder,
    RunningNorm,
)
from sb3_poem.common.trajectory import Trajectory

OBSERVATION_CLIP = 10.0
#: Widths of the hidden layers
DEFAULT_NET_ARCH: dict[str, Sequence[int]] = {
    "pi": (256, 256),
    "qf": (256, 256),
    "encoder": (128, 128),
    "decoder": (128, 128),
    "embedding": (64,),
}


class LatentPolicy(SACPolicy):
    """Networks conditioned on a task latent z, with the statistics that standardise their inputs.

    ``predict(obs, state=z)`` acts for latent ``z``; SB3's ``state`` slot carries it from step to
    step. Without a state the prior's mean acts.

    >>> from sb3_poem import PEARLSAC
    >>> layers = dict(layer_norm=True, net_arch=[64, 64])
    >>> model = PEARLSAC("MlpPolicy", "poem/PointGoal-v0", n_train_tasks=4, policy_kwargs=layers)
    >>> isinstance(model.policy, LatentPolicy)
    True

    :param net_arch: Hidden widths of actor and critics, or a dict with keys ``pi``, ``qf``,
        ``encoder``, ``decoder``, ``embedding`` for each
    :param activation_fn: Activation of actor, critics and decoder
    :param layer_norm: Whether actor, critics and decoder normalise their hidden layers before the
        activation (Ba, Kiros & Hinton, 2016; without gain and bias). It steadies critics of robots
        with many observations
    :param latent_dim: Dimension d of the latent
    :param context_has_value: Whether a context transition carries Q(s, a)
    :param n_critics: Number of critics
    :param optimizer_class: Optimiser of all networks
    :param optimizer_kwargs: Its arguments; Adam is fused unless they say otherwise
    """

    observation_space: spaces.Box
    action_space: spaces.Box
    net_arch: dict[str, list[int]]
    actor: LatentActor  # type: ignore[assignment]
    critic: LatentCritic  # type: ignore[assignment]
    critic_target: LatentCritic  # type: ignore[assignment]

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: Sequence[int] | dict[str, Sequence[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ReLU,
        layer_norm: bool = False,
        latent_dim: int = 5,
        context_has_value: bool = False,
        n_critics: int = 2,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        if not (isinstance(activation_fn, type) and issubclass(activation_fn, nn.Module)):
            raise TypeError(f"activation_fn must be a class, as nn.ReLU, but is {activation_fn!r}")
        if not callable(optimizer_class):
            needed = "a class, as torch.optim.Adam"
            raise TypeError(f"optimizer_class must be {needed}, but is {optimizer_class!r}")
        check_whole("n_critics", n_critics, 1)
        optimizer_kwargs = optimizer_kwargs or {}
        others = {"foreach", "differentiable"} & optimizer_kwargs.keys()
        if optimizer_class is th.optim.Adam and not others:
            optimizer_kwargs = {"fused": True, **optimizer_kwargs}
        BasePolicy.__init__(
            self,
            observation_space,
            action_space,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
        )
        given = net_arch if isinstance(net_arch, dict) else {"pi": net_arch, "qf": net_arch}
        if unknown := sorted(set(given) - set(DEFAULT_NET_ARCH)):
            known = sorted(DEFAULT_NET_ARCH)
            raise ValueError(f"net_arch has unknown keys {unknown}; known are {known}")
        widths = DEFAULT_NET_ARCH | {key: part for key, part in given.items() if part is not None}
        if not all(np.ndim(part) == 1 for part in widths.values()):
            needed = "a list of widths, as [256, 256], or a dictionary of such lists"
            raise TypeError(f"net_arch must be {needed}, but is {net_arch!r}")
        self.net_arch = {key: list(part) for key, part in widths.items()}
        for width in itertools.chain(*self.net_arch.values()):
            check_whole("net_arch", width, 1)
        self.activation_fn = activation_fn
        self.layer_norm = layer_norm
        self.latent_dim = latent_dim
        self.context_has_value = context_has_value
        self.n_critics = n_critics
        self._warned_of_no_latent = False
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        arch, latent_dim = self.net_arch, self.latent_dim
        obs_dim, action_dim = int(self.observation_space.shape[0]), int(self.action_space.shape[0])
        hidden, transition_dim = (self.activation_fn, self.layer_norm), 2 * obs_dim + action_dim
        self.obs_norm = RunningNorm(obs_dim, clip=OBSERVATION_CLIP)
        self.reward_norm = RunningNorm(1)  # of the first epoch, in whose units the critics learn
        context_dim = transition_dim + 1 + int(self.context_has_value)
        self.encoder = ContextEncoder(context_dim, latent_dim, arch["encoder"])
        self._build_embeddings(arch["embedding"])
        self.decoder = RewardDecoder(transition_dim + latent_dim, arch["decoder"], *hidden)
        self.actor = LatentActor(obs_dim + latent_dim, action_dim, arch["pi"], *hidden)
        shape = (obs_dim + action_dim + latent_dim, self.n_critics, arch["qf"], *hidden)
        self.critic, self.critic_target = LatentCritic(*shape), LatentCritic(*shape)
        self.critic_target.load_state_dict(self.critic.state_dict())
        self.critic_target.requires_grad_(False)
        trained = [parameter for parameter in self.parameters() if parameter.requires_grad]
        self.optimizer = self.optimizer_class(trained, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _build_embeddings(self, net_arch: list[int]) -> None:
        """PEARL has one embedding: the latent itself."""

    def policy_embedding(self, latents: th.Tensor) -> th.Tensor:
        """z_pi of latents (..., latent_dim)."""
        return latents

    def reward_embedding(self, latents: th.Tensor) -> th.Tensor:
        """z_r of latents (..., latent_dim)."""
        return latents

    def tensor(self, values: npt.ArrayLike) -> th.Tensor:
        """Numbers as float32 on the policy's device."""
        return th.as_tensor(values, dtype=th.float32, device=self.obs_norm.mean.device)

    def standardise(self, obs: th.Tensor) -> th.Tensor:
        """Standardised observations, bounded so that a fall does not saturate the networks."""
        return self.obs_norm(obs)

    def update_statistics(self, segments: Sequence[Segment]) -> None:
        """Standardise observations by all so far: a robot that has learned to run is far from what
        the first epoch showed. Rewards keep the first epoch's statistics.
        """
        obs = np.concatenate([segment.observations for segment in segments])
        self.obs_norm.update(obs.reshape(-1, obs.shape[-1]))
        if self.reward_norm.count == 0:
            rewards = np.concatenate([segment.rewards for segment in segments])
            self.reward_norm.update(rewards.reshape(-1, 1))
            if np.ptp(rewards) == 0.0:  # they do not differ, and give no unit
                self.reward_norm.std.fill_(1.0)

    def action_values(self, obs: th.Tensor, actions: th.Tensor, latents: np.ndarray) -> th.Tensor:
        """Q(s, a) of the more doubtful critic, (copies, steps), of standardised observations and
        actions (copies, steps, ...), under latents (copies, latent_dim).
        """
        copies = zip(obs, actions, self.tensor(latents), strict=True)
        values = [self.critic(o, a, own.expand(o.shape[0], -1)) for o, a, own in copies]
        return th.stack([each.min(dim=0).values for each in values])

    @th.no_grad()
    def predicted_returns(
        self,
        latents: np.ndarray,
        trajectories: Iterable[Trajectory],
        max_steps: int | None,
        dtype: th.dtype,
    ) -> np.ndarray:
        """See :meth:`PEARLSAC.predicted_returns`; ``dtype`` is the hidden layers' arithmetic."""
        rows, lengths, factors = [], [], []
        for trajectory in trajectories:
            steps = _evenly_spaced(len(trajectory), max_steps)
            seen = (trajectory.observations[at] for at in (steps, steps + 1))
            obs, next_obs = (self.standardise(self.tensor(values)) for values in seen)
            actions = self.tensor(self.scale_action(trajectory.actions[steps]))
            rows.append(th.cat([obs, actions, next_obs], dim=1))
            lengths.append(len(steps))
            factors.append(len(trajectory) / len(steps))
        embeddings = self.reward_embedding(self.tensor(np.atleast_2d(latents)))
        sums = self.decoder.sums(th.cat(rows), lengths, embeddings, dtype).double()
        norm = self.reward_norm
        sums = sums * norm.std + norm.mean * sums.new_tensor(lengths)
        return (sums * sums.new_tensor(factors)).cpu().numpy()

    def decode_rewards(
        self, obs: th.Tensor, actions: th.Tensor, next_obs: th.Tensor, reward_embedding: th.Tensor
    ) -> th.Tensor:
        """Predicted rewards (...) in the environment's units, of what is standardised."""
        return self.reward_norm.inverse(self.decoder(obs, actions, next_obs, reward_embedding))

    def acting_on(
        self, latents: np.ndarray
    ) -> Callable[[np.ndarray, th.Tensor | None], np.ndarray]:
        """How to act under latents (n, latent_dim): a function of observations (n, obs_dim) and
        standard normal noise (n, action_dim), None for the mean, to actions in [-1, 1].
        """
        with th.no_grad():
            embedding = self.policy_embedding(self.tensor(latents))

        @th.no_grad()
        def act(obs: np.ndarray, noise: th.Tensor | None) -> np.ndarray:
            mean, log_std = self.actor.distribution(self.standardise(self.tensor(obs)), embedding)
            actions = mean if noise is None else th.addcmul(mean, log_std.exp(), noise)
            return actions.tanh_().cpu().numpy()

        return act

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | np.ndarray | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """Actions for observations under task latents.

        :param observation: (obs_dim,) or (n, obs_dim)
        :param state: Latent (latent_dim,), or one for each observation (n, latent_dim); None is the
            prior's mean, of which a warning tells once
        :param episode_start: Not used: a latent outlives episodes
        :param deterministic: Mean action instead of a sample
        :return: Actions in the environment's units, and the latents (n, latent_dim)
        :raises ValueError: For observations or a state that are not finite or of another shape
        """
        if self.training:  # walking all modules takes longer than a small batch's actions
            self.set_training_mode(False)
        obs = as_observations(observation, self.observation_space.shape)
        obs = obs.astype(np.float32, copy=False)
        single = obs.ndim == 1
        obs = np.atleast_2d(obs)
        n, d = len(obs), self.latent_dim
        if not (finite := np.isfinite(obs).all(axis=1)).all():
            raise ValueError(f"observation {int(np.argmin(finite))} holds NaN or infinity")
        if state is None and not self._warned_of_no_latent:
            self._warned_of_no_latent = True
            warnings.warn(
                "predict was called without a latent (its state), and acts for latent 0, that is "
                "for no task: what it earns says little of the model. PreferenceAdapter(model, "
                "env, ...).adapt() gives a policy for a task; AdaptationEvalCallback evaluates "
                "such policies in training",
                stacklevel=3,
            )
        latents = np.zeros(d) if state is None else np.asarray(state, dtype=np.float64)
        if latents.shape not in ((d,), (n, d), (1, d)):
            raise ValueError(
                f"state has shape {latents.shape}, but a latent is ({d},), or ({n}, {d}) for these "
                "observations"
            )
        if not np.all(np.isfinite(latents)):
            raise ValueError(f"state holds NaN or infinity: {latents}")
        latents = np.array(np.broadcast_to(latents, (n, d)))
        actions = self.unscale_action(self.acting_on(latents)(obs, self._noise(n, deterministic)))
        actions = np.clip(actions, self.action_space.low, self.action_space.high)
        return (actions[0] if single else actions), latents

    def _noise(self, n: int, deterministic: bool) -> th.Tensor | None:
        shape = (n, *self.action_space.shape)
        return None if deterministic else th.randn(shape, device=self.device)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        act = self.acting_on(np.zeros((len(observation), self.latent_dim)))
        noise = self._noise(len(observation), deterministic)
        return self.tensor(act(observation.cpu().numpy(), noise))

    def set_training_mode(self, mode: bool) -> None:
        self.train(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = list(inspect.signature(LatentPolicy).parameters)
        names.remove("lr_schedule")
        return {"lr_schedule": self._dummy_schedule} | {name: getattr(self, name) for name in names}


def _evenly_spaced(total: int, count: int | None) -> np.ndarray:
    """At most ``count`` of ``total`` indices, at one distance, what is left over at both ends."""
    if count is None or total <= count:
        return np.arange(total)
    distance = -(-total // count)
    chosen = np.arange(0, total, distance)
    return chosen + (total - 1 - chosen[-1]) // 2


MlpPolicy = LatentPolicy
