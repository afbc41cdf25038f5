"""Beliefs against closed forms, and the page's other small parts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from sb3_poem.label.beliefs import belief, sentence, weighted_quantiles
from sb3_poem.label.families import as_points, describe
from sb3_poem.label.rendering import HEIGHT, WIDTH, beside, fit
from sb3_poem.pearl_sac.train_tasks import TrainTasks


def adapter(latents: np.ndarray, weights: np.ndarray, tasks: np.ndarray, means: np.ndarray) -> Any:
    """As much of one as a belief is drawn from: a task's number is the first coordinate of its
    latent.
    """
    inference = SimpleNamespace(
        posterior=lambda: (latents, weights),
        estimate=lambda: weights @ latents,
        answers=["left"],
    )
    variances = np.full(means.shape, 0.01)
    variances[:, 1:] = 1.0  # what training has left unused keeps the prior's variance
    return SimpleNamespace(
        inference=inference, model=SimpleNamespace(train_tasks=TrainTasks(tasks, means, variances))
    )


def test_latents_are_drawn_as_the_tasks_that_they_stand_for() -> None:
    rng = np.random.default_rng(0)
    tasks = np.linspace(0.0, 3.0, 61)[:, None]
    means = np.concatenate([tasks - 1.5, 0.01 * rng.standard_normal((61, 3))], axis=1)
    speeds = rng.uniform(0.2, 2.8, size=40)
    # The unused coordinates are the prior's noise; they must not move a speed.
    latents = np.concatenate([speeds[:, None] - 1.5, rng.standard_normal((40, 3))], axis=1)
    drawn = belief(adapter(latents, np.full(40, 1 / 40), tasks, means), "poem/HalfCheetahVel-v0")
    assert drawn["picture"] == "speed"
    np.testing.assert_allclose(np.array(drawn["points"])[:, 0], speeds, atol=0.1)
    assert drawn["estimate"][0] == pytest.approx(speeds.mean(), abs=0.1)


def test_before_any_answer_nothing_is_known() -> None:
    tasks = np.array([[0.0, 2.0], [0.1, 2.0]])
    asked = adapter(np.zeros((1, 2)), np.ones(1), tasks, tasks)
    assert "believes that you mean" in belief(asked, "poem/AntGoal-v0")["sentence"]
    asked.inference.answers = []
    drawn = belief(asked, "poem/AntGoal-v0")
    assert drawn["sentence"] == "It knows nothing yet of what you want."
    assert drawn["points"]  # the map stays


def test_distances_in_space_are_told_not_those_in_the_picture() -> None:
    tasks = np.array([[1.462, 0.669, 0.585]])  # the hand begins at 1.342, 0.749, 0.535
    asked = adapter(np.zeros((1, 2)), np.ones(1), tasks, np.zeros((1, 2)))
    drawn = belief(asked, "poem/FetchReach-v0")
    assert len(drawn["points"][0]) == len(drawn["estimate"]) == 2
    assert np.linalg.norm(drawn["estimate"]) < 0.1
    assert "nearer to you, about 15 cm away" in drawn["sentence"]


def test_directions_are_averaged_around_the_circle() -> None:
    tasks = np.array([[np.pi - 0.05], [-np.pi + 0.05], [0.0]])
    means = np.array([[1.0], [1.0], [-5.0]])
    drawn = belief(adapter(np.array([[1.0]]), np.ones(1), tasks, means), "poem/AntDir2D-v0")
    assert np.arctan2(*drawn["points"][0][::-1]) == pytest.approx(-np.pi / 2, abs=0.01)  # back


def test_tasks_as_points() -> None:
    np.testing.assert_allclose(
        as_points("poem/PointGoal-v0", np.array([[np.pi / 2]])), [[0.0, 1.0]], atol=1e-12
    )
    np.testing.assert_allclose(
        as_points("poem/AntGoal-v0", np.array([[1.0, -2.0]])), [[2.0, 1.0]], atol=1e-12
    )
    assert describe("Walk1D-v0").picture == "projection"
    assert describe("Walk1D-v0").title == "Walk1D"


@pytest.mark.parametrize(
    ("env_id", "hand"),
    [
        ("poem/FetchReach-v0", (1.342, 0.749, 0.535)),
        pytest.param("poem/MetaWorldML1-v0", (0.0, 0.6, 0.2), marks=pytest.mark.metaworld),
        ("poem/AntGoal-v0", (0.0, 0.0, 0.0)),
        ("poem/AntMaze-v0", (0.0, 0.0, 0.0)),
    ],
)
def test_places_are_drawn_as_the_films_camera_sees_them(
    env_id: str, hand: tuple[float, float, float]
) -> None:
    look = describe(env_id).look
    camera, model = mujoco.MjvCamera(), mujoco.MjModel.from_xml_string("<mujoco/>")
    camera.distance, camera.azimuth, camera.elevation = look.distance, look.azimuth, look.elevation
    scene, options = mujoco.MjvScene(model, 10), mujoco.MjvOption()
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, mujoco.MjData(model), options, None, camera, everything, scene)
    forward, up = scene.camera[0].forward, scene.camera[0].up
    dim = 2 if env_id.startswith("poem/Ant") else 3
    offsets = np.random.default_rng(0).uniform(-0.15, 0.15, size=(20, 3)) * (np.arange(3) < dim)
    axes = [np.cross(forward, up), up, forward]
    expected = offsets @ np.stack(axes[:dim], axis=1)
    places = (np.array(hand) + offsets)[:, :dim]
    np.testing.assert_allclose(as_points(env_id, places), expected, atol=2e-3)


def test_placements_of_an_object_and_a_goal_are_more_than_a_place() -> None:
    assert describe("poem/MetaWorldML1-v0", 6).picture == "projection"


def test_weighted_quantiles_are_those_of_the_repeated_sample() -> None:
    rng = np.random.default_rng(1)
    values, counts = rng.normal(size=30), rng.integers(1, 9, size=30)
    repeated = np.sort(np.repeat(values, counts))
    for share in (0.1, 0.5, 0.9):
        expected = repeated[int(np.ceil(share * len(repeated))) - 1]
        assert weighted_quantiles(values, counts / counts.sum(), (share,)) == [
            pytest.approx(expected)
        ]


def say(env_id: str, points: Any, weights: Any = None) -> str:
    points = np.array(points, dtype=np.float64)
    weights = np.full(len(points), 1 / len(points)) if weights is None else np.array(weights)
    return sentence(describe(env_id), points, weights, weights @ points)


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (1.0, 2.0, "run at 1.1 to 1.9 m/s"),
        (0.5, 0.85, "run at about 0.7 m/s"),
        (-0.2, 1.2, "run at 1.1 m/s or less"),
        (-0.15, 0.18, "run at about 0.1 m/s"),
        (-0.04, 0.05, "stand still, or nearly"),
    ],
)
def test_speeds_that_people_say(low: float, high: float, words: str) -> None:
    speeds = np.linspace(low, high, 101)[:, None]
    said = say("poem/HalfCheetahVel-v0", speeds)
    assert said == f"It believes that you want it to {words}."


def test_how_sure_it_is_of_one_of_two_ways() -> None:
    said = say("poem/HalfCheetahFwdBack-v0", [[1.0, 0.0], [-1.0, 0.0]], [0.25, 0.75])
    assert "75 % sure that you want it to run to the left" in said


@pytest.mark.parametrize(
    ("degrees", "words"),
    [
        (0, "straight ahead"),
        (20, "a bit left of straight ahead"),
        (-25, "a bit right of straight ahead"),
        (-45, "ahead and to the right"),
        (50, "ahead and to the left"),
        (75, "to the left and a bit ahead"),
        (-92, "straight to the right"),
        (-110, "to the right and a bit back"),
        (178, "straight back"),
        (-160, "a bit right of straight back"),
        (-130, "back and to the right"),
    ],
)
def test_directions_that_people_say(degrees: float, words: str) -> None:
    """Degrees are the robot's, counted to its left."""
    points = as_points("poem/AntDir2D-v0", np.radians([[degrees - 3.0], [degrees + 3.0]]))
    said = say("poem/AntDir2D-v0", points)
    assert said == f"It believes that you want it to go {words}, give or take 3 degrees."


