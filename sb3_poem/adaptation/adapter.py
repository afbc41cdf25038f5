"""Adaptation to one task, by ask and tell."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sb3_poem.adaptation.environments import Env, describe_model, model_and_env, warn_if_untrained
from sb3_poem.adaptation.inference import Answer, Snapshot
from sb3_poem.adaptation.noise import NoiseModel
from sb3_poem.adaptation.options import AdaptationOptions, inference_rng, rollout_seed
from sb3_poem.adaptation.policy import AdaptedPolicy
from sb3_poem.adaptation.preference import Preference, Query, as_preference
from sb3_poem.adaptation.state import read_json, write_json_atomically
from sb3_poem.common.checks import check_whole
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv

FORMAT_VERSION = 2

Oracle = Callable[[Trajectory, Trajectory], Any]


class OtherModelError(ValueError):
    """A saved adaptation belongs to another model than the one that it was given."""


class PreferenceAdapter:
    """Adapts a model to the hidden task of an environment by asking which of two trajectories is
    better.

    Nothing blocks: ``ask()`` gives a question, ``tell()`` takes its answer whenever there is one,
    ``policy()`` is usable at any time. The adapter reads no rewards and neither reads nor sets the
    task.

    .. code-block:: python

        adapter = PreferenceAdapter(model, env, seed=0)
        while not adapter.done:
            query = adapter.ask()
            adapter.tell(oracle(query.left, query.right))
        policy = adapter.policy()

    The new task is the one in effect in :attr:`env`, or the one that its first reset draws. Measure
    the policy there: ``evaluate_policy(policy, adapter.env)``. Another environment has another
    task; ``env.reset(seed=...)`` draws another, too, unless one was chosen, by
    ``sb3_poem.set_task(env, task)`` or ``reset(options={"task": task})``.

    :param model: A trained ``POEMSAC`` (or, within limits, ``PEARLSAC``), a file or folder of one,
        or the name of one that ships.
    :param env: The environment with the new task: a ``gym.Env``, its id, or a vector environment of
        Gymnasium's or SB3's, of which the first copy is watched.
    :param n_queries: How many answers are asked for at most (K).
    :param inference: "bayes", or "paper" (Algorithm 2 of Xu & Zhu 2025).
    :param query_rule: "worst-case" (eq. 10), "information-gain" or "random"; None takes
        "information-gain" for "bayes" and "worst-case" for "paper".
    :param n_candidates: Candidate latents (N_z); None takes 400 for "bayes" and the paper's 100 for
        "paper".
    :param epsilon: Tolerated error of eq. 9, in [0, 0.5); used by the paper's rules.
    :param candidates: Where candidates come from: "prior" (N(0, I)) or "aggregate" (the training
        tasks' posteriors and what lies between neighbours); None takes the prior, and for "bayes"
        the aggregate where that is far from the prior.
    :param likelihood: For "bayes": "decoder" (predicted returns of the trajectories shown) or
        "similarity" (S); None takes the decoder where the model has one and knows its error, which
        takes tasks that share their dynamics.
    :param decision: For "bayes": "expected-fitness", "posterior-mean" or "most-likely".
    :param noise_model: For "bayes": how the oracle errs; None takes ``oracle.noise_model`` where
        there is one, else no error.
    :param oracle: Who answers in :meth:`adapt`; a callable (left, right) -> Preference. If it has
        ``needs_frames``, trajectories carry frames. If it has ``bind`` and no environment yet, it
        is bound to ``env``.
    :param seed: Makes everything reproducible; None draws one, kept in ``seed``.
    :param deterministic: Whether policies act by their mode.
    :param library: For "bayes": trajectories to ask about instead of rolling out new ones.
    :param render: Whether questions carry frames, for :meth:`Query.to_video`. An ``env`` that is no
        id must have been made with ``render_mode="rgb_array"``.
    :raises ValueError: If an argument is out of its range, or the model belongs to another
        environment.
    :raises TypeError: If an argument is of another kind.
    """

    #: Where the new task is: the environment that was given or made from its id, as an SB3 VecEnv.
    env: VecEnv

    #: What one task's and many tasks' adaptation by this method are built from.
    options_class: ClassVar[Any] = AdaptationOptions

    def __init__(
        self,
        model: Any,
        env: Env,
        *,
        n_queries: int = 10,
        inference: str = "bayes",
        query_rule: str | None = None,
        n_candidates: int | None = None,
        epsilon: float = 0.1,
        candidates: str | None = None,
        likelihood: str | None = None,
        decision: str = "expected-fitness",
        noise_model: NoiseModel | None = None,
        oracle: Oracle | None = None,
        seed: int | None = None,
        deterministic: bool = True,
        library: Sequence[Trajectory] | None = None,
        render: bool = False,
    ) -> None:
        options = self.make_options(
            oracle,
            n_queries=n_queries,
            inference=inference,
            query_rule=query_rule,
            n_candidates=n_candidates,
            epsilon=epsilon,
            candidates=candidates,
            likelihood=likelihood,
            decision=decision,
            noise_model=noise_model,
            deterministic=deterministic,
        )
        self._start(model, env, options, oracle, seed, library, render)

    @classmethod
    def make_options(cls, oracle: Any = None, **options: Any) -> Any:
        """The options of an adaptation, which one task and many tasks share.

        :param oracle: Who will answer.
        :param options: Those of the constructor.
        :return: An ``options_class``.
        :raises ValueError: If an option is out of its range.
        """
        if options.get("noise_model") is None and not isinstance(oracle, type):
            options["noise_model"] = getattr(oracle, "noise_model", None)
        return cls.options_class(**options)

    def _start(
        self,
        model: Any,
        env: Env,
        options: Any,
        oracle: Oracle | None,
        seed: int | None,
        library: Sequence[Trajectory] | None,
        render: bool = False,
    ) -> None:
        if seed is not None:
            check_whole("seed", seed, 0)
        self.options = options
        self.seed = (
            int(np.random.SeedSequence().generate_state(1)[0] >> 1) if seed is None else int(seed)
        )
        self.render = render
        self.model, self.env = model_and_env(
            model, env, 1, render or bool(getattr(oracle, "needs_frames", False))
        )
        self._owns_env = isinstance(env, str)
        options.check(self.model, self.env, library)
        warn_if_untrained(self.model)
        self._take_oracle(oracle)
        self.library = None if library is None else list(library)
        self.inference = options.make_inference(self.model, inference_rng(self.seed), self.library)
        if (
            self.inference.library is not None and self._owns_env
        ):  # nothing is rolled out there: draw the task now
            self.env.seed(self.seed)
            self.env.reset()
        if hasattr(self.inference, "bind"):  # a method that is allowed to read rewards
            self.inference.bind(self.env)
        self._pending: Query | None = None
        self._previous: tuple[Snapshot, Query] | None = None

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
        return self.n_answers >= self.options.n_queries

    @property
    def pending(self) -> Query | None:
        """The question that waits for its answer, if any."""
        return self._pending

    def ask(self) -> Query:
        """The next question. While one waits for its answer, it is that one again.

        :return: Two trajectories on the new task.
        :raises RuntimeError: If all questions have been answered.
        """
        if self._pending is None:
            if self.done:
                raise RuntimeError(
                    f"all {self.options.n_queries} questions have been answered; take policy()"
                )
            self._pending = self._make_query()
        elif (
            self._needs_frames
            and self._pending.left.frames is None
            and self.inference.library is None
        ):
            # It comes from a file, which holds no frames; the same seed gives the same rollouts.
            self._pending = self._roll_out(
                *self.inference.same_latents(self._pending.left.latent, self._pending.right.latent)
            )
        return self._pending

    def tell(self, preference: Preference | str) -> None:
        """Answer the pending question.

        :param preference: A :class:`Preference`, or "left", "right" or "equal".
        :raises RuntimeError: If no question waits for an answer.
        :raises TypeError: If it is no answer.
        :raises ValueError: If it is another word. In both cases the question goes on waiting.
        """
        if self._pending is None:
            state = (
                "the last question has its answer already"
                if self.n_answers
                else "no question has been asked"
            )
            raise RuntimeError(f"tell() without a pending question: {state}; call ask() first")
        answer = as_preference(preference)
        query = self._pending
        before = self.inference.snapshot()
        self.inference.tell(answer, query.left, query.right)
        self._previous = (before, query)
        self._pending = None

    def undo(self) -> Query:
        """Take the last answer back; its question waits again. One step back, and only until the
        next question is asked for.

        :return: The question.
        :raises RuntimeError: If there is nothing to take back.
        """
        if self._previous is None or self._pending is not None:
            raise RuntimeError(
                "nothing to undo: undo() takes back the last answer, before the next question is asked for"
            )
        snapshot, query = self._previous
        self.inference.restore(snapshot, self.inference.answers[:-1])
        self._pending, self._previous = query, None
        return query

    def policy(self) -> AdaptedPolicy:
        """The policy for the answers so far; usable at any time.

        :return: A policy with SB3's ``predict``.
        """
        return AdaptedPolicy(self.model, self.inference.estimate(), self.n_answers, self.env)

    def __repr__(self) -> str:
        rule = getattr(self.options, "inference", getattr(self.options, "strategy", None))
        named = "" if rule is None else f", {rule}"
        answers = f"{self.n_answers} of {self.options.n_queries} answers"
        return f"{type(self).__name__}({describe_model(self.model)}{named}, {answers})"

    def adapt(self, oracle: Oracle | None = None, progress_bar: bool = False) -> AdaptedPolicy:
        """Ask the oracle until done.

        :param oracle: A callable (left, right) -> Preference; None takes the one given at
            construction.
        :param progress_bar: Whether to show one.
        :return: The adapted policy.
        :raises ValueError: If there is no oracle.
        """
        oracle = self.oracle if oracle is None else oracle
        if oracle is None:
            raise ValueError(
                "adapt() needs an oracle: pass it here or at construction, or use ask() and tell()"
            )
        self._take_oracle(oracle)
        from tqdm import tqdm

        with tqdm(
            total=self.options.n_queries,
            initial=self.n_answers,
            unit="query",
            disable=not progress_bar,
        ) as bar:
            while not self.done:
                query = self.ask()
                self.tell(oracle(query.left, query.right))
                bar.update()
        return self.policy()

    def close(self) -> None:
        """Close the environment, if the adapter made it from an id."""
        if self._owns_env:
            self.env.close()

    @classmethod
    def _format(cls) -> str:
        return f"sb3_poem.{cls.__name__}"

    @property
    def _needs_frames(self) -> bool | int:
        return getattr(self.oracle, "needs_frames", False) or self.render

    def _take_oracle(self, oracle: Oracle | None) -> None:
        self.oracle = oracle
        if oracle is None:
            return
        if isinstance(oracle, type):
            name = oracle.__name__
            raise TypeError(f"`oracle` is the class {name}, but must be an object: {name}()")
        if not callable(oracle):
            raise TypeError(
                "`oracle` must be called as oracle(left, right) and return a Preference, such as "
                f"ReturnOracle(), but is {oracle!r}"
            )
        if hasattr(oracle, "bind") and getattr(oracle, "env", None) is None:
            oracle.bind(self.env)

    def _make_query(self) -> Query:
        library = self.inference.library
        if library is not None:
            left, right = self.inference.ask_library()
            return Query(library[left], library[right])
        return self._roll_out(*self.inference.ask_latents())

    def _roll_out(self, left: np.ndarray, right: np.ndarray) -> Query:
        """Both rollouts start alike, one after the other in the first copy: other copies may hold
        other tasks.
        """
        seed = rollout_seed(self.seed, self.n_answers)
        trajectories = []
        for latent in (left, right):
            # Each fills a wave of its own; copies beyond the first repeat it and are not read.
            trajectories += rollout_latents(
                self.model,
                self.env,
                latent[None, :],
                None,
                [seed],
                self.options.deterministic,
                frames=self._needs_frames,
            )
        return Query(*trajectories)

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON-ready data: options, answers with their trajectories, posterior,
        random state, and the pending question. Frames stay out; model, environment, oracle and
        library too.

        :return: A dictionary that :meth:`from_dict` reads.
        """
        return {
            "format": self._format(),
            "version": FORMAT_VERSION,
            "model": {
                "latent_dim": int(self.model.latent_dim),
                "env_id": getattr(self.model, "env_id", None),
                "digest": getattr(self.model, "digest", None),
            },
            "seed": self.seed,
            "options": self.options.to_dict(),
            "uses_library": self.library is not None,
            "answers": [
                {"preference": answer.preference.value, **_pair_to_dict(answer.left, answer.right)}
                for answer in self.inference.answers
            ],
            "pending": None
            if self._pending is None
            else _pair_to_dict(self._pending.left, self._pending.right),
            "inference": self.inference.snapshot().to_dict(),
        }

    @classmethod
    def from_dict(
        cls,
        data: dict[str, Any],
        model: Any,
        env: Env,
        *,
        oracle: Oracle | None = None,
        library: Sequence[Trajectory] | None = None,
        render: bool = False,
    ) -> PreferenceAdapter:
        """Continue where :meth:`to_dict` stood: the same answers lead to the same policy as without
        the interruption.

        :param data: The dictionary.
        :param model: The same model.
        :param env: An environment with the same task.
        :param oracle: Who answers in :meth:`adapt`. A stochastic oracle's own generator is its own
            affair.
        :param library: The same library, if there was one.
        :param render: See :class:`PreferenceAdapter`.
        :return: The adapter.
        :raises OtherModelError: If the model has other weights, another family or another latent's
            dimension.
        :raises ValueError: If the data is broken, or of another version.
        """
        if data.get("format") != cls._format():
            raise ValueError(
                f"not a saved adaptation: `format` is {data.get('format')!r}, not {cls._format()!r}"
            )
        if data.get("version") != FORMAT_VERSION:
            raise ValueError(
                f"a saved adaptation of version {data.get('version')!r}; this program reads {FORMAT_VERSION}"
            )
        from sb3_poem.loading import as_model

        model = as_model(model)
        try:
            _check_same_model(data["model"], model)
            if data["uses_library"] and library is None:
                raise ValueError(
                    "this adaptation asks about a library of trajectories; pass the same `library` again"
                )
            adapter = cls.__new__(cls)
            options = cls.options_class.from_dict(data["options"])
            adapter._start(model, env, options, oracle, int(data["seed"]), library, render)
        except (KeyError, TypeError) as error:
            raise ValueError(
                f"a saved adaptation that is incomplete or broken: {error!r}"
            ) from error
        adapter.restore(data)
        return adapter

    def restore(self, data: dict[str, Any]) -> None:
        """Go to where another adapter of the same model, options and seed stood when
        :meth:`to_dict` was called.

        :param data: The dictionary.
        :raises ValueError: If the data is broken.
        """
        try:
            answers = [
                Answer(Preference(item["preference"]), *_pair_from_dict(item))
                for item in data["answers"]
            ]
            pending = None if data["pending"] is None else Query(*_pair_from_dict(data["pending"]))
            self.inference.restore(Snapshot.from_dict(data["inference"]), answers)
        except (KeyError, TypeError) as error:
            raise ValueError(
                f"a saved adaptation that is incomplete or broken: {error!r}"
            ) from error
        self._pending, self._previous = pending, None

    def to_json(self) -> str:
        """:meth:`to_dict` as a JSON text."""
        return json.dumps(self.to_dict(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str, model: Any, env: Env, **kwargs: Any) -> PreferenceAdapter:
        """:meth:`from_dict` of a JSON text.

        :param text: What :meth:`to_json` gave.
        :param model: The same model.
        :param env: An environment with the same task.
        :param kwargs: ``oracle``, ``library`` and ``render``.
        :return: The adapter.
        :raises ValueError: If the text is no JSON object, and as :meth:`from_dict`.
        """
        try:
            data = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"not a saved adaptation: {error}") from error
        if not isinstance(data, dict):
            raise ValueError(
                f"not a saved adaptation: it holds a {type(data).__name__}, not an object"
            )
        return cls.from_dict(data, model, env, **kwargs)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the state as a JSON file; an existing file is replaced only once the new one is
        whole.

        :param path: The file; its folder must exist.
        """
        write_json_atomically(path, self.to_dict())

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], model: Any, env: Env, **kwargs: Any
    ) -> PreferenceAdapter:
        """Continue from a file of :meth:`save`.

        :param path: The file.
        :param model: The same model.
        :param env: An environment with the same task.
        :param kwargs: ``oracle``, ``library`` and ``render``.
        :return: The adapter.
        :raises ValueError: If the file is truncated or foreign, and as :meth:`from_dict`.
        """
        return cls.from_dict(read_json(path), model, env, **kwargs)


def _pair_to_dict(left: Any, right: Any) -> dict[str, Any]:
    return {"left": left.to_dict(), "right": right.to_dict()}


def _pair_from_dict(data: dict[str, Any]) -> tuple[Trajectory, Trajectory]:
    return Trajectory.from_dict(data["left"]), Trajectory.from_dict(data["right"])


def _check_same_model(facts: dict[str, Any], model: Any) -> None:
    if facts["latent_dim"] != model.latent_dim:
        raise OtherModelError(
            f"the adaptation was saved with latent_dim={facts['latent_dim']}, but the model has {model.latent_dim}"
        )
    env_id = getattr(model, "env_id", None)
    if facts["env_id"] is not None and env_id is not None and facts["env_id"] != env_id:
        raise OtherModelError(
            f"the adaptation was saved with a model for {facts['env_id']}, but this one is for {env_id}"
        )
    if facts["digest"] != getattr(model, "digest", None):
        raise OtherModelError(
            f"the adaptation was saved with a model of other weights than this {describe_model(model)}: its latents mean "
            "nothing here; pass the very model with which it began, or begin anew"
        )
