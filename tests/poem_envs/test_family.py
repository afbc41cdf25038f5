"""The base class, on a family that only has a single environment, and what importing the package
costs.
"""

import subprocess
import sys
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv
from worlds import Walk1D

from poem_envs import TaskFamily, TaskFamilyVector, sawyer
from poem_envs.testing import check_task_family


@pytest.mark.filterwarnings("ignore:.*A Box observation space m.*imum value is")
def test_a_minimal_family_passes_the_checkers():
    check_env(Walk1D())
    gymnasium_check_env(Walk1D(), skip_render_check=True)


def test_a_minimal_family_earns_what_it_says():
    env = Walk1D()
    start, _ = env.reset(seed=0, options={"task": [0.5]})
    observation, reward, terminated, truncated, info = env.step(np.array([0.3]))
    assert observation == pytest.approx(start + 0.03)
    assert reward == pytest.approx(-abs(start[0] + 0.03 - 0.5))
    assert info["reward_features"] == observation
    assert not terminated
    assert not truncated


def test_a_minimal_family_in_sb3s_own_vec_env():
    vec_env = DummyVecEnv([Walk1D, Walk1D])
    tasks = vec_env.env_method("sample_tasks", 2, np.random.default_rng(0), indices=[0])[0]
    for copy, task in enumerate(tasks):
        vec_env.env_method("set_task", task, indices=[copy])
    start = vec_env.reset()
    assert np.array_equal(np.array(vec_env.get_attr("task")), tasks)
    _, rewards, _, infos = vec_env.step(np.zeros((2, 1), dtype=np.float32))
    assert rewards == pytest.approx(-np.abs(start - tasks)[:, 0])
    features = np.stack([info["reward_features"] for info in infos])
    assert vec_env.env_method("compute_rewards", tasks, features, indices=[0])[0] == pytest.approx(
        rewards
    )


@pytest.mark.filterwarnings("error", "ignore:.*A Box observation space m.*imum value is")
def test_a_minimal_family_in_make_vec_env():
    """SB3 asks for RGB images first; that the family has none is nothing to be warned of."""
    gym.register("test/Walk1D-v0", entry_point=Walk1D, max_episode_steps=10)
    try:
        vec_env = make_vec_env("test/Walk1D-v0", 2, seed=0)
        assert vec_env.reset().shape == (2, 1)
        assert vec_env.render_mode is None
        gymnasium_check_env(gym.make("test/Walk1D-v0").unwrapped)
    finally:
        del gym.registry["test/Walk1D-v0"]


def test_rewards_are_float64_whatever_the_family_computes_them_in():
    class Sparse(Walk1D):
        def _reward(self, tasks, features):
            return np.abs(features[..., 0] - tasks[..., 0]) < 0.5

    envs = TaskFamilyVector(Sparse, num_envs=2, nthread=1)
    envs.reset(options={"tasks": [[0.0], [1.0]]})
    rewards = envs.step(np.zeros((2, 1)))[1]
    assert rewards.dtype == np.float64
    assert rewards.tolist() == [1.0, 0.0]


class NoReward(TaskFamily):
    observation_space, action_space = Walk1D.observation_space, Walk1D.action_space
    task_space, reward_feature_dim = Walk1D.task_space, 1
    _begin_episode, _simulate = Walk1D._begin_episode, Walk1D._simulate


class NoSpaces(TaskFamily):
    """Its constructor does not call that of the base class, and sets one of four attributes."""

    _begin_episode, _simulate, _reward = Walk1D._begin_episode, Walk1D._simulate, Walk1D._reward

    def __init__(self):
        self.observation_space = Walk1D.observation_space


@pytest.mark.parametrize(
    ("family", "message"),
    [
        (NoReward, "abstract.*NoReward.*_reward"),
        (
            NoSpaces,
            r"NoSpaces: action_space must be a flat .*Box, bounded.*, but is None; task_space must "
            r"be a .*Box of shape \(task_dim,\), dtype float64, .*; reward_feature_dim must be a",
        ),
    ],
)
def test_what_a_family_lacks_is_said_when_it_is_made(family, message):
    with pytest.raises(TypeError, match=message):
        family()


@pytest.mark.parametrize("all_tasks", [[[-1.0], [1.0]], np.array([[-1], [1]])])
def test_finitely_many_tasks_as_numbers_of_any_kind(all_tasks):
    class Two(Walk1D):
        pass

    Two.all_tasks = all_tasks
    check_task_family(Two)
    single, several = Two(), TaskFamilyVector(Two, num_envs=2, nthread=1, max_episode_steps=5)
    single.set_task([1.0])
    single.reset(seed=0)
    several.set_tasks([[1.0], [-1.0]])
    several.reset(seed=0)
    assert single.task.dtype == np.float64
    assert np.array_equal(several.tasks[0], single.task)


def test_metadata_without_render_modes():
    class Blind(Walk1D):
        metadata: ClassVar = {"render_fps": 20}

    assert Blind().metadata["render_fps"] == 20


def test_the_import_is_light_and_quick():
    code = """
import time
start = time.process_time()
import poem_envs
seconds = time.process_time() - start
import sys, gymnasium
slow = "mujoco torch stable_baselines3 glfw imageio metaworld gymnasium_robotics"
heavy = sorted(set(slow.split()) & set(sys.modules))
print(seconds, heavy, sum(id.startswith("poem/") for id in gymnasium.registry))
"""
    command = [sys.executable, "-c", code]
    outputs = [subprocess.check_output(command, text=True) for _ in range(2)]
    runs = [output.split(maxsplit=1) for output in outputs]
    assert {rest.strip() for _, rest in runs} == {"[] 13"}
    assert min(float(seconds) for seconds, _ in runs) < 1.0


@pytest.mark.parametrize("make", [gym.make, gym.make_vec])
@pytest.mark.parametrize("name", ["ML1", "ML10"])
def test_meta_world_is_an_extra(monkeypatch, make, name):
    def absent(name):
        raise sawyer.PackageNotFoundError(name)

    monkeypatch.setattr(sawyer, "version", absent)
    needed = r"need metaworld >= 3.1, < 4: pip install -c constraints.txt '\.\[metaworld\]'"
    with pytest.raises(ImportError, match=needed):
        make(f"poem/MetaWorld{name}-v0")


def test_gymnasium_imports_the_package_by_its_name_in_an_id():
    env_id = "poem_envs:poem/AntGoal-v0"
    assert gym.make(env_id).reset(seed=0)[0].shape == (29,)
    assert gym.make_vec(env_id, num_envs=2).reset(seed=0)[0].shape == (2, 29)
