"""The adapted policy."""

import json
import os
import re
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch as th
from safetensors.torch import save
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation.environments import describe_model
from sb3_poem.adaptation.meta_model import MetaModel
from sb3_poem.common.checks import as_observations
from sb3_poem.common.files import write_atomically
from sb3_poem.common.networks import parse_tensors
from sb3_poem.loading import BY_CLASS_NAME
from sb3_poem.pearl_sac.saving import build_model, config_text, model_contents, parse_config

FORMAT = "sb3_poem adapted policy 2"
LATENT = "latent"
MODEL_PREFIX = "model."
POLICY_SUFFIX = ".safetensors"


class AdaptedPolicy:
    """A model with its latent fixed. It follows SB3's ``predict`` protocol, so ``evaluate_policy``
    and every other program of SB3's that only predicts takes it for a model.

    >>> from sb3_poem import PreferenceAdapter
    >>> policy = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", seed=0).policy()
    >>> policy.save("policy.safetensors")
    >>> action, _ = AdaptedPolicy.load("policy.safetensors").predict([0.0, 0.0])

    :param n_answers: How many answers led to it.
    :param env: To whose task (its first copy's) it was adapted; None for a policy from a file.
    """

    def __init__(
        self, model: MetaModel, latent: np.ndarray, n_answers: int = 0, env: VecEnv | None = None
    ) -> None:
        self.model = model
        self.n_answers = n_answers
        self.env = env
        self.latent = np.array(latent, dtype=np.float64)
        if self.latent.shape != (expected := (model.latent_dim,)):
            raise ValueError(f"`latent` has shape {self.latent.shape}, but must have {expected}")
        if not np.isfinite(self.latent).all():
            raise ValueError(f"`latent` must be finite, but is {self.latent}")
        self.observation_space = model.observation_space
        self.action_space = model.action_space

    def __repr__(self) -> str:
        latent = ", ".join(f"{value:.2f}" for value in self.latent)
        answers = f"{self.n_answers} answer{'s' * (self.n_answers != 1)}"
        return f"AdaptedPolicy({describe_model(self.model)}, {answers}, latent=[{latent}])"

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """SB3's ``predict`` of (obs_dim,) or (n, obs_dim): actions, and the latents as SB3's state.
        As the latent is fixed, ``state`` and ``episode_start`` are ignored.
        """
        shape = self.observation_space.shape
        observation = as_observations(observation, shape)
        single = observation.ndim == len(shape)
        latents = self.latent if single else np.tile(self.latent, (len(observation), 1))
        actions, _ = self.model.predict(observation, state=latents, deterministic=deterministic)
        return actions, latents

    def to_bytes(self) -> bytes:
        """The policy of one of this package's models as a safetensors file: the model, its
        configuration in the header, latent and number of answers. Nothing in it can run code.
        """
        algorithm = BY_CLASS_NAME.get(type(self.model).__name__)
        if algorithm is None or not isinstance(self.model, algorithm):
            known = " or ".join(BY_CLASS_NAME)
            raise TypeError(f"a policy of {describe_model(self.model)} has no file, as of {known}")
        config, tensors = model_contents(self.model)
        named = {MODEL_PREFIX + name: value for name, value in tensors.items()}
        facts = {"format": FORMAT, "config": config_text(config), "n_answers": str(self.n_answers)}
        return save({**named, LATENT: th.as_tensor(self.latent)}, facts)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write :meth:`to_bytes` to a file; a name without a suffix gets ``.safetensors``."""
        write_atomically(_named(path), self.to_bytes())

    @classmethod
    def load(cls, path: str | os.PathLike[str], device: str = "auto") -> Self:
        """Read what :meth:`save` wrote, or the page gives for download; see :meth:`from_bytes`."""
        file = Path(path) if Path(path).is_file() else _named(path)
        if not file.is_file():
            raise FileNotFoundError(f"{path}: there is no such file of an adapted policy")
        return cls.from_bytes(file.read_bytes(), device, os.fspath(file))

    @classmethod
    def from_bytes(cls, content: bytes, device: str = "auto", source: str = "the content") -> Self:
        """Read what :meth:`to_bytes` gave; a ``ValueError``, which names ``source``, if it is
        truncated or of another program.
        """
        tensors = parse_tensors(content, source)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        facts = header.get("__metadata__", {})
        if facts.get("format") != FORMAT:
            raise ValueError(
                f"{source} is not an adapted policy of this version of sb3_poem: its format is "
                f"{facts.get('format')!r}, expected {FORMAT!r}"
            )
        config = parse_config(facts.get("config", ""), source)
        algorithm = BY_CLASS_NAME.get(config["algorithm"])
        if algorithm is None:
            known = ", ".join(BY_CLASS_NAME)
            raise ValueError(f"{source} holds a {config['algorithm']}, known are {known}")
        latent = tensors.pop(LATENT, th.zeros(0)).double().numpy()
        parts = {name.removeprefix(MODEL_PREFIX): value for name, value in tensors.items()}
        model = build_model(algorithm, config, parts, source, device)
        n_answers = facts.get("n_answers", "")
        if not re.fullmatch("[0-9]{1,9}", n_answers):
            wrong = f"n_answers must be a whole number, but is {n_answers[:20]!r}"
            raise ValueError(f"{source} is broken: {wrong}")
        try:
            return cls(model, latent, int(n_answers))
        except ValueError as error:
            raise ValueError(f"{source} is broken: {error}") from error


def _named(path: str | os.PathLike[str]) -> Path:
    file = Path(path)
    return file if file.suffix else file.with_suffix(POLICY_SUFFIX)
