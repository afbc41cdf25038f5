"""The families that step in batches, beyond the contract of all families
(tests/test_family_contract.py).
"""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import poem_envs  # noqa: F401 (registers)


def make(env_id, **kwargs):
    return gym.make(env_id, **kwargs).unwrapped


def test_checkers_find_nothing(robot_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Gymnasium's own MuJoCo environments raise these: unbounded observations, and Humanoid's
        # torques up to 0.4.
        warnings.filterwarnings(
            "ignore", message=".*A Box observation space m.*imum value is -?infinity"
        )
        warnings.filterwarnings("ignore", message=".*recommend.*symmetric and normalized")
        gymnasium_check_env(make(robot_id), skip_render_check=True)
        sb3_check_env(make(robot_id))


def test_spaces_and_horizon(env_id):
    env = gym.make(env_id)
    horizon = 25 if "PointGoal" in env_id else 200
    dims = {
        "Point": (2, 2),
        "HalfC": (17, 6),
        "AntGo": (29, 8),
        "AntVe": (27, 8),
        "AntFw": (27, 8),
        "AntDi": (27, 8),
    }
    obs_dim, action_dim = dims.get(env_id.removeprefix("poem/")[:5], (376, 17))
    assert env.spec.max_episode_steps == horizon
    assert env.observation_space.shape == (obs_dim,)
    assert env.observation_space.dtype == np.float64
    assert env.action_space.shape == (action_dim,)
    assert env.action_space.dtype == np.float32
    assert env.unwrapped.task_space.shape == ((2,) if env_id == "poem/AntGoal-v0" else (1,))
    assert env.unwrapped.shared_dynamics


@pytest.mark.parametrize(
    ("env_id", "low", "high"),
    [
        ("poem/PointGoal-v0", 0, np.pi),
        ("poem/HalfCheetahVel-v0", 0, 3),
        ("poem/AntVel-v0", 0, 3),
        ("poem/AntDir2D-v0", -np.pi / 2, np.pi / 2),
        ("poem/HumanoidDir2D-v0", -np.pi / 2, np.pi / 2),
    ],
)
def test_tasks_are_uniform_on_the_documented_interval(env_id, low, high, rng):
    tasks = make(env_id).sample_tasks(4000, rng)
    assert tasks.shape == (4000, 1)
    assert tasks.dtype == np.float64
    ranks = np.sort(tasks[:, 0] - low) / (high - low)
    assert (
        np.abs(ranks - (np.arange(4000) + 0.5) / 4000).max() < 0.03
    )  # Kolmogorov-Smirnov, far beyond its 1 % point


def test_ant_goals_are_uniform_on_the_disc(rng):
    goals = make("poem/AntGoal-v0").sample_tasks(4000, rng)
    radius, angle = np.hypot(*goals.T), np.arctan2(goals[:, 1], goals[:, 0])
    for ranks in (np.sort((radius / 3) ** 2), np.sort(angle / (2 * np.pi) + 0.5)):
        assert np.abs(ranks - (np.arange(4000) + 0.5) / 4000).max() < 0.03


@pytest.mark.parametrize(
    ("env_id", "members"),
    [("poem/HalfCheetahFwdBack-v0", {1.0, -1.0}), ("poem/AntFwdBack-v0", {0.0, np.pi})],
)
def test_finite_families(env_id, members, rng):
    env = make(env_id)
    assert set(env.all_tasks[:, 0]) == members
    drawn = [tuple(env.sample_tasks(2, rng)[:, 0]) for _ in range(20)]
    assert all(set(tasks) == members for tasks in drawn)
    assert len(set(drawn)) == 2  # in either order
    assert {env.sample_tasks(1, rng)[0, 0] for _ in range(40)} == members
    with pytest.raises(ValueError, match=r"n=3 .*finite family of 2"):
        env.sample_tasks(3, rng)
    with pytest.raises(ValueError, match="not among this family's tasks"):
        env.set_task([0.5])
    env.set_task(env.all_tasks[1] * (1 - 1e-9))  # rounding on the way is forgiven
    env.reset()
    assert env.task == env.all_tasks[1]


def test_wrong_numbers_of_tasks():
    env = make("poem/PointGoal-v0")
    for n in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="n="):
            env.sample_tasks(n, np.random.default_rng(5))


def test_the_task_cannot_be_changed_from_outside(robot_id, rng):
    env = make(robot_id)
    (first,) = env.sample_tasks(1, rng)
    handed_in = first.copy()
    env.reset(options={"task": handed_in})
    handed_in[:] = 99
    env.task[:] = 99
    assert np.array_equal(env.task, first)


