"""Images of the families: shapes, cameras, and the hidden task, which shows only when asked for."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import poem_envs  # noqa: F401 (registers)

SIZE = {"width": 120, "height": 90}


@pytest.fixture(scope="module", autouse=True)
def _graphics():
    """Skip where there is neither a display nor a software renderer."""
    try:
        env = gym.make("poem/AntVel-v0", render_mode="rgb_array", **SIZE)
        env.reset(seed=0)
        env.render()
        env.close()
    except Exception as error:
        pytest.skip(f"this machine cannot render: {error}")


# One of each robot: making a graphics context takes a second in software.
ROBOTS = ["poem/PointGoal-v0", "poem/HalfCheetahVel-v0", "poem/AntGoal-v0", "poem/HumanoidDir2D-v0"]


def two_tasks(env_id):
    return gym.make(env_id).unwrapped.sample_tasks(2, np.random.default_rng(3))


# All whose tasks are drawn differently.
@pytest.mark.parametrize("env_id", [*ROBOTS, "poem/HalfCheetahFwdBack-v0", "poem/AntVel-v0"])
def test_the_task_shows_only_when_asked_for(env_id):
    env = gym.make(env_id, render_mode="rgb_array", **SIZE).unwrapped
    pictures = {}
    for asked in (None, False, True):  # None: as the constructor leaves it
        if asked is not None:
            env.render_task = asked
        for number, task in enumerate(two_tasks(env_id)):
            env.reset(seed=0, options={"task": task})
            pictures[asked, number] = env.render()
    env.close()
    hidden = pictures[None, 0]
    assert hidden.shape == (90, 120, 3)
    assert hidden.dtype == np.uint8
    assert hidden.std() > 5  # something is there
    for key in [(None, 1), (False, 0), (False, 1)]:
        assert np.array_equal(hidden, pictures[key])
    assert not np.array_equal(hidden, pictures[True, 0])
    assert not np.array_equal(hidden, pictures[True, 1])
    assert not np.array_equal(pictures[True, 0], pictures[True, 1])


@pytest.mark.parametrize("env_id", ["poem/PointGoal-v0", "poem/AntGoal-v0"])
def test_vector_environments_and_several_at_once(env_id):
    envs = gym.make_vec(env_id, num_envs=2, render_mode="rgb_array", render_task=True, **SIZE)
    single = gym.make(env_id, render_mode="rgb_array", render_task=True, **SIZE)
    tasks = two_tasks(env_id)
    envs.reset(seed=0, options={"tasks": tasks})
    single.reset(seed=1, options={"task": tasks[1]})
    pictures = envs.render()
    assert not np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[1], single.render())
    assert np.array_equal(
        pictures[1], envs.render_copy(1)
    )  # the other's rendering in between changed nothing
    single.close()
    assert np.array_equal(pictures[0], envs.render_copy(0))
    envs.close()


@pytest.mark.parametrize("env_id", ROBOTS[1:])
def test_a_recorded_state_renders_the_same(env_id):
    env = gym.make(env_id, render_mode="rgb_array", **SIZE)
    unseen = gym.make(env_id)
    env.reset(seed=0)
    unseen.reset(seed=0)
    env.action_space.seed(0)
    pictures, states = [], []
    for _ in range(4):
        action = env.action_space.sample()
        observation = env.step(action)[0]
        assert np.array_equal(
            observation, unseen.step(action)[0]
        )  # rendering does not disturb the simulation
        pictures.append(env.render())
        states.append(env.unwrapped.states[0].copy())
    assert not np.array_equal(pictures[0], pictures[3])
    env.reset(seed=1)
    for picture, state in zip(pictures, states, strict=True):
        env.unwrapped.states[0] = state
        assert np.array_equal(env.render(), picture)
    env.close()


@pytest.mark.parametrize(
    "env_id", ["poem/HalfCheetahVel-v0", "poem/AntVel-v0", "poem/HumanoidDir2D-v0"]
)
def test_the_camera_follows_the_robot(env_id):
    """Far from the start the picture is the same, but for the floor's pattern, as long as that has
    the same phase.
    """
    env = gym.make(env_id, render_mode="rgb_array", **SIZE)
    env.reset(seed=0)
    here = env.render()
    state = env.unwrapped.states[0].copy()
    state[1] += 4.0  # whole tiles of every floor
    env.unwrapped.states[0] = state
    there = env.render()
    middle = (slice(20, 70), slice(40, 80))
    assert np.abs(here[middle].astype(int) - there[middle]).mean() < 1
    env.close()


def test_other_modes_and_cameras():
    pictures = []
    for arguments in (
        {"render_mode": "rgbd_tuple"},
        {"render_mode": "depth_array"},
        {"render_mode": "rgb_array", "camera_name": "track"},
        {"render_mode": "rgb_array", "default_camera_config": {"distance": 9.0}},
    ):
        env = gym.make("poem/AntVel-v0", **arguments, **SIZE)
        env.reset(seed=0)
        pictures.append(env.render())
        env.close()
    (colours, depths), only_depths, from_the_model, from_afar = pictures
    assert colours.shape == (90, 120, 3)
    assert depths.shape == (90, 120)
    assert np.array_equal(depths, only_depths)
    assert not np.array_equal(colours, from_the_model)
    assert not np.array_equal(colours, from_afar)


def test_rendering_without_a_mode():
    env = gym.make("poem/PointGoal-v0").unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert env.render() is None


@pytest.mark.parametrize(
    "env_id",
    [
        pytest.param("poem/MetaWorldML1-v0", marks=pytest.mark.metaworld),
        "poem/FetchReach-v0",
        "poem/AntMaze-v0",
    ],
)
def test_other_environments_that_render_or_close_change_nothing(env_id):
    def image(env):
        env.reset(seed=0)
        return env.render()

    def make(of):
        return gym.make(of, render_mode="rgb_array")

    env, cheetah, twin = make(env_id), make("poem/HalfCheetahVel-v0"), make(env_id)
    first = image(env)
    assert first.std() > 5
    image(cheetah)
    np.testing.assert_array_equal(image(env), first)
    np.testing.assert_array_equal(image(twin), first)
    cheetah.close()
    twin.close()
    np.testing.assert_array_equal(image(env), first)
    env.close()
    again = make(env_id)  # perhaps with the simulator of one that was closed
    np.testing.assert_array_equal(image(again), first)
    again.close()


@pytest.mark.metaworld
def test_tasks_of_different_manipulations_render_in_turn():
    env = gym.make("poem/MetaWorldML10-v0", render_mode="rgb_array")
    tasks = env.unwrapped.sample_tasks(3, np.random.default_rng(0))
    images = []
    for task in [*tasks, *tasks]:
        env.reset(seed=0, options={"task": task})
        images.append(env.render())
    for first, second in zip(images[:3], images[3:], strict=True):
        np.testing.assert_array_equal(first, second)
    env.close()


@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*imum value is")
@pytest.mark.parametrize("env_id", ["poem/PointGoal-v0", "poem/HalfCheetahVel-v0"])
def test_gymnasiums_checker_needs_no_display(env_id, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    check_env(gym.make(env_id, width=64, height=64).unwrapped)
    with pytest.raises(ValueError, match="render_mode='human' needs a display; use 'rgb_array'"):
        gym.make(env_id, render_mode="human")
