"""``sb3-poem enjoy`` and ``record-video``: a policy for one task, in a window or in a file."""

import argparse
import shlex
from math import ceil
from pathlib import Path
from typing import Any

from poem_envs.headless import has_display
from poem_envs.registration import family_name
from sb3_poem.adaptation import evaluate_adaptation
from sb3_poem.cli.needs import check_output, say
from sb3_poem.cli.subject import COPIES_FOR_ONE_TASK, Subject, after, describe_task
from sb3_poem.cli.zoo import last_run
from sb3_poem.pearl_sac.saving import CHECKPOINT
from sb3_poem.resources import pretrained_names


def run_enjoy(arguments: argparse.Namespace) -> None:
    """Show a policy in a window."""
    if arguments.model is None:
        arguments.model = _last_run(arguments)
    if not has_display() and not arguments.no_render:
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        parser.add_argument("-n", "--n-timesteps")  # of which a film has no part
        _, shared = parser.parse_known_args(arguments.given[1:])
        film = shlex.join(["sb3-poem", "record-video", *shared, "--out", "policy.mp4"])
        raise OSError(f"there is no display to draw on: film it by `{film}`, or add --no-render")
    mode = None if arguments.no_render else "human"
    shown = Shown(arguments, mode)
    subject, steps = shown.subject, arguments.n_timesteps
    env = subject.make_env(mode, shown.shows_task)
    episodes = arguments.episodes if steps is None else ceil(steps / subject.model.horizon)
    try:
        for number in range(episodes):
            episode = subject.roll_out(env, shown.latents[-1], number)
            earned = f"return {subject.true_return(episode):.1f} in " if shown.has_task else ""
            say(f"Episode {number + 1}: {earned}{len(episode)} steps")
    finally:
        env.close()
        subject.env.close()


def run_record_video(arguments: argparse.Namespace) -> None:
    """Film a policy, or one before and after adaptation side by side."""
    check_output("--out", arguments.out, (".mp4", ".gif"))
    shown = Shown(arguments, "rgb_array")
    shown.subject.film(shown.latents, shown.captions, arguments.out, shown.shows_task)
    shown.subject.env.close()


class Shown:
    """The policies to show, ``latents`` (latent_dim,), one or two with ``captions``, and the task;
    both are printed. ``has_task`` is whether the task says anything of the policy.
    """

    def __init__(self, arguments: argparse.Namespace, render_mode: str | None) -> None:
        if arguments.model is None:
            arguments.model = _last_run(arguments)
        self.subject = subject = Subject(arguments, 1, COPIES_FOR_ONE_TASK)
        self.has_task = subject.latent is None or arguments.task is not None
        self.shows_task = self.has_task and render_mode is not None
        subject.make_env(render_mode, self.shows_task).close()  # before it is adapted
        if subject.latent is not None and arguments.known_task:
            what = f"but --model {arguments.model} is a policy"
            raise ValueError(f"--known-task chooses a policy of a model, {what}")
        self.captions: list[str] = []
        if self.has_task:
            say(f"Task of {subject.env_id}: {describe_task(subject.tasks[0])}")
        if subject.latent is not None:
            self.latents = [subject.latent]
            say(f"Policy: that in {arguments.model}, which is adapted already")
        elif arguments.known_task:
            known = subject.known_task_return(arguments.episodes)
            self.latents, n = [known.latents[0]], len(known.candidate_latents)
            what = f"the best of {n} for this task; return {known.mean_return:.1f}"
            say(f"Policy of {arguments.model}: {what}")
        else:
            self._adapt(arguments)

    def _adapt(self, arguments: argparse.Namespace) -> None:
        subject, asked = self.subject, arguments.queries
        with subject.console.status(f"Asking {asked} questions"):
            about = (subject.model, subject.env, subject.tasks)
            how: dict[str, Any] = {"n_episodes": arguments.episodes, "seed": subject.seed}
            measured = evaluate_adaptation(*about, record_at=(0, asked), **how)
        self.latents = list(measured.latents[0])
        self.captions = list(map(after, measured.record_at))
        earned = zip(measured.mean_returns, self.captions, strict=True)
        returns = ", ".join(f"return {mean:.1f} {when}" for mean, when in earned)
        say(f"Policy of {arguments.model}, adapted by the oracle that knows the return: {returns}")


def _last_run(arguments: argparse.Namespace) -> str:
    """The file with the model of the last run, or its checkpoint if it has not finished."""
    if arguments.env is None:
        last = "by --env the environment whose last run in --folder is shown"
        raise ValueError(f"name a model by --model, or {last}")
    name, number = arguments.env.replace("/", "-"), arguments.exp_id
    folder = Path(arguments.folder) / arguments.algo
    run = folder / f"{name}_{number}" if number else last_run(folder, name, seed=-1)
    if run is None or not run.is_dir():
        ships = family_name(arguments.env)
        which = ships if ships in pretrained_names() else "NAME (`sb3-poem models` lists them)"
        raise FileNotFoundError(
            f"there is no run{f' {number}' * bool(number)} of {arguments.algo} on {arguments.env} "
            f"in --folder {arguments.folder}: train one, or show one that ships by --model {which}"
        )
    model = run / f"{name}.zip"
    return str(model if model.exists() else run / CHECKPOINT)
