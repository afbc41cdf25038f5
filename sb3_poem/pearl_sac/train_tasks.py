"""The training tasks, and what is known of each one's latent."""

from dataclasses import dataclass

import numpy as np

from sb3_poem.common.checks import check_choice
from sb3_poem.common.family_view import FamilyView

DEFAULT_TRAIN_TASKS = 120
AGGREGATE_NEIGHBOURS = 5


def default_train_tasks(all_tasks: np.ndarray | None) -> int:
    """How many tasks to train on unless told: 120, or all of a smaller finite family."""
    return DEFAULT_TRAIN_TASKS if all_tasks is None else min(DEFAULT_TRAIN_TASKS, len(all_tasks))


@dataclass(eq=False)
class TrainTasks:
    """Training tasks (n, task_dim) with Gaussian posteriors of their latents, (n, latent_dim)."""

    tasks: np.ndarray
    latent_means: np.ndarray
    latent_variances: np.ndarray

    @classmethod
    def of_prior(cls, tasks: np.ndarray, latent_dim: int) -> "TrainTasks":
        """Tasks of which nothing is known: every posterior is the prior."""
        shape = (len(tasks), latent_dim)
        return cls(tasks, np.zeros(shape), np.ones(shape))

    @classmethod
    def draw(
        cls, family: FamilyView, n: int | None, latent_dim: int, rng: np.random.Generator
    ) -> "TrainTasks":
        """Draw tasks from a family; of None, :func:`default_train_tasks`."""
        count = default_train_tasks(family.all_tasks) if n is None else n
        most = np.inf if family.all_tasks is None else len(family.all_tasks)
        if count > most:
            raise ValueError(
                f"n_train_tasks is {count}, but {family.env_id} is a finite family of {most} "
                f"tasks; use at most {most}, or None for all"
            )
        return cls.of_prior(family.sample_tasks(count, rng), latent_dim)

    def __len__(self) -> int:
        return len(self.tasks)

    def draw_latents(self, task_ids: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """One latent from the posterior of each of some tasks, (len(task_ids), latent_dim)."""
        noise = rng.standard_normal((len(task_ids), self.latent_means.shape[1]))
        return self.latent_means[task_ids] + np.sqrt(self.latent_variances[task_ids]) * noise

    def sample_latents(self, n: int, rng: np.random.Generator, source: str = "prior") -> np.ndarray:
        """Draw latents (n, latent_dim).

        :param source: "prior": N(0, I). "aggregate": the training tasks' posteriors, and what lies
            between a task and its nearest neighbours
        """
        check_choice("source", source, ("prior", "aggregate"))
        means = self.latent_means
        if source == "prior":
            return rng.standard_normal((n, means.shape[1]))
        chosen = rng.integers(len(means), size=n)
        draws = means[chosen]
        # few tasks have nothing in between
        n_neighbours = min(AGGREGATE_NEIGHBOURS, len(means) // 4)
        if n_neighbours:
            distances = ((means[:, None, :] - means[None, :, :]) ** 2).sum(axis=2)
            picks = rng.integers(1, n_neighbours + 1, size=n)
            neighbours = distances.argsort(axis=1)[chosen, picks]
            draws = draws + rng.uniform(size=(n, 1)) * (means[neighbours] - draws)
        return draws + np.sqrt(self.latent_variances[chosen]) * rng.standard_normal(draws.shape)

    @property
    def aggregate_to_prior_kl(self) -> float:
        """KL of the aggregate posterior (the Gaussian of its moments) to N(0, I), nats."""
        mean = self.latent_means.mean(axis=0)
        second = self.latent_variances.mean(axis=0) + self.latent_means.var(axis=0)
        return 0.5 * float((mean**2 + second - 1.0 - np.log(second)).sum())
