"""What the tests of all families share."""

import numpy as np
import pytest
from gymnasium import wrappers

ALL_IDS = [
    "poem/PointGoal-v0",
    "poem/HalfCheetahVel-v0",
    "poem/HalfCheetahFwdBack-v0",
    "poem/AntVel-v0",
    "poem/AntFwdBack-v0",
    "poem/AntDir2D-v0",
    "poem/AntGoal-v0",
    "poem/HumanoidDir2D-v0",
]


@pytest.fixture(params=ALL_IDS)
def env_id(request: pytest.FixtureRequest) -> str:
    """Every registered family in turn."""
    return request.param


@pytest.fixture(
    params=[
        *("poem/PointGoal-v0", "poem/HalfCheetahFwdBack-v0", "poem/AntGoal-v0"),
        "poem/HumanoidDir2D-v0",
    ]
)
def robot_id(request: pytest.FixtureRequest) -> str:
    """One family of each robot, among them a finite one and one whose tasks are two numbers."""
    return request.param


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator for actions and tasks."""
    return np.random.default_rng(20250101)


@pytest.fixture(autouse=True)
def gymnasiums_own_time_limit(monkeypatch):
    """An import of rl_zoo3, by a test before, replaces TimeLimit by one that hides a time limit
    behind a termination.
    """
    kind = wrappers.TimeLimit
    if kind.__module__.startswith("rl_zoo3"):
        monkeypatch.setattr(wrappers, "TimeLimit", kind.__base__)
