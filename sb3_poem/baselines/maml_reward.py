"""MAML-reward: the answers adapt a meta-trained reward, and SAC learns from what was shown (Finn et
al. 2017; Hejna & Sadigh 2023).
"""

import contextlib
import copy
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import torch as th
from gymnasium import spaces
from safetensors.torch import save
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed
from torch import nn
from torch.func import functional_call, grad, vmap
from torch.nn.functional import softplus
from torch.nn.utils.rnn import pad_sequence

from sb3_poem.adaptation import Answer, Inference, Rule, Setting
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.preference import SIGNS, Preference
from sb3_poem.adaptation.rule import Shown, seen
from sb3_poem.baselines.fragments import (
    check_shared_dynamics,
    default_fragment_length,
    replay_fragments,
    standardised,
    transition_rows,
)
from sb3_poem.common.checks import check_number, check_whole
from sb3_poem.common.files import read_json, write_atomically, write_json_atomically
from sb3_poem.common.networks import MLP, digest_of, parse_tensors
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.pearl_sac import PEARLSAC
from sb3_poem.pearl_sac.policies import LatentPolicy

FORMAT = "sb3_poem meta reward 2"
WEIGHTS, CONFIG = "reward.safetensors", "reward.json"
SETTINGS = ("net_arch", "inner_learning_rate", "inner_steps", "fragment_length")
#: Of an outer step of the meta-training: tasks, and pairs that each adapts to and is judged by.
TASKS_PER_BATCH, PAIRS = 16, 10

Parameters = dict[str, th.Tensor]


class PreferencePairs(NamedTuple):
    """Pairs of fragments, (..., pairs, steps, in_dim + 1) transitions as :class:`RewardNetwork`
    takes them, and ``label`` (..., pairs): 1 where the left one is better, 0 or 0.5.
    """

    left: th.Tensor
    right: th.Tensor
    label: th.Tensor


class RewardNetwork(nn.Module):
    """Reward of a transition (s, a, s') of width ``in_dim``, unknown up to scale; and what MAML
    does with its parameters, whose inner loop has so many ``steps``.
    """

    def __init__(
        self, in_dim: int, net_arch: Sequence[int], learning_rate: float, steps: int
    ) -> None:
        super().__init__()
        # A smooth activation: MAML differentiates the gradient.
        self.mlp = MLP(in_dim, 1, net_arch, nn.Tanh)
        self.learning_rate, self.steps = learning_rate, steps

    def forward(self, transitions: th.Tensor) -> th.Tensor:
        """(..., in_dim + 1), the last entry 1, or 0 for what only fills up an episode that ended
        early -> (...).
        """
        return self.mlp(transitions[..., :-1]).squeeze(-1) * transitions[..., -1]

    def preference_loss(self, parameters: Parameters, pairs: PreferencePairs) -> th.Tensor:
        """Bradley-Terry cross-entropy of the sums of predicted rewards of one task's pairs."""
        both = th.stack([pairs.left, pairs.right])
        left, right = functional_call(self, parameters, (both,)).sum(dim=-1)
        return (softplus(left - right) - pairs.label * (left - right)).mean()

    def adapted(self, parameters: Parameters, pairs: PreferencePairs) -> Parameters:
        """MAML's inner loop: gradient steps on one task's preferences."""
        for _ in range(self.steps):
            slope = grad(self.preference_loss)(parameters, pairs)
            parameters = {k: v - self.learning_rate * slope[k] for k, v in parameters.items()}
        return parameters

    def maml_loss(
        self, parameters: Parameters, support: PreferencePairs, query: PreferencePairs
    ) -> th.Tensor:
        """MAML's outer objective: how well what ``support`` (tasks, pairs, ...) adapts predicts
        ``query``, other preferences of the same tasks.
        """

        def task_loss(some: PreferencePairs, others: PreferencePairs) -> th.Tensor:
            return self.preference_loss(self.adapted(parameters, some), others)

        return vmap(task_loss)(support, query).mean()


