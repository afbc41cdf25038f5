"""What adaptation needs of a model."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces

from sb3_poem.common.trajectory import Trajectory


class MetaModel(Protocol):
    """Policies pi(. | z), of which a latent z chooses one.

    ``POEMSAC`` and ``PEARLSAC`` are such models. A model of your own subclasses this, and then says
    only what is not the same as here.

    >>> import sb3_poem
    >>> model = sb3_poem.POEMSAC.from_pretrained("PointGoal")
    >>> latent = model.sample_latents(1, np.random.default_rng(0))[0]
    >>> action, _ = model.predict([0.0, 0.0], state=latent)
    """

    latent_dim: int

    @property
    def observation_space(self) -> spaces.Box:
        """Of one environment."""

    @property
    def action_space(self) -> spaces.Box:
        """Of one environment."""

    @property
    def horizon(self) -> int | None:
        """Steps after which an episode is cut."""

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, Any]:
        """SB3's; ``state`` is the latent, (latent_dim,) or one for each observation."""

    def sample_latents(self, n: int, rng: np.random.Generator, source: str = "prior") -> np.ndarray:
        """Draw latents (n, latent_dim): "prior" is N(0, I), "aggregate" what training used."""

    @property
    def env_id(self) -> str | None:
        """The registered environment that it was trained on; None if that is not known."""
        return None

    @property
    def env_kwargs(self) -> Mapping[str, Any]:
        """The arguments with which that one was made."""
        return {}

    @property
    def task_space(self) -> spaces.Space | None:
        """Of the tasks that it was trained on; None if that is not known."""
        return None

    @property
    def num_timesteps(self) -> int | None:
        """Environment steps that it was trained for; None if that is not known."""
        return None

    @property
    def digest(self) -> str | None:
        """Tells models of other numbers apart; None takes them for the same."""
        return None

    @property
    def task_latents(self) -> np.ndarray | None:
        """(n_train_tasks, latent_dim) of the training tasks."""
        return None

    @property
    def aggregate_to_prior_kl(self) -> float:
        """How far the training tasks' latents are from N(0, I), nats."""
        return 0.0


@runtime_checkable
class HasSimilarity(Protocol):
    """A model that knows how fit each policy is for each task (``POEMSAC``)."""

    def similarities(self, task_latents: np.ndarray, policy_latents: np.ndarray) -> np.ndarray:
        """S(z_i, z_j), (m, n), of latents (m, latent_dim) and (n, latent_dim)."""


@runtime_checkable
class HasRewardDecoder(Protocol):
    """A model that predicts the returns of trajectories."""

    #: Root mean square of what is wrong with a predicted reward; NaN where that is not known.
    predicted_rewards_error: float

    def predicted_returns(
        self, latents: np.ndarray, trajectories: Sequence[Trajectory], max_steps: int | None = None
    ) -> np.ndarray:
        """(m, number of trajectories), if each of the latents (m, latent_dim) were the task's; of a
        longer trajectory only ``max_steps`` steps are decoded.
        """
