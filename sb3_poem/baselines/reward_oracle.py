"""PEARL's own adaptation, which sees rewards at test time (Rakelly et al. 2019)."""

from dataclasses import dataclass

import numpy as np
import torch as th

from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.oracles import step_rewards
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.priors import N_CENTRES, SOURCES
from sb3_poem.adaptation.rule import Answer, Inference, Rule, Setting, Shown, seen
from sb3_poem.baselines.fragments import transition_rows
from sb3_poem.common.checks import check_choice
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.pearl_sac import PEARLSAC


@dataclass(frozen=True, repr=False)
class RewardOracle(Rule):
    """The reference that sees the new task's rewards: as many rollouts as the others, two for each
    question, by posterior sampling (Rakelly et al. 2019). Answers are not looked at. The model is a
    ``PEARLSAC``, or a ``POEMSAC`` with ``context="pearl"``.

    A context has no more transitions than in training, for the posterior, a product over them,
    would be too sure of more: what was collected is dealt out to as many contexts as it fills, and
    their posteriors' means and variances are averaged.

    >>> from sb3_poem import PEARLSAC, PreferenceAdapter, ReturnOracle
    >>> small = dict(n_train_tasks=4, gradient_steps=2, seed=0)
    >>> pearl = PEARLSAC("MlpPolicy", "poem/PointGoal-v0", **small).learn(200)
    >>> who = dict(rule=RewardOracle(), oracle=ReturnOracle(), n_queries=2)
    >>> policy = PreferenceAdapter(pearl, "poem/PointGoal-v0", **who).adapt()

    :param candidates: Where the first question's latents come from, and what is acted on before it:
        "prior" (N(0, I)), or "aggregate", the mean and variance of the training tasks' posteriors.
    """

    candidates: str = "prior"

    refuses_library = "the reward oracle learns from rollouts on the new task"

    def __post_init__(self) -> None:
        check_choice("candidates", self.candidates, SOURCES)

    def check(self, model: MetaModel, setting: Setting) -> None:
        """See :class:`Rule`: it needs an encoder of rewarded transitions, and rewards to read."""
        super().check(model, setting)
        name = type(model).__name__
        if not isinstance(model, PEARLSAC):
            raise ValueError(
                f"`model` needs a context encoder, which {name} does not have; pass a PEARLSAC"
            )
        if model.policy.context_has_value:
            raise ValueError(
                f"`model` needs an encoder of (s, a, s', r), but this {name}'s context also holds "
                "values of the task's own policy (eq. 8), which a new task does not have; pass a "
                "PEARLSAC"
            )
        if model.context_reward_statistics is None:
            raise ValueError(
                "`model` does not know how its contexts' rewards were standardised; train it for "
                "an epoch first"
            )
        if setting.env is None:
            raise ValueError("the reward oracle needs `env`, to read its rewards")
        FamilyView(setting.env)  # which refuses what is no family

    def start(self, model: MetaModel, rng: np.random.Generator, setting: Setting) -> Inference:
        assert isinstance(model, PEARLSAC)
        inference = RewardInference(model, rng, setting)
        if self.candidates == "aggregate":
            latents = model.sample_latents(N_CENTRES, rng, source="aggregate")
            inference.mean, inference.variance = latents.mean(axis=0), latents.var(axis=0)
        return inference


class RewardInference(Inference):
    """See :class:`RewardOracle`."""

    state = ("mean", "variance", "transitions")

    def __init__(self, model: PEARLSAC, rng: np.random.Generator, setting: Setting) -> None:
        super().__init__(rng)
        self.model, self._env, self._task = model, setting.env, setting.task
        self.mean, self.variance = np.zeros(model.latent_dim), np.ones(model.latent_dim)
        self.transitions: np.ndarray = np.empty((0, 0), dtype=np.float32)

    def ask(self) -> tuple[Shown, Shown]:
        """Two draws from the posterior."""
        noise = self.rng.standard_normal((2, len(self.mean)))
        left, right = self.mean + np.sqrt(self.variance) * noise
        return left, right

    def tell(self, preference: Preference, *shown: Shown) -> None:
        """Looks at the rewards of both trajectories, not at the answer."""
        rows = np.concatenate([self._context_rows(item) for item in seen(shown)])
        self.answers.append(Answer(preference, shown))
        self.transitions = np.vstack([self.transitions.reshape(-1, rows.shape[1]), rows])
        n = min(self.model.context_size, len(self.transitions))
        dealt = self.rng.permutation(len(self.transitions))[: len(self.transitions) // n * n]
        # (contexts, n, context_dim)
        contexts = th.as_tensor(self.transitions[dealt.reshape(-1, n)], device=self.model.device)
        with th.no_grad():
            mean, variance = self.model.policy.encoder(contexts)
        self.mean = mean.double().mean(dim=0).cpu().numpy()
        self.variance = variance.double().mean(dim=0).cpu().numpy()

    def estimate(self) -> np.ndarray:
        return self.mean.copy()

    def _context_rows(self, shown: Trajectory) -> np.ndarray:
        """(T, context_dim) standardised (s, a, s', r), as in training."""
        statistics = self.model.context_reward_statistics
        assert self._env is not None
        assert statistics is not None
        centre, deviation = statistics
        rewards = (step_rewards(self._env, self._task, shown) - centre) / deviation
        return transition_rows(self.model.policy, shown, rewards).cpu().numpy()
