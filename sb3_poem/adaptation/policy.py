"""The adapted policy."""

from __future__ import annotations

from typing import Any

import numpy as np


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
