"""Recorded answers, fed to another model or another rule of inference."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from sb3_poem.adaptation.adapter import shown_from_dict
from sb3_poem.adaptation.preference import BEST_OF_FOUR, PLACES, Preference
from sb3_poem.adaptation.rule import Setting, inference_rng
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.label.beliefs import believed_in_words
from sb3_poem.label.rendering import session_rule
from sb3_poem.label.store import Session, Store


class OtherRobotError(ValueError):
    """Trajectories that were recorded of another robot than a model's."""


# Latents of another model among which the one is sought that acts most like a recorded trajectory.
N_CANDIDATES = 256


def replay(
    store: Store,
    session: Session,
    model: Any,
    options: dict[str, Any] | None = None,
    seed: int = 0,
    is_own: bool = True,
) -> dict[str, Any]:
    """Feed a session's answers to a model. Before each answer the model foretells it: the one of
    largest predicted return for the policy that it would take so far.

    :param model: A model whose observations and actions are those of the recorded trajectories.
    :param options: Of the adaptation, as a session's; ``mistake_rate`` stands for the noise model.
        Bayes' rule reads answers as those to the session's kind of question.
    :param is_own: Whether the session was recorded with this very model. If not, the latents that
        were shown are replaced by those of its own latents that act most alike.
    :return: JSON-ready: ``session``, ``foretold`` of ``decided`` answers (those that are not
        "equal"), ``latents`` after 0, 1, ... answers, ``sentence`` (the belief in words) and
        ``action_error``, the root mean squared difference of the actions of such latents from those
        recorded (None where no latents had to be replaced).
    :raises OtherRobotError: If the model does not fit the recorded trajectories
    :raises ValueError: If the rule asks about pairs and the session about four
    """
    options, kind = dict(options or {}), session.question
    if options.get("inference", "bayes") == "bayes":
        options |= {"question": kind, "query_rule": "random"}  # which asks nothing of the model
    elif kind == BEST_OF_FOUR:
        only = f'which only inference="bayes" reads, but inference is {options["inference"]!r}'
        raise ValueError(f"session {session.id} asks which of four is best, {only}")
    rule = session_rule(options)
    rule.check(model, Setting())
    inference = rule.start(model, inference_rng(seed), Setting())
    if not is_own:
        rng = np.random.default_rng([seed, 1])
        others = model.sample_latents(N_CANDIDATES, rng, source="aggregate")
        candidates = np.concatenate([np.asarray(model.task_latents, dtype=np.float64), others])
    errors: list[float] = []
    latents, foretold, decided = [inference.estimate()], 0, 0
    for item in store.adapter_answers(session.id):
        preference = Preference(item["preference"])
        shown = shown_from_dict(kind, item)
        _check_fits(model, shown[0])
        if not is_own:
            alike = (_most_alike(model, candidates, clip) for clip in shown)
            shown, off = zip(*alike, strict=True)
            errors += off
        if preference is not Preference.EQUAL:
            decided += 1
            returns = model.predicted_returns(latents[-1][None, :], shown)[0]
            best = PLACES[kind][int(np.argmax(returns))]
            foretold += best in preference.value
        inference.tell(preference, *shown)
        latents.append(inference.estimate())
    replayed: Any = SimpleNamespace(model=model, inference=inference)
    return {
        "session": session.id,
        "model": session.model,
        "foretold": foretold,
        "decided": decided,
        "latents": [latent.tolist() for latent in latents],
        "sentence": believed_in_words(replayed, session.env_id),
        "action_error": float(np.sqrt(np.mean(np.square(errors)))) if errors else None,
    }


def recorded_digest(store: Store, session: Session) -> str | None:
    """The digest of the model with which an answered session was recorded; None at a terminal."""
    first: Any = store.whole_turn(store.answers(session.id)[0]["question"])
    return None if first["state"] is None else str(json.loads(first["state"])["model"]["digest"])


def _most_alike(model: Any, latents: np.ndarray, recorded: Trajectory) -> tuple[Trajectory, float]:
    """The trajectory, with that of the latents (n, d) whose policy acts most as it was acted, and
    the root mean squared difference of the actions.
    """
    seen = recorded.observations[:-1]
    errors = []
    for latent in latents:
        actions, _ = model.predict(seen, state=np.tile(latent, (len(seen), 1)), deterministic=True)
        errors.append(float(np.sqrt(np.mean(np.square(actions - recorded.actions)))))
    best = int(np.argmin(errors))
    return replace(recorded, latent=latents[best].copy()), errors[best]


def _check_fits(model: Any, trajectory: Trajectory) -> None:
    shown = (trajectory.observations.shape[1], trajectory.actions.shape[1])
    taken = (model.observation_space.shape[0], model.action_space.shape[0])
    if shown != taken:
        raise OtherRobotError(
            f"the recorded trajectories have {shown[0]} observations and {shown[1]} actions, but "
            f"the model takes {taken[0]} and {taken[1]}; replay to a model of the same robot"
        )
