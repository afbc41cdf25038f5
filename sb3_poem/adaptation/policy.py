"""The adapted policy."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from sb3_poem.common.files import write_atomically

FORMAT = "sb3_poem adapted policy 1"
LATENT = "latent"
MODEL_PREFIX = "model."


class AdaptedPolicy:
    """
    A model with its latent fixed. It follows SB3's ``predict`` protocol, so ``evaluate_policy`` and every other program of
    SB3's that only predicts takes it for a model.

    :param model: The model.
    :param latent: (d,).
    """

    def __init__(self, model: Any, latent: np.ndarray) -> None:
        self.model = model
        self.latent = np.asarray(latent, dtype=np.float64).copy()
        self.observation_space = model.observation_space
        self.action_space = model.action_space

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """
        Act.

        :param observation: (obs_dim,) or (n, obs_dim).
        :param state: Ignored: the latent is fixed. It is there for SB3's callers.
        :param episode_start: Ignored: nothing is remembered within an episode.
        :param deterministic: Whether to take the mode.
        :return: Actions, (act_dim,) or (n, act_dim), and the latents as SB3's state.
        """
        observation = np.asarray(observation)
        single = observation.ndim == len(self.observation_space.shape)
        latents = self.latent if single else np.tile(self.latent, (len(observation), 1))
        actions, _ = self.model.predict(observation, state=latents, deterministic=deterministic)
        return actions, latents

    def to_bytes(self) -> bytes:
        """
        The policy as one safetensors file: the model, its configuration in the header, and the latent. Nothing in it can run
        code.

        :return: The file's content, which :meth:`from_bytes` reads.
        """
        import torch as th
        from safetensors.torch import save

        from sb3_poem.common.pretrained import config_text, model_contents

        config, tensors = model_contents(self.model)
        named = {MODEL_PREFIX + name: value for name, value in tensors.items()}
        return save({**named, LATENT: th.as_tensor(self.latent)}, {"format": FORMAT, "config": config_text(config)})

    def save_pretrained(self, path: str | os.PathLike[str]) -> None:
        """
        Write :meth:`to_bytes` to a file.

        :param path: The file; a name that ends in ``.safetensors`` is best.
        :raises OSError: If it cannot be written.
        """
        write_atomically(Path(path), self.to_bytes())

    @classmethod
    def from_pretrained(cls, path: str | os.PathLike[str], device: str = "auto") -> AdaptedPolicy:
        """
        Read what :meth:`save_pretrained` wrote, or what the page for answering gives for download.

        :param path: The file.
        :param device: "auto", "cpu", "cuda".
        :return: The policy.
        :raises FileNotFoundError: If there is no such file.
        :raises ValueError: If it is truncated, or of another program.
        """
        return cls.from_bytes(Path(path).read_bytes(), device, os.fspath(path))

    @classmethod
    def from_bytes(cls, content: bytes, device: str = "auto", source: str = "the content") -> AdaptedPolicy:
        """
        Read what :meth:`to_bytes` gave.

        :param content: It.
        :param device: "auto", "cpu", "cuda".
        :param source: Where it comes from, for the message.
        :return: The policy.
        :raises ValueError: If it is truncated, or of another program.
        """
        from safetensors import SafetensorError
        from safetensors.torch import load

        from sb3_poem.common.pretrained import build_model
        from sb3_poem.pearl_sac import PEARLSAC
        from sb3_poem.poem_sac import POEMSAC

        try:
            tensors = load(content)
            header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        except (SafetensorError, ValueError) as error:
            raise ValueError(f"{source} is truncated, or no safetensors file: {error}") from error
        facts = header.get("__metadata__", {})
        if facts.get("format") != FORMAT or LATENT not in tensors:
            raise ValueError(f"{source} is not an adapted policy of this version of sb3_poem (expected format {FORMAT!r})")
        config = json.loads(facts["config"])
        algorithms: dict[str, type[PEARLSAC]] = {"POEMSAC": POEMSAC, "PEARLSAC": PEARLSAC}
        if config.get("algorithm") not in algorithms:
            raise ValueError(f"{source} holds a {config.get('algorithm')}, known are {', '.join(algorithms)}")
        latent = tensors.pop(LATENT).numpy()
        parts = {name.removeprefix(MODEL_PREFIX): value for name, value in tensors.items()}
        return cls(build_model(algorithms[config["algorithm"]], config, parts, source, device), latent)
