"""MAML-reward as an adapter: the answers adapt the reward, and SAC learns from what was shown."""

from __future__ import annotations

import contextlib
import copy
import random
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

from sb3_poem.adaptation.adapter import Oracle, PreferenceAdapter
from sb3_poem.adaptation.environments import Env, check_model_fits
from sb3_poem.adaptation.inference import Answer, LatentInference, Shown, Snapshot
from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.state import plain
from sb3_poem.baselines.maml_reward import JudgedPair, MetaReward
from sb3_poem.common.checks import check_whole
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.trajectory import Trajectory

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


class MAMLRewardModel:
    """A meta-trained reward with the face of a model. Its policies are SAC's after so many answers
    to some task; a "latent" names one by its number, and says with its second entry, 1 or -1, with
    which sign exploration noise is added: so two rollouts of one policy from equal seeds differ.

    :param reward: The meta-trained reward.
    :param model: The :class:`PEARLSAC` that it was meta-trained with, for spaces and horizon.
    """

    latent_dim = 2

    def __init__(self, reward: MetaReward, model: Any) -> None:
        self.reward = reward
        self.observation_space, self.action_space = model.observation_space, model.action_space
        self.horizon, self.env_id = model.horizon, getattr(model, "env_id", None)
        self.actors: list[Any] = []

    def __repr__(self) -> str:
        return f"MAMLRewardModel({self.env_id})"

    @property
    def digest(self) -> str:
        """Of the meta-trained reward's numbers."""
        return self.reward.digest

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
        """Act, as SB3's ``predict``.

        :param observation: (obs_dim,) or (n, obs_dim).
        :param state: (2,), or one for each observation (n, 2).
        :param episode_start: Ignored.
        :param deterministic: Whether to take the mode.
        :return: Actions in the environment's units, and the state.
        """
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
                    mean = (
                        mean
                        + th.as_tensor(latents[rows, 1:], dtype=th.float32)
                        * log_std.exp()
                        * noise[rows]
                    )
                actions[rows] = mean.tanh().numpy()
        actions = np.clip(
            policy.unscale_action(actions), self.action_space.low, self.action_space.high
        )
        return (actions[0] if np.ndim(observation) == 1 else actions), state


@dataclass(frozen=True)
class MAMLRewardOptions:
    """How MAML-reward adapts; the arguments are explained at :class:`MAMLRewardAdapter`."""

    n_queries: int = 10
    gradient_steps: int = 200
    batch_size: int = 128
    learning_rate: float = 1e-3
    gamma: float = 0.99

    #: Questions show exploring policies: nothing else brings SAC its experience.
    deterministic: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name in ("n_queries", "gradient_steps", "batch_size"):
            check_whole(name, getattr(self, name), 1)
        if not self.learning_rate > 0:
            raise ValueError(f"`learning_rate` must be positive, but is {self.learning_rate}")
        if not 0.0 <= self.gamma <= 1.0:
            raise ValueError(f"`gamma` must lie in [0, 1], but is {self.gamma}")

    def check(
        self, model: Any, vec_env: VecEnv, library: Sequence[Trajectory] | None = None
    ) -> None:
        """Refuse what MAML-reward cannot run with.

        :param vec_env: The environment to adapt in.
        :param library: Not taken.
        :raises ValueError: Without a meta-trained reward, and for a family whose tasks do not share
            their dynamics.
        """
        if not isinstance(model, MAMLRewardModel):
            raise ValueError(
                f"`model` must be a MAMLRewardModel, but is of type {type(model).__name__}; make one by "
                "MAMLRewardModel(meta_train_reward(model), model)"
            )
        check_model_fits(model, vec_env)
        if library is not None:
            raise ValueError("`library` must be None: SAC learns from rollouts on the new task")
        family = FamilyView.of(vec_env)
        if family is not None and not family.shared_dynamics:
            raise ValueError(
                "`env` must be of a family whose tasks share their dynamics: MAML-reward's network was trained on what "
                "tasks say of each other's fragments"
            )

    def make_inference(
        self, model: Any, rng: np.random.Generator, library: Sequence[Trajectory] | None = None
    ) -> MAMLRewardInference:
        """The inference that these options describe.

        :param model: A :class:`MAMLRewardModel`.
        :param rng: Its generator.
        :param library: Not taken, see :meth:`check`.
        :return: The inference.
        """
        return MAMLRewardInference(model, self, rng)

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return plain(asdict(self))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> MAMLRewardOptions:
        """Read what :meth:`to_dict` wrote.

        :param data: The dictionary.
        :return: The options.
        """
        return cls(**data)


