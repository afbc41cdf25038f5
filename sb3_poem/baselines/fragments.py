"""Fragments of the training tasks' trajectories, and trajectories as rows that networks take."""

from pathlib import Path

import numpy as np
import torch as th

from sb3_poem.adaptation.environments import Env, model_and_env
from sb3_poem.adaptation.rule import Setting
from sb3_poem.common.family_view import FamilyView, demanded
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.pearl_sac import PEARLSAC
from sb3_poem.pearl_sac.policies import LatentPolicy

MAX_ROUNDS = 50
FRAGMENT_LENGTH = 50


def default_fragment_length(horizon: int | None) -> int:
    """Steps of a fragment unless told: 50, or an episode that is shorter."""
    return min(FRAGMENT_LENGTH, horizon or FRAGMENT_LENGTH)


def replay_fragments(
    model: PEARLSAC, n: int, length: int, rng: np.random.Generator
) -> list[Trajectory]:
    """n fragments of so many steps from the replay buffers of the training tasks, tasks and places
    drawn uniformly, each within one episode, with reward features and the latest latent of its
    training task.
    """
    buffer, policy = model.replay_buffer, model.policy
    with_room = np.flatnonzero(buffer.counts >= length)
    found: list[Trajectory] = []
    for _ in range(MAX_ROUNDS if len(with_room) else 0):
        tasks = rng.choice(with_room, size=n)
        slots = rng.integers(buffer.counts[tasks] - length + 1)[:, None] + np.arange(length)
        rows = np.repeat(tasks[:, None], length, axis=1)
        batch = buffer.at(*(th.as_tensor(index, device=buffer.device) for index in (rows, slots)))
        parts = batch.observations, batch.next_observations, batch.features
        obs, next_obs, features = (part.cpu().numpy() for part in parts)
        actions = policy.unscale_action(batch.actions.cpu().numpy())
        # Where the next row is not what followed, an episode ended, or the ring holds newer steps.
        for i in np.flatnonzero((next_obs[:, :-1] == obs[:, 1:]).all(axis=(1, 2))):
            seen, latent = np.concatenate([obs[i], next_obs[i, -1:]]), model.task_latents[tasks[i]]
            found.append(Trajectory(seen, actions[i], latent.copy(), features[i]))
        if len(found) >= n:
            return found[:n]
    raise ValueError(
        f"`fragment_length` is {length}, but the replay buffer holds too few episodes that are as "
        f"long (the horizon is {model.horizon}); choose a smaller one"
    )


def training_rollouts(
    model: PEARLSAC | str | Path, env: Env, n: int, seed: int = 0
) -> list[Trajectory]:
    """n episodes of training tasks, drawn by ``seed``, under their own policies: a ``library`` for
    a loaded model. For ``model`` and ``env``, in which tasks are set, see
    :class:`PreferenceAdapter`.

    >>> library = training_rollouts("PointGoal", "poem/PointGoal-v0", 4)
    >>> len(library), library[0].actions.shape
    (4, (25, 2))
    """
    trained, vec_env = model_and_env(model, env)
    if not isinstance(trained, PEARLSAC):
        raise TypeError(f"`model` must be a PEARLSAC, but is of type {type(trained).__name__}")
    chosen = np.random.default_rng([seed, 4]).integers(len(trained.train_tasks), size=n)
    latents, tasks = trained.task_latents[chosen], trained.train_tasks.tasks[chosen]
    return rollout_latents(trained, vec_env, latents, tasks, seed, False)


def rollout_fragments(
    model: PEARLSAC | str | Path, env: Env, n: int, length: int, seed: int = 0
) -> list[Trajectory]:
    """Fragments of so many steps of :func:`training_rollouts`, one from a random place of each
    (all of a shorter one): what a replay buffer would hold of the present policies.
    """
    rng = np.random.default_rng([seed, 6])
    fragments = []
    for episode in training_rollouts(model, env, n, seed):
        steps = min(length, len(episode))
        start = int(rng.integers(len(episode) - steps + 1))
        part, seen = slice(start, start + steps), slice(start, start + steps + 1)
        features = demanded(episode.reward_features)[part]
        about = episode.observations[seen], episode.actions[part], episode.latent, features
        fragments.append(Trajectory(*about))
    return fragments


def check_shared_dynamics(setting: Setting, why: str) -> None:
    """Refuse an environment of a family whose tasks differ in their dynamics."""
    family = None if setting.env is None else FamilyView.of(setting.env)
    if family is not None and not family.shared_dynamics:
        raise ValueError(f"`env` must be of a family whose tasks share their dynamics: {why}")


def standardised(policy: LatentPolicy, trajectory: Trajectory) -> th.Tensor:
    """(T + 1, obs_dim) observations as the networks take them."""
    with th.no_grad():
        return policy.standardise(policy.tensor(trajectory.observations))


def transition_rows(
    policy: LatentPolicy, trajectory: Trajectory, last: np.ndarray | float
) -> th.Tensor:
    """(T, ...) standardised (s, a, s') and a last column."""
    obs = standardised(policy, trajectory)
    actions = policy.tensor(policy.scale_action(trajectory.actions))
    column = policy.tensor(np.full(len(actions), last))[:, None]
    return th.cat([obs[:-1], actions, obs[1:], column], dim=1)
