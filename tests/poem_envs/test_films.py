"""Films for people: one camera for both sides, marks where they belong, and a race. Where something
must be in a picture is computed here from the family's ``look``, by a camera of this file's own.
"""

from __future__ import annotations

import re

import gymnasium as gym
import numpy as np
import pytest

import poem_envs  # noqa: F401 (registers)
from poem_envs.films import Filmed, FilmRenderer, Look
from poem_envs.headless import can_draw

pytestmark = pytest.mark.skipif(not can_draw(), reason="no off-screen OpenGL")
SIZE = WIDTH, HEIGHT = 240, 180
ML1 = pytest.param("poem/MetaWorldML1-v0", marks=pytest.mark.metaworld)
WALKERS = ["poem/AntVel-v0", "poem/AntDir2D-v0", "poem/HumanoidDir2D-v0", "poem/AntGoal-v0"]
ARMS = ["poem/FetchReach-v0", ML1]


def mask(image: np.ndarray, side: int) -> np.ndarray:
    """Where an image has the colour of the left path, blue, or of the right one, orange."""
    red, green, blue = np.moveaxis(image.astype(int), 2, 0)
    if side == 0:
        return blue - red > 60
    return (red - blue > 110) & (red - green > 50) & (green > 50)


def middle(image: np.ndarray, side: int) -> np.ndarray:
    """The middle of the pixels of a path's colour, x to the right and y upwards."""
    rows, columns = np.nonzero(mask(image, side))
    assert len(rows) > 5
    return np.array([columns.mean(), HEIGHT - rows.mean()])


def seen_at(look: Look, place: np.ndarray, robot: np.ndarray) -> tuple[int, int]:
    """The row and the column of a place (3,) in a film of its own, where the robot's root is."""
    a, e = np.radians([look.azimuth, look.elevation])
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    lookat = np.array(look.lookat) + (robot * (1, 1, 0) if look.follows else 0.0)
    away = place - (lookat - look.distance * forward)
    scale = HEIGHT / 2 / np.tan(np.radians(45 / 2)) / (away @ forward)
    x, y = away @ right, away @ np.cross(right, forward)
    return round(HEIGHT / 2 - scale * y), round(WIDTH / 2 + scale * x)


def is_marked(image: np.ndarray, side: int, row: int, column: int) -> bool:
    """Whether a path's colour is within two pixels."""
    return bool(mask(image, side)[row - 2 : row + 3, column - 2 : column + 3].any())


def walk(env: gym.Env, way: tuple[float, float], moments: int = 8) -> np.ndarray:
    """The states of a robot that is moved from its start, whatever its legs do."""
    env.reset(seed=0)
    path = np.tile(env.unwrapped.film_state(), (moments, 1))
    path[:, 1:3] = np.linspace((0, 0), way, moments)
    return path


def reach(env: gym.Env, action: list[float], moments: int = 25) -> tuple[np.ndarray, np.ndarray]:
    """The states of an arm that takes an action again and again, and its hand's places."""
    observation, _ = env.reset(
        seed=0, options={"task": env.unwrapped.sample_tasks(1, generator())[0]}
    )
    path, places = [env.unwrapped.film_state()], [observation[:3]]
    for _ in range(moments):
        observation = env.step(np.array(action, np.float32))[0]
        path.append(env.unwrapped.film_state())
        places.append(observation[:3])
    return np.array(path), np.array(places)


def generator() -> np.random.Generator:
    return np.random.default_rng(0)


def check_sides(env: gym.Env, paths: list[np.ndarray]) -> tuple[list[list[np.ndarray]], list]:
    """The films of the sides and the race; a side does not depend on which one it is."""
    assert isinstance(env.unwrapped, Filmed)
    film = env.unwrapped.film
    sides, race = [film(paths, [i], SIZE) for i in (0, 1)], film(paths, [0, 1], SIZE)
    swapped = [film(paths[::-1], [1 - i], SIZE) for i in (0, 1)]
    for side in (0, 1):
        assert len(sides[side]) == len(paths[side])
        for image, other in zip(sides[side], swapped[side], strict=True):
            assert image.shape == (HEIGHT, WIDTH, 3)
            painted = mask(image, side) | mask(other, 1 - side)
            differing = (image.astype(int) - other != 0).any(axis=2) & ~painted
            assert differing.mean() < 0.01  # edges of what is painted
    assert len(race) == max(map(len, paths))
    assert mask(race[-1], 0).sum() > 10
    assert mask(race[-1], 1).sum() > 10
    return sides, race


