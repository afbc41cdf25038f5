"""TaskVecEnv against SB3's DummyVecEnv of single environments."""

import functools
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TimeLimit
from meta_toys import Walk
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecMonitor, VecNormalize

from poem_envs.registration import plain_id
from sb3_poem import set_task
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import TaskVecEnv, make_task_vec_env, vectorised

SMALL = {"buffer_size": 500, "batch_size": 16, "policy_kwargs": {"net_arch": [8]}, "device": "cpu"}
POINT = "poem/PointGoal-v0"


def random_actions(env, steps, seed=0):
    rng = np.random.default_rng(seed)
    space = env.action_space
    return rng.uniform(space.low, space.high, size=(steps, env.num_envs, *space.shape)).astype(
        np.float32
    )


# of the second some episodes end early
@pytest.mark.parametrize("env_id", [POINT, "poem/HumanoidDir2D-v0"])
def test_gives_what_dummy_vec_env_gives(env_id):
    n_envs, steps = 4, 60
    env_kwargs = {"max_episode_steps": 20}
    ours = make_vec_env(env_id, n_envs, seed=3, vec_env_cls=TaskVecEnv, env_kwargs=env_kwargs)
    theirs = make_vec_env(env_id, n_envs, seed=3, env_kwargs=env_kwargs)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.render_mode == theirs.render_mode
    assert np.array_equal(ours.reset(), theirs.reset())
    assert ours.reset_infos == theirs.reset_infos
    assert np.array_equal(ours.get_attr("task"), theirs.get_attr("task"))
    ended = 0
    for step, actions in enumerate(random_actions(ours, steps)):
        if step == 30:
            tasks = np.repeat(
                theirs.env_method("sample_tasks", 2, np.random.default_rng(1), indices=[0])[0],
                2,
                axis=0,
            )
            ours.set_tasks(tasks)
            for index, task in enumerate(tasks):
                theirs.env_method("set_task", task, indices=[index])
        (obs, rewards, dones, infos), expected = ours.step(actions), theirs.step(actions)
        for one, two in zip((obs, rewards, dones), expected, strict=False):
            assert np.array_equal(one, two)
            assert one.dtype == two.dtype
        for info, other in zip(infos, expected[3], strict=True):
            assert info.keys() == other.keys()
            assert np.array_equal(info["reward_features"], other["reward_features"])
            assert info["TimeLimit.truncated"] == other["TimeLimit.truncated"]
            if "episode" in info:
                ended += 1
                assert np.array_equal(info["terminal_observation"], other["terminal_observation"])
                assert info["episode"].keys() == other["episode"].keys()
                assert (info["episode"]["r"], info["episode"]["l"]) == (
                    other["episode"]["r"],
                    other["episode"]["l"],
                )
                assert 0 <= info["episode"]["t"] < 60
        assert np.array_equal(
            ours.last_reward_features, [info["reward_features"] for info in infos]
        )
    assert ended >= 3 * n_envs


