"""One turn of a conversation, as a pure function: the state before, and the answer, give the state
after and its video.

Nothing is remembered between turns but models and environments, so any process may compute any turn
of any session, ahead of time or again; the same input always gives the same turn, bit for bit.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.adaptation.noise import MistakeNoise
from sb3_poem.adaptation.options import rollout_seed
from sb3_poem.adaptation.preference import Preference
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.label.beliefs import belief
from sb3_poem.label.catalogue import Choice
from sb3_poem.label.videos import HEIGHT, WIDTH, fit, pair, write_clip

# The result's rollout starts as no question's does.
RESULT_ROLLOUT = 1_000_000
# The hidden task of the environment, of which the person knows nothing, comes from a stream of its
# own.
TASK_STREAM = 0x1ABE1
# Frames per second that a film should not fall below.
SMOOTH_FPS = 8.0
# Frames per second of a film otherwise; where a family is drawn more often, some steps are left
# out.
FILM_FPS = 20.0
#: Models that a process keeps.
BENCHES = 4
#: What an adapter's dictionary holds of its conversation; the rest is the ``state`` of a turn.
CONVERSATION = ("answers", "pending")


@dataclass(frozen=True)
class Request:
    """What a turn is made from.

    :param choice: The model and its environment.
    :param seed: Of the adaptation.
    :param options: Of the adapter.
    :param wanted: "question" or "result".
    :param video: The file to write.
    :param state: The state of the turn before; None at the start.
    :param answers: The answers before that turn: ``preference``, ``left``, ``right``.
    :param pending: That turn's question: ``left``, ``right``.
    :param preference: The answer to it; None at the start, and to film the question again.
    :param film_every: How many steps lie between two frames of the video, if it moves smoothly
        enough then.
    """

    choice: Choice
    seed: int
    options: dict[str, Any]
    wanted: str
    video: Path
    state: dict[str, Any] | None = None
    answers: Sequence[dict[str, Any]] = ()
    pending: dict[str, Any] | None = None
    preference: str | None = None
    film_every: int = 1

    @property
    def marker(self) -> Path:
        """A file that whoever asks may keep while the turn is wanted: taking it away ends the work."""
        return self.video.with_suffix(".wanted")


class NotWantedError(Exception):
    """A turn's marker was taken away while it was made."""


@dataclass(frozen=True)
class Turn:
    """A question, or a result, and what is believed there.

    :param state: What the next turn is made from, beside the conversation; None where none follows
        (at a terminal), as then are belief and latent.
    :param left: The question's left trajectory; None in a result.
    :param right: The right one.
    :param belief: As :func:`sb3_poem.label.beliefs.belief` gives it.
    :param latent: (d,) of the policy that would be taken now.
    :param fps: Of the video.
    :param frames: Of the video.
    """

    state: dict[str, Any] | None
    left: dict[str, Any] | None
    right: dict[str, Any] | None
    belief: dict[str, Any] | None
    latent: list[float] | None
    fps: float
    frames: int


class _Watches:
    """Stands for the person where the adapter asks who answers: somebody who needs to see.

    :param film_every: See :class:`Request`.
    """

    def __init__(self, film_every: int) -> None:
        self.needs_frames = film_every

    def __call__(self, left: Trajectory, right: Trajectory) -> Preference:
        """Answers come through ``tell()``, when they come."""
        raise RuntimeError("a person answers on the page; adapt() cannot ask")


