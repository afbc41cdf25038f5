"""``sb3-poem adapt``: adapt a model to unseen tasks by preference queries, and say what it earns."""

import argparse
import ast
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

# A model that rl_zoo3 trained may hold its schedules. Importing it replaces Gymnasium's TimeLimit, so it comes first.
import rl_zoo3  # noqa: F401
import torch as th
from rich.console import Console
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_poem.adaptation import (
    AdaptationEvaluation,
    BoltzmannOracle,
    HumanOracle,
    MistakeOracle,
    Preference,
    PreferenceAdapter,
    ReturnOracle,
    TaskOracle,
    evaluate_adaptation,
    evaluate_episodes,
    known_task_return,
)
from sb3_poem.adaptation.evaluation import evaluation_seed, held_out_tasks
from sb3_poem.adaptation.human import HumanAnswer
from sb3_poem.adaptation.oracles import compute_reward
from sb3_poem.cli.outputs import check_device, check_output
from sb3_poem.cli.packages import import_packages
from sb3_poem.cli.report import Report, describe_task
from sb3_poem.common.family import FamilyEnv
from sb3_poem.common.foreign import environment_of
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.common.video import side_by_side, write_video
from sb3_poem.loading import load_model

DEFAULT_TASKS = 30
# Copies that step in lockstep.
VECTORISED_COPIES = 60
# Episodes per latent when looking for a task's best: the fewer, the more luck counts in the limit.
SELECTION_EPISODES = 3


def run_adapt(arguments: argparse.Namespace) -> None:
    """
    Run the command.

    :param arguments: as ``sb3_poem.cli`` parsed them
    :raises ValueError: if they do not fit the model or the environment
    :raises OSError: if the model cannot be read, or a file not be written
    """
    check_device(arguments.device)
    check_output("--json", arguments.json, (".json",))
    check_output("--plot", arguments.plot, (".png", ".pdf", ".svg"))
    check_output("--video", arguments.video, (".mp4", ".gif"))
    if arguments.oracle == "human" and arguments.task is None and arguments.plot is not None:
        raise ValueError("--plot needs returns, and with --oracle human only --task says by which goal to measure them")
    if arguments.store is not None and arguments.oracle != "human":
        raise ValueError(f"--store keeps a person's answers, but --oracle is {arguments.oracle}")
    import_packages(arguments.gym_packages)
    th.set_num_threads(arguments.num_threads)
    console = Console()
    adaptation = Adaptation(arguments, console)
    evaluation = adaptation.ask_person() if arguments.oracle == "human" else adaptation.ask_oracle()
    if evaluation is not None:
        adaptation.report(evaluation)
    adaptation.env.close()


def parse_env_kwargs(pairs: list[str]) -> dict[str, Any]:
    """
    Read ``KEY:VALUE`` arguments; a value is a Python literal, or else a string.

    :raises ValueError: if there is no colon
    """
    kwargs = {}
    for pair in pairs:
        key, colon, text = pair.partition(":")
        if not colon or not key.isidentifier():
            raise ValueError(f"--env-kwargs {pair}: must have the form KEY:VALUE")
        try:
            kwargs[key] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            kwargs[key] = text
    return kwargs


