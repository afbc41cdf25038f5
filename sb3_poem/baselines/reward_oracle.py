"""What could be had if rewards were seen at test time: PEARL's own adaptation (Rakelly et al.
2019).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
import torch as th

from sb3_poem.adaptation.adapter import Oracle, PreferenceAdapter
from sb3_poem.adaptation.environments import Env, check_model_fits
from sb3_poem.adaptation.inference import Answer, LatentInference, Shown
from sb3_poem.adaptation.oracles import step_rewards
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.state import plain
from sb3_poem.common.checks import check_whole
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.trajectory import Trajectory

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


@dataclass(frozen=True)
class RewardOracleOptions:
    """How the reward oracle adapts; the arguments are explained at :class:`RewardOracleAdapter`."""

    n_queries: int = 10
    deterministic: bool = True

    def __post_init__(self) -> None:
        check_whole("n_queries", self.n_queries, 1)

    def check(
        self, model: Any, vec_env: VecEnv, library: Sequence[Trajectory] | None = None
    ) -> None:
        """Refuse what the reward oracle cannot run with.

        :param vec_env: The environment to adapt in.
        :param library: Not taken.
        :raises ValueError: If the model has no encoder of rewarded transitions, or the environment
            no reward to read.
        """
        check_model_fits(model, vec_env)
        if library is not None:
            raise ValueError(
                "`library` must be None: the reward oracle learns from rollouts on the new task"
            )
        if not hasattr(getattr(model, "policy", None), "encoder"):
            raise ValueError(
                f"`model` needs a context encoder, which {type(model).__name__} does not have; pass a PEARLSAC"
            )
        if model.policy.context_has_value:
            raise ValueError(
                f"`model` needs an encoder of (s, a, s', r), but this {type(model).__name__}'s context also holds values of "
                "the task's own policy (eq. 8), which a new task does not have; pass a PEARLSAC"
            )
        if model.context_reward_statistics is None:
            raise ValueError(
                "`model` does not know how its contexts' rewards were standardised; train it for an epoch first"
            )
        FamilyView(vec_env)  # which refuses what is no family

    def make_inference(
        self, model: Any, rng: np.random.Generator, library: Sequence[Trajectory] | None = None
    ) -> RewardInference:
        """The inference that these options describe.

        :param model: A trained model.
        :param rng: Its generator.
        :param library: Not taken, see :meth:`check`.
        :return: The inference.
        """
        return RewardInference(model, rng)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return plain(asdict(self))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> RewardOracleOptions:
        """Read what :meth:`to_dict` wrote.

        :param data: The dictionary.
        :return: The options.
        """
        return cls(**data)


class RewardInference(LatentInference):
    """Posterior sampling: latents are drawn from the posterior, rolled out, and the encoder gives
    the next posterior from what was collected. A context has no more transitions than in training:
    the posterior is a product over them, and would be too sure of more.

    :param model: A trained ``PEARLSAC``.
    :param rng: The only source of randomness.
    """

    def __init__(self, model: Any, rng: np.random.Generator) -> None:
        self.model = model
        self.rng = rng
        self.answers: list[Answer] = []
        self.mean, self.variance = np.zeros(model.latent_dim), np.ones(model.latent_dim)
        self.transitions: np.ndarray = np.empty((0, 0), dtype=np.float32)
        self._env: gym.Env | VecEnv | None = None
        self._task: np.ndarray | None = None

    def bind(self, env: gym.Env | VecEnv, task: np.ndarray | None = None) -> None:
        """Say whose rewards to read.

        :param env: The task family.
        :param task: (task_dim,); None takes the one in effect in ``env``.
        """
        self._env, self._task = env, task

    def ask_latents(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`LatentInference`: two draws from the posterior, at first from the prior."""
        left, right = self.mean + np.sqrt(self.variance) * self.rng.standard_normal(
            (2, len(self.mean))
        )
        return left, right

    def tell(self, preference: Preference, left: Shown, right: Shown) -> None:
        """See :class:`LatentInference`. The answer is not looked at, the rewards of both
        trajectories are.

        :raises ValueError: If no trajectories with reward features are given.
        :raises RuntimeError: Before :meth:`bind`.
        """
        self.answers.append(Answer(preference, left, right))
        rows = np.concatenate([self._context_rows(shown) for shown in (left, right)])
        self.transitions = (
            rows if not len(self.transitions) else np.concatenate([self.transitions, rows])
        )
        n = min(self.model.context_size, len(self.transitions))
        picks = self.rng.choice(len(self.transitions), size=n, replace=False)
        with th.no_grad():
            context = th.as_tensor(self.transitions[picks], device=self.model.device)[None]
            mean, variance = self.model.policy.encoder(context)
        self.mean, self.variance = (
            mean[0].double().cpu().numpy(),
            variance[0].double().cpu().numpy(),
        )

    def estimate(self) -> np.ndarray:
        """See :class:`LatentInference`: the posterior's mean."""
        return self.mean.copy()

    def _context_rows(self, shown: Shown) -> np.ndarray:
        """(T, context_dim) standardised (s, a, s', r), as in training."""
        if not isinstance(shown, Trajectory):
            raise ValueError(
                "the reward oracle needs the two trajectories that were rolled out, not their latents alone"
            )
        if self._env is None:
            raise RuntimeError(
                "the reward oracle has no environment to read rewards from: call bind(env)"
            )
        policy, device = self.model.policy, self.model.device
        centre, deviation = self.model.context_reward_statistics
        rewards = (step_rewards(self._env, self._task, shown) - centre) / deviation
        with th.no_grad():
            obs = policy.standardise(
                th.as_tensor(shown.observations, dtype=th.float32, device=device)
            )
            actions = policy.scale_action_batch(
                th.as_tensor(shown.actions, dtype=th.float32, device=device)
            )
            column = th.as_tensor(rewards, dtype=th.float32, device=device)[:, None]
            return th.cat([obs[:-1], actions, obs[1:], column], dim=1).cpu().numpy()

    def _arrays(self) -> dict[str, np.ndarray]:
        return {"mean": self.mean, "variance": self.variance, "transitions": self.transitions}

    def _set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        self.mean, self.variance, self.transitions = (
            arrays["mean"],
            arrays["variance"],
            arrays["transitions"],
        )