def test_a_seed_determines_an_unchosen_task(robot_id):
    env, other = make(robot_id), make(robot_id)
    start, _ = env.reset(seed=7)
    task = env.task
    next_start, _ = env.reset()
    assert np.array_equal(env.task, task)  # kept without a seed, while
    assert not np.array_equal(next_start, start)  # the random numbers go on
    env.reset(seed=8)
    env.reset(seed=7)
    other.reset(seed=7)
    assert np.array_equal(env.task, task)
    assert np.array_equal(other.task, task)
    drawn = []
    for seed in range(10):
        env.reset(seed=seed)
        drawn.append(tuple(env.task))
    assert len(set(drawn)) > 1


def test_wrong_tasks(robot_id):
    env = make(robot_id)
    env.reset(seed=0)
    before = env.task
    for wrong, message in (
        (np.zeros(3), r"task has shape \(3,\), expected"),
        (np.full_like(before, 99.0), "task is 99.0 at component 0"),
        (np.full_like(before, np.nan), "task is nan at component 0"),
        (np.zeros((1, 1)), r"task has shape \(1, 1\)"),
        ("fast", "task='fast' is no array"),
    ):
        for choose in (env.set_task, lambda task: env.reset(options={"task": task})):
            with pytest.raises(ValueError, match=message):
                choose(wrong)
    with pytest.raises(ValueError, match=r"task has shape \(\)"):
        env.set_task(None)
    env.reset()
    assert np.array_equal(env.task, before)


def test_compute_rewards_broadcasts_to_the_same_bits(env_id, rng):
    env = make(env_id)
    tasks = np.concatenate([env.sample_tasks(2, rng) for _ in range(20)])
    features = rng.normal(0, 2, size=(7, 5, env.reward_feature_dim))
    together = env.compute_rewards(tasks[:, None, None], features)
    assert together.shape == (40, 7, 5)
    assert together.dtype == np.float64
    one_by_one = [
        [[float(env.compute_rewards(t, f)) for f in row] for row in features] for t in tasks
    ]
    assert np.array_equal(together, one_by_one)
    strided = env.compute_rewards(tasks[::2], np.asfortranarray(features)[0, 0])
    assert np.array_equal(strided, together[::2, 0, 0])


def test_compute_rewards_refuses_wrong_dimensions():
    env = make("poem/PointGoal-v0")
    task_dim, feature_dim = env.task_space.shape[0], env.reward_feature_dim
    with pytest.raises(ValueError, match="task_dim"):
        env.compute_rewards(np.zeros(task_dim + 1), np.zeros(feature_dim))
    with pytest.raises(ValueError, match="feature_dim=2"):
        env.compute_rewards(np.zeros(task_dim), np.zeros((3, feature_dim + 1)))


def test_wrong_actions(robot_id):
    env, other = make(robot_id), make(robot_id)
    high = env.action_space.high.astype(np.float64)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros_like(high))
    for each in (env, other):
        each.reset(seed=0)
    for value in (np.nan, np.inf, 2.0):
        wrong = np.zeros_like(high)
        wrong[1] = value
        with pytest.raises(ValueError, match=rf"action is {value} at component 1.*inside \[-"):
            env.step(wrong)
    with pytest.raises(ValueError, match="action has shape"):
        env.step(np.zeros(len(high) + 1))
    with pytest.raises(ValueError, match="action='left'"):
        env.step("left")
    clipped, expected = env.step(high + 9e-7), other.step(high)  # the bad ones left no trace
    assert np.array_equal(clipped[0], expected[0])
    assert clipped[1] == expected[1]


@pytest.mark.parametrize(
    ("env_id", "seen"),
    [
        ("poem/PointGoal-v0", [1, 1]),
        ("poem/HalfCheetahVel-v0", [1, 0]),
        ("poem/AntGoal-v0", [1, 1, 0]),
        ("poem/HumanoidDir2D-v0", [1, 1, 0]),
        ("poem/FetchReach-v0", [1, 1, 1]),
        pytest.param("poem/MetaWorldML1-v0", [1, 1, 1], marks=pytest.mark.metaworld),
    ],
)
def test_what_people_can_tell_apart(env_id, seen, rng):
    """A tenth of a standard deviation of what films show, or of their length."""
    env = make(env_id)
    spread = rng.uniform(0.5, 2.0, size=len(seen))
    left = rng.normal(size=(100, len(seen)))
    for feature, is_seen in enumerate(seen):
        moved = 0.3 * spread * np.eye(len(seen))[feature]
        assert env.visible_difference(left, left + moved, spread) == pytest.approx(3.0 * is_seen)
    assert env.visible_difference(left, left, spread) == 0.0
    assert env.visible_difference(left, np.tile(left.mean(axis=0), (80, 1)), spread) == (
        pytest.approx(2.0)
    )
    env.close()


@pytest.mark.metaworld
def test_what_earns_the_same_may_look_different():
    env, rewards = make("poem/MetaWorldML1-v0", env_name="push"), np.ones((9, 1))
    assert env.visible_difference(rewards, rewards, np.ones(1)) == np.inf
    env.close()
