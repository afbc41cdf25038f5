"""One turn of a conversation, as a pure function: the state before, and the answer, give the state
after and its video, which is small, quick to encode, and to the frame seekable in every browser.
Any process may compute any turn of any session, ahead of time or again, bit for bit.
"""

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.adaptation.named_rule import named_rule
from sb3_poem.adaptation.noise import INFER
from sb3_poem.adaptation.rule import Rule, rollout_seed
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.rollouts import rollout_latents
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.vec_env import make_shown_env
from sb3_poem.common.video import joined, write_video
from sb3_poem.label.beliefs import belief
from sb3_poem.label.families import ModelInfo
from sb3_poem.loading import BY_CLASS_NAME
from sb3_poem.pearl_sac.saving import read_config
from sb3_poem.poem_sac import POEMSAC

# The result's rollout starts as no question's does.
RESULT_ROLLOUT = 1_000_000
# Of the hidden task of the environment, of which the person knows nothing.
TASK_STREAM = 0x1ABE1
# Frames per second of a film: at least, and where a family moves faster, about.
SMOOTH_FPS, FILM_FPS = 8.0, 15.0
# Seconds that a film lasts: what is over sooner is shown slower.
SHORTEST_FILM = 5.0
# The race is drawn for every second frame of the films beside it.
RACE_EVERY = 2
#: Models that a process keeps.
MAX_RENDERERS = 4
#: What an adapter's dictionary holds of its conversation; the rest is the ``state`` of a turn.
CONVERSATION = ("answers", "pending")
WIDTH, HEIGHT = 320, 240


class StorageError(OSError):
    """What cannot be kept: the disk is full, say."""


class RenderCancelledError(Exception):
    """A turn's marker was taken away while it was made."""


@dataclass(frozen=True)
class TurnRequest:
    """What a turn is made from."""

    model: ModelInfo
    seed: int
    options: dict[str, Any]
    kind: str  # "question" or "result"
    video: Path  # to write
    # The turn before, None at the start: its state, the answers before it (``preference``, and what
    # was shown by its place, as ``left``), its question (what it shows) and the answer to that.
    state: dict[str, Any] | None = None
    answers: Sequence[dict[str, Any]] = ()
    pending: dict[str, Any] | None = None
    preference: str | None = None
    repeats: int | None = None  # number of the question that is asked again instead of a new one
    film_every: int = 1  # steps between two frames of the video, if it is smooth enough then

    @property
    def marker(self) -> Path:
        """A file that is kept while the turn is wanted: its end is the work's."""
        return self.video.with_suffix(".wanted")


@dataclass(frozen=True)
class Turn:
    """A question, or a result, and what is believed there; the state, what the next turn is made
    from beside the conversation, belief and latent are None at a terminal, where none follows.
    """

    state: dict[str, Any] | None
    shown: dict[str, Any] | None  # the question's trajectories by their place; None in a result
    # As :func:`sb3_poem.label.beliefs.belief` gives it, and the adapter's ``contradicted``
    belief: dict[str, Any] | None
    latent: list[float] | None  # (d,) of the policy that would be taken now
    fps: float
    frames: int


class FilmedVecEnv(VecEnvWrapper):
    """An environment whose rollouts are filmed while the turn is wanted. Where its family films
    states (:class:`poem_envs.films.Filmed`), these take the place of images.
    """

    #: A file without which filming raises RenderCancelledError; None films always.
    marker: Path | None = None

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.films_states = venv.has_attr("film_state")

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        return self.venv.step_wait()

    def get_images(self) -> Any:
        self._check_wanted()
        return self.env_method("film_state") if self.films_states else self.venv.get_images()

    def films(self, *clips: Trajectory) -> list[np.ndarray]:
        """Frames that show every clip, and a race of two, beside each other."""
        if not self.films_states:
            return beside(len(clips), *([*map(fit, clip.frames or ())] for clip in clips))
        paths = [np.array(clip.frames) for clip in clips]
        parts = [self._film(paths, [i]) for i in range(len(paths))]
        if len(paths) == 2:
            race = self._film([path[::RACE_EVERY] for path in paths], range(len(paths)))
            parts.append([frame for frame in race for _ in range(RACE_EVERY)])
        return beside(len(paths), *parts)

    def _film(self, paths: list[np.ndarray], shown: Sequence[int]) -> list[np.ndarray]:
        self._check_wanted()
        return self.env_method("film", paths, shown, (WIDTH, HEIGHT), indices=[0])[0]

    def _check_wanted(self) -> None:
        if self.marker is not None and not self.marker.exists():
            raise RenderCancelledError


