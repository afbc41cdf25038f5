"""``sb3-poem adapt``: adapt a model to unseen tasks by preferences, and say what it earns."""

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sb3_poem.adaptation import (
    AdaptationEvaluation,
    AdaptedPolicy,
    HumanOracle,
    KnownTaskReturn,
    PreferenceAdapter,
    evaluate_adaptation,
    evaluate_episodes,
    named_rule,
    return_spread,
)
from sb3_poem.adaptation.adapter import shown_from_dict
from sb3_poem.adaptation.environments import COPIES
from sb3_poem.adaptation.evaluation import evaluation_seed
from sb3_poem.adaptation.policy import POLICY_SUFFIX
from sb3_poem.benchmark.cells import make_oracle_factory
from sb3_poem.benchmark.models import try_lock
from sb3_poem.benchmark.suites import OracleSpec
from sb3_poem.cli.arguments import DEFAULT_STORE
from sb3_poem.cli.needs import check_output, say
from sb3_poem.cli.report import row_text, write_report
from sb3_poem.cli.subject import COPIES_FOR_ONE_TASK, Subject, after
from sb3_poem.label import Store, StoreRecorder
from sb3_poem.label.beliefs import believed_in_words

DEFAULT_TASKS, DEFAULT_MISTAKE_RATE = 30, 0.2
DEFAULT_THRESHOLDS = (0.1, 0.7)
#: Options that mean something with a value of another alone
GOES_WITH = {
    **dict.fromkeys(("store", "resume"), ("oracle", "human")),
    "beta": ("oracle", "boltzmann"),
    "mistake_rate": ("oracle", "mistake"),
    "thresholds": ("question", "graded"),
    "infer_noise": ("inference", "bayes"),
}


def run_adapt(arguments: argparse.Namespace) -> int:
    check_output("--json", arguments.json, (".json",))
    check_output("--plot", arguments.plot, (".png", ".pdf", ".svg"))
    check_output("--video", arguments.video, (".mp4", ".gif"))
    check_output("--save", arguments.save, (POLICY_SUFFIX,))
    if arguments.save is not None and arguments.save.exists() and not arguments.resume:
        other = "choose another name, or remove it"
        raise ValueError(f"--save {arguments.save}: a policy is kept there already; {other}")
    human = arguments.oracle == "human"
    n_tasks = _check_tasks(arguments)
    subject = Subject(arguments, n_tasks, COPIES_FOR_ONE_TASK if human else COPIES)
    if subject.latent is not None:
        what = "a policy that is adapted already; name the model instead"
        raise ValueError(f"--model {arguments.model} is {what}")
    adaptation = Adaptation(arguments, subject)
    if arguments.video is not None:
        subject.make_env("rgb_array", adaptation.task_matters).close()  # before it is adapted
    try:
        return adaptation.ask_person() if human else adaptation.ask_oracle()
    finally:
        subject.env.close()


def _check_tasks(arguments: argparse.Namespace) -> int:
    """How many tasks there are; refuses what does not go with so many, or with who answers."""
    human, named = arguments.oracle == "human", arguments.task is not None
    n_tasks: int = 1 if human or named else arguments.tasks or DEFAULT_TASKS
    if (arguments.tasks or n_tasks) != n_tasks:
        one = "--task is" if named else "--oracle human answers for"
        raise ValueError(f"{one} one task, but --tasks asks for {arguments.tasks}")
    if arguments.save is not None and n_tasks > 1:
        adapted = f"{n_tasks} are adapted: add --tasks 1, or --task X"
        raise ValueError(f"--save keeps the policy of one task, but {adapted}")
    if human and not named and arguments.plot is not None:
        only = "with --oracle human only --task says by which goal to measure them"
        raise ValueError(f"--plot needs returns, and {only}")
    for flag, (other, value) in GOES_WITH.items():
        given, chosen = getattr(arguments, flag), getattr(arguments, other) or "pair"
        if given is not None and given is not False and chosen != value:
            name = flag.replace("_", "-")
            raise ValueError(f"--{name} is for --{other} {value}, but that is {chosen}")
    equal, much = arguments.thresholds = arguments.thresholds or DEFAULT_THRESHOLDS
    if not 0.0 <= equal <= much < np.inf:
        shares = "must be two shares, the first not the larger"
        raise ValueError(f"--thresholds {equal:g} {much:g}: {shares}")
    if (last := max(arguments.record or (0,))) > arguments.queries:
        raise ValueError(f"--record {last} is more than --queries {arguments.queries}")
    return n_tasks


