"""A meta-trained reward, which a few answers adapt to a task (Hejna & Sadigh 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as tensors_to_bytes

from sb3_poem.adaptation.preference import Preference
from sb3_poem.adaptation.state import read_json, write_json_atomically
from sb3_poem.baselines.fragments import default_fragment_length, replay_fragments
from sb3_poem.baselines.maml import (
    Parameters,
    PreferencePairs,
    RewardNetwork,
    adapt_parameters,
    maml_loss,
)
from sb3_poem.common.checks import check_whole
from sb3_poem.common.digest import digest_of
from sb3_poem.common.files import write_atomically
from sb3_poem.common.trajectory import Trajectory

FORMAT = "sb3_poem meta reward 1"
WEIGHTS, CONFIG = "reward.safetensors", "reward.json"
LABELS = {Preference.LEFT: 1.0, Preference.RIGHT: 0.0, Preference.EQUAL: 0.5}


class JudgedPair(NamedTuple):
    """An answer, with what stood left and right."""

    preference: Preference
    left: Trajectory
    right: Trajectory


def _standardisation(policy: Any) -> dict[str, th.Tensor]:
    """By what observations are standardised; the parameters mean something only together with it."""
    return {"obs_mean": policy.obs_norm.mean, "obs_std": policy.obs_norm.std}


class MetaReward:
    """A reward network from which a few preferences lead to a task's reward.

    :param policy: A :class:`LatentPolicy`, whose standardisation of observations is used.
    :param net_arch: Hidden layers of the network.
    :param inner_learning_rate: Step size of MAML's inner loop.
    :param inner_steps: Gradient steps of the inner loop.
    :param seed: Of the initial parameters.
    """

    def __init__(
        self,
        policy: Any,
        net_arch: Sequence[int] = (64, 64),
        inner_learning_rate: float = 0.1,
        inner_steps: int = 5,
        seed: int = 0,
    ) -> None:
        if not inner_learning_rate > 0:
            raise ValueError(
                f"`inner_learning_rate` must be positive, but is {inner_learning_rate}"
            )
        check_whole("inner_steps", inner_steps, 1)
        self.policy, self.inner_learning_rate, self.inner_steps = (
            policy,
            inner_learning_rate,
            inner_steps,
        )
        self.net_arch = tuple(int(width) for width in net_arch)
        in_dim = 2 * spaces.flatdim(policy.observation_space) + spaces.flatdim(policy.action_space)
        with th.random.fork_rng():
            th.manual_seed(seed)
            self.network = RewardNetwork(in_dim, net_arch).to(policy.device)
        self.parameters: Parameters = {
            name: value.detach().clone() for name, value in self.network.named_parameters()
        }

    @property
    def digest(self) -> str:
        """Of its numbers, the standardisation's included."""
        return digest_of({**self.parameters, **_standardisation(self.policy)})

    def save(self, folder: str | Path) -> None:
        """Write the parameters as safetensors and the settings as JSON.

        :param folder: Where; made if missing.
        :raises OSError: If it cannot be written.
        """
        folder = Path(folder)
        tensors = {
            f"network.{name}": value.detach().cpu().contiguous()
            for name, value in self.parameters.items()
        }
        tensors |= {
            name: value.cpu().contiguous() for name, value in _standardisation(self.policy).items()
        }
        config = {
            "format": FORMAT,
            "net_arch": list(self.net_arch),
            "inner_learning_rate": self.inner_learning_rate,
            "inner_steps": self.inner_steps,
        }
        write_atomically(folder / WEIGHTS, tensors_to_bytes(tensors))
        write_json_atomically(folder / CONFIG, config)

    @classmethod
    def load(cls, folder: str | Path, policy: Any) -> MetaReward:
        """Read what :meth:`save` wrote.

        :param policy: The :class:`LatentPolicy` with which it was meta-trained.
        :return: The meta-trained reward.
        :raises FileNotFoundError: If the folder does not hold one.
        :raises ValueError: If a file is broken or of another version, or the policy is another one.
        """
        folder = Path(folder)
        if not (folder / CONFIG).is_file():
            raise FileNotFoundError(f"{folder} holds no meta-trained reward: it has no {CONFIG}")
        config = read_json(folder / CONFIG)
        if config.get("format") != FORMAT:
            raise ValueError(
                f"{folder / CONFIG} is not of this version of sb3_poem (expected format {FORMAT!r})"
            )
        try:
            tensors = load_tensors((folder / WEIGHTS).read_bytes())
        except SafetensorError as error:
            raise ValueError(
                f"{folder / WEIGHTS} is truncated, or no safetensors file: {error}"
            ) from error
        for name, value in _standardisation(policy).items():
            own = value.cpu()
            if (
                name not in tensors
                or tensors[name].shape != own.shape
                or not th.equal(tensors[name], own)
            ):
                raise ValueError(
                    f"`policy` is not the one with which the reward in {folder} was meta-trained: its {name} differs; "
                    "load the same model again"
                )
        meta = cls(policy, config["net_arch"], config["inner_learning_rate"], config["inner_steps"])
        names = {f"network.{name}": value.shape for name, value in meta.parameters.items()}
        if names != {name: tensors[name].shape for name in tensors if name.startswith("network.")}:
            raise ValueError(
                f"{folder / WEIGHTS} does not hold the network that {CONFIG} describes"
            )
        meta.parameters = {
            name: tensors[f"network.{name}"].to(policy.device) for name in meta.parameters
        }
        return meta

    def transitions(self, trajectory: Trajectory) -> th.Tensor:
        """(T, in_dim + 1) standardised (s, a, s') of a trajectory, and 1."""
        policy = self.policy
        with th.no_grad():
            obs = policy.standardise(
                th.as_tensor(trajectory.observations, dtype=th.float32, device=policy.device)
            )
            actions = policy.scale_action_batch(
                th.as_tensor(trajectory.actions, dtype=th.float32, device=policy.device)
            )
            return th.cat([obs[:-1], actions, obs[1:], obs.new_ones(len(actions), 1)], dim=1)

    def adapted(self, answers: Sequence[JudgedPair]) -> Parameters:
        """The reward after some answers.

        :param answers: The answers, each with trajectories of any length.
        :return: Parameters of the network.
        """
        parameters = self.parameters
        if not answers:
            return parameters
        longest = max(len(shown) for answer in answers for shown in (answer.left, answer.right))
        left, right = (
            th.stack([_filled(self.transitions(shown), longest) for shown in side])
            for side in zip(*((answer.left, answer.right) for answer in answers), strict=True)
        )
        label = th.tensor([LABELS[answer.preference] for answer in answers], device=left.device)
        pairs = PreferencePairs(left, right, label)
        adapted = adapt_parameters(
            self.network, parameters, pairs, self.inner_learning_rate, self.inner_steps
        )
        return {name: value.detach() for name, value in adapted.items()}

    def rewards(self, parameters: Parameters, trajectory: Trajectory) -> np.ndarray:
        """Predicted rewards.

        :param parameters: What :meth:`adapted` gave.
        :return: (T,), in the network's own unit.
        """
        with th.no_grad():
            predicted = th.func.functional_call(
                self.network, parameters, (self.transitions(trajectory),)
            )
        return predicted.double().cpu().numpy()


