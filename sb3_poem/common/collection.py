"""Lockstep collection of one horizon of experience on every copy of a vectorised environment."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_poem.common.buffers import Segment
from sb3_poem.common.family_view import FamilyView

OnStep = Callable[[dict[str, Any]], bool]


def check_finite(
    name: str, values: np.ndarray, task_ids: np.ndarray, episodes: np.ndarray, step: int
) -> None:
    """Refuse NaN and infinity in any copy's values; names the copy, its task and its episode."""
    # then all are; the sum of large finite values may overflow, which the lines below sort out
    if np.isfinite(values.sum()):
        return
    finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if not finite.all():
        copy = int(np.argmin(finite))
        raise ValueError(
            f"the environment returned {name} that are NaN or infinite: copy {copy}, training task "
            f"{int(task_ids[copy])}, episode {int(episodes[copy])}, step {step}: {values[copy]}. "
            "Training stops here, before the networks see them."
        )


def collect_segment(
    family: FamilyView,
    act: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
    task_ids: np.ndarray,
    tasks: np.ndarray,
    latents: np.ndarray,
    seed: int,
    episode_counts: np.ndarray,
    on_step: OnStep,
) -> Segment | None:
    """Run every copy for one horizon on its task; an episode that ends early is followed by another
    of the same task. Refuses NaN, infinity, and what :meth:`FamilyView.check_experience` does.

    :param act: Maps observations (copies, obs_dim) to actions in the environment's units and in
        [-1, 1]
    :param task_ids: (copies,) index of each copy's task, whose ``tasks`` are (copies, task_dim)
    :param latents: (copies, latent_dim), noted in the segment
    :param episode_counts: (copies,) episodes begun so far, counted on here; for messages
    :param on_step: Given the local variables of a step; False ends the collection, without result
    """
    obs = family.reset(tasks, seed)
    check_finite("observations", obs, task_ids, episode_counts, 0)
    n, steps = family.num_envs, []
    in_first_episode = np.ones(n, dtype=bool)
    for step in range(family.horizon):
        actions, scaled_actions = act(obs)
        check_finite("actions (of the policy)", actions, task_ids, episode_counts, step)
        new_obs, rewards, dones, infos = family.env.step(actions)
        assert isinstance(new_obs, np.ndarray)
        if not on_step(locals()):
            return None
        next_obs, terminated = new_obs, np.zeros(n, dtype=np.float32)
        if dones.any():
            next_obs = new_obs.copy()
            for copy in np.flatnonzero(dones):
                next_obs[copy] = infos[copy]["terminal_observation"]
                terminated[copy] = not infos[copy].get("TimeLimit.truncated", False)
        features = family.features_of(infos)
        returned = {"observations": next_obs, "rewards": rewards, "reward features": features}
        for name, values in returned.items():
            check_finite(name, values, task_ids, episode_counts, step)
        seen, then = obs.astype(np.float32), next_obs.astype(np.float32)
        # rewards as most VecEnvs give them; SubprocVecEnv does not round
        paid = rewards.astype(np.float32).astype(np.float64)
        steps.append((seen, scaled_actions, then, paid, terminated, features, in_first_episode))
        in_first_episode = in_first_episode & ~dones
        episode_counts += dones
        obs = new_obs
    stacked = (np.stack(rows, axis=1) for rows in zip(*steps, strict=True))
    segment = Segment(task_ids, latents, *stacked)
    family.check_experience(tasks, seed, segment)
    return segment


def relabelled_returns(
    compute_rewards: Callable[[np.ndarray, np.ndarray], np.ndarray],
    tasks: np.ndarray,
    features: np.ndarray,
    mask: np.ndarray,
) -> np.ndarray:
    """Returns under tasks (tasks, task_dim) of trajectories' features (trajectories, steps,
    feat_dim), over the steps of a mask (trajectories, steps): (tasks, trajectories).
    """
    returns = np.empty((len(tasks), len(features)))
    # one row at a time bounds the memory at trajectories x steps
    for row, task in zip(returns, tasks, strict=True):
        row[:] = (compute_rewards(task, features) * mask).sum(axis=1)
    return returns