def test_a_direction_that_may_be_any_is_not_named() -> None:
    points = as_points("poem/AntDir2D-v0", np.linspace(-np.pi / 2, np.pi / 2, 91)[:, None])
    assert "does not know yet which way" in say("poem/AntDir2D-v0", points)


def test_the_sentence_says_what_the_needle_shows() -> None:
    """The policy that would be taken, which is not the middle of what is believed."""
    points = as_points("poem/AntDir2D-v0", np.radians([[0.0], [0.0], [50.0]]))
    said = sentence(describe("poem/AntDir2D-v0"), points, np.full(3, 1 / 3), points[0])
    assert "go straight ahead, give or take 50 degrees" in said


@pytest.mark.parametrize(
    ("env_id", "places", "words"),
    [
        (
            "poem/AntGoal-v0",
            [[1.8, 0.6], [2.2, 0.6], [1.8, 0.8]],
            "a bit left of straight ahead, about 2 m away, give or take 0.3 m",
        ),
        (
            "poem/AntGoal-v0",
            [[-0.02, 0.9], [0.02, 0.9]],
            "straight to the left, about 0.9 m away, give or take 0.1 m",
        ),
        ("poem/AntGoal-v0", [[2, 0], [-2, 0.1], [0, 2]], "within about 3 m of where it begins"),
        ("poem/AntGoal-v0", [[0, 0], [0, 0]], "within about 0.1 m of where it begins"),
        ("poem/PointGoal-v0", [[2.4], [2.3]], "up and to the left"),
        ("poem/PointGoal-v0", [[2.4], [0.9]], "straight up, but is not sure yet"),
    ],
)
def test_places_that_people_say(env_id: str, places: Any, words: str) -> None:
    said = say(env_id, as_points(env_id, np.array(places, dtype=np.float64)))
    assert said == f"It believes that you mean a place {words}."