def meta_train_reward(
    model: Any,
    n_iterations: int = 500,
    n_fragments: int = 500,
    fragment_length: int | None = None,
    tasks_per_batch: int = 16,
    n_support: int = 10,
    n_query: int = 10,
    learning_rate: float = 1e-3,
    seed: int = 0,
    **arguments: Any,
) -> MetaReward:
    """Meta-train a reward on the preferences of a model's training tasks about fragments from its
    replay buffer.

    Every training task judges fragments of all of them, so the family must share dynamics.

    :param model: A trained :class:`PEARLSAC` with its environment and its replay buffer.
    :param n_iterations: Steps of the outer loop.
    :param n_fragments: Fragments that pairs are drawn from.
    :param fragment_length: Steps of a fragment; None takes 50, or an episode that is shorter.
    :param tasks_per_batch: Tasks in an outer step (all, if there are fewer).
    :param n_support: Pairs that a task adapts to.
    :param n_query: Pairs that it is judged by.
    :param learning_rate: Of Adam in the outer loop.
    :param seed: Of everything.
    :param arguments: Of :class:`MetaReward`.
    :return: The meta-trained reward.
    :raises ValueError: If the family does not share dynamics, or the replay buffer is empty.
    """
    if not model.family.shared_dynamics:
        raise ValueError(
            f"`model` must be of a family whose tasks share their dynamics, but those of {model.family.env_id} do not: "
            "MAML-reward lets every training task judge all tasks' fragments"
        )
    if not model.replay_buffer.counts.any():
        raise ValueError(
            "`model` has an empty replay buffer (a loaded model has none): call load_replay_buffer"
        )
    for name, value in (
        ("n_iterations", n_iterations),
        ("n_support", n_support),
        ("n_query", n_query),
    ):
        check_whole(name, value, 1)
    rng = np.random.default_rng([seed, 5])
    meta = MetaReward(model.policy, seed=seed, **arguments)
    length = default_fragment_length(model.horizon) if fragment_length is None else fragment_length
    fragments = replay_fragments(model, n_fragments, length, rng)
    inputs = th.stack([meta.transitions(fragment) for fragment in fragments])
    features = np.stack([np.asarray(fragment.reward_features) for fragment in fragments])
    returns = model.family.compute_rewards(
        model.train_tasks.tasks[:, None, None, :], features[None]
    ).sum(axis=2)
    parameters = {name: value.requires_grad_() for name, value in meta.parameters.items()}
    optimizer = th.optim.Adam(parameters.values(), lr=learning_rate)
    n_tasks = min(tasks_per_batch, len(returns))
    for _ in range(n_iterations):
        tasks = rng.choice(len(returns), size=n_tasks, replace=False)
        support, query = (_judged(inputs, returns, tasks, n, rng) for n in (n_support, n_query))
        optimizer.zero_grad()
        maml_loss(
            meta.network, parameters, support, query, meta.inner_learning_rate, meta.inner_steps
        ).backward()
        optimizer.step()
    meta.parameters = {name: value.detach() for name, value in parameters.items()}
    return meta


def _judged(
    inputs: th.Tensor,
    returns: np.ndarray,
    tasks: np.ndarray,
    n_pairs: int,
    rng: np.random.Generator,
) -> PreferencePairs:
    left, right = rng.integers(len(inputs), size=(2, len(tasks), n_pairs))
    rows = tasks[:, None]
    label = 0.5 + 0.5 * np.sign(returns[rows, left] - returns[rows, right])
    return PreferencePairs(
        inputs[left], inputs[right], th.as_tensor(label, dtype=inputs.dtype, device=inputs.device)
    )


def _filled(rows: th.Tensor, length: int) -> th.Tensor:
    return th.cat([rows, rows.new_zeros(length - len(rows), rows.shape[1])])