@pytest.mark.parametrize("env_id", [POINT, "poem/HalfCheetahFwdBack-v0"])
def test_a_copy_looks_like_a_single_environment(env_id):
    ours, theirs = make_task_vec_env(env_id, 3), make_vec_env(env_id, 3)
    for name in ("task_space", "all_tasks", "shared_dynamics", "reward_feature_dim", "task"):
        for one, two in zip(ours.get_attr(name), theirs.get_attr(name), strict=True):
            assert np.array_equal(one, two)
    assert ours.get_attr("spec", indices=[1])[0].id == env_id
    assert (
        ours.get_attr("spec")[0].max_episode_steps == theirs.get_attr("spec")[0].max_episode_steps
    )
    assert ours.get_attr("observation_space") == theirs.get_attr("observation_space")
    assert ours.get_attr("action_space") == theirs.get_attr("action_space")
    task, other = ours.env_method("sample_tasks", 2, np.random.default_rng(0), indices=[0])[0]
    assert np.array_equal(
        [task, other],
        theirs.env_method("sample_tasks", 2, np.random.default_rng(0), indices=[0])[0],
    )
    for env in (ours, theirs):
        env.seed(5)
        env.env_method("set_task", task, indices=[1])
        env.env_method("set_task", other, indices=[0, 2])
        env.reset()
        assert np.array_equal(env.get_attr("task"), [other, task, other])
        env.set_options([{}, {"task": other}, {}])
        env.reset()
        assert np.array_equal(env.get_attr("task"), [other] * 3)
    features = np.random.default_rng(0).normal(size=(4, ours.get_attr("reward_feature_dim")[0]))
    relabel = functools.partial(TaskVecEnv.env_method, method_name="compute_rewards", indices=[0])
    assert np.array_equal(
        relabel(ours, tasks=task, features=features)[0],
        theirs.env_method("compute_rewards", task, features, indices=[0])[0],
    )
    assert ours.has_attr("task")
    for hidden in ("tasks", "num_envs", "step", "set_tasks"):
        assert not ours.has_attr(hidden)


def test_env_is_wrapped():
    env = make_task_vec_env("poem/PointGoal-v0", 2)
    assert env.env_is_wrapped(Monitor) == [True, True]
    assert env.env_is_wrapped(TimeLimit, indices=[0]) == [True]
    assert env.env_is_wrapped(gym.wrappers.RescaleAction) == [False, False]


def test_seeding():
    env = make_task_vec_env("poem/HalfCheetahVel-v0", 3)
    env.seed(4)
    first = env.reset()
    assert not np.array_equal(env.reset(), first)
    env.seed(4)
    assert np.array_equal(env.reset(), first)
    single = gym.make("poem/HalfCheetahVel-v0")
    assert np.array_equal(single.reset(seed=6)[0], first[2])
    assert env.get_attr("np_random_seed") == [4, 5, 6]


def test_only_the_first_function_is_called():
    calls = []

    def make():
        calls.append(1)
        return gym.make("poem/HalfCheetahVel-v0", ctrl_cost_weight=3.0, max_episode_steps=7)

    env = TaskVecEnv([make] * 5)
    assert calls == [1]
    assert env.get_attr("ctrl_cost_weight") == [3.0] * 5
    env.reset()
    dones = [env.step(actions)[2].all() for actions in random_actions(env, 7)]
    assert dones == [False] * 6 + [True]


def test_ids_that_name_their_module():
    assert isinstance(make_task_vec_env("poem_envs:poem/PointGoal-v0", 2), TaskVecEnv)
    assert (
        plain_id("poem_envs:poem/PointGoal-v0")
        == plain_id("poem/PointGoal-v0")
        == "poem/PointGoal-v0"
    )
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        make_task_vec_env("no_such_module:poem/PointGoal-v0", 2)


def test_attributes_of_a_family_in_processes():
    env = make_task_vec_env("poem/FetchReach-v0", 2, nthread=1)
    assert env.get_attr("max_episode_steps") == [50, 50]


def test_set_attr():
    env = make_task_vec_env("poem/PointGoal-v0", 2)
    env.set_attr("render_task", True)
    assert env.get_attr("render_task") == [True, True]
    with pytest.raises(ValueError, match="only be set for all"):
        env.set_attr("render_task", False, indices=[0])
    with pytest.raises(AttributeError, match="use set_tasks"):
        env.set_attr("task", [0.3])


