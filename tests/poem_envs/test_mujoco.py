"""The MuJoCo families against closed-form rewards and against Gymnasium's own environments."""

import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import poem_envs  # noqa: F401 (registers)


def make(env_id, **kwargs):
    return gym.make(env_id, **kwargs).unwrapped


def make_gymnasium(env_id, **kwargs):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that Humanoid-v4 is superseded
        return gym.make(env_id, **kwargs).unwrapped


def random_actions(env, n, rng):
    low, high = env.action_space.low, env.action_space.high
    return rng.uniform(low, high, size=(n, *env.action_space.shape)).astype(np.float32)


def split(env, state):
    """Time, positions and velocities of a physics state."""
    nq = env.model.nq
    return state[0], state[1 : 1 + nq], state[1 + nq :]


def transitions(env, actions, **reset_arguments):
    """Physics state before and after, action, reward and end of each step."""
    env.reset(**reset_arguments)
    for action in actions:
        before = env.states[0].copy()
        _, reward, terminated, _, _ = env.step(action)
        yield before, env.states[0].copy(), action.astype(np.float64), reward, terminated
        if terminated:
            return


def velocity(before, after, dt):
    return (after[1:3] - before[1:3]) / dt


# What each family pays for a step, written from the description of the families: state before and
# after, action, task.
REWARDS = {
    "poem/HalfCheetahVel-v0": lambda b, a, u, g: -abs((a[1] - b[1]) / 0.05 - g[0]) - 0.05 * u @ u,
    "poem/HalfCheetahFwdBack-v0": lambda b, a, u, g: g[0] * (a[1] - b[1]) / 0.05 - 0.05 * u @ u,
    "poem/AntVel-v0": lambda b, a, u, g: (
        1 - abs(velocity(b, a, 0.05)[0] - g[0]) - 0.005 * u @ u + 0.05
    ),
    "poem/AntFwdBack-v0": lambda b, a, u, g: (
        velocity(b, a, 0.05) @ [np.cos(g[0]), np.sin(g[0])] - 0.5 * u @ u + 1
    ),
    "poem/AntDir2D-v0": lambda b, a, u, g: (
        velocity(b, a, 0.05) @ [np.cos(g[0]), np.sin(g[0])] - 0.5 * u @ u + 1
    ),
    "poem/AntGoal-v0": lambda b, a, u, g: -abs(a[1] - g[0]) - abs(a[2] - g[1]) - 0.1 * u @ u,
}


@pytest.mark.parametrize("env_id", REWARDS)
def test_rewards(env_id, rng):
    env = make(env_id)
    for task in env.sample_tasks(2, rng):
        for before, after, action, reward, _ in transitions(
            env, random_actions(env, 20, rng), seed=1, options={"task": task}
        ):
            assert reward == pytest.approx(
                REWARDS[env_id](before, after, action, task), rel=1e-10, abs=1e-10
            )


def centre_of_mass(model, state):
    """Of the whole robot, from the masses and centres of its bodies."""
    data = mujoco.MjData(model)
    data.qpos[:] = state[1 : 1 + model.nq]
    mujoco.mj_kinematics(model, data)
    return (model.body_mass[:, None] * data.xipos).sum(axis=0)[:2] / model.body_mass.sum()


