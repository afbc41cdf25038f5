"""POEM: meta-RL whose task embedding preserves the order of preferences."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from torch.autograd.function import once_differentiable
from torch.nn.functional import softplus

from sb3_poem.common.buffers import Segment
from sb3_poem.common.checks import check_choice, check_number
from sb3_poem.pearl_sac.arguments import GivenEnv, refuse_unknown, with_arguments_of
from sb3_poem.pearl_sac.collector import EpochCollector, in_waves, relabelled_returns
from sb3_poem.pearl_sac.objective import Metrics, Objective, TaskEmbeddings
from sb3_poem.pearl_sac.pearl_sac import PEARLSAC
from sb3_poem.pearl_sac.sampler import MetaBatch
from sb3_poem.poem_sac.policies import MlpPolicy, POEMPolicy

#: Arguments that are words, and which
CHOICES = {
    "similarity": ("two-encoder", "cosine", "inner"),
    "context": ("optimal", "pearl"),
}
#: About how many tasks' policies are run on each other where tasks do not share dynamics
GROUP_SIZE = 4
#: Share of the returns by rollouts that the next epoch still knows, where it measures no newer one
REMEMBERED = 0.95


@dataclass
class POEMObjective(Objective):
    """PEARL's losses and, weighted with ``preference_coef``, the preference loss."""

    actor_trains_encoder: ClassVar[bool] = True  # L_policy trains both (section 5.3)

    policy: POEMPolicy
    preference_coef: float

    def embedding_loss(
        self, batch: MetaBatch, embeddings: TaskEmbeddings
    ) -> tuple[th.Tensor, Metrics]:
        """The preference loss (eqs. 6, 7), weighted."""
        similarities = self.policy.compare(embeddings.reward, embeddings.policy)  # eq. 3
        loss, accuracy = preference_loss(similarities, batch.returns)
        metrics = {"preference_loss": loss, "preference_accuracy": accuracy}
        return self.preference_coef * loss, metrics