class MAMLRewardInference(LatentInference):
    """After each answer the reward is adapted anew from the meta-trained start to all answers,
    everything that was shown is relabelled with it, and SAC goes on learning from that.

    What is learnt follows from the seed and the answers alone, so a saved adaptation keeps no
    networks: they are learnt again.

    :param rng: Seeds SAC.
    """

    def __init__(
        self, model: MAMLRewardModel, options: MAMLRewardOptions, rng: np.random.Generator
    ) -> None:
        self.model = model
        self.options = options
        self.rng = rng
        self.seed = int(rng.integers(2**31))
        self._restart()

    def _restart(self) -> None:
        self.answers: list[Answer] = []
        with _seeded(self.seed):
            self.sac = _make_sac(self.model, self.options)
        self.latent = self.model.add(self.sac.actor)

    def ask_latents(self) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`LatentInference`: the current policy twice, with opposite exploration noise."""
        return self.latent.copy(), self.latent * np.array([1.0, -1.0])

    def same_latents(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`LatentInference`: the current policy, which has another number here than in
        the file.
        """
        return self.ask_latents()

    def tell(self, preference: Preference, left: Shown, right: Shown) -> None:
        """See :class:`LatentInference`.

        :raises ValueError: If no trajectories are given.
        """
        if not (isinstance(left, Trajectory) and isinstance(right, Trajectory)):
            raise ValueError(
                "MAML-reward needs the two trajectories that were shown, not their latents alone"
            )
        self.answers.append(Answer(preference, left, right))
        judged = [JudgedPair(a.preference, a.left, a.right) for a in self.answers]  # type: ignore[arg-type]
        parameters = self.model.reward.adapted(judged)
        shown = [trajectory for pair in judged for trajectory in (pair.left, pair.right)]
        rewards = [self.model.reward.rewards(parameters, trajectory) for trajectory in shown]
        scale = max(
            float(np.concatenate(rewards).std()), 1e-6
        )  # preferences fix no unit; SAC's entropy needs one
        with _seeded(self.seed + len(self.answers)):
            self._fill_buffer(shown, [row / scale for row in rewards])
            self.sac.train(self.options.gradient_steps, self.options.batch_size)
        self.latent = self.model.add(self.sac.actor)

    def estimate(self) -> np.ndarray:
        """See :class:`LatentInference`: the latest policy."""
        return self.latent.copy()

    def restore(self, snapshot: Snapshot, answers: list[Answer]) -> None:
        """See :class:`LatentInference`: the answers are told again."""
        self.seed = int(snapshot.arrays["seed"][0])
        super().restore(snapshot, [])
        self._restart()
        for answer in answers:
            self.tell(answer.preference, answer.left, answer.right)

    def _fill_buffer(self, shown: list[Trajectory], rewards: list[np.ndarray]) -> None:
        buffer, policy = self.sac.replay_buffer, self.model.reward.policy
        assert buffer is not None
        buffer.reset()
        for trajectory, row in zip(shown, rewards, strict=True):
            with th.no_grad():
                obs = policy.standardise(
                    th.as_tensor(trajectory.observations, dtype=th.float32, device=policy.device)
                )
            obs, actions = obs.cpu().numpy(), policy.scale_action(trajectory.actions)
            # Nothing ends but by the time limit, unless an episode is shorter than that.
            ended = len(trajectory) < self.model.horizon
            for t in range(len(trajectory)):
                done = ended and t == len(trajectory) - 1
                buffer.add(obs[t], obs[t + 1], actions[t], row[t], np.array([done]), [{}])

    def _arrays(self) -> dict[str, np.ndarray]:
        return {"seed": np.array([self.seed])}

    def _set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        self.seed = int(arrays["seed"][0])


class MAMLRewardAdapter(PreferenceAdapter):
    """Adapts by MAML-reward (Hejna & Sadigh 2023), with the face of :class:`PreferenceAdapter`: a
    meta-trained reward is adapted to the answers, and SB3's SAC learns the policy on it from the
    trajectories that were shown, at most 2 K.

    :param model: A :class:`MAMLRewardModel`.
    :param env: See :class:`PreferenceAdapter`.
    :param n_queries: How many answers are asked for at most (K).
    :param gradient_steps: SAC's gradient steps after each answer.
    :param batch_size: SAC's.
    :param learning_rate: SAC's.
    :param gamma: SAC's.
    :param oracle: See :class:`PreferenceAdapter`.
    :param seed: See :class:`PreferenceAdapter`.
    :raises ValueError: If an argument is out of its range, or the model or family does not do, see
        :meth:`MAMLRewardOptions.check`.
    """

    options_class: ClassVar[Any] = MAMLRewardOptions

    def __init__(
        self,
        model: Any,
        env: Env,
        *,
        n_queries: int = 10,
        gradient_steps: int = 200,
        batch_size: int = 128,
        learning_rate: float = 1e-3,
        gamma: float = 0.99,
        oracle: Oracle | None = None,
        seed: int | None = None,
    ) -> None:
        options = MAMLRewardOptions(n_queries, gradient_steps, batch_size, learning_rate, gamma)
        self._start(model, env, options, oracle, seed, None)

    @classmethod
    def make_options(cls, oracle: Any = None, **options: Any) -> MAMLRewardOptions:
        """See :class:`PreferenceAdapter`.

        :param oracle: Not looked at.
        :param options: Those of the constructor.
        :return: The options.
        """
        return MAMLRewardOptions(**options)


def _make_sac(model: MAMLRewardModel, options: MAMLRewardOptions) -> SAC:
    """SAC without an environment: it learns from trajectories that it is given."""
    sac = SAC(
        "MlpPolicy",
        None,  # type: ignore[arg-type]
        learning_rate=options.learning_rate,
        gamma=options.gamma,
        buffer_size=2 * options.n_queries * int(model.horizon),
        target_entropy=-float(np.prod(model.action_space.shape)),
        device="cpu",
        _init_setup_model=False,
    )
    sac.observation_space, sac.action_space, sac.n_envs = (
        model.observation_space,
        model.action_space,
        1,
    )
    sac._setup_model()
    sac.set_logger(Logger(None, []))
    return sac


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """SB3 draws from the global generators: seed them, and hand them back as they were."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002
    with th.random.fork_rng():
        random.seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002
        th.manual_seed(seed)
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002
