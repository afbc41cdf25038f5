"""Beliefs against closed forms, and the page's other small parts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
import pytest

from sb3_poem.label.beliefs import belief, posterior, sentence, weighted_quantiles
from sb3_poem.label.families import as_points, describe
from sb3_poem.label.rendering import HEIGHT, WIDTH, beside, fit
from sb3_poem.pearl_sac.train_tasks import TrainTasks


def adapter(latents: np.ndarray, weights: np.ndarray, tasks: np.ndarray, means: np.ndarray) -> Any:
    """As much of one as a belief is drawn from: a task's number is the first coordinate of its
    latent.
    """
    inference = SimpleNamespace(
        particles=latents, weights=weights, estimate=lambda: weights @ latents
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


def test_directions_are_averaged_around_the_circle() -> None:
    tasks = np.array([[np.pi - 0.05], [-np.pi + 0.05], [0.0]])
    means = np.array([[1.0], [1.0], [-5.0]])
    drawn = belief(adapter(np.array([[1.0]]), np.ones(1), tasks, means), "poem/AntDir2D-v0")
    assert np.arctan2(*drawn["points"][0][::-1]) == pytest.approx(np.pi, abs=0.01)


def test_tasks_as_points() -> None:
    np.testing.assert_allclose(
        as_points("poem/PointGoal-v0", np.array([[np.pi / 2]])), [[0.0, 1.0]], atol=1e-12
    )
    np.testing.assert_allclose(as_points("poem/AntGoal-v0", np.array([[1.0, -2.0]])), [[1.0, -2.0]])
    np.testing.assert_allclose(
        as_points("poem/HalfCheetahFwdBack-v0", np.array([[-1.0]])), [[-1.0, 0.0]]
    )
    assert describe("Walk1D-v0").picture == "projection"
    assert describe("Walk1D-v0").title == "Walk1D"


def test_places_in_space_are_drawn_as_the_camera_sees_them() -> None:
    fetch = gym.make("poem/FetchReach-v0")
    fetch.reset(seed=0)
    robot = fetch.unwrapped.env.unwrapped
    config, camera = robot.mujoco_renderer.default_cam_config, mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = (
        config["distance"],
        config["azimuth"],
        config["elevation"],
    )
    camera.lookat[:] = config["lookat"]
    scene = mujoco.MjvScene(robot.model, 1000)
    mujoco.mjv_updateScene(
        robot.model, robot.data, mujoco.MjvOption(), None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene
    )
    forward, up = scene.camera[0].forward, scene.camera[0].up
    hand = robot.initial_gripper_xpos
    places = hand + np.random.default_rng(0).uniform(-0.15, 0.15, size=(20, 3))
    expected = (places - hand) @ np.stack([np.cross(forward, up), up], axis=1)
    np.testing.assert_allclose(as_points("poem/FetchReach-v0", places), expected, atol=2e-3)

    sawyer = gym.make("poem/MetaWorldML1-v0")
    sawyer.reset(seed=0)
    arm = sawyer.unwrapped._sawyer.env
    axes = arm.model.cam("corner2").mat0.reshape(3, 3)
    places = arm.hand_init_pos + np.random.default_rng(1).uniform(-0.3, 0.3, size=(20, 3))
    expected = (
        -(places - arm.hand_init_pos) @ axes[:, :2]
    )  # videos show this camera's image turned by half a turn
    np.testing.assert_allclose(as_points("poem/MetaWorldML1-v0", places), expected, atol=2e-3)
    # Placements of an object and a goal are more than a place.
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


def test_sentences() -> None:
    speeds = np.linspace(1.0, 2.0, 101)[:, None]
    even = np.full(101, 1 / 101)
    assert "between 1.1 and 1.9 m/s" in sentence("speed", speeds, even, speeds.mean(axis=0), "m/s")
    ways = np.array([[1.0, 0.0], [-1.0, 0.0]])
    assert "25 % sure" not in sentence("direction", ways, np.array([0.25, 0.75]), ways[1], "")
    assert "75 % sure that you want it to run to the left" in sentence(
        "direction", ways, np.array([0.25, 0.75]), ways[1], ""
    )
    up = np.array([[0.0, 1.0], [0.1, 0.99]])
    assert "away from you" in sentence("direction", up, np.full(2, 0.5), up[0], "")


def test_the_papers_candidates_weigh_the_same() -> None:
    latents, weights = posterior(SimpleNamespace(candidates=np.ones((4, 2))))
    assert latents.shape == (4, 2)
    np.testing.assert_allclose(weights, 0.25)


def test_clips_beside_each_other_last_as_long_as_the_longer() -> None:
    left = [np.full((HEIGHT, WIDTH, 3), value, dtype=np.uint8) for value in (10, 20)]
    right = [np.full((HEIGHT, WIDTH, 3), 99, dtype=np.uint8)] * 5
    both = beside(left, right, [*right, right[0]])
    assert len(both) == 5
    assert both[0].shape == (HEIGHT, 3 * WIDTH, 3)
    assert [int(frame[0, 0, 0]) for frame in both] == [10, 20, 20, 20, 20]
    assert {int(frame[0, WIDTH, 0]) for frame in both} == {99}
    square = np.zeros((480, 480, 3), dtype=np.uint8)
    square[200:280, 200:280] = 255
    small = fit(square)
    assert small.shape == (HEIGHT, WIDTH, 3)
    assert small[HEIGHT // 2, WIDTH // 2].min() > 250