class Bench:
    """A model and its environment, which renders.

    :param env: An SB3 ``VecEnv`` that renders RGB images.
    """

    def __init__(self, model: Any, env: Any, env_id: str) -> None:
        if env.render_mode != "rgb_array":
            raise ValueError(
                f'`env` must be made with render_mode="rgb_array" to be shown, but has {env.render_mode!r}'
            )
        self.model = model
        self.env = env
        self.env_id = env_id
        self.fps = FamilyView(env).render_fps

    def turn(self, request: Request) -> Turn:
        """Make a turn, and write its video.

        :param request: What it is made from.
        :return: The turn.
        """
        adapter = self.adapter(request)
        if request.preference is not None:
            adapter.tell(request.preference)
        believed, latent = belief(adapter, self.env_id), adapter.policy().latent
        if request.wanted == "question":
            query = adapter.ask()
            frames = pair(query.left.frames or [], query.right.frames or [])
        else:
            frames = self._film(adapter, latent, self._film_every(request))
        fps = self.fps / self._film_every(request)
        write_clip(frames, request.video, fps)
        data = adapter.to_dict()
        pending = data["pending"] or {"left": None, "right": None}
        state = {name: value for name, value in data.items() if name not in CONVERSATION}
        return Turn(
            state, pending["left"], pending["right"], believed, latent.tolist(), fps, len(frames)
        )

    def warm_up(self) -> None:
        """Do once what only the first time is slow: the first image, the first action."""
        latent = np.zeros((1, self.model.latent_dim))
        rollout_latents(self.model, self.env, latent, None, [0], frames=True, max_steps=2)

    def adapter(self, request: Request) -> PreferenceAdapter:
        """The adapter as it was before the answer.

        :param request: What a turn is made from.
        :return: The adapter.
        """
        # The session counts the questions; the adapter must only be ready for one more.
        n_queries = len(request.answers) + 2
        if request.state is None:
            return PreferenceAdapter(
                self.model,
                self.env,
                oracle=_Watches(self._film_every(request)),
                seed=request.seed,
                n_queries=n_queries,
                **adapter_options(request.options),
            )
        state = {**request.state, "options": {**request.state["options"], "n_queries": n_queries}}
        data = {**state, "answers": list(request.answers), "pending": request.pending}
        return PreferenceAdapter.from_dict(
            data, self.model, self.env, oracle=_Watches(self._film_every(request))
        )

    def _film_every(self, request: Request) -> int:
        every = max(
            1, int(self.fps / FILM_FPS)
        )  # of what moves faster than films do not all steps are filmed
        return (
            every * request.film_every
            if self.fps / (every * request.film_every) >= SMOOTH_FPS
            else every
        )

    def _film(
        self, adapter: PreferenceAdapter, latent: np.ndarray, film_every: int
    ) -> list[np.ndarray]:
        seed = rollout_seed(adapter.seed, RESULT_ROLLOUT)
        clip = rollout_latents(
            self.model,
            self.env,
            latent[None, :],
            None,
            [seed],
            adapter.options.deterministic,
            frames=film_every,
        )[0]
        return [fit(frame) for frame in clip.frames or []]


def adapter_options(options: dict[str, Any]) -> dict[str, Any]:
    """Options of a session as the adapter's.

    :param options: JSON-ready; ``mistake_rate`` stands for the noise model.
    :return: Keyword arguments of ``PreferenceAdapter``.
    """
    others = dict(options)
    return {"noise_model": MistakeNoise(others.pop("mistake_rate", 0.05)), **others}


def make_turn(request: Request) -> Turn:
    """Make a turn in this process, which keeps models and environments that it has used.

    :param request: What it is made from.
    :return: The turn.
    :raises NotWantedError: If there was a marker, and it is taken away.
    """
    bench = bench_of(request.choice)
    bench.env.env_method("render_while", request.marker if request.marker.exists() else None)
    family = FamilyView(bench.env)
    family.set_tasks(family.sample_tasks(1, np.random.default_rng([TASK_STREAM, request.seed])))
    return bench.turn(request)


@lru_cache(maxsize=BENCHES)
def bench_of(choice: Choice) -> Bench:
    """Load a model and make its environment.

    :param choice: Which.
    :return: Both, ready.
    """
    from stable_baselines3.common.vec_env import DummyVecEnv

    env = DummyVecEnv(
        [lambda: _RendersWhileWanted(make_env(choice.env_id, dict(choice.env_kwargs)))]
    )
    return Bench(load_choice(choice), env, choice.env_id)


class _RendersWhileWanted(gym.Wrapper):
    """Rendering is what takes long in a turn, so there it is looked whether the turn is still
    wanted.
    """

    _marker: Path | None = None

    def render_while(self, marker: Path | None) -> None:
        """From now on.

        :param marker: A file without which rendering raises :class:`NotWantedError`; None renders
            always.
        """
        self._marker = marker

    def render(self) -> Any:
        """See :class:`gymnasium.Env`."""
        if self._marker is not None and not self._marker.exists():
            raise NotWantedError
        return super().render()


def load_choice(choice: Choice) -> Any:
    """Load a model.

    :param choice: Which.
    :return: The model.
    """
    from sb3_poem.pearl_sac import PEARLSAC
    from sb3_poem.poem_sac import POEMSAC

    algorithm: type[PEARLSAC] = PEARLSAC if choice.algorithm == PEARLSAC.__name__ else POEMSAC
    return algorithm.from_pretrained(choice.folder, device="cpu")


def make_env(env_id: str, env_kwargs: dict[str, Any]) -> gym.Env:
    """An environment that renders, small and fast where it can.

    :param env_kwargs: Its arguments.
    :return: The environment.
    :raises ValueError: If it cannot render RGB images.
    """
    from sb3_poem.common.vec_env import make_shown_env

    small = {"width": WIDTH, "height": HEIGHT}
    for extra in ({**small, "render_quality": "fast"}, small):
        with contextlib.suppress(TypeError):  # it does not take these
            return make_shown_env(env_id, "rgb_array", **{**extra, **env_kwargs})
    return make_shown_env(env_id, "rgb_array", **env_kwargs)
