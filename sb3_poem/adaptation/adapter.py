"""Adaptation to one task, by ask and tell."""

import contextlib
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from sb3_poem.adaptation.bayes import Bayes
from sb3_poem.adaptation.environments import Env, describe_model, model_and_env, warn_if_untrained
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.adaptation.oracles import HasNeedsFrames, Oracle
from sb3_poem.adaptation.policy import AdaptedPolicy
from sb3_poem.adaptation.preference import PLACES, Preference, Query, as_preference
from sb3_poem.adaptation.rule import (
    Answer,
    Rule,
    Setting,
    Shown,
    as_rule,
    inference_rng,
    latent_of,
    latents_of,
    rollout_seed,
    seen,
)
from sb3_poem.common.checks import check_whole
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.files import parse_json, read_json, write_json_atomically
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory, decode_array, encode_array
from sb3_poem.loading import as_model

FORMAT, FORMAT_VERSION = "sb3_poem.PreferenceAdapter", 3


class OtherModelError(ValueError):
    """A saved adaptation belongs to another model than the one that it was given."""


class PreferenceAdapter:
    """Adapts a model to the hidden task of an environment by asking which of two trajectories is
    better, or which of four is best.

    Nothing blocks: ``ask()`` gives a question, ``tell()`` takes its answer whenever there is one,
    ``policy()`` is usable at any time. The adapter reads no rewards and neither reads nor sets the
    task.

    >>> from sb3_poem import PreferenceAdapter, ReturnOracle
    >>> adapter = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", seed=0)
    >>> oracle = ReturnOracle(adapter.env)
    >>> while not adapter.done:
    ...     query = adapter.ask()
    ...     adapter.tell(oracle(query.left, query.right))
    >>> policy = adapter.policy()

    The new task is the one in effect in :attr:`env`, or the one that its first reset draws.

    :param model: A trained ``POEMSAC`` (or, within limits, ``PEARLSAC``), a file or folder of one,
        or the name of one that ships.
    :param env: The environment with the new task: a ``gym.Env``, its id, or a vector environment of
        Gymnasium's or SB3's, of which the first copy is watched.
    :param rule: How to ask and to infer: :class:`Bayes`, :class:`Paper` (Algorithm 2 of Xu & Zhu
        2025), or a baseline; None is ``Bayes()``.
    :param n_queries: How many answers are asked for at most (K).
    :param oracle: Who answers in :meth:`adapt`; a callable of the trajectories that a question
        shows -> Preference. If it has ``needs_frames``, these carry frames. If it has ``bind`` and
        no environment of its own, it is bound to ``env`` until another adapter takes it.
    :param seed: Makes everything reproducible; None draws one, kept in ``seed``.
    :param deterministic: Whether policies act by their mode.
    :param library: Trajectories to ask about instead of rolling out new ones, for a rule that can.
    :param render: Whether questions carry frames, for :meth:`Query.to_video`: of every step, or of
        every n-th. An ``env`` that is no id must have been made with ``render_mode="rgb_array"``.
    :raises ValueError: If an argument is out of its range, the model belongs to another
        environment, or the rule cannot run with them.
    :raises TypeError: If an argument is of another kind.
    """

    #: The question that waits for its answer, if any.
    pending: Query | None
    #: Where the new task is: the environment that was given or made from its id, as an SB3 VecEnv.
    env: VecEnv

    def __init__(
        self,
        model: MetaModel | str | Path,
        env: Env,
        *,
        rule: Rule | None = None,
        n_queries: int = 10,
        oracle: Oracle | None = None,
        seed: int | None = None,
        deterministic: bool = True,
        library: Sequence[Trajectory] | None = None,
        render: bool | int = False,
    ) -> None:
        check_whole("n_queries", n_queries, 1)
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0] >> 1)
        check_whole("seed", seed, 0)
        _check_oracle(oracle)
        self._chosen_rule = Bayes() if rule is None else as_rule(rule)
        self.rule = self._chosen_rule.answered_by(oracle)
        self.n_queries, self.seed = int(n_queries), int(seed)
        self.deterministic, self.render, self.oracle = deterministic, render, oracle
        self.model, self.env = model_and_env(model, env, 1, bool(self._needs_frames))
        self._owns_env = isinstance(env, str)
        self.library = None if library is None else list(library)
        self._setting = Setting(self.n_queries, self.library, self.env, None, self._visibility)
        self._start()
        warn_if_untrained(self.model)
        self._take_oracle(oracle)
        if self.inference.library is not None:
            self._begin_episode(self.seed)
        # What was rolled out to choose a question, by the question's number and latent
        self._seen: dict[tuple[int, bytes], Trajectory] = {}
        self.pending = None
        self._previous: tuple[dict[str, Any], Query] | None = None

    def _start(self) -> None:
        self.rule.check(self.model, self._setting)
        self.inference = self.rule.start(self.model, inference_rng(self.seed), self._setting)

    def _begin_episode(self, seed: int) -> None:
        """Where nothing is rolled out, let the chosen task take effect, or draw the first one."""
        family = FamilyView.of(self.env)
        if family is not None:
            family.seed_episodes([seed] * self.env.num_envs)
            self.env.reset()

    @property
    def n_answers(self) -> int:
        """How many answers there are."""
        return len(self.inference.answers)

    @property
    def answers(self) -> list[Answer]:
        """The answers so far, with their trajectories."""
        return list(self.inference.answers)

    @property
    def done(self) -> bool:
        """Whether all questions have been answered."""
        return self.n_answers >= self.n_queries

    def ask(self) -> Query:
        """The next question, trajectories on the new task; the same again while it waits for its
        answer. A ``RuntimeError`` if all questions have been answered.
        """
        if self.pending is None:
            self._check_unfinished()
            self.pending = self._make_query(self.inference.ask(), self.n_answers)
        elif self._needs_frames and self._frames_are_missing(self.pending):
            # Neither a file nor an answer holds frames; the same seed gives the same rollouts.
            number, latents = self._number_of(self.pending), latents_of(self.pending.shown)
            shown = self.inference.same_latents(number, *latents)
            self.pending = self._make_query(shown, number)
        return self.pending

    def _frames_are_missing(self, query: Query) -> bool:
        return self.inference.library is None and query.shown[0].frames is None

    @property
    def contradicted(self) -> int | None:
        """The number, from 0, of the answer that the others contradict most; None if they agree,
        or the rule does not tell.
        """
        return self.inference.contradicted()

    def ask_again(self, number: int) -> Query:
        """Ask about the same trajectories as question ``number``, from 0, instead of the one that
        waits, if any; the answer is one more, beside the first. A ``ValueError`` if that question
        has none, and a ``RuntimeError`` if all questions have been answered.
        """
        self._check_unfinished()
        if number not in range(self.n_answers):
            known = f"that of an answer, from 0 to {self.n_answers - 1}"
            raise ValueError(f"`number` must be {known}, but is {number!r}")
        self.pending = Query(seen(self.answers[number].shown), self.rule.question)
        return self.ask()

    def tell(self, preference: Preference | str) -> None:
        """Answer the pending question.

        :param preference: A :class:`Preference`, or its word, "left" say.
        :raises RuntimeError: If no question waits for an answer.
        :raises TypeError, ValueError: If it is no answer to such a question, which goes on waiting.
        """
        if self.pending is None:
            answered = "the last question has its answer already"
            state = answered if self.n_answers else "no question has been asked"
            raise RuntimeError(f"tell() without a pending question: {state}; call ask() first")
        query = self.pending
        answer = as_preference(preference, query.kind)
        before = self.inference.snapshot()
        shown = query.shown
        if self.inference.library is None:  # the frames of ten questions would take gigabytes
            shown = tuple(replace(item, frames=None) for item in shown)
        self.inference.tell(answer, *shown)
        self.pending, self._previous = None, (before, query)
        self._seen.clear()

    def undo(self) -> Query:
        """Take the last answer back; its question waits again. One step back, and only until the
        next question is asked for: else a ``RuntimeError``.
        """
        if self._previous is None or self.pending is not None:
            only = "undo() takes back the last answer, before the next question is asked for"
            raise RuntimeError(f"nothing to undo: {only}")
        snapshot, query = self._previous
        self.inference.restore(snapshot, self.inference.answers[:-1])
        self.pending, self._previous = query, None
        return query

    def policy(self) -> AdaptedPolicy:
        """The policy for the answers so far, with SB3's ``predict``; usable at any time."""
        return AdaptedPolicy(self.model, self.inference.estimate(), self.n_answers, self.env)

    def __repr__(self) -> str:
        answers = f"{self.n_answers} of {self.n_queries} answers"
        return f"PreferenceAdapter({describe_model(self.model)}, {self.rule}, {answers})"

    def adapt(self, oracle: Oracle | None = None, progress_bar: bool = False) -> AdaptedPolicy:
        """Ask the oracle (None takes the one given at construction) until done; a ``ValueError`` if
        another one errs otherwise than the questions asked so far took for granted.
        """
        oracle = self.oracle if oracle is None else oracle
        if oracle is None:
            raise ValueError(
                "adapt() needs an oracle: pass it here or at construction, or use ask() and tell()"
            )
        _check_oracle(oracle)
        rule = self._chosen_rule.answered_by(oracle)  # refuses one that answers other questions
        if rule != self.rule:
            if self.n_answers or self.pending is not None:
                raise ValueError(
                    f"adapt() was given {oracle!r}, for which the rule is {rule}, but questions "
                    f"were asked by {self.rule}: pass the oracle to PreferenceAdapter, or a rule "
                    "with its `noise_model`"
                )
            self.rule = rule
            self._start()
        self._take_oracle(oracle)
        n, hidden = self.n_queries, not progress_bar
        with tqdm(total=n, initial=self.n_answers, unit="query", disable=hidden) as bar:
            while not self.done:
                self.tell(oracle(*self.ask().shown))
                bar.update()
        return self.policy()

    def close(self) -> None:
        """Close the environment, if the adapter made it from an id."""
        if self._owns_env:
            self.env.close()

    @property
    def _looks(self) -> bool | int:
        return isinstance(self.oracle, HasNeedsFrames) and self.oracle.needs_frames

    @property
    def _needs_frames(self) -> bool | int:
        return self._looks or self.render

    def _check_unfinished(self) -> None:
        if self.done:
            raise RuntimeError(f"all {self.n_queries} questions have been answered; take policy()")

    def _take_oracle(self, oracle: Any) -> None:
        self.oracle = oracle
        #: Whether somebody looks at the questions, also while answers given before are told again
        self._watched = self._looks or (self.render and oracle is None)
        bind, env = getattr(oracle, "bind", None), getattr(oracle, "env", None)
        # Nor is one that another adapter lent it its own
        if bind is not None and (env is None or env is getattr(oracle, "lent_env", None)):
            bind(self.env)
            oracle.lent_env = self.env

    def _number_of(self, query: Query) -> int:
        """Of the answer about the very trajectories of a question; else the next one's."""
        for number, answer in enumerate(self.answers):
            pairs = zip(seen(answer.shown), query.shown, strict=True)
            if all(np.array_equal(old.observations, new.observations) for old, new in pairs):
                return number
        return self.n_answers

    def _make_query(self, shown: Sequence[Shown], number: int) -> Query:
        rolled = tuple(self._rolled_out(item, number, self._needs_frames) for item in shown)
        return Query(rolled, self.rule.question)

    def _rolled_out(self, shown: Shown, number: int, frames: int) -> Trajectory:
        """What is shown of question ``number``: all its rollouts start alike."""
        if isinstance(shown, Trajectory):
            return shown
        latent = latent_of(shown)
        known = self._seen.get((number, latent.tobytes()))
        if known is not None and (known.frames is not None or not frames):
            return known
        seed = rollout_seed(self.seed, number)
        by_mode = self.deterministic and not self.rule.explores
        # One by one: copies beyond the first may hold other tasks. They repeat it, and are unread.
        about = (self.model, self.env, latent[None], None, [seed], by_mode)
        return rollout_latents(*about, frames=frames)[0]

    def _visibility(self, *pair: Shown) -> float:
        """See :class:`Setting`: the family's :meth:`~poem_envs.TaskFamily.visible_difference`, up
        to 1; for a simulated oracle 1.
        """
        family = FamilyView.of(self.env) if self._watched else None
        if family is None:
            return 1.0
        # The first pair is nearly always the one that is asked about, so that it is filmed at once.
        frames = 0 if self._seen else self._needs_frames
        left, right = rolled = [self._rolled_out(item, self.n_answers, frames) for item in pair]
        self._seen |= {(self.n_answers, clip.latent.tobytes()): clip for clip in rolled}
        if left.reward_features is None or right.reward_features is None:
            return 1.0
        shown = [*(item for answer in self.answers for item in answer.shown), *rolled]
        features = [item.reward_features for item in shown if isinstance(item, Trajectory)]
        spread = np.concatenate([rows for rows in features if rows is not None]).std(axis=0)
        visible = family.visible_difference(left.reward_features, right.reward_features, spread)
        return min(1.0, visible)

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON-ready data, for :meth:`from_dict`, but frames, model, environment,
        oracle and library.
        """
        model, pending, kind = self.model, self.pending, self.rule.question
        facts = {"env_id": model.env_id, "digest": model.digest}
        state = self.inference.snapshot()
        arrays = {name: encode_array(array) for name, array in state["arrays"].items()}
        return {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "model": {"latent_dim": int(model.latent_dim), **facts},
            "rule": self.rule.to_dict(),
            "n_queries": self.n_queries,
            "seed": self.seed,
            "deterministic": self.deterministic,
            "uses_library": self.library is not None,
            "answers": [
                {"preference": answer.preference.value, **shown_to_dict(kind, seen(answer.shown))}
                for answer in self.inference.answers
            ],
            "pending": None if pending is None else shown_to_dict(kind, pending.shown),
            "inference": {**state, "arrays": arrays},
        }

    @classmethod
    def from_dict(
        cls,
        data: dict[str, Any],
        model: MetaModel | str | Path,
        env: Env,
        *,
        oracle: Oracle | None = None,
        library: Sequence[Trajectory] | None = None,
        render: bool | int = False,
    ) -> Self:
        """Continue where :meth:`to_dict` stood: the same answers lead to the same policy as without
        the interruption. Model, task and library must be the same (an id's task is drawn again);
        for the arguments see :class:`PreferenceAdapter`.

        :raises ValueError: If the data is broken, of another version or model
            (``OtherModelError``), or its rule is not imported.
        """
        form, version = data.get("format"), data.get("version")
        if form != FORMAT:
            raise ValueError(f"not a saved adaptation: `format` is {form!r}, not {FORMAT!r}")
        if version != FORMAT_VERSION:
            raise ValueError(
                f"a saved adaptation of version {version!r}; this program reads {FORMAT_VERSION}"
            )
        own: MetaModel = as_model(model)
        with _complete():
            _check_same_model(data["model"], own)
            if data["uses_library"] and library is None:
                asks = "this adaptation asks about a library of trajectories"
                raise ValueError(f"{asks}; pass the same `library` again")
            kept = {name: data[name] for name in ("n_queries", "seed", "deterministic")}
            kept["rule"] = Rule.from_dict(data["rule"])
            adapter = cls(own, env, oracle=oracle, library=library, render=render, **kept)
        adapter.restore(data)
        if adapter._owns_env and library is None and (adapter.n_answers or adapter.pending):
            adapter._begin_episode(rollout_seed(adapter.seed, 0))  # as the first question did
        return adapter

    def restore(self, data: dict[str, Any]) -> None:
        """Go to where another adapter of the same model, rule and seed stood at :meth:`to_dict`;
        broken data raises a ``ValueError``.
        """
        kind = self.rule.question
        with _complete():
            answers = [
                Answer(Preference(item["preference"]), shown_from_dict(kind, item))
                for item in data["answers"]
            ]
            waits = data["pending"]
            pending = None if waits is None else Query(shown_from_dict(kind, waits), kind)
            state = data["inference"]
            arrays = {name: decode_array(array) for name, array in state["arrays"].items()}
            self.inference.restore({**state, "arrays": arrays}, answers)
        self.pending, self._previous = pending, None
        self._seen.clear()

    def to_json(self) -> str:
        """:meth:`to_dict` as a JSON text."""
        return json.dumps(self.to_dict(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str, model: MetaModel | str | Path, env: Env, **kwargs: Any) -> Self:
        """:meth:`from_dict`, with its arguments, of a JSON text."""
        data = parse_json(text, "the text is not a saved adaptation")
        return cls.from_dict(data, model, env, **kwargs)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state as a JSON file, which replaces an existing one only when it is whole."""
        write_json_atomically(path, self.to_dict())

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], model: MetaModel | str | Path, env: Env, **kwargs: Any
    ) -> Self:
        """:meth:`from_dict`, with its arguments, of a file of :meth:`save`."""
        return cls.from_dict(read_json(path, "a saved adaptation"), model, env, **kwargs)


