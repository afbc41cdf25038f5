"""POEM: meta-RL whose task embedding preserves the order of preferences."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_poem.common.buffers import Segment
from sb3_poem.common.collection import relabelled_returns
from sb3_poem.common.family_view import FamilyView
from sb3_poem.pearl_sac.collector import EpochCollector, in_waves
from sb3_poem.pearl_sac.environments import GivenEnv
from sb3_poem.pearl_sac.pearl_sac import PEARLSAC
from sb3_poem.pearl_sac.unsupported import refuse_unknown
from sb3_poem.poem_sac.objective import POEMObjective
from sb3_poem.poem_sac.policies import MlpPolicy, POEMPolicy
from sb3_poem.poem_sac.sampler import GroupSampler

SIMILARITIES = ("two-encoder", "inner")
CONTEXTS = ("optimal", "pearl")
PREFERENCE_SOURCES = ("auto", "relabel", "rollout")


class POEMSAC(PEARLSAC):
    """Preference-order-preserving embedding on soft actor-critic (POEM, Xu & Zhu, ICML 2025),
    Algorithm 1.

    On top of :class:`PEARLSAC`: a reward embedding f_r and a policy embedding f_pi of the latent,
    whose inner product orders policies as a task's preferences do (eq. 3); the preference loss that
    trains them (eqs. 6, 7); contexts of the current policies with their action values (eq. 8); an
    encoder that learns from the actor as well.

    Differences from the paper: twin target critics and a learned entropy coefficient, as SB3's SAC
    has them, instead of a value network; a replay buffer that outlives the epoch for the critics
    and the actor, while contexts and preference labels are the last epoch's only; the critics' loss
    trains the encoder too, as in PEARL.

    All arguments of :class:`PEARLSAC` but ``context_relabel_fraction`` (contexts are of the task's
    own policy, eq. 8), and:

    :param preference_coef: Weight of the preference loss
    :param similarity: "two-encoder": <f_r(z_i), f_pi(z_j)>; "inner": <z_i, z_j>, the ablation of
        Proposition 1
    :param context: "optimal": (s, a, s', r, Q); "pearl": (s, a, s', r), the ablation
    :param preference_source: Where J[i, j] comes from. "relabel": task i's reward function on task
        j's trajectories; "rollout": task j's policy is run on task i, within random groups of
        tasks, and the steps are counted; "auto": relabel where the family shares dynamics
    :param preference_group_size: Tasks whose policies are run on each other with "rollout"
    """

    zoo_name: ClassVar[str] = "poem_sac"
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}
    policy: POEMPolicy

    def __init__(
        self,
        policy: str | type[POEMPolicy],
        env: GivenEnv | None,
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
        kl_coef: float = 1.0,
        reward_coef: float = 0.2,
        policy_coef: float = 0.5,
        preference_coef: float = 6.0,
        similarity: str = "two-encoder",
        context: str = "optimal",
        preference_source: str = "auto",
        preference_group_size: int = 4,
        relabel_fraction: float = 0.0,
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
        for name, value, known in (
            ("similarity", similarity, SIMILARITIES),
            ("context", context, CONTEXTS),
            ("preference_source", preference_source, PREFERENCE_SOURCES),
        ):
            if value not in known:
                raise ValueError(
                    f"{name} must be one of {', '.join(map(repr, known))}, got {value!r}"
                )
        if not preference_coef >= 0:
            raise ValueError(f"preference_coef must be at least 0, got {preference_coef}")
        if preference_group_size < 2:
            raise ValueError(
                f"preference_group_size must be at least 2, got {preference_group_size}"
            )
        self.preference_coef = preference_coef
        self.similarity = similarity
        self.context = context
        self.preference_source = preference_source
        self.preference_group_size = preference_group_size
        #: Tasks whose policies were run on each other's in the last epoch, with returns by rollouts
        self.groups: list[np.ndarray] = []
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            gradient_steps=gradient_steps,
            ent_coef=ent_coef,
            target_update_interval=target_update_interval,
            target_entropy=target_entropy,
            n_train_tasks=n_train_tasks,
            meta_batch_size=meta_batch_size,
            context_size=context_size,
            trajectories_per_task=trajectories_per_task,
            latent_dim=latent_dim,
            kl_coef=kl_coef,
            reward_coef=reward_coef,
            policy_coef=policy_coef,
            relabel_fraction=relabel_fraction,
            reward_scale=reward_scale,
            n_steps=n_steps,
            shaping_coef=shaping_coef,
            mirror_fraction=mirror_fraction,
            noise_color=noise_color,
            policy_delay=policy_delay,
            horizon=horizon,
            precision=precision,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _complete_policy_kwargs(self) -> None:
        super()._complete_policy_kwargs()
        self.policy_kwargs["two_encoder"] = self.similarity == "two-encoder"
        self.policy_kwargs["context_has_value"] = self.context == "optimal"

    def _check_family(self, family: FamilyView) -> None:
        super()._check_family(family)
        if self.preference_source == "relabel" and not family.shared_dynamics:
            raise ValueError(
                f'preference_source must be "rollout" or "auto": the tasks of {family.env_id} do not share dynamics, '
                "so a trajectory of one cannot be relabelled for another"
            )

    def similarities(self, task_latents: np.ndarray, policy_latents: np.ndarray) -> np.ndarray:
        """S(z_i, z_j) = <f_r(z_i), f_pi(z_j)> (eq. 3): how well policy j fits task i.

        :param task_latents: (m, latent_dim)
        :param policy_latents: (n, latent_dim)
        :return: (m, n)
        """
        with th.no_grad():
            tasks, policies = (
                th.as_tensor(np.atleast_2d(latents), dtype=th.float32, device=self.device)
                for latents in (task_latents, policy_latents)
            )
            return self.policy.similarity(tasks, policies).double().cpu().numpy()

    @property
    def relabels(self) -> bool:
        """Whether J[i, j] comes from relabelling, rather than from rollouts."""
        return self.preference_source == "relabel" or (
            self.preference_source == "auto" and self.family.shared_dynamics
        )

    @property
    def epoch_steps(self) -> int:
        """Environment steps of an epoch's collection, those that compare policies included."""
        if self.relabels:
            return super().epoch_steps
        sizes = [len(group) for group in self._split(np.arange(len(self.train_tasks)))]
        return super().epoch_steps + self._steps_of(sum(size * (size - 1) for size in sizes))

    def _split(self, tasks: np.ndarray) -> list[np.ndarray]:
        """Groups of tasks, whose policies are run on each other's."""
        return np.array_split(tasks, max(1, len(tasks) // self.preference_group_size))

    def measure_returns(self, epoch: Segment, collector: EpochCollector) -> np.ndarray | None:
        """J[i, j] by relabelling or, within groups of tasks, by rollouts; see
        :meth:`PEARLSAC.measure_returns`.
        """
        if not self.relabels:
            return self._measure_by_rollouts(epoch, collector)
        tasks = self.train_tasks.tasks
        returns = relabelled_returns(
            self.family.compute_rewards, tasks, epoch.features, epoch.first_episode
        )
        return returns.reshape(len(tasks), len(tasks), -1).mean(axis=2)

    def _measure_by_rollouts(self, epoch: Segment, collector: EpochCollector) -> np.ndarray | None:
        """Run the policies of random groups of tasks on each other's tasks."""
        returns = super().measure_returns(epoch, collector)
        n_tasks = len(self.train_tasks)
        self.groups = self._split(self.generators.numpy.permutation(n_tasks))
        pairs = [(i, j) for group in self.groups for i in group for j in group if i != j]
        own_latents = epoch.latents.reshape(n_tasks, -1, self.latent_dim)[:, 0]
        for wave in in_waves(np.array(pairs, dtype=np.int64).reshape(-1, 2), self.family.num_envs):
            task_ids, policy_ids = wave.T
            segment = collector.roll_out(task_ids, own_latents[policy_ids])
            if segment is None or returns is None:
                return None
            returns[task_ids, policy_ids] = (segment.rewards * segment.first_episode).sum(axis=1)
        return returns

    def make_sampler(self) -> GroupSampler:
        """What draws meta-batches."""
        parts = vars(super().make_sampler())
        return GroupSampler(**parts, groups=self.groups, group_size=self.preference_group_size)

    def make_objective(self) -> POEMObjective:
        """What gradient steps minimise."""
        return POEMObjective(**vars(super().make_objective()), preference_coef=self.preference_coef)
