"""The tasks of a meta-trained model: which it was trained on, their latents, and the environment that they come from."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import torch as th
from gymnasium.vector import VectorEnv
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.common.decoding import decoded_sums
from sb3_poem.common.digest import digest_of
from sb3_poem.common.family import FamilyEnv
from sb3_poem.common.precision import hidden_dtype
from sb3_poem.common.random import Generators
from sb3_poem.pearl_sac.persistence import PersistentSAC, default_train_tasks
from sb3_poem.pearl_sac.policies import LatentPolicy

AGGREGATE_NEIGHBOURS = 5


class TaskSAC(PersistentSAC):
    """Soft actor-critic on a family of tasks, each with a posterior of its latent; a base of :class:`PEARLSAC`."""

    policy: LatentPolicy
    generators: Generators
    horizon: int | None
    latent_dim: int
    precision: str
    n_train_tasks: int | None
    trajectories_per_task: int
    relabel_fraction: float
    context_relabel_fraction: float
    shaping_coef: float = 0.0  # models of before it
    mirror_fraction: float = 0.0  # likewise
    train_tasks: np.ndarray | None
    latent_means: np.ndarray | None
    latent_variances: np.ndarray | None
    env_kwargs: Mapping[str, Any] = MappingProxyType({})  # models of an earlier version do not hold them
    _family: FamilyEnv | None

    def _draw_tasks(self) -> None:
        family = self.family
        count = default_train_tasks(family.all_tasks) if self.n_train_tasks is None else self.n_train_tasks
        if family.all_tasks is not None and count > len(family.all_tasks):
            raise ValueError(
                f"n_train_tasks is {count}, but {family.env_id} is a finite family of {len(family.all_tasks)} tasks; "
                f"use at most {len(family.all_tasks)}, or None for all"
            )
        self.env_id = family.env_id
        self.env_kwargs = family.env_kwargs
        self.task_space = family.task_space
        self.reward_feature_dim = family.reward_feature_dim
        self.train_tasks = family.sample_tasks(count, self.generators.child())
        self.latent_means = np.zeros((count, self.latent_dim))
        self.latent_variances = np.ones((count, self.latent_dim))

    def _check_family(self, family: FamilyEnv) -> None:
        """
        :raises ValueError: if the model's arguments need what the family does not have
        """
        for name in ("relabel_fraction", "context_relabel_fraction", "mirror_fraction"):
            if getattr(self, name) > 0 and not family.shared_dynamics:
                raise ValueError(f"{name} must be 0: the tasks of {family.env_id} do not share dynamics")
        if self.shaping_coef > 0 and not family.has_potential:
            raise ValueError(
                f"shaping_coef must be 0: {family.env_id} has no potential; a family defines one by "
                "_potential(tasks, observations)"
            )
        if self.mirror_fraction > 0 and not family.symmetries:
            raise ValueError(
                f"mirror_fraction must be 0: {family.env_id} names no symmetries; a family of them sets `symmetries`, "
                "a tuple of poem_envs.Symmetry"
            )

    def _family_of(self, env: VecEnv) -> FamilyEnv:
        """View of an environment, which must be of the model's own family once the model has one."""
        family = FamilyEnv(env, self.horizon)
        self._check_family(family)
        if self.train_tasks is not None:
            family.check_same_family(self.task_space, self.reward_feature_dim)
        return family

    def set_env(self, env: GymEnv | VectorEnv | str, force_reset: bool = True) -> None:  # type: ignore[override]
        """Change the environment, to one of the same family with any number of copies; a registered id
        gets as many as the model has.

        :raises ValueError: if the environment is of another family; the model then keeps its own
        """
        given = self._vectorise(env, None, 1, self.n_envs)
        if given is None:
            raise TypeError("env is None, but set_env needs an environment")
        vec_env = self._wrap_env(given, self.verbose)
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
    def epoch_steps(self) -> int:
        """Environment steps of an epoch's collection."""
        assert self.train_tasks is not None
        return self._steps_of(len(self.train_tasks) * self.trajectories_per_task)

    def _steps_of(self, rollouts: int) -> int:
        """Environment steps of so many rollouts, all copies of the environment at a time."""
        n_envs = self.family.num_envs
        return -(-rollouts // n_envs) * n_envs * self.family.horizon

    @property
    def task_latents(self) -> np.ndarray:
        """Posterior means of the training tasks' latents, (n_train_tasks, latent_dim)."""
        assert self.latent_means is not None
        return self.latent_means

    @property
    def digest(self) -> str:
        """Of what adaptation uses: all networks but the critics, and the training tasks' latents."""
        state = self.policy.state_dict().items()
        used: dict[str, Any] = {name: value for name, value in state if not name.startswith("critic")}
        used |= {name: th.as_tensor(getattr(self, name)) for name in ("latent_means", "latent_variances")}
        return digest_of(used)

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

    def predicted_returns(self, latents: np.ndarray, trajectories: Iterable[Any], max_steps: int | None = None) -> np.ndarray:
        """Returns that the reward decoder predicts for trajectories, if each latent were the task's.

        :param latents: (m, latent_dim)
        :param trajectories: With ``observations`` (T + 1, obs_dim) and ``actions`` (T, action_dim) in the environment's units
        :param max_steps: Of a longer trajectory only so many steps are decoded, evenly spaced, and the sum is scaled up;
            None decodes all
        :return: (m, number of trajectories)
        """
        device, policy = self.device, self.policy
        rows: list[th.Tensor] = []
        lengths: list[int] = []
        shares: list[float] = []  # of a trajectory's steps, one over
        with th.no_grad():
            for trajectory in trajectories:
                total = len(trajectory.actions)
                steps = _evenly_spaced(total, max_steps)
                obs, next_obs = (
                    policy.standardise(th.as_tensor(trajectory.observations[at], dtype=th.float32, device=device))
                    for at in (steps, steps + 1)
                )
                actions = th.as_tensor(trajectory.actions[steps], dtype=th.float32, device=device)
                rows.append(th.cat([obs, policy.scale_action_batch(actions), next_obs], dim=1))
                lengths.append(len(steps))
                shares.append(total / max(len(steps), 1))
            latent_tensor = th.as_tensor(np.atleast_2d(latents), dtype=th.float32, device=device)
            embeddings = policy.reward_embedding(latent_tensor)
            dtype = hidden_dtype(self.precision, device.type)
            sums = decoded_sums(policy.decoder.mlp, th.cat(rows), lengths, embeddings, dtype).double()
            sums = sums * policy.reward_std + policy.reward_mean * sums.new_tensor(lengths)
            return (sums * sums.new_tensor(shares)).cpu().numpy()


def _evenly_spaced(total: int, count: int | None) -> np.ndarray:
    """At most ``count`` of ``total`` indices, at one distance, with what is left over at both ends."""
    if count is None or total <= count:
        return np.arange(total)
    distance = -(-total // count)
    chosen = np.arange(0, total, distance)
    return chosen + (total - 1 - chosen[-1]) // 2