class MetaReward:
    """A reward network from which a few preferences lead to a task's reward.

    >>> from sb3_poem import PEARLSAC
    >>> small = dict(n_train_tasks=4, gradient_steps=2, seed=0)
    >>> pearl = PEARLSAC("MlpPolicy", "poem/PointGoal-v0", **small).learn(200)
    >>> meta_train_reward(pearl, n_iterations=1).save("reward")
    >>> MetaReward.load("reward", pearl.policy).inner_steps
    5

    :param policy: Whose standardisation of observations is used.
    :param inner_learning_rate: Step size of MAML's inner loop, which has ``inner_steps``.
    :param fragment_length: Steps of the fragments of the meta-training; None: any.
    :param seed: Of the initial parameters.
    """

    def __init__(
        self,
        policy: LatentPolicy,
        net_arch: Sequence[int] = (64, 64),
        inner_learning_rate: float = 0.1,
        inner_steps: int = 5,
        fragment_length: int | None = None,
        seed: int = 0,
    ) -> None:
        check_number("inner_learning_rate", inner_learning_rate, above=0.0)
        check_whole("inner_steps", inner_steps, 1)
        self.policy = policy
        self.inner_learning_rate, self.inner_steps = inner_learning_rate, inner_steps
        self.fragment_length = fragment_length
        self.net_arch = tuple(int(width) for width in net_arch)
        in_dim = 2 * spaces.flatdim(policy.observation_space) + spaces.flatdim(policy.action_space)
        with th.random.fork_rng():
            th.manual_seed(seed)
            network = RewardNetwork(in_dim, net_arch, inner_learning_rate, inner_steps)
        self.network = network.to(policy.device)
        self.parameters: Parameters = {
            name: value.detach().clone() for name, value in self.network.named_parameters()
        }

    @property
    def digest(self) -> str:
        return digest_of({**self.parameters, **_standardisation(self.policy)})

    def save(self, folder: str | Path) -> None:
        """Write the parameters as safetensors and the settings as JSON."""
        tensors = {f"network.{name}": value for name, value in self.parameters.items()}
        tensors |= _standardisation(self.policy)
        content = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
        write_atomically(Path(folder) / WEIGHTS, save(content))
        settings = {name: getattr(self, name) for name in SETTINGS}
        write_json_atomically(Path(folder) / CONFIG, {"format": FORMAT, **settings})

    @classmethod
    def load(cls, folder: str | Path, policy: LatentPolicy) -> Self:
        """Read what :meth:`save` wrote; the policy must be that of the meta-training."""
        weights, settings = Path(folder) / WEIGHTS, Path(folder) / CONFIG
        if not settings.is_file():
            raise FileNotFoundError(f"{folder} holds no meta-trained reward: it has no {CONFIG}")
        config = read_json(settings, "the settings of a meta-trained reward")
        if config.get("format") != FORMAT:
            raise ValueError(f"{settings} is not of this version of sb3_poem, {FORMAT!r}")
        tensors = parse_tensors(weights.read_bytes(), weights)
        for name, value in _standardisation(policy).items():
            kept = tensors.get(name)
            if kept is None or kept.shape != value.shape or not th.equal(kept, value.cpu()):
                raise ValueError(
                    f"`policy` is not the one with which the reward in {folder} was meta-trained: "
                    f"its {name} differs; load the same model again"
                )
        meta = cls(policy, **{name: config[name] for name in SETTINGS})
        shapes = {f"network.{name}": value.shape for name, value in meta.parameters.items()}
        if shapes != {name: t.shape for name, t in tensors.items() if name.startswith("network.")}:
            raise ValueError(f"{weights} does not hold the network that {CONFIG} describes")
        for name in meta.parameters:
            meta.parameters[name] = tensors[f"network.{name}"].to(policy.device)
        return meta

    def transitions(self, trajectory: Trajectory) -> th.Tensor:
        """(T, in_dim + 1) standardised (s, a, s') of a trajectory, and 1."""
        return transition_rows(self.policy, trajectory, 1.0)

    def adapted(self, answers: Sequence[Answer]) -> Parameters:
        """The network's parameters after some answers. The inner loop's steps suit sums over the
        fragments of the meta-training: longer trajectories count with their mean over as many.
        """
        if not answers:
            return self.parameters
        shown = [one for answer in answers for one in seen(answer.shown)]
        # (2 answers, longest, in_dim + 1)
        rows = pad_sequence([self.transitions(trajectory) for trajectory in shown], True)
        longest = rows.shape[1]
        rows[..., -1] *= min(1.0, (self.fragment_length or longest) / longest)
        labels = [0.5 + 0.5 * SIGNS[answer.preference] for answer in answers]
        pairs = PreferencePairs(rows[::2], rows[1::2], th.tensor(labels, device=rows.device))
        adapted = self.network.adapted(self.parameters, pairs)
        return {name: value.detach() for name, value in adapted.items()}

    def rewards(self, parameters: Parameters, trajectory: Trajectory) -> np.ndarray:
        """(T,) predicted rewards with what :meth:`adapted` gave, in the network's own unit."""
        with th.no_grad():
            predicted = functional_call(self.network, parameters, (self.transitions(trajectory),))
        return predicted.double().cpu().numpy()


