"""What ``adapt``, ``enjoy`` and ``record-video`` work on: a model, its environment, test tasks."""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

# A model that rl_zoo3 trained may hold its schedules.
# Importing it replaces Gymnasium's TimeLimit, so it comes first.
import rl_zoo3  # noqa: F401
import torch as th
from rich.console import Console
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_poem.adaptation import AdaptedPolicy, KnownTaskReturn, Trajectory, known_task_return
from sb3_poem.adaptation.evaluation import evaluation_seed
from sb3_poem.adaptation.known_task import SELECTION_EPISODES
from sb3_poem.adaptation.policy import POLICY_SUFFIX
from sb3_poem.cli.needs import check_device, import_packages, parse_pairs, say
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.foreign import environment_of
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.vec_env import make_shown_env, make_task_vec_env
from sb3_poem.common.video import side_by_side, write_video
from sb3_poem.loading import load_model
from sb3_poem.pearl_sac import PEARLSAC

# Copies that step in lockstep for one task, whose questions need but two of them.
COPIES_FOR_ONE_TASK = 20


def describe_task(task: Sequence[float] | np.ndarray) -> str:
    """A task's numbers in one line."""
    return ", ".join(f"{value:.3g}" for value in task)


def after(n_answers: int) -> str:
    """When a policy was adapted so far."""
    return f"after {n_answers} answer{'s' * (n_answers != 1)}"


class Subject:
    """A model, an environment with many copies, and test tasks or the one of ``--task``."""

    def __init__(self, arguments: argparse.Namespace, n_tasks: int, copies: int) -> None:
        self.console, self.seed = Console(), int(arguments.seed)
        check_device(arguments.device)
        import_packages(arguments.gym_packages)
        th.set_num_threads(arguments.num_threads)
        #: (latent_dim,) of a file that holds a policy, which is adapted already
        self.latent: np.ndarray | None = None
        with self.console.status("Reading the model"):
            if Path(arguments.model).suffix == POLICY_SUFFIX:
                policy = AdaptedPolicy.load(arguments.model, arguments.device)
                assert isinstance(policy.model, PEARLSAC)
                self.model, self.latent = policy.model, policy.latent
            else:
                self.model = load_model(arguments.model, arguments.device)
        done, total = self.model.num_timesteps, self.model._total_timesteps
        if done < total:
            say(f"{arguments.model} is of {done:,} of the {total:,} steps of its training")
        given = parse_pairs("--env-kwargs", arguments.env_kwargs)
        self.env_id, self.env_kwargs = environment_of(
            arguments.model, self.model.env_id, self.model.env_kwargs, arguments.env, given
        )
        self.env = make_task_vec_env(self.env_id, copies, **self.env_kwargs)
        self.family = FamilyView(self.env)
        try:
            self.family.check_same_family(self.model.task_space, self.model.reward_feature_dim)
        except ValueError as error:
            trained = f"{arguments.model} was trained on {self.model.env_id}"
            raise ValueError(f"--env {self.env_id}, but {trained}: {error}") from error
        task, width = arguments.task, self.family.task_dim
        if task is not None and len(task) != width:
            numbers = f"{width} number{'s' * (width != 1)}"
            raise ValueError(f"--task needs {numbers} for {self.env_id}, got {len(task)}")
        #: (n_tasks, task_dim)
        self.tasks = np.array([task], dtype=np.float64)
        space = self.family.task_space
        if task is not None and not space.contains(self.tasks[0].astype(space.dtype)):
            raise ValueError(f"--task {describe_task(task)} is outside of the tasks, {space}")
        if task is None:
            self.tasks = self.family.test_tasks(n_tasks, self.seed)

    def known_task_return(self, n_episodes: int, limits: bool | str = False) -> KnownTaskReturn:
        """The best of the model's policies for each task, measured on so many episodes."""
        about = (self.model, self.env, self.tasks, None, n_episodes, self.seed)
        selection = min(n_episodes, SELECTION_EPISODES)
        with self.console.status("Looking for the best policy of every task, as if it were known"):
            return known_task_return(*about, selection_episodes=selection, limits=limits)

    def make_env(self, render_mode: str | None, show_task: bool) -> DummyVecEnv:
        """A single environment with the first task, which is drawn too if it is shown."""
        options = {**self.env_kwargs, "render_task": True} if show_task else self.env_kwargs
        env = DummyVecEnv([partial(make_shown_env, self.env_id, render_mode, **options)])
        FamilyView(env).set_tasks(self.tasks[:1])
        return env

    def roll_out(
        self, env: DummyVecEnv, latent: np.ndarray, episode: int = 0, frames: bool = False
    ) -> Trajectory:
        """An episode of a policy (latent_dim,) on the first task; equal numbers start alike."""
        seed, latents, tasks = evaluation_seed(self.seed) + episode, latent[None], self.tasks[:1]
        return rollout_latents(self.model, env, latents, tasks, [seed], frames=frames)[0]

    def true_return(self, episode: Trajectory) -> float:
        """What an episode earns on the first task."""
        assert episode.reward_features is not None
        return float(self.family.compute_rewards(self.tasks[0], episode.reward_features).sum())

    def film(
        self, latents: Sequence[np.ndarray], captions: Sequence[str], path: Path, show_task: bool
    ) -> None:
        """Film one policy (latent_dim,) on the first task, or two side by side, with captions, from
        the same start; ``show_task`` draws the task, and writes what was earned on it.
        """
        env = self.make_env("rgb_array", show_task)
        with self.console.status("Filming"):
            clips = [self.roll_out(env, latent, frames=True) for latent in latents]
            film, *other = [clip.frames or [] for clip in clips]
            if other:
                earned = [f": {self.true_return(clip):.1f}" if show_task else "" for clip in clips]
                left, right = (words + more for words, more in zip(captions, earned, strict=True))
                film = side_by_side(film, other[0], (left, right))
            write_video(film, path, FamilyView(env).render_fps)
        env.close()
        say(f"Wrote {path}" + (f" (task {describe_task(self.tasks[0])})" if show_task else ""))
