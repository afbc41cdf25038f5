"""Fragments of the training tasks' trajectories, which ANOLE shows instead of rolling out on the
new task.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_poem.adaptation.environments import Env, model_and_env
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory

MAX_ROUNDS = 50
FRAGMENT_LENGTH = 50


def default_fragment_length(horizon: int) -> int:
    """Steps of a fragment unless told.

    :param horizon: Steps of an episode.
    :return: 50, or an episode.
    """
    return min(FRAGMENT_LENGTH, horizon)


def replay_fragments(model: Any, n: int, length: int, rng: np.random.Generator) -> list[Trajectory]:
    """Fragments from the replay buffers of the training tasks, tasks and places drawn uniformly.

    A fragment lies within one episode. Which latent acted is not kept in the buffers; a fragment
    carries the latest latent of the training task that it comes from.

    :param model: A :class:`PEARLSAC` with its replay buffer.
    :param n: How many.
    :param length: Steps of a fragment.
    :param rng: The generator.
    :return: n trajectories of ``length`` steps, with reward features.
    :raises ValueError: If no episode in the buffers is as long.
    """
    buffer, policy = model.replay_buffer, model.policy
    with_room = np.flatnonzero(buffer.counts >= length)
    found: list[Trajectory] = []
    for _ in range(MAX_ROUNDS if len(with_room) else 0):
        tasks = rng.choice(with_room, size=n)
        slots = rng.integers(buffer.counts[tasks] - length + 1)[:, None] + np.arange(length)
        rows = np.repeat(tasks[:, None], length, axis=1)
        batch = buffer.at(
            th.as_tensor(rows, device=buffer.device), th.as_tensor(slots, device=buffer.device)
        )
        obs, next_obs, features = (
            part.cpu().numpy()
            for part in (batch.observations, batch.next_observations, batch.features)
        )
        actions = policy.unscale_action(batch.actions.cpu().numpy())
        # Where the next row is not what followed, an episode ended, or the ring holds newer steps.
        whole = (next_obs[:, :-1] == obs[:, 1:]).all(axis=(1, 2))
        found += [
            Trajectory(
                np.concatenate([obs[i], next_obs[i, -1:]]),
                actions[i],
                model.task_latents[tasks[i]].copy(),
                features[i],
            )
            for i in np.flatnonzero(whole)
        ]
        if len(found) >= n:
            return found[:n]
    raise ValueError(
        f"`fragment_length` is {length}, but the replay buffer holds too few episodes that are as long (the horizon is "
        f"{model.horizon}); choose a smaller one"
    )


def training_rollouts(
    model: Any, env: Env, n: int, seed: int = 0, deterministic: bool = False
) -> list[Trajectory]:
    """Episodes of training tasks under their own policies: a ``library`` for a model that was
    loaded without its replay buffer.

    :param model: A trained :class:`PEARLSAC`, or its name, see :class:`PreferenceAdapter`.
    :param env: An environment of its family, or its id, see :class:`PreferenceAdapter`. Tasks are
        set in it.
    :param n: How many.
    :param seed: Draws the training tasks and seeds the episodes.
    :param deterministic: Whether policies act by their mode.
    :return: n trajectories.
    """
    model, vec_env = model_and_env(model, env)
    chosen = np.random.default_rng([seed, 4]).integers(len(model.train_tasks), size=n)
    return rollout_latents(
        model,
        vec_env,
        model.task_latents[chosen],
        model.train_tasks.tasks[chosen],
        seed,
        deterministic,
    )


def rollout_fragments(model: Any, env: Env, n: int, length: int, seed: int = 0) -> list[Trajectory]:
    """Fragments of :func:`training_rollouts`, one from a random place of each: what a replay buffer
    would hold of the present policies, for a model that was loaded without one.

    :param model: A trained :class:`PEARLSAC`, or its name, see :class:`PreferenceAdapter`.
    :param env: An environment of its family, or its id, see :class:`PreferenceAdapter`. Tasks are
        set in it.
    :param n: How many.
    :param length: Steps of a fragment; an episode that ended earlier is taken whole.
    :param seed: Of the training tasks, the episodes and the places.
    :return: n trajectories.
    """
    rng = np.random.default_rng([seed, 6])
    fragments = []
    for episode in training_rollouts(model, env, n, seed):
        steps = min(length, len(episode))
        start = int(rng.integers(len(episode) - steps + 1))
        features = episode.reward_features
        fragments.append(
            Trajectory(
                episode.observations[start : start + steps + 1],
                episode.actions[start : start + steps],
                episode.latent,
                None if features is None else features[start : start + steps],
            )
        )
    return fragments