def preference_loss(similarity: th.Tensor, returns: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Bradley-Terry cross-entropy over all triples (i, j, k) of a meta-batch (eqs. 6 and 7 of Xu &
    Zhu 2025).

    Task i predicts that policy j is preferred over policy k with probability sigmoid(S[i, j] - S[i,
    k]); the truth is whether J[i, j] > J[i, k]. Pairs of equal or unknown return carry no order and
    are left out; without any pair the loss is 0.

    :param similarity: (tasks, tasks), S[i, j] = S(z_i, z_j)
    :param returns: (tasks, tasks), J[i, j], NaN where unknown
    :return: Loss, and the share of pairs in the right order (NaN without pairs)
    """
    return _PreferenceLoss.apply(similarity, returns)


class _PreferenceLoss(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, similarity: th.Tensor, returns: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        # (tasks i, policies j, policies k)
        margin, difference = (x[:, :, None] - x[:, None, :] for x in (similarity, returns))
        # every pair counts twice, as (j, k) and as (k, j), which changes neither of the means
        sign = difference.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0).sign_()
        agreement = margin.mul_(sign)
        ordered = sign.abs()
        n_pairs = ordered.sum()
        counted = n_pairs.clamp(min=1.0)
        # of j's similarity, over all k: (j, k) and (k, j) give the same
        ctx.gradient = (sign * th.sigmoid(-agreement)).sum(dim=2).mul_(-2.0 / counted)
        accuracy = (agreement > 0).sum() / n_pairs
        ctx.mark_non_differentiable(accuracy)
        return ordered.mul_(softplus(-agreement)).sum() / counted, accuracy

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_loss: th.Tensor, _: th.Tensor) -> tuple[th.Tensor, None]:  # type: ignore[override]
        return ctx.gradient * of_loss, None


def preference_groups(tasks: np.ndarray) -> list[np.ndarray]:
    """Groups of about :data:`GROUP_SIZE` tasks, whose policies are run on each other's."""
    return np.array_split(tasks, max(1, len(tasks) // GROUP_SIZE))


def comparing_rollouts(n_tasks: int) -> int:
    """How many rollouts of an epoch run a policy on another task of its group."""
    groups = preference_groups(np.arange(n_tasks))
    return sum(len(group) * (len(group) - 1) for group in groups)


@with_arguments_of(PEARLSAC, without="context_relabel_fraction")
class POEMSAC(PEARLSAC):
    """Preference-order-preserving embedding on soft actor-critic (POEM, Xu & Zhu, ICML 2025),
    Algorithm 1.

    On top of :class:`PEARLSAC`: a reward embedding f_r and a policy embedding f_pi of the latent,
    whose inner product orders policies as a task's preferences do (eq. 3); the preference loss that
    trains them (eqs. 6, 7); contexts of the current policies with their action values (eq. 8); an
    encoder that learns from the actor as well.

    Differences from the paper are those of SAC and PEARL: twin target critics, a learned entropy
    coefficient, a replay buffer that outlives the epoch, a critics' loss that trains the encoder.
    Of the arguments of :class:`PEARLSAC` it lacks ``context_relabel_fraction`` (``context`` says
    whose transitions contexts hold), and defaults of the losses' weights are others.

    >>> model = POEMSAC("MlpPolicy", "poem/PointGoal-v0", n_train_tasks=4, gradient_steps=1, seed=0)
    >>> model = model.learn(200)  # two epochs of four episodes; a real one takes 500 times as many
    >>> model.similarities(model.task_latents, model.task_latents).shape  # tasks, policies
    (4, 4)

    :param preference_coef: Weight of the preference loss
    :param similarity: "two-encoder": <f_r(z_i), f_pi(z_j)>; "cosine": the cosine of the angle
        between f_r(z_i) and f_pi(z_j), over a temperature, as the text of section 5.1 reads; then S
        cannot grow without end, and the tolerance of eq. 9 has a scale; "inner": <z_i, z_j>, the
        ablation of Proposition 1
    :param similarity_temperature: Of "cosine"
    :param context: "optimal": (s, a, s', r, Q) of the task's own policy (eq. 8); "pearl", the
        ablation: (s, a, s', r) as PEARL samples them, where tasks share their dynamics half of the
        contexts by other tasks' policies, as in a new task's first rollouts
    """

    zoo_name: ClassVar[str] = "poem_sac"
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": MlpPolicy}
    objective_class: ClassVar[type[Objective]] = POEMObjective
    policy: POEMPolicy

    def __init__(
        self,
        policy: str | type[POEMPolicy],
        env: GivenEnv | None,
        *args: Any,
        kl_coef: float = 0.02,
        reward_coef: float = 0.2,
        policy_coef: float = 0.5,
        preference_coef: float = 6.0,
        similarity: str = "two-encoder",
        similarity_temperature: float = 0.1,
        context: str = "optimal",
        **kwargs: Any,
    ) -> None:
        refuse_unknown(kwargs.keys() & {"context_relabel_fraction"}, type(self))
        self.preference_coef = preference_coef
        self.similarity = similarity
        self.similarity_temperature = similarity_temperature
        self.context = context
        kwargs |= {"kl_coef": kl_coef, "reward_coef": reward_coef, "policy_coef": policy_coef}
        kwargs["context_relabel_fraction"] = 0.0 if context == "optimal" else None
        super().__init__(policy, env, *args, **kwargs)

    def _check_arguments(self, given: Mapping[str, Any]) -> None:
        super()._check_arguments(given)
        check_number("preference_coef", self.preference_coef, 0.0)
        check_number("similarity_temperature", self.similarity_temperature, 1e-6)
        for name, known in CHOICES.items():
            check_choice(name, getattr(self, name), known)

    def _complete_policy_kwargs(self) -> None:
        super()._complete_policy_kwargs()
        self.policy_kwargs["two_encoder"] = self.similarity != "inner"
        cosine = self.similarity == "cosine"
        self.policy_kwargs["temperature"] = self.similarity_temperature if cosine else None
        self.policy_kwargs["context_has_value"] = self.context == "optimal"

    def similarities(self, task_latents: np.ndarray, policy_latents: np.ndarray) -> np.ndarray:
        """S(z_i, z_j) (eq. 3), how well policy j fits task i: (m, latent_dim), (n, latent_dim) ->
        (m, n).
        """
        with th.no_grad():
            given = map(np.atleast_2d, (task_latents, policy_latents))
            tasks, policies = map(self.policy.tensor, given)
            return self.policy.similarity(tasks, policies).double().cpu().numpy()

    @property
    def epoch_steps(self) -> int:
        """Environment steps of an epoch's collection, those that compare policies included."""
        if self.family.shared_dynamics:
            return super().epoch_steps
        return super().epoch_steps + self._steps_of(comparing_rollouts(len(self.train_tasks)))

    def measure_returns(self, epoch: Segment, collector: EpochCollector) -> np.ndarray:
        """J[i, j] by task i's reward function on task j's trajectories where tasks share dynamics;
        else by running task j's policy on task i, within random groups of tasks: what earlier
        epochs measured is forgotten bit by bit, 1 in 20 an epoch.
        """
        family, tasks, n_tasks = self.family, self.train_tasks.tasks, len(self.train_tasks)
        if family.shared_dynamics:
            steps = (epoch.features, epoch.first_episode)
            relabelled = relabelled_returns(family.compute_rewards, tasks, *steps)
            return relabelled.reshape(n_tasks, n_tasks, -1).mean(axis=2)
        returns = super().measure_returns(epoch, collector)
        shuffled = self.generators.numpy.permutation(n_tasks)
        pairs = [
            (i, j) for group in preference_groups(shuffled) for i in group for j in group if i != j
        ]
        own_latents = epoch.latents.reshape(n_tasks, -1, self.latent_dim)[:, 0]
        for wave in in_waves(np.array(pairs, dtype=np.int64).reshape(-1, 2), family.num_envs):
            task_ids, policy_ids = wave.T
            segment = collector.roll_out(task_ids, own_latents[policy_ids])
            returns[task_ids, policy_ids] = (segment.rewards * segment.first_episode).sum(axis=1)
        if self.epoch_context is not None:  # which forgets, since policies change
            before = self.epoch_context.returns.cpu().numpy()
            remembered = self.generators.numpy.random(returns.shape) < REMEMBERED
            returns = np.where(np.isnan(returns) & remembered, before, returns)
        return returns
