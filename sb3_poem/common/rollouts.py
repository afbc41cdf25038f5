"""Roll out many latent-conditioned policies in lockstep on one vector environment."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_poem.common.family_view import FamilyView, seed_copies
from sb3_poem.common.trajectory import Trajectory

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


def rollout_latents(
    model: Any,
    vec_env: VecEnv,
    latents: np.ndarray,
    tasks: np.ndarray | None = None,
    seed: int | Sequence[int] = 0,
    deterministic: bool = True,
    *,
    frames: bool | int = False,
    max_steps: int | None = None,
) -> list[Trajectory]:
    """Roll out one episode of pi(. | f_pi(z)) for every latent z, as many at a time as the
    environment has copies.

    Every rollout resets its copy with a seed of its own, so a rollout of policies that act by their
    mode depends on its latent, its task and its seed, and not on which copy ran it or on how many
    copies there are. Two rollouts with equal seeds start alike (common random numbers). Action
    noise (``deterministic=False``) is drawn for all copies of a wave together: it depends on the
    wave's first seed, on the copy and on their number, too. A copy's first episode alone is kept.
    Nothing is restored afterwards: the environment keeps the tasks and the state that it ended in.

    :param model: Anything with SB3's ``predict(obs, state=latents, deterministic=...)``.
    :param vec_env: Any SB3 vector environment. ``last_reward_features`` is read where it has it,
        else ``info["reward_features"]``.
    :param latents: (n, latent_dim), any n.
    :param tasks: (n, task_dim) to set before each rollout; None keeps the environment's own tasks
        as they are.
    :param seed: One seed a rollout, or one integer s: then rollout i takes s + i.
    :param deterministic: Whether the policies act by their mode.
    :param frames: Whether to render every step, or n to render every n-th; the environment needs
        ``render_mode="rgb_array"``.
    :param max_steps: Where an episode is cut if the environment does not end it; None takes
        ``model.horizon``.
    :return: n trajectories, in the order of the latents.
    :raises ValueError: On wrong shapes, and if an observation or an action is not finite; the
        episode is named.
    """
    return [
        Trajectory(
            observations=episode.observations,
            actions=episode.actions,
            latent=episode.latent,
            reward_features=episode.reward_features,
            frames=episode.frames,
        )
        for episode in _episodes(
            model, vec_env, latents, tasks, seed, deterministic, frames, max_steps, keep=True
        )
    ]


@dataclass(frozen=True, eq=False)
class Outcome:
    """What evaluation needs to know of an episode.

    :param reward_features: (T, feat_dim).
    :param success: Whether any of its steps was a success; None where the environment's infos do
        not say (``"is_success"``).
    """

    reward_features: np.ndarray
    success: bool | None


def rollout_outcomes(
    model: Any,
    vec_env: VecEnv,
    latents: np.ndarray,
    tasks: np.ndarray | None = None,
    seed: int | Sequence[int] = 0,
    deterministic: bool = True,
    *,
    max_steps: int | None = None,
) -> list[Outcome]:
    """As :func:`rollout_latents`, but keep each episode's outcome only: for evaluation, where
    observations would take hundreds of megabytes (Humanoid).

    :param model: See :func:`rollout_latents`.
    :param vec_env: See :func:`rollout_latents`.
    :param latents: (n, latent_dim).
    :param tasks: (n, task_dim) or None.
    :param seed: One seed a rollout, or one integer.
    :param deterministic: Whether the policies act by their mode.
    :param max_steps: Where an episode is cut.
    :return: n outcomes, in the order of the latents.
    :raises ValueError: As :func:`rollout_latents`, and if the environment gives no reward features.
    """
    outcomes = []
    for episode in _episodes(
        model, vec_env, latents, tasks, seed, deterministic, False, max_steps, keep=False
    ):
        if episode.reward_features is None:
            raise ValueError(
                'the environment gives no info["reward_features"], from which returns are computed; '
                "it must be a task family (poem_envs.TaskFamily)"
            )
        outcomes.append(Outcome(episode.reward_features, episode.success))
    return outcomes


def rollout_features(
    model: Any,
    vec_env: VecEnv,
    latents: np.ndarray,
    tasks: np.ndarray | None = None,
    seed: int | Sequence[int] = 0,
    deterministic: bool = True,
    *,
    max_steps: int | None = None,
) -> list[np.ndarray]:
    """The reward features of each episode's :func:`rollout_outcomes`, n arrays (T_i, feat_dim),
    with the same arguments.
    """
    outcomes = rollout_outcomes(
        model, vec_env, latents, tasks, seed, deterministic, max_steps=max_steps
    )
    return [outcome.reward_features for outcome in outcomes]


def policy_actions(
    model: Any, observations: np.ndarray, latents: np.ndarray, deterministic: bool
) -> np.ndarray:
    """The actions of pi(. | f_pi(z)), one latent an observation.

    :param observations: (n, obs_dim).
    :param latents: (n, latent_dim).
    :param deterministic: Whether to take the mode.
    :return: (n, act_dim).
    """
    actions, _ = model.predict(observations, state=latents, deterministic=deterministic)
    return actions


@dataclass
class _Episode:
    observations: np.ndarray
    actions: np.ndarray
    latent: np.ndarray
    reward_features: np.ndarray | None
    frames: list[np.ndarray] | None
    success: bool | None


def _episodes(
    model: Any,
    vec_env: VecEnv,
    latents: np.ndarray,
    tasks: np.ndarray | None,
    seed: int | Sequence[int],
    deterministic: bool,
    frames: int,
    max_steps: int | None,
    keep: bool,
) -> Iterator[_Episode]:
    latents = np.asarray(latents, dtype=np.float64)
    if latents.ndim != 2:
        raise ValueError(
            f"`latents` must have shape (n, latent_dim), but has shape {latents.shape}"
        )
    if not np.isfinite(latents).all():
        raise ValueError(
            f"`latents` must be finite, but row {int(np.argmin(np.isfinite(latents).all(axis=1)))} is not"
        )
    if tasks is not None:
        tasks = np.asarray(tasks, dtype=np.float64)
        if tasks.ndim != 2 or len(tasks) != len(latents):
            raise ValueError(
                f"`tasks` must have shape ({len(latents)}, task_dim), one a latent, but has shape {tasks.shape}"
            )
    seeds = _seeds(seed, len(latents))
    steps = model.horizon if max_steps is None else max_steps
    if steps < 1:
        raise ValueError(f"`max_steps` must be at least 1, but is {steps}")
    if frames < 0:
        raise ValueError(f"`frames` must be True, False, or at least 1, but is {frames}")
    if frames and vec_env.render_mode != "rgb_array":
        raise ValueError(
            f'rendering needs an environment made with render_mode="rgb_array", but this one has {vec_env.render_mode!r}'
        )
    for start in range(0, len(latents), vec_env.num_envs):
        wave = slice(start, start + vec_env.num_envs)
        wave_tasks = None if tasks is None else tasks[wave]
        with _seeded_noise(seeds[start], deterministic):
            yield from _wave(
                model,
                vec_env,
                latents[wave],
                wave_tasks,
                seeds[wave],
                deterministic,
                frames,
                int(steps),
                keep,
                start,
            )


def _seeds(seed: int | Sequence[int], n: int) -> list[int]:
    if isinstance(seed, (int, np.integer)):
        return [int(seed) + i for i in range(n)]
    seeds = [int(value) for value in seed]
    if len(seeds) != n:
        raise ValueError(
            f"`seed` must be one integer or hold one a latent ({n}), but holds {len(seeds)}"
        )
    return seeds


@contextlib.contextmanager
def _seeded_noise(seed: int, deterministic: bool) -> Iterator[None]:
    """SB3's policies draw action noise from torch's global generator: seed it for the rollout, and
    hand it back as it was.
    """
    if deterministic:
        yield
        return
    import torch

    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield


def _wave(
    model: Any,
    vec_env: VecEnv,
    latents: np.ndarray,
    tasks: np.ndarray | None,
    seeds: list[int],
    deterministic: bool,
    frames: int,
    max_steps: int,
    keep: bool,
    first: int,
) -> Iterator[_Episode]:
    """At most ``num_envs`` rollouts; spare copies repeat the last one, and are not read."""
    n, copies = len(latents), vec_env.num_envs
    padded = np.minimum(np.arange(copies), n - 1)
    copy_seeds = [seeds[i] for i in padded]
    if tasks is not None:
        FamilyView(vec_env).set_tasks(tasks[padded])
        seed_copies(vec_env, copy_seeds)
    elif (family := FamilyView.of(vec_env)) is not None:
        family.seed_episodes(copy_seeds)
    else:
        seed_copies(vec_env, copy_seeds)
    latents = latents[padded]
    observations = _finite(
        _flat_observations(vec_env.reset()), np.arange(copies) < n, first, 0, "an observation"
    )

    lengths = np.zeros(copies, dtype=np.int64)
    running = np.arange(copies) < n
    seen = [observations.copy()] if keep else []
    taken: list[np.ndarray] = []
    features: list[np.ndarray | None] = []
    successes: list[bool | None] = [None] * copies
    last_observations = observations.copy()
    images: list[list[np.ndarray]] = [[] for _ in range(copies)]
    if frames:
        _add_images(images, vec_env, running)
    for step in range(1, max_steps + 1):
        actions = policy_actions(model, observations, latents, deterministic)
        _finite(actions, running, first, step, "an action")
        raw_observations, _, dones, infos = vec_env.step(actions)
        observations = _flat_observations(raw_observations)
        features.append(_reward_features(vec_env, infos, running))
        for copy in np.flatnonzero(running):
            if "is_success" in infos[copy]:
                successes[copy] = bool(infos[copy]["is_success"])
        after = observations.copy()
        for copy in np.flatnonzero(dones & running):
            after[copy] = infos[copy]["terminal_observation"]
        _finite(after, running, first, step, "an observation")
        last_observations[running] = after[running]
        lengths[running] = step
        if keep:
            taken.append(np.array(actions))
            seen.append(after)
        running = running & ~np.asarray(dones, dtype=bool)
        if frames and step % frames == 0:
            _add_images(images, vec_env, running)
        if not running.any():
            break

    have_features = all(rows is not None for rows in features)
    stacked_features = (
        np.stack([rows for rows in features if rows is not None], axis=1) if have_features else None
    )
    stacked_observations = np.stack(seen, axis=1) if keep else None  # (copies, used + 1, obs_dim)
    stacked_actions = np.stack(taken, axis=1) if keep else None  # (copies, used, act_dim)
    for row in range(n):
        used = int(lengths[row])
        yield _Episode(
            observations=last_observations[row : row + 1]
            if stacked_observations is None
            else stacked_observations[row, : used + 1].copy(),
            actions=np.empty((0, 0))
            if stacked_actions is None
            else stacked_actions[row, :used].copy(),
            latent=latents[row].copy(),
            reward_features=None
            if stacked_features is None
            else stacked_features[row, :used].copy(),
            frames=images[row] if frames else None,
            success=successes[row],
        )


def _flat_observations(observations: Any) -> np.ndarray:
    if not isinstance(observations, np.ndarray):
        raise ValueError(
            f"observations must be arrays (a Box space), but are of type {type(observations).__name__}"
        )
    return observations.reshape(len(observations), -1)


def _reward_features(
    vec_env: VecEnv, infos: Sequence[dict[str, Any]], running: np.ndarray
) -> np.ndarray | None:
    """(copies, feat_dim) of this step, or None where the environment gives none; rows of copies at
    rest may hold anything.
    """
    fast = getattr(vec_env, "last_reward_features", None)
    if fast is not None:
        return np.array(fast, dtype=np.float64)
    rows = [info.get("reward_features") for info in infos]
    present = [row for row, needed in zip(rows, running, strict=True) if needed]
    if any(row is None for row in present):
        return None
    width = np.asarray(present[0]).shape
    return np.stack(
        [np.zeros(width) if row is None else np.asarray(row, dtype=np.float64) for row in rows]
    )


def _finite(
    values: np.ndarray, running: np.ndarray, first: int, step: int, what: str
) -> np.ndarray:
    bad = running & ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise ValueError(
            f"{what} of episode {first + int(np.argmax(bad))} at step {step} is not finite; the rollout stops"
        )
    return values


def _add_images(images: list[list[np.ndarray]], vec_env: VecEnv, running: np.ndarray) -> None:
    for copy, image in enumerate(vec_env.get_images()):
        if running[copy] and image is not None:
            images[copy].append(np.asarray(image))