def meta_train_reward(
    model: PEARLSAC,
    n_iterations: int = 500,
    n_fragments: int = 500,
    fragment_length: int | None = None,
    learning_rate: float = 1e-3,
    seed: int = 0,
    **arguments: Any,
) -> MetaReward:
    """Meta-train a reward on the preferences of a model's training tasks about fragments from its
    replay buffer. Every task judges fragments of all of them, so the family must share dynamics.

    :param n_iterations: Steps of the outer loop, by Adam with ``learning_rate``.
    :param n_fragments: Fragments that pairs are drawn from.
    :param fragment_length: Their steps; None takes 50, or an episode that is shorter.
    :param arguments: Of :class:`MetaReward`.
    :raises ValueError: If dynamics are not shared, or the replay buffer is empty.
    """
    if not model.family.shared_dynamics:
        raise ValueError(
            "`model` must be of a family whose tasks share their dynamics, but those of "
            f"{model.family.env_id} do not: every task judges all tasks' fragments"
        )
    if not model.replay_buffer.counts.any():
        raise ValueError(
            "`model` has an empty replay buffer (a loaded model has none): call load_replay_buffer"
        )
    check_whole("n_iterations", n_iterations, 1)
    check_whole("n_fragments", n_fragments, 1)
    rng = np.random.default_rng([seed, 5])
    length = default_fragment_length(model.horizon) if fragment_length is None else fragment_length
    meta = MetaReward(model.policy, fragment_length=length, seed=seed, **arguments)
    fragments = replay_fragments(model, n_fragments, length, rng)
    inputs = th.stack([meta.transitions(fragment) for fragment in fragments])
    features = np.stack([np.asarray(fragment.reward_features) for fragment in fragments])
    tasks = model.train_tasks.tasks[:, None, None, :]
    returns = model.family.compute_rewards(tasks, features[None]).sum(axis=2)
    parameters = {name: value.requires_grad_() for name, value in meta.parameters.items()}
    optimizer = th.optim.Adam(parameters.values(), lr=learning_rate)
    n_tasks = min(TASKS_PER_BATCH, len(returns))
    for _ in range(n_iterations):
        judges = rng.choice(len(returns), size=n_tasks, replace=False)
        support, query = (_judged(inputs, returns, judges, rng) for _ in range(2))
        optimizer.zero_grad()
        meta.network.maml_loss(parameters, support, query).backward()
        optimizer.step()
    meta.parameters = {name: value.detach() for name, value in parameters.items()}
    return meta


def _judged(
    inputs: th.Tensor, returns: np.ndarray, tasks: np.ndarray, rng: np.random.Generator
) -> PreferencePairs:
    """Pairs for each of some tasks, by their returns (all tasks, fragments)."""
    left, right = rng.integers(len(inputs), size=(2, len(tasks), PAIRS))
    rows = tasks[:, None]
    label = 0.5 + 0.5 * np.sign(returns[rows, left] - returns[rows, right])
    labels = th.as_tensor(label, dtype=inputs.dtype, device=inputs.device)
    return PreferencePairs(inputs[left], inputs[right], labels)