def test_refused_environments():
    def wrapped():
        return gym.wrappers.TimeAwareObservation(gym.make("poem/PointGoal-v0"))

    def with_task():
        env = gym.make("poem/PointGoal-v0")
        env.unwrapped.set_task([0.3])
        return env

    def only_single():
        gym.register("test/OnlySingle-v0", entry_point=Walk)
        return gym.make("test/OnlySingle-v0")

    def keywords():
        return Monitor(gym.make("poem/PointGoal-v0"), reset_keywords=("task",))

    from poem_envs.point_goal import PointGoalEnv

    for make, message in [
        (functools.partial(gym.make, "Pendulum-v1"), "no task family"),
        (wrapped, "TimeAwareObservation"),
        (PointGoalEnv, "not made by gym.make"),
        (with_task, "was given a task"),
        (only_single, "without a vector_entry_point"),
        (keywords, "reset_keywords"),
    ]:
        with pytest.raises(ValueError, match=message):
            TaskVecEnv([make] * 2)
    with pytest.raises(ValueError, match="env_fns is empty"):
        TaskVecEnv([])
    for n_envs in (0, 2.5):
        with pytest.raises(ValueError, match="`n_envs` must be"):
            make_task_vec_env("poem/PointGoal-v0", n_envs)


def test_bad_actions_and_options():
    env = make_task_vec_env("poem/PointGoal-v0", 3)
    env.reset()
    actions = np.zeros((3, 2))
    actions[1, 0] = np.nan
    with pytest.raises(ValueError, match=r"actions\[1\] is nan"):
        env.step(actions)
    env.step(np.zeros((3, 2)))  # the bad call left no trace
    env.set_options({"goal": 1})
    with pytest.raises(ValueError, match="unknown keys"):
        env.reset()


def test_monitor_files_hold_the_episodes_of_all_copies(tmp_path):
    env = make_vec_env("poem/PointGoal-v0", 3, vec_env_cls=TaskVecEnv, monitor_dir=str(tmp_path))
    env.reset()
    returns = []
    for actions in random_actions(env, 50):
        returns += [info["episode"]["r"] for info in env.step(actions)[3] if "episode" in info]
    env.close()
    header, *rows = (tmp_path / "0.monitor.csv").read_text().splitlines()[:8]
    assert "poem/PointGoal-v0" in header
    assert rows[0] == "r,l,t"
    assert len(returns) == 6
    assert [float(row.split(",")[0]) for row in rows[1:]] == pytest.approx(returns)
    assert {row.split(",")[1] for row in rows[1:]} == {"25"}
    assert [path.name for path in tmp_path.iterdir()] == ["0.monitor.csv"]


def test_images():
    env = make_task_vec_env("poem/PointGoal-v0", 4, render_mode="rgb_array", width=32, height=24)
    env.reset()
    assert [image.shape for image in env.get_images()] == [(24, 32, 3)] * 4
    assert env.render().shape == (48, 64, 3)
    assert env.env_method("render", indices=[2])[0].shape == (24, 32, 3)
    silent = make_task_vec_env("poem/PointGoal-v0", 2)
    with pytest.warns(UserWarning, match="render mode is None"):
        assert silent.get_images() == [None, None]


def test_sb3_algorithms_and_wrappers_take_it():
    env = make_task_vec_env("poem/PointGoal-v0", 4)
    model = SAC(
        "MlpPolicy", VecNormalize(VecFrameStack(env, 2)), learning_starts=100, seed=0, **SMALL
    )
    model.learn(120)
    assert len(model.ep_info_buffer) == 4
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # evaluate_policy warns of environments without a Monitor
        mean, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=4)
    assert np.isfinite(mean)


def test_learning_is_the_same_as_with_dummy_vec_env():
    weights = []
    for kind in (TaskVecEnv, DummyVecEnv):
        env = make_vec_env("poem/PointGoal-v0", 2, seed=1, vec_env_cls=kind)
        model = SAC("MlpPolicy", env, learning_starts=60, seed=1, **SMALL).learn(70)
        weights.append(model.policy.state_dict())
    assert all(
        np.array_equal(weights[0][key].numpy(), weights[1][key].numpy()) for key in weights[0]
    )


