"""Fixtures of PEARLSAC's tests, most of which run POEMSAC too."""

import pytest
from meta_toys import EPOCH, small

from sb3_poem import PEARLSAC, POEMSAC


@pytest.fixture(params=[PEARLSAC, POEMSAC])
def algorithm(request: pytest.FixtureRequest) -> type[PEARLSAC]:
    """Both algorithms in turn."""
    return request.param


@pytest.fixture(scope="session", params=[PEARLSAC, POEMSAC])
def trained(request: pytest.FixtureRequest) -> PEARLSAC:
    """A model after two epochs; tests leave it as it is."""
    return small(request.param).learn(2 * EPOCH)