@pytest.mark.parametrize(
    ("point", "words"),
    [
        ((0.0, 0.1), "straight up, about 10 cm away, give or take 1 cm"),
        ((0.2, 0.05), "to the right and a bit up, about 21 cm away, give or take 1 cm"),
        ((-0.1, -0.1), "down and to the left, about 14 cm away, give or take 1 cm"),
    ],
)
def test_places_in_space_that_people_say(point: tuple[float, float], words: str) -> None:
    said = say("poem/FetchReach-v0", [point, point])
    assert said == f"It believes that you mean a place {words}."


def test_forward_and_backward_are_told_apart() -> None:
    for env_id, tasks in (
        ("AntFwdBack", [[0.0], [np.pi]]),
        ("HalfCheetahFwdBack", [[1.0], [-1.0]]),
    ):
        points = as_points(f"poem/{env_id}-v0", np.array(tasks))
        np.testing.assert_allclose(points, [[1.0, 0.0], [-1.0, 0.0]], atol=1e-12)


def test_clips_beside_each_other_last_as_long_as_the_longer() -> None:
    left = [np.full((HEIGHT, WIDTH, 3), value, dtype=np.uint8) for value in (10, 20)]
    right = [np.full((HEIGHT, WIDTH, 3), 99, dtype=np.uint8)] * 5
    both = beside(2, left, right, [*right, right[0]])
    assert len(both) == 5
    assert both[0].shape == (HEIGHT, 3 * WIDTH, 3)
    assert [int(frame[0, 0, 0]) for frame in both] == [10, 20, 20, 20, 20]
    assert {int(frame[0, WIDTH, 0]) for frame in both} == {99}
    square = np.zeros((480, 480, 3), dtype=np.uint8)
    square[200:280, 200:280] = 255
    small = fit(square)
    assert small.shape == (HEIGHT, WIDTH, 3)
    assert small[HEIGHT // 2, WIDTH // 2].min() > 250