def test_humanoid_rewards(rng):
    env = make("poem/HumanoidDir2D-v0")
    assert env.dt == pytest.approx(0.015)
    for angle in (-1.0, 0.6):
        for before, after, action, reward, _ in transitions(
            env, random_actions(env, 15, rng), seed=1, options={"task": [angle]}
        ):
            speed = (centre_of_mass(env.model, after) - centre_of_mass(env.model, before)) / 0.015
            expected = 1.25 * speed @ [np.cos(angle), np.sin(angle)] - 0.1 * action @ action + 5
            assert reward == pytest.approx(expected, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize(
    ("env_id", "weights"),
    [
        ("poem/HalfCheetahVel-v0", {"forward_reward_weight": 0.0}),
        ("poem/HalfCheetahFwdBack-v0", {"forward_reward_weight": 0.0}),
        (
            "poem/AntVel-v0",
            {"forward_reward_weight": 0.0, "forward_reward_offset": 0.0, "healthy_reward": 0.0},
        ),
        ("poem/AntFwdBack-v0", {"forward_reward_weight": 0.0, "healthy_reward": 0.0}),
        ("poem/AntDir2D-v0", {"forward_reward_weight": 0.0, "healthy_reward": 0.0}),
        ("poem/AntGoal-v0", {"distance_reward_weight": 0.0}),
        ("poem/HumanoidDir2D-v0", {"forward_reward_weight": 0.0, "healthy_reward": 0.0}),
    ],
)
def test_every_weight_is_an_argument(env_id, weights, rng):
    """With all other weights at zero, minus the action cost is left; with that at zero too,
    nothing.
    """
    action = random_actions(make(env_id), 1, rng)[0]
    for ctrl_cost_weight in (2.0, 0.0):
        env = make(env_id, ctrl_cost_weight=ctrl_cost_weight, **weights)
        env.reset(seed=0)
        reward = env.step(action)[1]
        assert reward == pytest.approx(
            -ctrl_cost_weight * float(np.sum(action.astype(np.float64) ** 2))
        )


def ends_at(env, height):
    """Whether a step ends the episode that begins with the robot at rest, its torso at a height."""
    env.reset(seed=0)
    state = env.states[0].copy()
    state[3], state[1 + env.model.nq :] = height, 0.0
    env.states[0] = state
    return env.step(np.zeros(env.action_space.shape))[2]


@pytest.mark.parametrize(
    ("env_id", "default"),
    [
        ("poem/AntVel-v0", (0.2, 1.0)),
        ("poem/AntFwdBack-v0", (0.2, 1.0)),
        ("poem/AntDir2D-v0", (0.2, 1.0)),
        ("poem/HumanoidDir2D-v0", (1.0, 2.0)),
    ],
)
def test_early_ends(env_id, default):
    env = make(env_id)
    assert env.healthy_z_range == default
    assert not ends_at(env, default[1] - 0.1)
    assert ends_at(env, default[1] + 0.1)
    high_up = make(
        env_id, healthy_z_range=(3.0, 4.0)
    )  # in free fall, where a step moves the torso by about a centimetre
    assert [ends_at(high_up, height) for height in (2.95, 3.05, 3.95, 4.05)] == [
        True,
        False,
        False,
        True,
    ]
    careless = make(env_id, terminate_when_unhealthy=False)
    assert not ends_at(careless, default[1] + 0.1)


@pytest.mark.parametrize(
    "env_id", ["poem/HalfCheetahVel-v0", "poem/HalfCheetahFwdBack-v0", "poem/AntGoal-v0"]
)
def test_families_without_an_early_end(env_id, rng):
    env = make(env_id)
    env.reset(seed=0)
    state = env.states[0].copy()
    state[2 if "Cheetah" in env_id else 3] = 3.0
    env.states[0] = state
    assert not any(env.step(action)[2] for action in random_actions(env, 20, rng))


GYMNASIUM = {
    "poem/HalfCheetahVel-v0": ("HalfCheetah-v5", {}),
    "poem/AntVel-v0": ("Ant-v5", {"include_cfrc_ext_in_observation": False}),
    "poem/AntGoal-v0": (
        "Ant-v5",
        {
            "include_cfrc_ext_in_observation": False,
            "exclude_current_positions_from_observation": False,
        },
    ),
}


@pytest.mark.parametrize("env_id", GYMNASIUM)
def test_dynamics_are_gymnasiums(env_id, rng):
    """Same start for the same seed and the same observations over an episode, to the bit, given the
    same warm start.
    """
    env = make(env_id)
    other_id, arguments = GYMNASIUM[env_id]
    other = make_gymnasium(other_id, **arguments)
    observation, _ = env.reset(seed=1)
    assert np.array_equal(observation, other.reset(seed=1)[0])
    assert env.dt == other.dt
    for action in random_actions(env, 200, rng):
        observation, _, _, _, info = env.step(action)
        other.data.qacc_warmstart[:] = 0.0
        expected, *_, expected_info = other.step(action)
        assert np.array_equal(observation, expected)
        if other_id == "HalfCheetah-v5":
            assert info["reward_features"][0] == expected_info["x_velocity"]


def test_humanoid_dynamics_are_gymnasiums(rng):
    env, other = (
        make("poem/HumanoidDir2D-v0"),
        make_gymnasium("Humanoid-v4", terminate_when_unhealthy=False),
    )
    env.reset(seed=3)
    other.reset(seed=3)
    for action in random_actions(env, 60, rng):  # it falls and lies, with many contacts
        env.step(action)
        other.data.qacc_warmstart[:] = 0.0
        other.step(action)
        _, qpos, qvel = split(env, env.states[0].copy())
        assert np.array_equal(qpos, other.data.qpos)
        assert np.array_equal(qvel, other.data.qvel)


def test_humanoid_observations_are_gymnasiums_at_the_same_state(rng):
    env, other = make("poem/HumanoidDir2D-v0"), make_gymnasium("Humanoid-v4")
    other.reset(seed=0)
    observation, _ = env.reset(seed=3)
    touched = False
    for action in [None, *random_actions(env, 60, rng)]:
        if action is not None:
            observation = env.step(action)[0]
        _, qpos, qvel = split(env, env.states[0].copy())
        other.data.ctrl[:] = 0.0 if action is None else action
        other.data.qacc_warmstart[:] = 0.0
        other.set_state(qpos, qvel)
        mujoco.mj_rnePostConstraint(other.model, other.data)
        assert np.array_equal(observation, other._get_obs())
        touched = touched or np.abs(other.data.cfrc_ext).max() > 1.0
    assert touched  # contact forces were compared, not zeros


@pytest.mark.parametrize("env_id", ["poem/HalfCheetahVel-v0", "poem/AntVel-v0"])
def test_the_warm_start_matters_little(env_id, rng):
    """Gymnasium as it is, its warm start running on, ends each step nearly where ours does."""
    env = make(env_id)
    other_id, arguments = GYMNASIUM[env_id]
    other = make_gymnasium(other_id, **arguments)
    env.reset(seed=0)
    other.reset(seed=0)
    worst = 0.0
    for action in random_actions(env, 100, rng):
        env.states[0] = np.concatenate([[0.0], other.data.qpos, other.data.qvel])
        other.step(action)
        env.step(action)
        _, qpos, qvel = split(env, env.states[0].copy())
        worst = max(
            worst, np.abs(qpos - other.data.qpos).max(), np.abs(qvel - other.data.qvel).max()
        )
    assert worst < 1e-10


@pytest.mark.parametrize("num_envs", [None, 3])
def test_divergence_is_an_error_that_names_the_episode(num_envs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a file there
    env_id = "poem/HalfCheetahVel-v0"
    env = make(env_id) if num_envs is None else gym.make_vec(env_id, num_envs=num_envs)
    copy = 0 if num_envs is None else 1
    actions = np.zeros(env.action_space.shape)
    env.reset(seed=40)
    env.reset()
    env.step(actions)
    state = env.states[copy].copy()
    state[1 + 9 :] = 1e9
    env.states[copy] = state
    seed, where = (40, "") if num_envs is None else (41, " in environment copy 1")
    with pytest.raises(
        RuntimeError, match=rf"step 2 of episode 2 since reset\(seed={seed}\){where}"
    ):
        env.step(actions)
    env.reset(seed=0)
    env.step(actions)


def test_other_models(tmp_path, monkeypatch):
    source = make("poem/AntVel-v0")
    path = tmp_path / "ant.xml"
    mujoco.mj_saveLastXML(str(path), mujoco.MjModel.from_xml_path(_asset("ant.xml")))
    env = make("poem/AntVel-v0", xml_file=str(path), frame_skip=2)
    assert env.dt == pytest.approx(0.02)
    assert env.metadata["render_fps"] == 50
    monkeypatch.chdir(tmp_path.parent)
    assert make("poem/AntVel-v0", xml_file=f"{tmp_path.name}/ant.xml").model.nu == 8
    assert source.metadata["render_fps"] == 20
    with pytest.raises(OSError, match=r"xml_file='octopus\.xml'"):
        make("poem/AntVel-v0", xml_file="octopus.xml")


def _asset(name):
    from gymnasium.envs.mujoco.mujoco_env import expand_model_path

    return expand_model_path(name)
