"""What the tests of adaptation share."""

import pytest

from sb3_poem import POEMSAC


@pytest.fixture(scope="module")
def point_goal():
    return POEMSAC.from_pretrained("PointGoal", device="cpu")
