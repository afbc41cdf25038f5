"""Wrappers that change what is seen, done or paid are refused before anything is learned."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces, wrappers
from meta_toys import EPOCH, POINT_GOAL, Walk, assert_same_model, small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.common.vec_env import make_task_vec_env

Wrap = Callable[[gym.Env], gym.Env]


class Wet(gym.ActionWrapper):
    """A user's own, of a kind that changes something."""

    def action(self, action: np.ndarray) -> np.ndarray:
        return 0.5 * action


class EvenWalk(Walk):
    """The opposite of an action is one too."""

    action_space = spaces.Box(-3.0, 3.0, (1,), np.float32)


class Own(gym.Wrapper):
    """A wrapper of nobody's knowledge, which changes one thing."""

    def __init__(self, env: gym.Env, what: str = "nothing") -> None:
        super().__init__(env)
        self.what = what
        if what == "observation_space":
            self.observation_space = gym.spaces.Box(
                -1.0, 1.0, env.observation_space.shape, np.float64
            )

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        return observation + (self.what == "start"), info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, *rest = self.env.step(-action if self.what == "action" else action)
        reward += 0.01 * (self.what == "reward")
        return 2 * observation if self.what == "observation" else observation, reward, *rest


class OwnVec(VecEnvWrapper):
    """The same of a vectorised environment."""

    def reset(self) -> Any:
        return 2 * self.venv.reset()

    def step_wait(self) -> Any:
        observations, *rest = self.venv.step_wait()
        return 2 * observations, *rest


@pytest.mark.parametrize(
    ("wrap", "name"),
    [
        (
            functools.partial(wrappers.TransformReward, func=lambda reward: reward),
            "TransformReward",
        ),
        (wrappers.NormalizeObservation, "NormalizeObservation"),
        (wrappers.NormalizeReward, "NormalizeReward"),
        (functools.partial(wrappers.FrameStackObservation, stack_size=2), "FrameStackObservation"),
        (
            functools.partial(wrappers.RescaleAction, min_action=-2.0, max_action=2.0),
            "RescaleAction",
        ),
        (wrappers.ClipAction, "ClipAction"),
        (wrappers.TimeAwareObservation, "TimeAwareObservation"),
        (functools.partial(wrappers.RepeatAction, num_repeats=2), "RepeatAction"),
        (Wet, r"ActionWrapper \(it is in: Wet, Monitor, \w*TimeLimit, "),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_known_wrappers_are_refused_by_name(wrap: Wrap, name: str) -> None:
    env = wrap(Monitor(gym.make(POINT_GOAL)))
    with pytest.raises(ValueError, match=f"env must not be wrapped in {name}.*the family itself"):
        small(POEMSAC, env)


@pytest.mark.parametrize("wrap", [VecNormalize, functools.partial(VecFrameStack, n_stack=2)])
@pytest.mark.parametrize("make", [make_vec_env, make_task_vec_env])
def test_sb3s_wrappers_are_refused_by_name(
    wrap: Callable[[VecEnv], VecEnv], make: Callable[[str, int], VecEnv]
) -> None:
    for env in (wrap(make(POINT_GOAL, 2)), VecMonitor(wrap(make(POINT_GOAL, 2)))):
        with pytest.raises(
            ValueError,
            match=r"must not be wrapped in Vec(Normalize|FrameStack) .*in YAML: no `normalize`",
        ):
            small(PEARLSAC, env)


def test_one_copy_is_enough() -> None:
    env = DummyVecEnv(
        [lambda: gym.make(POINT_GOAL), lambda: wrappers.NormalizeReward(gym.make(POINT_GOAL))]
    )
    with pytest.raises(ValueError, match="must not be wrapped in NormalizeReward"):
        small(POEMSAC, env)


def make_wrapped(wrap: Wrap) -> gym.Env:
    return wrap(gym.make(f"poem_envs:{POINT_GOAL}"))


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (wrappers.NormalizeObservation, "must not be wrapped in NormalizeObservation"),
        (
            functools.partial(Own, what="observation"),
            r"env's wrappers Own change what is seen or done",
        ),
        (functools.partial(Own, what="reward"), r"env paid .* by one of its wrappers Own"),
    ],
    ids=["known", "observation", "reward"],
)
def test_in_subprocesses(wrap: Wrap, message: str) -> None:
    env = SubprocVecEnv([functools.partial(make_wrapped, wrap)] * 2, start_method="fork")
    try:
        with pytest.raises(ValueError, match=message):
            small(POEMSAC, env).learn(EPOCH)
    finally:
        env.close()


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("observation", "env's wrappers Own change what is seen or done"),
        ("start", "env's wrappers Own change what is seen or done"),
        ("action", "env's wrappers Own change what is seen or done"),
        (
            "reward",
            r"env paid .* at step 0 of copy 0, but compute_rewards.* is .*, by one of its wrappers Own",
        ),
    ],
)
@pytest.mark.parametrize("registered", [True, False])
def test_unknown_wrappers_are_refused_by_the_first_experience(
    what: str, message: str, registered: bool
) -> None:
    """Before a gradient step: there is no such experience among what is learned from."""
    family = gym.make(POINT_GOAL) if registered else gym.wrappers.TimeLimit(EvenWalk(edge=0.5), 25)
    model = small(POEMSAC, Own(family, what), horizon=25)
    with pytest.raises(ValueError, match=message):
        model.learn(EPOCH)
    assert model._n_updates == 0
    assert model.replay_buffer.counts.sum() == 0


def test_unknown_wrappers_around_the_vectorised_environment() -> None:
    for env in (make_task_vec_env(POINT_GOAL, 2), make_vec_env(POINT_GOAL, 2)):
        with pytest.raises(ValueError, match="env's wrappers OwnVec change what is seen or done"):
            small(POEMSAC, OwnVec(env)).learn(EPOCH)


def test_another_space_is_refused_at_once() -> None:
    with pytest.raises(
        ValueError, match=r"env's wrappers \(Monitor, Own, .*\) must leave observation_space Box"
    ):
        small(POEMSAC, Own(gym.make(POINT_GOAL), "observation_space"))


def test_a_family_that_does_not_pay_what_it_computes() -> None:
    class Bribed(Walk):
        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            observation, reward, *rest = super().step(action)
            return observation, reward + 1.0, *rest

    with pytest.raises(
        ValueError, match=r"env paid .*, but compute_rewards.* is .*; .*check_task_family"
    ):
        small(POEMSAC, Bribed(), horizon=5).learn(EPOCH)


def test_a_reward_that_does_not_broadcast() -> None:
    class OneByOne(Walk):
        def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
            return -np.abs(features[0] - tasks[0]) if features.ndim == 1 else np.zeros(3)

    with pytest.raises(
        ValueError, match=r"compute_rewards must give .* rewards of shape \(1, 5\), but gave \(3,\)"
    ):
        small(POEMSAC, OneByOne(), horizon=5).learn(EPOCH)


def test_what_changes_nothing_is_taken() -> None:
    def make() -> gym.Env:
        return Own(Monitor(gym.make(POINT_GOAL)))

    wrapped = small(POEMSAC, VecCheckNan(VecMonitor(DummyVecEnv([make] * 3)))).learn(EPOCH)
    assert_same_model(wrapped, small(POEMSAC, make_vec_env(POINT_GOAL, 3)).learn(EPOCH))
    small(
        POEMSAC, DummyVecEnv([lambda: wrappers.RecordEpisodeStatistics(gym.make(POINT_GOAL))])
    ).learn(1)