class RewardOracleAdapter(PreferenceAdapter):
    """The reference that sees the new task's rewards, with the face of :class:`PreferenceAdapter`:
    as many rollouts as the others, two for each question, by posterior sampling. Answers are taken
    and not looked at.

    It is as good as the encoder, whose contexts in training are of the tasks' own policies: where
    it reads the task from what was done rather than from the rewards, contexts of other policies
    mislead it.

    :param model: A trained ``PEARLSAC`` (not a ``POEMSAC`` whose context holds values).
    :param env: See :class:`PreferenceAdapter`; a task family, from which rewards are read.
    :param n_queries: How many pairs of rollouts there are at most (K).
    :param oracle: See :class:`PreferenceAdapter`.
    :param seed: See :class:`PreferenceAdapter`.
    :param deterministic: Whether policies act by their mode.
    :raises ValueError: If an argument is out of its range, or the model or environment does not do,
        see :meth:`RewardOracleOptions.check`.
    """

    options_class: ClassVar[Any] = RewardOracleOptions

    def __init__(
        self,
        model: Any,
        env: Env,
        *,
        n_queries: int = 10,
        oracle: Oracle | None = None,
        seed: int | None = None,
        deterministic: bool = True,
    ) -> None:
        self._start(model, env, RewardOracleOptions(n_queries, deterministic), oracle, seed, None)

    @classmethod
    def make_options(cls, oracle: Any = None, **options: Any) -> RewardOracleOptions:
        """See :class:`PreferenceAdapter`.

        :param oracle: Not looked at.
        :param options: Those of the constructor.
        :return: The options.
        """
        return RewardOracleOptions(**options)
