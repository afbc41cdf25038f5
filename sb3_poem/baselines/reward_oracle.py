"""What could be had if rewards were seen at test time: PEARL's own adaptation (Rakelly et al.
2019).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th

from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.oracles import step_rewards
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.rule import Answer, Inference, Rule, Setting, Shown, trajectories_of
from sb3_poem.baselines.transitions import transition_rows
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.pearl_sac import PEARLSAC

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


@dataclass(frozen=True, repr=False)
class RewardOracle(Rule):
    """The reference that sees the new task's rewards: as many rollouts as the others, two for each
    question, by posterior sampling (Rakelly et al. 2019). Answers are taken and not looked at.

    Latents are drawn from the posterior, rolled out, and the encoder gives the next posterior from
    what was collected. A context has no more transitions than in training: the posterior is a
    product over them, and would be too sure of more.

    It is as good as the encoder, whose contexts in training are of the tasks' own policies: where
    it reads the task from what was done rather than from the rewards, contexts of other policies
    mislead it. The model is a ``PEARLSAC`` (not a ``POEMSAC`` whose context holds values), and the
    environment a task family, from which rewards are read.
    """

    refuses_library = "the reward oracle learns from rollouts on the new task"

    def check(self, model: MetaModel, setting: Setting) -> None:
        """See :class:`Rule`: it needs an encoder of rewarded transitions, and rewards to read."""
        super().check(model, setting)
        name = type(model).__name__
        if not isinstance(model, PEARLSAC):
            lacks = f"needs a context encoder, which {name} does not have"
            raise ValueError(f"`model` {lacks}; pass a PEARLSAC")
        if model.policy.context_has_value:
            raise ValueError(
                f"`model` needs an encoder of (s, a, s', r), but this {name}'s context also holds "
                "values of the task's own policy (eq. 8), which a new task does not have; pass a "
                "PEARLSAC"
            )
        if model.context_reward_statistics is None:
            lacks = "does not know how its contexts' rewards were standardised"
            raise ValueError(f"`model` {lacks}; train it for an epoch first")
        FamilyView(_env_of(setting))  # which refuses what is no family

    def start(self, model: Any, rng: np.random.Generator, setting: Setting) -> RewardInference:
        return RewardInference(model, rng, _env_of(setting), setting.task)


class RewardInference(Inference):
    """See :class:`RewardOracle`; a task of None is the one in effect in ``env``, whose rewards are
    read.
    """

    state = ("mean", "variance", "transitions")

    def __init__(
        self, model: Any, rng: np.random.Generator, env: VecEnv, task: np.ndarray | None
    ) -> None:
        super().__init__(rng)
        self.model = model
        self.mean, self.variance = np.zeros(model.latent_dim), np.ones(model.latent_dim)
        self.transitions: np.ndarray = np.empty((0, 0), dtype=np.float32)
        self._env, self._task = env, task

    def ask(self) -> tuple[Shown, Shown]:
        """See :class:`Inference`: two draws from the posterior, at first from the prior."""
        noise = self.rng.standard_normal((2, len(self.mean)))
        left, right = self.mean + np.sqrt(self.variance) * noise
        return left, right

    def tell(self, preference: Preference, left: Shown, right: Shown) -> None:
        """See :class:`Inference`. The answer is not looked at, the rewards of both trajectories
        are.
        """
        shown = trajectories_of("the reward oracle", left, right)
        rows = np.concatenate([self._context_rows(item) for item in shown])
        self.answers.append(Answer(preference, left, right))
        before = [self.transitions] if len(self.transitions) else []
        self.transitions = np.concatenate([*before, rows])
        n = min(self.model.context_size, len(self.transitions))
        picks = self.rng.choice(len(self.transitions), size=n, replace=False)
        with th.no_grad():
            context = th.as_tensor(self.transitions[picks], device=self.model.device)[None]
            mean, variance = self.model.policy.encoder(context)
        self.mean = mean[0].double().cpu().numpy()
        self.variance = variance[0].double().cpu().numpy()

    def estimate(self) -> np.ndarray:
        return self.mean.copy()

    def _context_rows(self, shown: Trajectory) -> np.ndarray:
        """(T, context_dim) standardised (s, a, s', r), as in training."""
        centre, deviation = self.model.context_reward_statistics
        rewards = (step_rewards(self._env, self._task, shown) - centre) / deviation
        return transition_rows(self.model.policy, shown, rewards).cpu().numpy()


def _env_of(setting: Setting) -> VecEnv:
    if setting.env is None:
        raise ValueError("the reward oracle needs `env`, to read its rewards")
    return setting.env
