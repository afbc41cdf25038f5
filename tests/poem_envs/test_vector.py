"""Vectorised families: bit for bit as many single environments."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv

import poem_envs  # noqa: F401 (registers)

# Arguments under which random actions end some episodes early, within the steps that the tests
# take.
EARLY_ENDS = {"poem/AntDir2D-v0": {"healthy_z_range": (0.45, 0.9)}, "poem/HumanoidDir2D-v0": {}}


def make_vec(env_id, num_envs, **kwargs):
    return gym.make_vec(
        env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **kwargs
    )


def random_actions(envs, steps, rng):
    space = envs.single_action_space
    return rng.uniform(space.low, space.high, size=(steps, envs.num_envs, *space.shape)).astype(
        np.float32
    )


@pytest.mark.parametrize(
    "env_id",
    [
        *("poem/PointGoal-v0", "poem/HalfCheetahFwdBack-v0", "poem/AntGoal-v0"),
        *EARLY_ENDS,
    ],
)
def test_equals_single_environments_to_the_bit(env_id, rng):
    """Over several episodes with early ends, time limits, resets in a step, and new tasks."""
    num_envs, steps, horizon = 5, 75, 30
    arguments = {"max_episode_steps": horizon, **EARLY_ENDS.get(env_id, {})}
    envs = make_vec(env_id, num_envs, **arguments)
    singles = [gym.make(env_id, **arguments) for _ in range(num_envs)]
    observations, infos = envs.reset(seed=21)
    assert infos == {}
    assert np.array_equal(
        observations, [env.reset(seed=21 + i)[0] for i, env in enumerate(singles)]
    )
    ends = {"terminated": 0, "truncated": 0}
    for step, actions in enumerate(random_actions(envs, steps, rng)):
        if step == 40:
            tasks = np.concatenate([envs.sample_tasks(1, rng) for _ in range(num_envs)])
            envs.set_tasks(tasks)
            for env, task in zip(singles, tasks, strict=True):
                env.unwrapped.set_task(task)
        observations, rewards, terminations, truncations, infos = envs.step(actions)
        assert ("final_obs" in infos) == (terminations | truncations).any()
        for i, env in enumerate(singles):
            observation, reward, terminated, truncated, info = env.step(actions[i])
            assert reward == rewards[i]
            assert (terminated, truncated) == (terminations[i], truncations[i])
            assert np.array_equal(info["reward_features"], infos["reward_features"][i])
            if "final_obs" in infos:
                assert np.array_equal(observation, infos["final_obs"][i])
                assert infos["_final_obs"][i] == (terminated or truncated)
            if terminated or truncated:
                ends["terminated" if terminated else "truncated"] += 1
                observation, _ = env.reset()
            assert np.array_equal(observation, observations[i])
            assert np.array_equal(env.unwrapped.task, envs.tasks[i])
    assert (ends["terminated"] > 0) == (env_id in EARLY_ENDS)
    assert ends["truncated"] > 0


@pytest.mark.parametrize("env_id", ["poem/HalfCheetahVel-v0", "poem/HumanoidDir2D-v0"])
def test_the_number_of_threads_and_copies_changes_nothing(env_id, rng):
    variants = [
        make_vec(env_id, n, nthread=nthread)
        for n, nthread in [(7, 1), (7, 2), (7, 3), (7, 20), (9, 2)]
    ]
    actions = random_actions(variants[-1], 25, rng)
    results = []
    for envs in variants:
        envs.reset(seed=0)
        results.append([np.array(envs.step(a[: envs.num_envs])[0][:7]) for a in actions])
        envs.close()
    for other in results[1:]:
        assert np.array_equal(results[0], other)


def test_interface(robot_id):
    envs = make_vec(robot_id, 3)
    assert isinstance(envs, VectorEnv)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    single = gym.make(robot_id)
    assert envs.single_observation_space == single.observation_space
    assert envs.single_action_space == single.action_space
    assert envs.observation_space.shape == (3, *single.observation_space.shape)
    assert envs.task_space == single.unwrapped.task_space
    assert envs.reward_feature_dim == single.unwrapped.reward_feature_dim
    assert envs.shared_dynamics
    assert envs.max_episode_steps == single.spec.max_episode_steps
    assert envs.tasks is None
    with pytest.raises(ResetNeeded):
        envs.step(np.zeros(envs.action_space.shape))
    observations, _ = envs.reset(seed=0)
    assert observations in envs.observation_space
    assert envs.np_random_seed == [0, 1, 2]
    envs.close()
    envs.close()


def test_reproducible(robot_id, rng):
    envs = make_vec(robot_id, 2)
    actions = random_actions(envs, 10, rng)
    results = []
    for _ in range(2):
        observations, _ = envs.reset(seed=8)
        results.append((observations, envs.tasks, *[envs.step(a)[0] for a in actions]))
    for one, two in zip(*results, strict=True):
        assert np.array_equal(one, two)
    by_list, _ = envs.reset(seed=[9, 8])
    assert np.array_equal(by_list, results[0][0][::-1])
    partly, _ = envs.reset(seed=[9, None])
    assert np.array_equal(partly[0], by_list[0])
    assert not np.array_equal(partly[1], by_list[1])
    with pytest.raises(ValueError, match="holds 3 seeds"):
        envs.reset(seed=[1, 2, 3])


def test_arrays_are_not_reused(robot_id, rng):
    envs = make_vec(robot_id, 2, max_episode_steps=2)
    first, _ = envs.reset(seed=0)
    arrays = [first]
    for actions in random_actions(envs, 4, rng):
        observations, rewards, _, _, infos = envs.step(actions)
        arrays += [
            observations,
            rewards,
            infos["reward_features"],
            *([infos["final_obs"]] if "final_obs" in infos else []),
        ]
    for i, one in enumerate(arrays):
        assert not any(np.shares_memory(one, other) for other in arrays[i + 1 :])


def test_set_tasks(robot_id, rng):
    envs = make_vec(robot_id, 3, max_episode_steps=4)
    draw = lambda: np.concatenate([envs.sample_tasks(1, rng) for _ in range(3)])  # noqa: E731
    first, second = draw(), draw()
    envs.set_tasks(first)
    assert envs.tasks is None
    envs.reset(seed=0)
    assert np.array_equal(envs.tasks, first)
    envs.set_tasks(second)
    zeros = np.zeros(envs.action_space.shape)
    for _ in range(3):
        envs.step(zeros)
        assert np.array_equal(envs.tasks, first)
    _, rewards, *_, infos = envs.step(zeros)
    assert np.array_equal(rewards, envs.compute_rewards(first, infos["reward_features"]))
    assert np.array_equal(envs.tasks, second)
    envs.set_tasks(first[1:2], copies=[1])
    envs.reset()
    assert np.array_equal(envs.tasks, [second[0], first[1], second[2]])
    envs.reset(options={"tasks": first})
    assert np.array_equal(envs.tasks, first)
    envs.tasks[:] = 99
    assert np.array_equal(envs.tasks, first)


def test_bad_input_names_the_copy(rng):
    envs = make_vec("poem/PointGoal-v0", 3)
    envs.reset(seed=0)
    actions = np.zeros(envs.action_space.shape)
    actions[2, 1] = np.nan
    with pytest.raises(ValueError, match=r"actions\[2\] is nan at component 1"):
        envs.step(actions)
    with pytest.raises(ValueError, match=r"actions has shape .*expected \(3, "):
        envs.step(actions[:2])
    tasks = np.concatenate([envs.sample_tasks(1, rng) for _ in range(3)])
    tasks[1, 0] = 50
    with pytest.raises(ValueError, match=r"tasks\[1\] is 50.0 at component 0"):
        envs.set_tasks(tasks)
    with pytest.raises(ValueError, match="tasks has shape"):
        envs.set_tasks(tasks[:2])
    with pytest.raises(ValueError, match="unknown keys"):
        envs.reset(options={"task": tasks[0]})


def test_constructor_arguments():
    for arguments, message in [
        ({"num_envs": 0}, "num_envs=0"),
        ({"num_envs": 2, "max_episode_steps": 0}, "max_episode_steps=0"),
        ({"num_envs": 2, "nthread": 0}, "nthread=0"),
        ({"num_envs": 2, "render_mode": "human"}, "render_mode='human'"),
        ({"num_envs": 2, "render_mode": "ascii"}, "render_mode='ascii'"),
    ]:
        with pytest.raises(ValueError, match=message):
            gym.make_vec("poem/HalfCheetahVel-v0", **arguments)
    envs = make_vec("poem/HalfCheetahVel-v0", 2, ctrl_cost_weight=0.0, max_episode_steps=None)
    envs.reset(seed=0)
    truncations = [envs.step(np.zeros((2, 6)))[3].any() for _ in range(201)]
    assert not any(truncations)
