"""MAML-reward: the answers adapt the reward, and SAC learns from what was shown."""

import contextlib
import copy
import random
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed

from sb3_poem.adaptation import Answer, Inference, Rule, Setting
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.rule import Shown
from sb3_poem.baselines.fragments import check_shared_dynamics, standardised
from sb3_poem.baselines.meta_reward import MetaReward
from sb3_poem.common.checks import check_whole
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.pearl_sac import PEARLSAC


class MAMLRewardModel(MetaModel):
    """A meta-trained reward with the face of a model. Its policies are SAC's after so many answers
    to some task; a "latent" holds the number of one, and the sign, 1 or -1, with which exploration
    noise is added: so two rollouts of one policy from equal seeds differ.

    >>> from sb3_poem import PEARLSAC
    >>> from sb3_poem.baselines import meta_train_reward
    >>> small = dict(n_train_tasks=4, gradient_steps=2, seed=0)
    >>> pearl = PEARLSAC("MlpPolicy", "poem/PointGoal-v0", **small).learn(200)
    >>> MAMLRewardModel(meta_train_reward(pearl, n_iterations=1), pearl)
    MAMLRewardModel(poem/PointGoal-v0)

    :param model: The :class:`PEARLSAC` that the reward was meta-trained with.
    """

    latent_dim = 2
    observation_space: Any = None
    action_space: Any = None
    horizon: int = 0
    env_id: str | None = None

    def __init__(self, reward: MetaReward, model: PEARLSAC) -> None:
        self.reward = reward
        self.observation_space, self.action_space = model.observation_space, model.action_space
        self.horizon, self.env_id = model.horizon or 0, model.env_id
        self.actors: list[Any] = []

    def __repr__(self) -> str:
        return f"MAMLRewardModel({self.env_id})"

    @property
    def digest(self) -> str:
        return self.reward.digest

    def sample_latents(self, n: int, rng: np.random.Generator, source: str = "prior") -> np.ndarray:
        raise NotImplementedError("a MAMLRewardModel has no policies before the first answer")

    def add(self, actor: Any) -> np.ndarray:
        """Keep a copy of an actor, and give its latent (2,)."""
        self.actors.append(copy.deepcopy(actor).eval())
        return np.array([len(self.actors) - 1, 1.0])

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """SB3's, with latents (2,) or (n, 2) as state."""
        obs = np.atleast_2d(np.asarray(observation, dtype=np.float32))
        latents = np.broadcast_to(np.asarray(state, dtype=np.float64), (len(obs), 2))
        policy = self.reward.policy
        actions = np.empty((len(obs), *self.action_space.shape), dtype=np.float32)
        with th.no_grad():
            inputs = policy.standardise(th.as_tensor(obs, device=policy.device))
            noise = th.randn(actions.shape)
            for number in np.unique(latents[:, 0]).astype(int):
                rows = np.flatnonzero(latents[:, 0] == number)
                mean, log_std, _ = self.actors[number].get_action_dist_params(inputs[rows].cpu())
                if not deterministic:
                    sign = th.as_tensor(latents[rows, 1:], dtype=th.float32)
                    mean = mean + sign * log_std.exp() * noise[rows]
                actions[rows] = mean.tanh().numpy()
        space = self.action_space
        actions = np.clip(policy.unscale_action(actions), space.low, space.high)
        return (actions[0] if np.ndim(observation) == 1 else actions), state


@dataclass(frozen=True, repr=False)
class MAMLReward(Rule):
    """MAML-reward (Hejna & Sadigh 2023): a meta-trained reward is adapted to the answers, and SB3's
    SAC learns the policy on it from the trajectories that were shown. The model is a
    :class:`MAMLRewardModel`, the options are SAC's.

    After each answer the reward is adapted anew to all answers, everything that was shown is
    relabelled with it, and SAC goes on learning from that; a saved adaptation keeps no networks.

    >>> from sb3_poem import PEARLSAC, PreferenceAdapter, ReturnOracle
    >>> from sb3_poem.baselines import meta_train_reward
    >>> env_id, small = "poem/PointGoal-v0", dict(n_train_tasks=4, gradient_steps=2, seed=0)
    >>> pearl = PEARLSAC("MlpPolicy", env_id, **small).learn(200)
    >>> model = MAMLRewardModel(meta_train_reward(pearl, n_iterations=1), pearl)
    >>> rule = MAMLReward(gradient_steps=1)
    >>> adapter = PreferenceAdapter(model, env_id, rule=rule, oracle=ReturnOracle(), n_queries=1)
    >>> policy = adapter.adapt()
    """

    gradient_steps: int = 200
    batch_size: int = 128
    learning_rate: float = 1e-3
    gamma: float = 0.99

    explores = True
    refuses_library = "SAC learns from rollouts on the new task"

    def __post_init__(self) -> None:
        for name in ("gradient_steps", "batch_size"):
            check_whole(name, getattr(self, name), 1)
        if not self.learning_rate > 0:
            raise ValueError(f"`learning_rate` must be positive, but is {self.learning_rate}")
        if not 0.0 <= self.gamma <= 1.0:
            raise ValueError(f"`gamma` must lie in [0, 1], but is {self.gamma}")

    def check(self, model: MetaModel, setting: Setting) -> None:
        """See :class:`Rule`: it needs a meta-trained reward, and tasks that share dynamics."""
        if not isinstance(model, MAMLRewardModel):
            raise ValueError(
                f"`model` must be a MAMLRewardModel, but is of type {type(model).__name__}; make "
                "one by MAMLRewardModel(meta_train_reward(model), model)"
            )
        super().check(model, setting)
        why = "MAML-reward's network was trained on what tasks say of each other's fragments"
        check_shared_dynamics(setting, why)

    def start(self, model: Any, rng: np.random.Generator, setting: Setting) -> Inference:
        return MAMLRewardInference(self, model, rng, setting.n_queries)


