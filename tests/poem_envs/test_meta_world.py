"""The Meta-World families against Meta-World itself."""

import pickle

import gymnasium as gym
import numpy as np
import pytest

import poem_envs  # noqa: F401 (registers)
from poem_envs import sawyer
from poem_envs.testing import check_task_family

ALL_V3_ENVIRONMENTS = pytest.importorskip("metaworld.env_dict").ALL_V3_ENVIRONMENTS
Task = pytest.importorskip("metaworld.types").Task
pytestmark = pytest.mark.metaworld

# The last four have starts that Meta-World computes from data that is out of date.
MANIPULATIONS = [
    "reach",
    "push",
    "door-open",
    "box-close",
    "dial-turn",
    "lever-pull",
    "window-close",
]


def make(name="ML1", **kwargs):
    return gym.make(f"poem/MetaWorld{name}-v0", **kwargs).unwrapped


def metaworlds_own(manipulation, placement):
    """Meta-World's environment, as its benchmarks make it, with a placement of ours."""
    env_cls = ALL_V3_ENVIRONMENTS[f"{manipulation}-v3"]
    env = env_cls()
    data = {"rand_vec": placement, "env_cls": env_cls, "partially_observable": True}
    env.set_task(Task(env_name=f"{manipulation}-v3", data=pickle.dumps(data)))
    return env


def placement_of_the_episode(env):
    """Meta-World's rand_vec of the episode under way; for reaching its puck was drawn by the
    episode's generator.
    """
    if not env.shared_dynamics:
        return env.task
    return np.concatenate([env._sawyer.env.obj_init_pos, env.task])


@pytest.mark.parametrize("manipulation", MANIPULATIONS)
def test_starts_steps_and_rewards_are_metaworlds(manipulation, rng):
    env = make(env_name=manipulation)
    actions = rng.uniform(-1, 1, (25, 4)).astype(np.float32).astype(np.float64)
    tasks = env.sample_tasks(3, rng)
    env.reset(seed=0, options={"task": tasks[0]})
    for action in actions:  # an episode before, of another placement, must leave nothing behind
        env.step(action)
    for task in tasks[1:]:
        start, _ = env.reset(seed=1, options={"task": task})
        own = metaworlds_own(manipulation, placement_of_the_episode(env))
        own_start, _ = own.reset()
        assert np.array_equal(start, own_start)
        for action in actions:
            observation, reward, terminated, truncated, info = env.step(action)
            own_observation, own_reward, _, _, own_info = own.step(action)
            assert np.array_equal(observation, own_observation)
            assert reward == pytest.approx(own_reward, rel=1e-13)
            assert info["success"] == own_info["success"]
            assert not terminated
            assert not truncated


@pytest.mark.parametrize("manipulation", ["reach", "reach-wall"])
def test_relabelled_rewards_of_reaching_are_those_of_metaworld_with_the_other_goal(
    manipulation, rng
):
    env = make(env_name=manipulation)
    played, other = env.sample_tasks(2, rng)
    env.reset(seed=3, options={"task": played})
    own = metaworlds_own(manipulation, np.concatenate([env._sawyer.env.obj_init_pos, other]))
    own.reset()
    # Towards the goal and beyond it, so that the tolerance around it is met too.
    for step in range(60):
        action = (
            np.append(np.clip(10 * (other - env._sawyer.env.tcp_center), -1, 1), 0.0)
            if step < 50
            else np.ones(4)
        )
        _, _, _, _, info = env.step(action)
        _, own_reward, _, _, _ = own.step(action)
        assert env.compute_rewards(other, info["reward_features"]) == pytest.approx(
            own_reward, rel=1e-13
        )
        if step == 49:
            assert own_reward == 10.0


def test_observations_hide_the_goal_and_success_stays(rng):
    env = make()
    goal = env.sample_tasks(1, rng)[0]
    observation, _ = env.reset(seed=0, options={"task": goal})
    successes, sticky = [], []
    for step in range(80):
        assert not observation[-3:].any()
        towards = goal - observation[:3] if step < 60 else np.array([0.0, -1.0, 0.0])
        observation, _, _, _, info = env.step(np.append(np.clip(10 * towards, -1, 1), 0.0))
        successes.append(info["success"])
        sticky.append(info["is_success"])
    assert not successes[0]
    assert any(successes)
    assert not successes[-1]
    assert sticky == np.logical_or.accumulate(successes).tolist()


def test_tasks_of_a_manipulation_are_those_that_metaworld_accepts(rng):
    env = make(env_name="push")
    tasks = env.sample_tasks(200, rng)
    box = ALL_V3_ENVIRONMENTS["push-v3"]()._random_reset_space
    assert np.array_equal(env.task_space.low, box.low)
    assert np.array_equal(env.task_space.high, box.high)
    assert np.linalg.norm(tasks[:, :2] - tasks[:, 3:5], axis=1).min() >= 0.15
    assert tasks.std(axis=0)[[0, 1, 3, 4]] == pytest.approx(
        (box.high - box.low)[[0, 1, 3, 4]] / np.sqrt(12), rel=0.15
    )
    near = tasks[0].copy()
    near[:2], near[3:5] = [0.05, 0.7], [0.05, 0.8]
    with pytest.raises(ValueError, match=r"refuses the placement.*too near"):
        env.set_task(near)