class Adaptation:
    """A model, the environment with its test tasks, and how the arguments say to adapt the one to the other."""

    def __init__(self, arguments: argparse.Namespace, console: Console) -> None:
        self.arguments = arguments
        self.console = console
        self.seed: int = arguments.seed
        with console.status("Reading the model"):
            self.model = load_model(arguments.model, arguments.device)
        given = parse_env_kwargs(arguments.env_kwargs)
        self.env_id, self.env_kwargs = environment_of(
            arguments.model, self.model.env_id, self.model.env_kwargs, arguments.env, given
        )
        self.env = self._make_env()
        if arguments.record and max(arguments.record) > arguments.queries:
            raise ValueError(f"--record {max(arguments.record)} is more than --queries {arguments.queries}")
        family = FamilyEnv(self.env)
        try:
            family.check_same_family(self.model.task_space, self.model.reward_feature_dim)
        except ValueError as error:
            raise ValueError(
                f"--env {self.env_id}, but {arguments.model} was trained on {self.model.env_id}: {error}"
            ) from error
        chosen = {name: getattr(arguments, name) for name in ("inference", "query_rule", "candidates", "n_candidates")}
        self.options = {name: value for name, value in chosen.items() if value is not None}
        self.tasks = self._choose_tasks(family)

    def _make_env(self) -> VecEnv:
        return make_task_vec_env(self.env_id, VECTORISED_COPIES, **self.env_kwargs)

    def _choose_tasks(self, family: FamilyEnv) -> np.ndarray:
        """The test tasks, (n_tasks, task_dim). Those of a finite family are repeated in turn: each is one adaptation more."""
        arguments = self.arguments
        if arguments.task is not None:
            if arguments.tasks not in (None, 1):
                raise ValueError(f"--task is one task, but --tasks asks for {arguments.tasks}")
            if len(arguments.task) != family.task_dim:
                raise ValueError(f"--task needs {family.task_dim} numbers for {self.env_id}, got {len(arguments.task)}")
            return np.array([arguments.task], dtype=np.float64)
        human = arguments.oracle == "human"
        if human and arguments.tasks not in (None, 1):
            raise ValueError(f"--oracle human answers for one task, but --tasks asks for {arguments.tasks}")
        count = arguments.tasks or (1 if human else DEFAULT_TASKS)
        return held_out_tasks(family, count, self.seed)

    def ask_oracle(self) -> AdaptationEvaluation:
        """Let a program that knows the tasks answer."""
        arguments = self.arguments
        factories: dict[str, Callable[..., TaskOracle]] = {
            "return": ReturnOracle,
            "boltzmann": partial(BoltzmannOracle, arguments.beta),
            "mistake": partial(MistakeOracle, arguments.mistake_rate),
        }
        return evaluate_adaptation(
            self.model,
            self.env,
            self.tasks,
            factories[arguments.oracle],
            record_at=arguments.record or range(arguments.queries + 1),
            n_episodes=arguments.episodes,
            seed=self.seed,
            progress_bar=True,
            **self.options,
        )

    def ask_person(self) -> AdaptationEvaluation | None:
        """
        Let a person answer, who judges by their own wish. Returns are measured only if ``--task`` says what the wish was;
        if not, ``--json`` holds the answers and the posterior, from which :meth:`PreferenceAdapter.load` continues.
        """
        arguments = self.arguments
        env = DummyVecEnv([partial(self._make_rendering_env, show_task=False)])
        if arguments.task is not None:
            env.env_method("set_task", self.tasks[0])
        oracle = HumanOracle(record=self._recorder())
        adapter = PreferenceAdapter(
            self.model, env, oracle=oracle, n_queries=arguments.queries, seed=self.seed, **self.options
        )
        assert adapter.oracle is not None
        latents, answers = [adapter.policy().latent], []
        while not adapter.done:
            query = adapter.ask()
            answer = adapter.oracle(query.left, query.right)
            adapter.tell(answer)
            answers.append(answer)
            latents.append(adapter.policy().latent)
            if arguments.json is not None and arguments.task is None:
                adapter.save(arguments.json)
        env.close()
        if arguments.task is not None:
            return self._evaluate(np.array(latents), answers)
        if arguments.video is not None:
            self._film(self.tasks[0], np.stack([latents[0], latents[-1]]), (0, len(answers)))
        return None

    def _recorder(self) -> Callable[[HumanAnswer], None] | None:
        """Keeps the person's answers in the store of the page, if ``--store`` names one."""
        if self.arguments.store is None:
            return None
        from sb3_poem.label import Store, StoreRecorder

        name = Path(self.arguments.model).name
        return StoreRecorder(
            Store(self.arguments.store), name, self.env_id, self.seed, dict(self.options), self.arguments.queries
        )

    def _evaluate(self, latents: np.ndarray, answers: list[Preference]) -> AdaptationEvaluation:
        """Measure the latents (n_records, latent_dim) that one task went through."""
        tasks = np.repeat(self.tasks, len(latents), axis=0)
        with self.console.status("Measuring the returns"):
            outcomes = evaluate_episodes(
                self.model, self.env, latents, tasks, self.arguments.episodes, evaluation_seed(self.seed)
            )
        successes = None if outcomes.successes is None else outcomes.successes[None]
        records = tuple(range(len(latents)))
        return AdaptationEvaluation(self.tasks, records, latents[None], outcomes.returns[None], [answers], successes)

    def report(self, evaluation: AdaptationEvaluation) -> None:
        """Print and write what was asked for."""
        arguments = self.arguments
        with self.console.status("Looking for the best policy of every task, as if it were known"):
            known = known_task_return(
                self.model,
                self.env,
                self.tasks,
                n_episodes=arguments.episodes,
                seed=self.seed,
                selection_episodes=min(arguments.episodes, SELECTION_EPISODES),
            )
        settings = {
            "model": arguments.model,
            "env_id": self.env_id,
            "env_kwargs": self.env_kwargs,
            "oracle": arguments.oracle,
            "beta": arguments.beta if arguments.oracle == "boltzmann" else None,
            "mistake_rate": arguments.mistake_rate if arguments.oracle == "mistake" else None,
            **self.options,
            "episodes": arguments.episodes,
            "seed": self.seed,
        }
        title = f"{self.env_id}, {len(self.tasks)} task{'s' * (len(self.tasks) > 1)}, {arguments.oracle} oracle"
        Report(title, settings, evaluation, known).write(self.console, arguments.json, arguments.plot)
        if arguments.video is not None:
            self._film(self.tasks[0], evaluation.latents[0, [0, -1]], (evaluation.record_at[0], evaluation.record_at[-1]))

    def _make_rendering_env(self, show_task: bool) -> gym.Env:
        options = {"render_task": True} if show_task else {}
        env = gym.make(self.env_id, render_mode="rgb_array", **self.env_kwargs, **options)
        if "rgb_array" not in env.metadata.get("render_modes", ()):
            raise ValueError(f"{self.env_id} cannot be filmed: it has no render mode 'rgb_array'")
        return env

    def _film(self, task: np.ndarray, latents: np.ndarray, answers: tuple[int, int]) -> None:
        """Film the policies of two latents, (2, latent_dim), on one task from the same start: after so many answers each."""
        path: Path = self.arguments.video
        task_matters = self.arguments.oracle != "human" or self.arguments.task is not None
        env = DummyVecEnv([partial(self._make_rendering_env, show_task=task_matters)])
        with self.console.status("Filming"):
            seeds = [evaluation_seed(self.seed)] * 2
            clips = rollout_latents(self.model, env, latents, np.stack([task, task]), seeds, frames=True)
            captions = [f"after {n} answer{'s' * (n != 1)}" for n in answers]
            if task_matters:
                for i, clip in enumerate(clips):
                    assert clip.reward_features is not None
                    captions[i] += f": {compute_reward(env, task, clip.reward_features).sum():.1f}"
            fps = float(env.get_attr("metadata")[0].get("render_fps", 20))
            frames = side_by_side(clips[0].frames or [], clips[1].frames or [], (captions[0], captions[1]))
            write_video(frames, path, fps)
        env.close()
        self.console.print(f"Wrote {path}" + (f" (task {describe_task(task)})" if task_matters else ""))