@pytest.mark.parametrize("env_id", WALKERS)
def test_walkers_are_seen_where_they_went(env_id: str) -> None:
    env = gym.make(env_id)
    look = env.unwrapped.look
    ahead, aside = np.array([0.9, 0.2]), np.array([0.3, 1.3])
    paths = [walk(env, tuple(ahead)), walk(env, tuple(aside), 5)]
    sides, race = check_sides(env, paths)
    for side, end in enumerate((ahead, aside)):
        robot = np.array([*end, 0.0])
        marked = [
            is_marked(sides[side][-1], side, *seen_at(look, share * robot, robot))
            for share in np.linspace(0.0, 0.6, 7)  # from the start on
        ]
        assert np.mean(marked) > 0.5  # legs may hide the rest
    # What the words mean that the belief uses: one went ahead, the other to the left.
    directions = np.array([look.right, look.ahead]) @ np.array([[1, 0, 0], [0, 1, 0]]).T
    apart = middle(race[-1], 1) - middle(race[-1], 0)
    expected = directions @ (aside - ahead)
    assert apart @ expected > 0.6 * np.linalg.norm(apart) * np.linalg.norm(expected)
    env.close()


def test_the_cheetah_runs_along_metres() -> None:
    env = gym.make("poem/HalfCheetahVel-v0")
    paths = []
    for distance in (2.0, 6.0):
        path = walk(env, (0.0, 0.0))
        path[:, 1] = np.linspace(0, distance, len(path))
        path[:, 2] = 0.0
        paths.append(path)
    sides, race = check_sides(env, paths)
    # Six metres are seen in the race, where the faster is to the right; in a film of its own the
    # robot stays in the middle, and the lines on the floor go by.
    assert middle(race[-1], 1)[0] - middle(race[-1], 0)[0] > 30
    assert (sides[0][0] != sides[0][2]).any(axis=2).mean() > 0.02
    env.close()


@pytest.mark.parametrize("env_id", ["poem/AntDir2D-v0", "poem/AntVel-v0"])
def test_a_race_over_thirty_metres_shows_both_whole_ways_and_robots(env_id: str) -> None:
    env = gym.make(env_id)
    race = env.unwrapped.film([walk(env, (30.0, 0.0)), walk(env, (20.0, 9.0))], [0, 1], SIZE)
    for side in (0, 1):
        rows, columns = np.nonzero(mask(race[-1], side))
        assert min(rows.min(), HEIGHT - 1 - rows.max()) > 0  # nothing is cut off
        assert min(columns.min(), WIDTH - 1 - columns.max()) > 0
        assert np.ptp(rows) > HEIGHT / 12  # nor too small to see
    env.close()


def test_no_edge_of_the_floor_is_seen_in_a_long_race() -> None:
    env = gym.make("poem/AntFwdBack-v0")
    race = env.unwrapped.film([walk(env, (60.0, 0.0)), walk(env, (-60.0, 0.0))], [0, 1], SIZE)
    top = race[-1][:10].astype(int)
    assert np.ptp(top, axis=1).max() < 10  # floor or sky, in one line with the horizon
    assert top.min() > 100
    env.close()


def test_a_humanoid_fills_a_third_of_the_picture() -> None:
    env = gym.make("poem/HumanoidDir2D-v0")
    image = env.unwrapped.film([walk(env, (0.0, 0.0))], [0], SIZE)[0].astype(int)
    rows = np.flatnonzero((image[..., 0] - image[..., 2] > 30).any(axis=1))
    assert np.ptp(rows) > HEIGHT / 3
    # In a race over all that it walks in an episode, nearly, and nothing is cut off.
    paths = [walk(env, (8.0, 0.0)), walk(env, (5.0, 5.0))]
    race = env.unwrapped.film(paths, [0, 1], SIZE)[-1].astype(int)
    for side in (0, 1):
        rows, columns = np.nonzero(mask(race, side))
        assert rows.min() > 0
        assert columns.min() > 0
        assert columns.max() < WIDTH - 1
        robot = columns < columns.min() + 20  # the rest is its way
        assert np.ptp(rows[robot]) > HEIGHT / 3
    env.close()


