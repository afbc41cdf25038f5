"""What the benchmark must know of a family before it starts anything."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from functools import cache

import gymnasium as gym
import numpy as np

import poem_envs  # noqa: F401  registers the environments
from sb3_poem.benchmark.suites import family_id
from sb3_poem.common.family import REQUIRED_ATTRIBUTES


@dataclass(frozen=True)
class FamilyFacts:
    """
    A task family.

    :param env_id: Its id.
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
    """
    Look at a family.

    :param name: An id, or AntGoal for poem/AntGoal-v0.
    :return: What there is to know.
    :raises ValueError: If there is no such environment, or it is no task family, or has no time limit.
    """
    env_id = family_id(name)
    try:
        env = gym.make(env_id)
    except gym.error.Error as error:
        known = ", ".join(sorted(family.split("/")[1].split("-")[0] for family in gym.registry if family.startswith("poem/")))
        raise ValueError(f"--families {name}: {error} The package's own families are: {known}") from error
    with contextlib.closing(env):
        missing = [attribute for attribute in REQUIRED_ATTRIBUTES if not hasattr(env.unwrapped, attribute)]
        if missing:
            raise ValueError(f"--families {name} is no task family (a poem_envs.TaskFamily): it has no {', '.join(missing)}")
        family = env.unwrapped
        limit = None if env.spec is None else env.spec.max_episode_steps
        if limit is None:
            raise ValueError(f"--families {name}: register {env_id} with max_episode_steps")
        tasks: np.ndarray | None = family.all_tasks  # type: ignore[attr-defined]
        shared = bool(family.shared_dynamics)  # type: ignore[attr-defined]
        return FamilyFacts(env_id, int(limit), None if tasks is None else len(tasks), shared)