@contextlib.contextmanager
def _complete() -> Iterator[None]:
    """Says of data that lacks something that it does."""
    try:
        yield
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"a saved adaptation that is incomplete or broken: {error!r}") from error


def shown_to_dict(kind: str, shown: Sequence[Trajectory]) -> dict[str, Any]:
    """What a question of this kind shows, JSON-ready, by place: "left" and "right", say."""
    return {place: item.to_dict() for place, item in zip(PLACES[kind], shown, strict=True)}


def shown_from_dict(kind: str, data: dict[str, Any]) -> tuple[Trajectory, ...]:
    """Read what :func:`shown_to_dict` wrote, other keys aside."""
    return tuple(Trajectory.from_dict(data[place]) for place in PLACES[kind])


def _check_oracle(oracle: object) -> None:
    if isinstance(oracle, type):
        name = oracle.__name__
        raise TypeError(f"`oracle` is the class {name}, but must be an object: {name}()")
    if oracle is not None and not callable(oracle):
        raise TypeError(
            "`oracle` must be called as oracle(left, right) and return a Preference, such as "
            f"ReturnOracle(), but is {oracle!r}"
        )


def _check_same_model(facts: dict[str, Any], model: MetaModel) -> None:
    saved, dim, env_id = "the adaptation was saved with", facts["latent_dim"], facts["env_id"]
    if dim != model.latent_dim:
        raise OtherModelError(f"{saved} latent_dim={dim}, but the model has {model.latent_dim}")
    if None not in (env_id, model.env_id) and env_id != model.env_id:
        raise OtherModelError(f"{saved} a model for {env_id}, but this one is for {model.env_id}")
    if facts["digest"] != model.digest:
        raise OtherModelError(
            f"{saved} a model of other weights than this {describe_model(model)}: its latents mean "
            "nothing here; pass the very model with which it began, or begin anew"
        )
