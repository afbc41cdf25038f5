"""What the benchmark must know of a family before it starts anything."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cache

import gymnasium as gym

from sb3_poem.benchmark.suites import family_id
from sb3_poem.common.family_view import FamilyView, vectorised


@dataclass(frozen=True)
class FamilyFacts:
    """A task family.

    :param horizon: Steps of an episode.
    :param n_tasks: How many tasks there are; None: infinitely many.
    :param shared_dynamics: Whether tasks differ in their rewards alone.
    """

    env_id: str
    horizon: int
    n_tasks: int | None
    shared_dynamics: bool


@cache
def family_facts(name: str) -> FamilyFacts:
    """Look at a family.

    :param name: An id, or AntGoal for poem/AntGoal-v0.
    :return: What there is to know.
    :raises ValueError: If there is no such environment, or it is no task family, or has no time
        limit.
    """
    env_id = family_id(name)
    try:
        with contextlib.closing(vectorised(gym.make(env_id))) as env:
            family = FamilyView.for_training(env)
    except gym.error.Error as error:
        known = ", ".join(
            sorted(
                each.split("/")[1].split("-")[0]
                for each in gym.registry
                if each.startswith("poem/")
            )
        )
        raise ValueError(
            f"--families {name}: {error} The package's own families are: {known}"
        ) from error
    except ValueError as error:
        raise ValueError(f"--families {name}: {error}") from error
    n_tasks = None if family.all_tasks is None else len(family.all_tasks)
    return FamilyFacts(env_id, family.horizon, n_tasks, family.shared_dynamics)