class Adaptation:
    """How the arguments say to adapt the subject's model to its tasks."""

    def __init__(self, arguments: argparse.Namespace, subject: Subject) -> None:
        self.arguments, self.subject = arguments, subject
        rate = arguments.mistake_rate
        values = {"mistake": DEFAULT_MISTAKE_RATE if rate is None else rate}
        values["boltzmann"] = arguments.beta
        value, thresholds = values.get(arguments.oracle), tuple(arguments.thresholds)
        self.oracle = OracleSpec(arguments.oracle, value, thresholds=thresholds)
        names = ("inference", "query_rule", "candidates", "n_candidates", "question")
        chosen = {name: getattr(arguments, name) for name in names}
        chosen["noise_model"] = "infer" if arguments.infer_noise else None
        self.options = {name: value for name, value in chosen.items() if value is not None}
        self.rule = named_rule(**self.options)
        #: Whether who answers knows the task
        self.task_matters = arguments.oracle != "human" or arguments.task is not None

    def ask_oracle(self) -> int:
        """Let a program that knows the tasks answer, and say each measurement as it comes."""
        arguments, subject = self.arguments, self.subject
        spread = None
        if self.rule.question == "graded":
            spread = return_spread(subject.model, subject.env, subject.seed)
        factory = make_oracle_factory(self.oracle, self.rule.question, spread)
        measured: list[AdaptationEvaluation] = []
        last = arguments.queries
        first = {0} if arguments.video is not None else set()  # which the film shows, too
        record_at = tuple(sorted({*(arguments.record or range(last)), last, *first}))

        def show(evaluation: AdaptationEvaluation) -> None:
            measured.append(evaluation)
            with tqdm.external_write_mode():
                say(row_text(evaluation))

        known = None
        try:
            about = (subject.model, subject.env, subject.tasks, factory)
            how: dict[str, Any] = {"n_episodes": arguments.episodes, "seed": subject.seed}
            how |= {"rule": self.rule, "record_at": record_at, "progress_bar": True}
            evaluate_adaptation(*about, on_record=show, **how)
            known = subject.known_task_return(arguments.episodes, "exact")
        except KeyboardInterrupt:
            if not measured:
                raise
        evaluation = measured[-1]
        self._report(evaluation, known)
        self._save(evaluation.latents[0, -1], evaluation.record_at[-1])
        if known is None:
            say(f"Interrupted after {evaluation.record_at[-1]} of {record_at[-1]} answers.")
            return 130
        if arguments.video is not None:
            self._film(evaluation.latents[0], evaluation.record_at)
        return 0

    def ask_person(self) -> int:
        """Let a person answer, who judges by their own wish. The store has each answer at once.

        Returns are measured only if ``--task`` says what the wish was; if not, ``--json`` holds the
        answers and the posterior, from which :meth:`PreferenceAdapter.load` continues.
        """
        arguments, subject = self.arguments, self.subject
        store = Store(arguments.store or DEFAULT_STORE)
        name = Path(arguments.model).resolve().name  # by which replay knows it, as "." or a link
        about = (name, subject.env_id, subject.seed, self.options, arguments.queries)
        recorder = StoreRecorder(store, *about, resume=arguments.resume)
        session = recorder.session.id
        with try_lock(store.folder / f"session-{session}.lock") as mine:
            if not mine:
                there = f"session {session} of {store.folder} is in use at another terminal"
                raise ValueError(f"--resume: {there}; let it end there, or stop it, first")
            return self._ask(recorder)

    def _ask(self, recorder: StoreRecorder) -> int:
        arguments, subject = self.arguments, self.subject
        store, n_queries = recorder.store, arguments.queries
        session, kept = f"session {recorder.session.id}", recorder.kept()
        if arguments.resume:
            nothing = "There is nothing to go on with; beginning"
            found = "Going on with" if recorder.resumed else nothing
            say(f"{found} {session} of {store.folder}")
        # Of each session, as another terminal may show its films meanwhile
        films = Path("preference_queries", f"session-{recorder.session.id}")
        oracle = HumanOracle(films, record=recorder, question=self.rule.question)
        env = subject.make_env("rgb_array", show_task=False)
        how: dict[str, Any] = {"oracle": oracle, "n_queries": n_queries, "seed": subject.seed}
        adapter = PreferenceAdapter(subject.model, env, rule=self.rule, **how)
        latents, stopped = [adapter.policy().latent], ""
        if not adapter.done:
            say("Answer by your own wish. Ctrl-C stops; what was answered is kept.")
        try:
            while not adapter.done:
                oracle.n_asked = adapter.n_answers
                oracle.needs_frames = adapter.n_answers >= len(kept)
                shown = adapter.ask().shown
                if oracle.needs_frames:
                    adapter.tell(oracle(*shown))
                else:
                    self._tell_again(adapter, kept[adapter.n_answers], session)
                latents.append(adapter.policy().latent)
        except (EOFError, KeyboardInterrupt) as error:
            if not adapter.n_answers:
                raise
            interrupted = isinstance(error, KeyboardInterrupt)
            stopped = "Interrupted" if interrupted else "Standard input ended"
        finally:
            env.close()
        return self._conclude(adapter, recorder, np.array(latents), stopped)

    def _tell_again(self, adapter: PreferenceAdapter, kept: dict[str, Any], about: str) -> None:
        shown = adapter.ask().shown
        for now, was in zip(shown, shown_from_dict(self.rule.question, kept), strict=True):
            # Later actions follow from how this machine rounds, too.
            acts = np.allclose(now.actions[0], was.actions[0], atol=1e-2)
            if not (acts and np.allclose(now.latent, was.latent)):
                raise ValueError(
                    f"--resume: question {adapter.n_answers + 1} of {about} was another one; was "
                    f"it asked with another model of the name {Path(self.arguments.model).name}? "
                    "Leave out --resume to begin anew"
                )
        adapter.tell(kept["preference"])

    def _conclude(
        self, adapter: PreferenceAdapter, recorder: StoreRecorder, latents: np.ndarray, stopped: str
    ) -> int:
        """Write what was asked for by latents (n_answers + 1, latent_dim), and say how to go on."""
        arguments, subject = self.arguments, self.subject
        interrupted = stopped == "Interrupted"
        if stopped:
            say(f"\n{stopped} after {adapter.n_answers} of {arguments.queries} answers.")
        self._save(latents[-1], adapter.n_answers)
        if arguments.json is not None and arguments.task is None:
            adapter.save(arguments.json)
            say(f"Wrote {arguments.json}")
        if arguments.task is not None and not interrupted:
            known = subject.known_task_return(arguments.episodes, "exact")
            self._report(self._measure(latents, adapter), known)
        if arguments.video is not None and not interrupted:
            self._film(latents, (0, adapter.n_answers))
        say(f"\n{believed_in_words(adapter, subject.env_id)}")
        say(f"The answers are in {recorder.store.folder}, session {recorder.session.id}. Next:")
        words = [word for word in arguments.given if word != "--resume"]
        again = shlex.join(["sb3-poem", *words, "--resume"])
        if not adapter.done:
            say(f"  answer the rest:  {again}")
        if arguments.save is None:
            own = f"policy-{recorder.session.id}{POLICY_SUFFIX}"
            say(f"  keep the policy:  {again} --save {own}")
        else:
            film = ["sb3-poem", "record-video", "--model", str(arguments.save)]
            for flag, given in (
                ("--env", [arguments.env] if arguments.env else []),
                ("--env-kwargs", arguments.env_kwargs),
                ("--gym-packages", arguments.gym_packages),
            ):
                film += [flag, *given] * bool(given)
            say(f"  watch the policy: {shlex.join([*film, '--out', 'policy.mp4'])}")
        return 130 if interrupted else 0

    def _measure(self, latents: np.ndarray, adapter: PreferenceAdapter) -> AdaptationEvaluation:
        """Measure the latents (n_answers + 1, latent_dim) that one task went through."""
        subject, last = self.subject, len(latents) - 1
        wanted = self.arguments.record or range(last)
        records = [n for n in range(last + 1) if n in wanted or n == last]
        latents = latents[records]
        tasks = np.repeat(subject.tasks, len(latents), axis=0)
        with subject.console.status("Measuring the returns"):
            about = (subject.model, subject.env, latents, tasks, self.arguments.episodes)
            outcomes = evaluate_episodes(*about, evaluation_seed(subject.seed))
        successes = None if outcomes.successes is None else outcomes.successes[None]
        answers = [[answer.preference for answer in adapter.answers]]
        adapted = (subject.tasks, tuple(records), latents[None], answers)
        return AdaptationEvaluation(*adapted, outcomes.returns[None], successes)

    def _report(self, evaluation: AdaptationEvaluation, known: KnownTaskReturn | None) -> None:
        """Print and write what was measured; without ``known`` it was interrupted."""
        arguments, subject, oracle = self.arguments, self.subject, self.oracle
        settings = {
            "model": arguments.model,
            "env_id": subject.env_id,
            "env_kwargs": subject.env_kwargs,
            "oracle": oracle.kind,
            "beta": oracle.value if oracle.kind == "boltzmann" else None,
            "mistake_rate": oracle.value if oracle.kind == "mistake" else None,
            "thresholds": arguments.thresholds if self.rule.question == "graded" else None,
            **self.options,
            "episodes": arguments.episodes,
            "seed": subject.seed,
            "complete": known is not None,
        }
        n_tasks = len(subject.tasks)
        title = f"{subject.env_id}, {n_tasks} task{'s' * (n_tasks > 1)}, {oracle.kind} oracle"
        title += ", incomplete" * (known is None)
        write_report(title, settings, evaluation, known, arguments.json, arguments.plot)

    def _film(self, latents: np.ndarray, answers: Sequence[int]) -> None:
        """Film the policies (n_records, latent_dim) after the fewest and the most answers."""
        captions = (after(answers[0]), after(answers[-1]))
        policies, video = (latents[0], latents[-1]), self.arguments.video
        self.subject.film(policies, captions, video, self.task_matters)

    def _save(self, latent: np.ndarray, n_answers: int) -> None:
        if self.arguments.save is not None:
            AdaptedPolicy(self.subject.model, latent, n_answers).save(self.arguments.save)
            say(f"Wrote {self.arguments.save}")