def test_takes_environments_that_were_made_after_an_import_of_rl_zoo3(monkeypatch):
    """rl_zoo3 patches Gymnasium's TimeLimit when it is imported, whoever imported that before."""
    from rl_zoo3.gym_patches import PatchedTimeLimit

    # as that one, also if it was there before TaskVecEnv
    names = {"__module__": PatchedTimeLimit.__module__}
    monkeypatch.setattr(gym.wrappers, "TimeLimit", type("Later", (PatchedTimeLimit,), names))
    env = TaskVecEnv([functools.partial(gym.make, POINT)] * 2)
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [True, True]
    assert env.reset().shape == (2, 2)


@pytest.mark.parametrize(
    ("make", "num_envs"),
    [
        (lambda: gym.make(POINT).unwrapped, None),
        (lambda: gym.make(POINT), None),
        (lambda: gym.wrappers.RecordEpisodeStatistics(Monitor(gym.make(POINT))), None),
        (lambda: gym.make_vec(POINT, 3), 3),
        (lambda: gym.wrappers.vector.RecordEpisodeStatistics(gym.make_vec(POINT, 3)), 3),
        (lambda: gym.make_vec(POINT, 2, vectorization_mode="sync"), 2),
        (
            lambda: gym.wrappers.vector.RecordEpisodeStatistics(
                gym.make_vec(POINT, 2, vectorization_mode="sync")
            ),
            2,
        ),
        (lambda: make_vec_env(POINT, 2), 2),
        (lambda: VecMonitor(make_task_vec_env(POINT, 3)), 3),
    ],
)
def test_a_task_is_chosen_through_whatever_is_around_the_family(make, num_envs):
    def tasks():
        if isinstance(env, gym.Env):
            return env.get_wrapper_attr("task")
        if isinstance(env.unwrapped, gym.vector.SyncVectorEnv):
            return np.stack(env.unwrapped.call("task"))
        return (
            env.unwrapped.tasks
            if isinstance(env, gym.vector.VectorEnv)
            else np.stack(env.get_attr("task"))
        )

    env = make()
    set_task(env, [2.5])
    env.reset()
    assert (tasks() == 2.5).all()
    if num_envs is None:
        env.reset(seed=3)
        assert (tasks() == 2.5).all()
        return
    of_each = np.linspace(0.5, 2.0, num_envs)[:, None]
    set_task(env, of_each)
    env.reset()
    assert np.array_equal(tasks(), of_each)
    for wrong in (2.5, [[1.0]] * (num_envs + 1)):
        with pytest.raises(
            ValueError,
            match=rf"expected \(task_dim,\) or \(num_envs, task_dim\) with num_envs={num_envs}",
        ):
            set_task(env, wrong)


def test_a_task_of_what_is_no_family():
    cart_poles = (
        gym.make("CartPole-v1"),
        gym.make_vec("CartPole-v1", 2),
        make_vec_env("CartPole-v1", 2),
    )
    for env in (POINT, None, *cart_poles):
        with pytest.raises(TypeError, match=r"must be a task family \(poem_envs.TaskFamily\)"):
            set_task(env, [1.0])


@pytest.mark.parametrize("mode", ["vector_entry_point", "sync"])
def test_gymnasiums_vector_environments_are_taken_as_they_are(mode):
    vector_env = gym.make_vec(POINT, 2, vectorization_mode=mode, step_length=0.1)
    env = vectorised(vector_env)
    family = FamilyView.for_training(env)
    assert (family.num_envs, family.horizon, family.env_id, family.env_kwargs) == (
        2,
        25,
        POINT,
        {"step_length": 0.1},
    )
    family.reset(np.array([[0.5], [2.0]]), seed=0)
    set_task(vector_env, [1.0])  # the same copies
    vector_env.reset()
    assert np.array_equal(np.stack(env.get_attr("task")), [[1.0], [1.0]])
    with pytest.raises(
        ValueError, match=r"env is a RecordEpisodeStatistics, but must be gym.make_vec\(id, n\)"
    ):
        vectorised(gym.wrappers.vector.RecordEpisodeStatistics(vector_env))
