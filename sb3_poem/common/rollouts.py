"""Roll out many latent-conditioned policies in lockstep on one vector environment."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.common.checks import check_whole
from sb3_poem.common.family_view import FamilyView, reward_features, seed_copies
from sb3_poem.common.trajectory import Trajectory


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
    environment has copies; in the order of the latents.

    Every rollout resets its copy with a seed of its own: of policies that act by their mode it
    depends on its latent, task and seed alone, not on the copy or on how many there are, and two
    with equal seeds start alike (common random numbers). Action noise is drawn for a wave of copies
    together. A copy's first episode alone is kept; the environment keeps the tasks and the state
    that it ended in.

    :param model: Anything with SB3's ``predict(obs, state=latents, deterministic=...)``.
    :param latents: (n, latent_dim), any n.
    :param tasks: (n, task_dim) to set before each rollout; None keeps the environment's own tasks.
    :param seed: One seed a rollout, or one integer s: then rollout i takes s + i.
    :param deterministic: Whether the policies act by their mode.
    :param frames: Whether to render every step, or n to render every n-th; the environment needs
        ``render_mode="rgb_array"``.
    :param max_steps: Where an episode is cut; None takes ``model.horizon``.
    :raises ValueError: On wrong shapes, and if an observation or an action is not finite.
    """
    how = (seed, deterministic, frames, max_steps)
    return [seen for seen, _ in rollout_episodes(model, vec_env, latents, tasks, *how)]


def rollout_episodes(
    model: Any,
    vec_env: VecEnv,
    latents: np.ndarray,
    tasks: np.ndarray | None = None,
    seed: int | Sequence[int] = 0,
    deterministic: bool = True,
    frames: int = 0,
    max_steps: int | None = None,
) -> Iterator[tuple[Trajectory, bool | None]]:
    """As :func:`rollout_latents`, whose observations may take up all memory, one after another; and
    whether any step was a success, None where infos do not say (``"is_success"``).
    """
    latents = np.asarray(latents, dtype=np.float64)
    n, copies = len(latents), vec_env.num_envs
    if latents.ndim != 2:
        raise ValueError(f"`latents` must have shape (n, latent_dim), but has {latents.shape}")
    if not (finite := np.isfinite(latents).all(axis=1)).all():
        raise ValueError(f"`latents` must be finite, but row {int(np.argmin(finite))} is not")
    if tasks is not None:
        tasks = np.asarray(tasks, dtype=np.float64)
        if tasks.ndim != 2 or len(tasks) != n:
            raise ValueError(
                f"`tasks` must have shape ({n}, task_dim), one a latent, but has shape "
                f"{tasks.shape}"
            )
    seeds = [seed + i for i in range(n)] if isinstance(seed, (int, np.integer)) else list(seed)
    if len(seeds) != n:
        raise ValueError(f"`seed` must be one integer or hold one a latent ({n}), not {len(seeds)}")
    steps = model.horizon if max_steps is None else max_steps
    check_whole("max_steps", steps, 1)
    check_whole("frames", int(frames), 0)
    if frames and vec_env.render_mode != "rgb_array":
        raise ValueError(
            'rendering needs an environment made with render_mode="rgb_array", but this one has '
            f"{vec_env.render_mode!r}"
        )
    family = FamilyView.of(vec_env) if tasks is None else FamilyView(vec_env)
    for first in range(0, n, copies):
        # spare copies repeat the last one, and are not read
        wave = np.minimum(first + np.arange(copies), n - 1)
        wave_seeds = [int(seeds[i]) for i in wave]
        # SB3's action noise is drawn from torch's global generator, which is handed back as it was
        with th.random.fork_rng(enabled=not deterministic):
            if not deterministic:
                th.manual_seed(wave_seeds[0])
            if family is not None and tasks is None:
                family.seed_episodes(wave_seeds)
            else:
                if family is not None and tasks is not None:
                    family.set_tasks(tasks[wave])
                seed_copies(vec_env, wave_seeds)
            how = (deterministic, frames, int(steps), first, min(copies, n - first))
            yield from _wave(model, vec_env, latents[wave], *how)


def _wave(
    model: Any,
    vec_env: VecEnv,
    latents: np.ndarray,
    deterministic: bool,
    frames: int,
    max_steps: int,
    first: int,
    n: int,
) -> Iterator[tuple[Trajectory, bool | None]]:
    """An episode of each of ``n`` copies, of which the first has this number."""
    copies = len(latents)
    running, lengths = np.arange(copies) < n, np.zeros(copies, dtype=np.int64)
    successes: list[bool | None] = [None] * copies
    images: list[list[np.ndarray]] = [[] for _ in range(copies)]

    def finite(values: np.ndarray, step: int, what: str) -> np.ndarray:
        bad = running & ~np.isfinite(values).all(axis=1)
        if bad.any():
            episode = first + int(np.argmax(bad))
            raise ValueError(f"{what} of episode {episode} at step {step} is not finite")
        return values

    def render() -> None:
        for copy, image in enumerate(vec_env.get_images()):
            if running[copy] and image is not None:
                images[copy].append(np.asarray(image))

    observations = finite(_flat(vec_env.reset()), 0, "an observation")
    seen, taken = [observations.copy()], []
    features: list[np.ndarray | None] = []
    if frames:
        render()
    for step in range(1, max_steps + 1):
        actions, _ = model.predict(observations, state=latents, deterministic=deterministic)
        taken.append(np.array(finite(actions, step, "an action")))
        stepped, _, dones, infos = vec_env.step(actions)
        observations = _flat(stepped)
        given = reward_features(vec_env, infos)
        features.append(None if given is None else np.array(given, dtype=np.float64))
        after = observations.copy()
        for copy in np.flatnonzero(running):
            if "is_success" in infos[copy]:
                successes[copy] = bool(infos[copy]["is_success"])
            if dones[copy]:
                after[copy] = np.ravel(infos[copy]["terminal_observation"])
        seen.append(finite(after, step, "an observation"))
        lengths[running] = step
        running = running & ~dones
        if frames and step % frames == 0:
            render()
        if not running.any():
            break

    present = [rows for rows in features if rows is not None]
    of_rewards = np.stack(present, axis=1) if len(present) == len(features) else None
    observed, acted = np.stack(seen, axis=1), np.stack(taken, axis=1)
    for row, used in enumerate(lengths[:n].tolist()):
        trajectory = Trajectory(
            observations=observed[row, : used + 1].copy(),
            actions=acted[row, :used].copy(),
            latent=latents[row].copy(),
            reward_features=None if of_rewards is None else of_rewards[row, :used].copy(),
            frames=images[row] if frames else None,
        )
        yield trajectory, successes[row]


def _flat(observations: Any) -> np.ndarray:
    if not isinstance(observations, np.ndarray):
        kind = type(observations).__name__
        raise ValueError(f"observations must be arrays (a Box space), but are of type {kind}")
    return observations.reshape(len(observations), -1)
