"""The symmetries that families name are those of MuJoCo's own dynamics."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.mujoco import mujoco_env

from poem_envs import SignedPermutation, Symmetry


@pytest.mark.parametrize("env_id", ["poem/AntGoal-v0", "poem/AntFwdBack-v0"])
@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_mirrored_step_of_the_ant_is_the_mirror_image_of_the_step(
    env_id: str, number: int
) -> None:
    env, other = gym.make(env_id).unwrapped, gym.make(env_id).unwrapped
    symmetry: Symmetry = env.symmetries[number]
    positions = (
        gym.make("poem/AntGoal-v0").unwrapped.symmetries[number].observations
    )  # of all coordinates
    obs, _ = env.reset(seed=3)
    other.reset(seed=4)
    env.action_space.seed(0)
    moved = 0.0
    for _ in range(30):
        state = np.array(env.get_physics_state())
        state[1:] = positions(state[1:])  # after the time, positions and velocities
        other.set_physics_state(state)
        action = env.action_space.sample()
        before, (obs, _, _, _, info) = obs, env.step(action)
        its_obs, _, _, _, its_info = other.step(symmetry.actions(action))
        np.testing.assert_allclose(its_obs, symmetry.observations(obs), atol=1e-6)
        np.testing.assert_allclose(
            its_info["reward_features"], symmetry.features(info["reward_features"]), atol=1e-6
        )
        moved = max(moved, np.abs(obs - before).max())
    assert moved > 0.5
    assert not np.allclose(its_obs, obs, atol=0.1)


def test_start_states_are_as_likely_as_their_mirror_images() -> None:
    env = gym.make("poem/AntGoal-v0").unwrapped
    env.reset_noise_scale = 0.0
    obs, _ = env.reset(seed=0)
    for symmetry in env.symmetries:
        np.testing.assert_allclose(symmetry.observations(obs), obs)


def test_the_symmetries_of_the_ant_are_a_group() -> None:
    half_turn, reflection, both = gym.make("poem/AntVel-v0").unwrapped.symmetries
    values = np.arange(1.0, 28.0)
    for symmetry in (half_turn, reflection, both):
        np.testing.assert_array_equal(symmetry.then(symmetry).observations(values), values)
    np.testing.assert_array_equal(
        both.observations(values), reflection.observations(half_turn.observations(values))
    )
    np.testing.assert_array_equal(
        both.observations(values), half_turn.observations(reflection.observations(values))
    )


def test_then_is_one_after_the_other() -> None:
    first, second = (
        SignedPermutation((2, 0, 1), (1, -1, 1)),
        SignedPermutation((1, 0, 2), (-1, 1, 1)),
    )
    values = np.array([[3.0, 5.0, 7.0]])
    np.testing.assert_array_equal(first(values), [[7.0, -3.0, 5.0]])
    np.testing.assert_array_equal(first.then(second)(values), second(first(values)))


def test_another_model_file_names_none(tmp_path: Path) -> None:
    path = tmp_path / "mine.xml"
    path.write_text((Path(mujoco_env.__file__).parent / "assets" / "ant.xml").read_text())
    assert gym.make("poem/AntVel-v0", xml_file=str(path)).unwrapped.symmetries == ()
