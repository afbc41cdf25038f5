"""Where candidate latents come from before the first answer."""

from typing import TypeAlias

import numpy as np
from scipy.special import logsumexp

from sb3_poem.adaptation.meta_model import MetaModel

SOURCES = ("prior", "aggregate")
N_CENTRES = 256


class GaussianPrior:
    """N(0, I) of d dimensions, Algorithm 2's own prior."""

    #: Whether it has places of little density between such of much
    has_holes = False

    def __init__(self, dim: int) -> None:
        self.dim = dim

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """(n, d) draws."""
        return rng.standard_normal((n, self.dim))

    def balanced_sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """(n, d) draws in pairs of z and -z, so that their mean is the prior's own."""
        half = rng.standard_normal(((n + 1) // 2, self.dim))
        return np.concatenate([half, -half])[:n]

    def log_density(self, latents: np.ndarray) -> np.ndarray:
        """(m,) log density at (m, d), up to a constant."""
        return -0.5 * np.square(latents).sum(axis=1)


class AggregatePrior:
    """The mixture of the training tasks' posteriors. As a model gives no density of it, this is a
    mixture of Gaussians around draws (M, d) of the model.
    """

    has_holes = True

    def __init__(self, centres: np.ndarray) -> None:
        self.centres = np.asarray(centres, dtype=np.float64)
        distances = np.linalg.norm(self.centres[:, None, :] - self.centres[None, :, :], axis=2)
        np.fill_diagonal(distances, np.inf)
        # Narrow enough to change the mixture little, wide enough for no holes between neighbours.
        nearest = float(np.median(distances.min(axis=1))) / np.sqrt(self.centres.shape[1])
        self.width = max(0.5 * nearest, 1e-6)

    def sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        chosen = self.centres[rng.integers(len(self.centres), size=n)]
        return chosen + self.width * rng.standard_normal(chosen.shape)

    def balanced_sample(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draws of which no centre is taken once more than another."""
        rounds = [rng.permutation(len(self.centres)) for _ in range(-(-n // len(self.centres)))]
        chosen = self.centres[np.concatenate(rounds)[:n]]
        return chosen + self.width * rng.standard_normal(chosen.shape)

    def log_density(self, latents: np.ndarray) -> np.ndarray:
        own, others = np.square(latents).sum(axis=1), np.square(self.centres).sum(axis=1)
        squared = own[:, None] - 2.0 * latents @ self.centres.T + others
        return logsumexp(-0.5 * squared / self.width**2, axis=1)


Prior: TypeAlias = GaussianPrior | AggregatePrior


def make_prior(model: MetaModel, source: str, rng: np.random.Generator) -> Prior:
    """The prior of a model from one of ``SOURCES``; the aggregate's centres are drawn."""
    if source == "prior":
        return GaussianPrior(model.latent_dim)
    return AggregatePrior(model.sample_latents(N_CENTRES, rng, source="aggregate"))