def _standardisation(policy: LatentPolicy) -> dict[str, th.Tensor]:
    """Without which the parameters mean nothing."""
    return {"obs_mean": policy.obs_norm.mean, "obs_std": policy.obs_norm.std}


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
        self.actors: dict[str, Any] = {}

    def __repr__(self) -> str:
        return f"MAMLRewardModel({self.env_id})"

    @property
    def digest(self) -> str:
        return self.reward.digest

    def sample_latents(self, n: int, rng: np.random.Generator, source: str = "prior") -> np.ndarray:
        raise NotImplementedError("a MAMLRewardModel has no policies before the first answer")

    def add(self, actor: Any) -> np.ndarray:
        """Keep a copy of an actor, unless there is one, and give its latent (2,)."""
        digest = digest_of(actor.state_dict())
        if digest not in self.actors:
            self.actors[digest] = copy.deepcopy(actor).eval()
        return np.array([list(self.actors).index(digest), 1.0])

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
            noise, actors = th.randn(actions.shape), list(self.actors.values())
            for number in np.unique(latents[:, 0]).astype(int):
                rows = np.flatnonzero(latents[:, 0] == number)
                mean, log_std, _ = actors[number].get_action_dist_params(inputs[rows].cpu())
                if not deterministic:
                    sign = th.as_tensor(latents[rows, 1:], dtype=th.float32)
                    mean = mean + sign * log_std.exp() * noise[rows]
                actions[rows] = mean.tanh().numpy()
        space = self.action_space
        actions = np.clip(policy.unscale_action(actions), space.low, space.high)
        return (actions[0] if np.ndim(observation) == 1 else actions), state


@dataclass(frozen=True, repr=False)
class MAMLReward(Rule):
    """MAML-reward (Hejna & Sadigh 2022): a meta-trained reward is adapted to the answers, and SB3's
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

    :param gradient_steps: SAC's steps after each answer, at least 1.
    :param batch_size: Transitions in such a step.
    :param learning_rate: Of SAC's networks.
    :param gamma: SAC's discount factor, in [0, 1].
    :raises ValueError: If an option is out of its range.
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
        check_number("learning_rate", self.learning_rate, above=0.0)
        check_number("gamma", self.gamma, 0.0, 1.0)

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

    def start(self, model: MetaModel, rng: np.random.Generator, setting: Setting) -> Inference:
        assert isinstance(model, MAMLRewardModel)
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
        #: After each number of answers
        self.latents = [self.model.add(self.sac.actor)]

    def ask(self) -> tuple[Shown, Shown]:
        """The current policy twice, with opposite exploration noise."""
        return self.same_latents(-1)

    def same_latents(self, number: int, *latents: np.ndarray) -> tuple[Shown, Shown]:
        """The policy after so many answers, whose number in the file was another."""
        return self.latents[number].copy(), self.latents[number] * np.array([1.0, -1.0])

    def tell(self, preference: Preference, *shown: Shown) -> None:
        self.answers.append(Answer(preference, seen(shown)))
        clips = [one for each in self.answers for one in seen(each.shown)]
        parameters = self.model.reward.adapted(self.answers)
        rewards = [self.model.reward.rewards(parameters, trajectory) for trajectory in clips]
        # Preferences fix no unit; SAC's entropy needs one.
        scale = max(float(np.concatenate(rewards).std()), 1e-6)
        with _seeded(int(self.seed[0]) + len(self.answers)):
            self._fill_buffer(clips, [row / scale for row in rewards])
            self.sac.train(self.rule.gradient_steps, self.rule.batch_size)
        self.latents.append(self.model.add(self.sac.actor))

    def estimate(self) -> np.ndarray:
        return self.latents[-1].copy()

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
