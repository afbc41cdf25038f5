"""Fixtures of PEARLSAC's tests, most of which run POEMSAC too."""

import first_hour
import pytest

from sb3_poem import PEARLSAC, POEMSAC


@pytest.fixture(params=[PEARLSAC, POEMSAC])
def algorithm(request: pytest.FixtureRequest) -> type[PEARLSAC]:
    """Both algorithms in turn."""
    return request.param


@pytest.fixture(params=[PEARLSAC, POEMSAC])
def trained(request: pytest.FixtureRequest) -> PEARLSAC:
    """A model after two epochs; tests leave it as it is."""
    return first_hour.trained(request.param)


@pytest.fixture
def poem() -> POEMSAC:
    """The same of POEMSAC alone, for what is one code in both."""
    return first_hour.trained()