# The table of ML10 in Yu et al. 2019, in the names of Meta-World's version 3.
ML10_TRAIN = (
    "reach push pick-place door-open drawer-close button-press-topdown peg-insert-side window-open "
    "sweep basketball"
)
ML10_TEST = "drawer-open door-close shelf-place sweep-into lever-pull"


@pytest.mark.parametrize(
    ("split", "names"), [("train", ML10_TRAIN), ("test", ML10_TRAIN), ("held-out", ML10_TEST)]
)
def test_ml10_has_metaworlds_manipulations_in_equal_parts(split, names, rng):
    env = make("ML10", split=split)
    tasks = env.sample_tasks(4 * len(names.split()), rng)
    numbers, counts = np.unique(tasks[:, 0], return_counts=True)
    assert {env.manipulations[int(number)] for number in numbers} == set(names.split())
    assert set(counts) == {4}
    for task in tasks[:2]:
        env.set_task(task)
        env.reset(seed=0)
        assert isinstance(
            env._sawyer.env, ALL_V3_ENVIRONMENTS[f"{env.manipulations[int(task[0])]}-v3"]
        )


def test_splits_are_other_placements_of_one_space():
    train, test, held_out = (make("ML10", split=split) for split in ("train", "test", "held-out"))
    assert (
        train.task_space == test.task_space == held_out.task_space
    )  # so that a model adapts to all of them
    one, other = (env.sample_tasks(20, np.random.default_rng(0)) for env in (train, test))
    assert not set(map(tuple, one[:, 1:])) & set(map(tuple, other[:, 1:]))
    one, other = (
        make(split=split).sample_tasks(50, np.random.default_rng(0)) for split in ("train", "test")
    )
    assert not set(map(tuple, one)) & set(map(tuple, other))


@pytest.mark.parametrize("env_name", ["push", "push-v3"])
def test_names_with_and_without_their_version(env_name):
    assert make(env_name=env_name).env_name == "push"


@pytest.mark.parametrize(
    ("env_name", "message"),
    [
        (
            "door-opn",
            "env_name='door-opn' is none of .* 50 manipulations; did you mean 'door-open'",
        ),
        ("pusch-v3", "did you mean 'push'"),
        ("xyzzy", "choose one of assembly, .*window-open"),
        (3, "env_name=3 is none of"),
    ],
)
def test_an_unknown_manipulation_lists_near_ones(env_name, message):
    with pytest.raises(ValueError, match=message):
        make(env_name=env_name)


@pytest.mark.parametrize("found", ["2.0.0", "3.0.0", "4.0.1"])
def test_another_version_of_metaworld(monkeypatch, found):
    monkeypatch.setattr(sawyer, "version", lambda name: found)
    with pytest.raises(
        ImportError,
        match=rf"metaworld >= 3.1, < 4, but metaworld {found} is installed.*pip install",
    ):
        make()


def test_splits_that_there_are_not():
    for name, splits in (("ML1", "'train', 'test'"), ("ML10", "'train', 'test', 'held-out'")):
        with pytest.raises(ValueError, match=f"split='validation': .* it has {splits}"):
            make(name, split="validation")


def test_wrong_tasks_of_ml10(rng):
    env = make("ML10")
    three_numbers = next(
        task for task in env.sample_tasks(10, rng) if env.manipulations[int(task[0])] == "door-open"
    )
    for index, value, message in (
        (0, 3.5, "a whole number"),
        (6, 0.1, "is 3 numbers from .*, then zeros"),
        (1, 0.15, "is 3 numbers from"),
    ):
        wrong = three_numbers.copy()
        wrong[index] = value
        with pytest.raises(ValueError, match=message):
            env.set_task(wrong)


def test_a_simulation_that_diverges_says_where():
    env = make()
    env.reset(seed=7)
    env._sawyer.env.data.qvel[:] = 1e12
    with pytest.raises(
        RuntimeError, match=r"MetaWorldML1Env diverged at step 1 of episode 1 since reset\(seed=7\)"
    ):
        env.step(np.zeros(4))


@pytest.mark.slow
@pytest.mark.parametrize("env_name", sawyer.manipulation_names())
def test_every_manipulation_keeps_the_contract(env_name):
    check_task_family("poem/MetaWorldML1-v0", n_steps=6, env_name=env_name, width=64, height=64)


def test_images_are_upright():
    """The hand is lifted: what moves must move up in the image."""
    env = make(render_mode="rgb_array", width=96, height=96, camera_name="corner")
    env.reset(seed=0)
    heights = []
    for _ in range(2):
        red, green, blue = env.render().astype(float).transpose(2, 0, 1)
        heights.append(
            np.nonzero((red > 60) & (red > 2 * green) & (red > 2 * blue))[0].min()
        )  # the arm's uppermost row
        for _ in range(40):
            env.step(np.array([0.0, 0.0, 1.0, 0.0]))
    env.close()
    assert heights[1] < heights[0]