@pytest.mark.parametrize("env_id", ["poem/AntDir2D-v0", "poem/HumanoidDir2D-v0", "poem/AntGoal-v0"])
def test_words_and_metres_are_in_sight(env_id: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env, seen, marks = gym.make(env_id), [], FilmRenderer._add_marks
    monkeypatch.setattr(
        FilmRenderer, "_add_marks", lambda *args: seen.append(marks(*args)) or seen[-1]
    )
    for way in ((2.5, 0.5), (1.0, 2.5), (0.3, -2.7)):
        env.unwrapped.film([walk(env, way)], [0], SIZE)
        words = {text for text, _, _ in seen[-1]}
        assert words > {"ahead", "left", "back", "right"}
        assert any(re.fullmatch(r"[1-4] m", text) for text in words)
    env.close()


def test_all_of_antgoals_places_are_in_the_picture() -> None:
    env = gym.make("poem/AntGoal-v0")
    for way in ((3.0, 0.0), (-3.0, 0.0), (0.0, 3.0), (0.0, -3.0)):
        path = walk(env, way)
        image = env.unwrapped.film([path], [0], SIZE)[-1]
        row, column = seen_at(env.unwrapped.look, np.array([*way, 0.0]), np.zeros(3))
        assert min(row, HEIGHT - row, column, WIDTH - column) > 10
        assert np.ptp(image[row - 4 : row + 5, column - 4 : column + 5], axis=(0, 1)).max() > 20
    # Who walks out of it is followed by the camera's distance, on either side.
    far = [walk(env, (12.0, 0.0)), walk(env, (1.0, 0.0))]
    films = [env.unwrapped.film(far, [i], SIZE)[-1] for i in (0, 1)]
    assert mask(films[0], 0).any(axis=1).sum() > HEIGHT / 4
    assert mask(films[1], 1).any(axis=1).sum() < HEIGHT / 12
    # The circles tell the scale: they are as large in both.
    assert np.array_equal(films[0][HEIGHT // 2 + 2 :], films[1][HEIGHT // 2 + 2 :]) or (
        (films[0][HEIGHT * 2 // 3 :] == films[1][HEIGHT * 2 // 3 :]).mean() > 0.98
    )
    env.close()


@pytest.mark.parametrize("env_id", ARMS)
def test_a_hands_way_is_drawn_in_space(env_id: str) -> None:
    env = gym.make(env_id)
    (right, places), (up, _) = (
        reach(env, [0.2, 0.3, 0.1, 0.0], 15),
        reach(env, [-0.2, 0.2, 0.5, 0.0], 6),
    )
    sides, _ = check_sides(env, [right, up])
    marked = [
        is_marked(sides[0][-1], 0, *seen_at(env.unwrapped.look, place, place)) for place in places
    ]
    assert np.mean(marked) > 0.9  # whatever is in front of it
    assert np.ptp(places, axis=0).max() > 0.03
    env.close()


@pytest.mark.metaworld
def test_a_puck_that_is_no_part_of_the_task_is_not_shown() -> None:
    env = gym.make("poem/MetaWorldML1-v0")
    task, images = env.unwrapped.sample_tasks(1, generator())[0], []
    for seed in (0, 1):  # of the puck's place
        env.reset(seed=seed, options={"task": task})
        images.append(env.unwrapped.film([env.unwrapped.film_state()[None]], [0], SIZE)[0])
    assert np.array_equal(*images)
    assert not np.array_equal(*(env.reset(seed=seed)[0] for seed in (0, 1)))
    env.close()


def test_a_points_way() -> None:
    env = gym.make("poem/PointGoal-v0")
    paths = [np.linspace((0, 0), end, 9) for end in ((-0.8, 0.6), (1.0, 0.2))]
    sides, race = check_sides(env, paths)
    for side, (x, y) in enumerate(((-0.8, 0.6), (1.0, 0.2))):
        scale = HEIGHT / 2.7
        row, column = round(HEIGHT / 2 - scale * (y - 0.4)), round(WIDTH / 2 + scale * x)
        assert is_marked(sides[side][-1], side, row, column)
        assert is_marked(race[-1], side, row, column)
    env.close()


def test_a_maze_is_seen_from_above() -> None:
    env = gym.make("poem/AntMaze-v0")
    paths = [walk(env, (2.0, 0.0)), walk(env, (0.0, 2.0))]
    _, race = check_sides(env, paths)
    apart = middle(race[-1], 1) - middle(race[-1], 0)
    assert apart[0] < 0 < apart[1]
    env.close()


def test_filming_changes_neither_the_simulation_nor_other_images() -> None:
    env = gym.make("poem/AntGoal-v0", render_mode="rgb_array", width=64, height=48)
    env.reset(seed=0)
    before, state = env.render(), env.unwrapped.states.copy()
    env.unwrapped.film([walk(env, (1.0, 0.0))], [0], SIZE)
    env.reset(seed=0)
    assert np.array_equal(env.unwrapped.states, state)
    assert np.array_equal(env.render(), before)
    env.close()