class Renderer:
    """A model and its environment, an SB3 ``VecEnv`` that renders RGB images."""

    def __init__(self, model: Any, env: VecEnv, env_id: str) -> None:
        if env.render_mode != "rgb_array":
            must = '`env` must be made with render_mode="rgb_array" to be shown'
            raise ValueError(f"{must}, but has {env.render_mode!r}")
        family = FamilyView(env)
        family.check_same_family(model.task_space, model.reward_feature_dim)
        self.model = model
        self.env = FilmedVecEnv(env)
        self.env_id = env_id
        self.fps = family.render_fps

    def turn(self, request: TurnRequest) -> Turn:
        """Make a turn, and write its video, while it is wanted."""
        self.env.marker = request.marker
        every, fps = film_rate(self.fps, self.model.horizon, request.film_every)
        adapter = self._adapter(request, every)
        if request.preference is not None:
            adapter.tell(request.preference)
        believed = {**belief(adapter, self.env_id), "contradicted": adapter.contradicted}
        latent = adapter.policy().latent
        if request.kind == "question":
            again = request.repeats
            query = adapter.ask() if again is None else adapter.ask_again(again)
            clips = [*query.shown]
        else:
            seeds = [rollout_seed(adapter.seed, RESULT_ROLLOUT)]
            about = (self.model, self.env, latent[None], None, seeds, adapter.deterministic)
            clips = rollout_latents(*about, frames=every)
        frames = self.env.films(*clips)
        try:
            write_video(frames, request.video, fps)
        except OSError as error:
            raise StorageError(str(error)) from error
        data = adapter.to_dict()
        state = {name: value for name, value in data.items() if name not in CONVERSATION}
        return Turn(state, data["pending"], believed, latent.tolist(), fps, len(frames))

    def warm_up(self) -> None:
        """Do once what only the first time is slow: the first image, the first action."""
        latent = np.zeros((1, self.model.latent_dim))
        self.env.films(
            *rollout_latents(self.model, self.env, latent, None, [0], frames=True, max_steps=2)
        )

    def _adapter(self, request: TurnRequest, every: int) -> PreferenceAdapter:
        """The adapter as it was before the answer."""
        model, env = self.model, self.env
        # The session counts the questions; the adapter must only be ready for one more.
        more: dict[str, Any] = {"n_queries": len(request.answers) + 2}
        if request.state is None:
            more |= {"rule": session_rule(request.options), "seed": request.seed}
            return PreferenceAdapter(model, env, render=every, **more)
        more |= {"answers": list(request.answers), "pending": request.pending}
        return PreferenceAdapter.from_dict({**request.state, **more}, model, env, render=every)


def film_rate(fps: float, horizon: int, wanted: int) -> tuple[int, float]:
    """How many steps lie between two frames of a film, and its frames per second.

    :param fps: Steps per second.
    :param horizon: Steps of an episode.
    :param wanted: How many times fewer frames there should be, unless it would move in jerks then.
    """
    fps = min(fps, horizon / SHORTEST_FILM)
    every = max(1, round(fps / FILM_FPS))  # what moves faster than films do is not filmed whole
    if fps / (every * wanted) >= SMOOTH_FPS:
        every *= wanted
    return every, max(fps / every, SMOOTH_FPS)


def session_rule(options: dict[str, Any]) -> Rule:
    """The rule that a session's options name; who answers is inferred, unless they say how often
    that person errs.
    """
    usual = {} if "mistake_rate" in options else {"noise_model": INFER}
    return named_rule(**{**usual, **options})


def make_turn(request: TurnRequest) -> Turn:
    """Make a turn, by models and environments that the process keeps."""
    renderer = renderer_of(request.model)
    family = FamilyView(renderer.env)
    family.set_tasks(family.sample_tasks(1, np.random.default_rng([TASK_STREAM, request.seed])))
    return renderer.turn(request)


@lru_cache(maxsize=MAX_RENDERERS)
def renderer_of(info: ModelInfo) -> Renderer:
    """Load a model and make its environment."""
    make = partial(make_env, info.env_id, **dict(info.env_kwargs))
    return Renderer(load_shown_model(info), DummyVecEnv([make]), info.env_id)


def load_shown_model(info: ModelInfo) -> Any:
    """Load a model from its folder, whatever else has its name."""
    algorithm = BY_CLASS_NAME.get(read_config(info.folder)["algorithm"], POEMSAC)
    return algorithm.from_pretrained(info.folder, device="cpu")


def make_env(env_id: str, **env_kwargs: Any) -> gym.Env:
    """An environment that renders, small and fast where it can."""
    small = {"width": WIDTH, "height": HEIGHT}
    for extra in ({**small, "render_quality": "fast"}, small):
        with contextlib.suppress(TypeError):  # it does not take these
            return make_shown_env(env_id, "rgb_array", **{**extra, **env_kwargs})
    return make_shown_env(env_id, "rgb_array", **env_kwargs)


def beside(first: int, *clips: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Clips of one size beside each other, as long as so many first ones."""
    longest = max(map(len, clips[:first]))
    return joined([clip[:longest] for clip in clips], axis=1)


def fit(frame: np.ndarray) -> np.ndarray:
    """A frame in the page's size, whole, with bars of its corner's colour beside another shape."""
    if frame.shape[:2] == (HEIGHT, WIDTH):
        return frame
    from PIL import Image, ImageOps

    image, corner = Image.fromarray(frame), tuple(frame[0, 0].tolist())
    return np.asarray(ImageOps.pad(image, (WIDTH, HEIGHT), Image.Resampling.BILINEAR, color=corner))