class MAMLRewardInference(Inference):
    """See :class:`MAMLReward`."""

    state = ("seed",)

    def __init__(
        self, rule: MAMLReward, model: MAMLRewardModel, rng: np.random.Generator, n_queries: int
    ) -> None:
        super().__init__(rng)
        self.rule, self.model, self.n_queries = rule, model, n_queries
        self.seed = np.array([rng.integers(2**31)])
        self._restart()

    def _restart(self) -> None:
        self.answers = []
        with _seeded(int(self.seed[0])):
            self.sac = _make_sac(self.model, self.rule, self.n_queries)
        self.latent = self.model.add(self.sac.actor)

    def ask(self) -> tuple[Shown, Shown]:
        """The current policy twice, with opposite exploration noise."""
        return self.latent.copy(), self.latent * np.array([1.0, -1.0])

    def same_latents(self, *latents: np.ndarray) -> tuple[Shown, ...]:
        """The current policy, whose number in the file was another."""
        return self.ask()

    def tell(self, preference: Preference, *shown: Any) -> None:
        self.answers.append(Answer(preference, shown))
        seen = [one for each in self.answers for one in each.shown]
        parameters = self.model.reward.adapted(self.answers)
        rewards = [self.model.reward.rewards(parameters, trajectory) for trajectory in seen]
        # Preferences fix no unit; SAC's entropy needs one.
        scale = max(float(np.concatenate(rewards).std()), 1e-6)
        with _seeded(int(self.seed[0]) + len(self.answers)):
            self._fill_buffer(seen, [row / scale for row in rewards])
            self.sac.train(self.rule.gradient_steps, self.rule.batch_size)
        self.latent = self.model.add(self.sac.actor)

    def estimate(self) -> np.ndarray:
        return self.latent.copy()

    def restore(self, snapshot: dict[str, Any], answers: list[Answer]) -> None:
        """Tells the answers again."""
        super().restore(snapshot, [])
        self._restart()
        for answer in answers:
            self.tell(answer.preference, *answer.shown)

    def _fill_buffer(self, shown: list[Trajectory], rewards: list[np.ndarray]) -> None:
        buffer, policy = self.sac.replay_buffer, self.model.reward.policy
        assert buffer is not None
        buffer.reset()
        for trajectory, row in zip(shown, rewards, strict=True):
            obs = standardised(policy, trajectory).cpu().numpy()
            actions = policy.scale_action(trajectory.actions)
            # Nothing ends but by the time limit, unless an episode is shorter than that.
            done = np.zeros(len(row), dtype=bool)
            done[-1] = len(row) < self.model.horizon
            for t in range(len(row)):
                buffer.add(obs[t], obs[t + 1], actions[t], row[t], done[t : t + 1], [{}])


def _make_sac(model: MAMLRewardModel, rule: MAMLReward, n_queries: int) -> SAC:
    """SAC without an environment: it learns from trajectories that it is given."""
    sac = SAC(
        "MlpPolicy",
        None,  # type: ignore[arg-type]
        learning_rate=rule.learning_rate,
        gamma=rule.gamma,
        buffer_size=2 * n_queries * model.horizon,
        target_entropy=-float(np.prod(model.action_space.shape)),
        device="cpu",
        _init_setup_model=False,
    )
    sac.observation_space, sac.action_space = model.observation_space, model.action_space
    sac.n_envs = 1
    sac._setup_model()
    sac.set_logger(Logger(None, []))
    return sac


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """SB3 draws from the global generators: seed them, and hand them back as they were."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002
    with th.random.fork_rng():
        set_random_seed(seed)
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002
