"""Bad arguments and broken environments: clear errors, before anything is harmed."""

from __future__ import annotations

import functools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from meta_toys import ARCH, POINT_GOAL, Poisoned, TwoWalks, Walk, WindyWalk, differing, parameters, small, walks
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.common.buffers import TaskBatch

NAN = float("nan")


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        *[
            (name, value, rf"{name} must be at least 1, got {value}")
            for name in [
                "batch_size",
                "meta_batch_size",
                "context_size",
                "trajectories_per_task",
                "latent_dim",
                "buffer_size",
                "n_train_tasks",
                "n_steps",
                "policy_delay",
            ]
            for value in (0, -3)
        ],
        ("gradient_steps", -2, "gradient_steps must be at least -1, got -2"),
        *[
            (name, value, rf"{name} must be at least 0, got {value}")
            for name in ("kl_coef", "reward_coef", "policy_coef", "learning_starts", "noise_color")
            for value in (-0.5, NAN)
        ],
        ("target_update_interval", 0, "target_update_interval must be at least 1, got 0"),
        *[("gamma", value, r"gamma must lie in \[0, 1\]") for value in (-0.1, 1.01, NAN)],
        *[("tau", value, r"tau must lie in \[0, 1\]") for value in (-0.1, 1.01, NAN)],
        *[("reward_scale", value, "reward_scale must be a positive number or") for value in (0, -1.0, NAN, "big", None)],
        *[
            (name, value, rf"{name} must lie in \[0, 1\], got")
            for name in ("relabel_fraction", "shaping_coef", "mirror_fraction")
            for value in (-0.1, 1.1, NAN)
        ],
        ("precision", "fp16", "precision must be one of 'auto', 'bf16', 'fp32', got 'fp16'"),
        ("horizon", 30, "horizon is 30, but the environment ends episodes after 25 steps"),
        ("policy_kwargs", {"net_arch": {"critic": [3]}}, "net_arch has unknown keys"),
        ("device", "tpu7", "[Dd]evice|tpu"),
    ],
)
def test_arguments_of_both(algorithm: type[PEARLSAC], argument: str, value: Any, message: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=message):
        small(algorithm, **{argument: value})


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        ("similarity", "cosine", "similarity must be one of 'two-encoder', 'inner', got 'cosine'"),
        ("context", "rewards", "context must be one of 'optimal', 'pearl', got 'rewards'"),
        ("preference_source", "human", "preference_source must be one of 'auto', 'relabel', 'rollout', got 'human'"),
        ("preference_coef", -1.0, r"preference_coef must be at least 0, got -1\.0"),
        ("preference_coef", NAN, "preference_coef must be at least 0, got nan"),
        ("preference_group_size", 1, "preference_group_size must be at least 2, got 1"),
    ],
)
def test_arguments_of_poem(argument: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small(POEMSAC, **{argument: value})


def test_an_unknown_argument(algorithm: type[PEARLSAC]) -> None:
    with pytest.raises(TypeError, match="train_freq"):
        small(algorithm, train_freq=1)


# ---------------------------------------------------------------- environments


@pytest.mark.parametrize("env", ["Pendulum-v1", functools.partial(gym.make, "Pendulum-v1")])
def test_no_task_family(algorithm: type[PEARLSAC], env: Any) -> None:
    with pytest.raises(ValueError, match=r"env is no task family: it has no attribute 'task_space'.*poem_envs\.TaskFamily"):
        small(algorithm, env() if callable(env) else env)


def test_no_environment_at_all(algorithm: type[PEARLSAC]) -> None:
    with pytest.raises(gym.error.NameNotFound, match="Nowhere"):
        small(algorithm, "poem/Nowhere-v0")
    with pytest.raises((AssertionError, ValueError, TypeError), match="environment"):
        small(algorithm, None)


def test_discrete_actions(algorithm: type[PEARLSAC]) -> None:
    with pytest.raises(AssertionError, match=r"only supports .*Box.* as action spaces"):
        small(algorithm, gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="is no task family"):  # it has a vectorised version, which is looked at first
        small(algorithm, "CartPole-v1")


def test_more_tasks_than_a_finite_family_has(algorithm: type[PEARLSAC]) -> None:
    message = (
        r"n_train_tasks is 3, but poem/HalfCheetahFwdBack-v0 is a finite family of 2 tasks; use at most 2, or None for all"
    )
    with pytest.raises(ValueError, match=message):
        small(algorithm, "poem/HalfCheetahFwdBack-v0", n_train_tasks=3)
    model = small(algorithm, walks(2, TwoWalks), horizon=10, n_train_tasks=None)
    assert sorted(model.train_tasks.ravel()) == [-1.0, 1.0]


def test_vec_normalize(algorithm: type[PEARLSAC]) -> None:
    with pytest.raises(ValueError, match="env must not be wrapped in VecNormalize"):
        small(algorithm, VecNormalize(make_vec_env(POINT_GOAL, 2)))


def test_relabelling_needs_shared_dynamics(algorithm: type[PEARLSAC]) -> None:
    with pytest.raises(ValueError, match=r"relabel_fraction must be 0: the tasks of .* do not share dynamics"):
        small(algorithm, walks(2, WindyWalk), horizon=10, relabel_fraction=0.5)
    with pytest.raises(ValueError, match=r"context_relabel_fraction must be 0: the tasks of .* do not share dynamics"):
        small(PEARLSAC, walks(2, WindyWalk), horizon=10, context_relabel_fraction=0.5)
    with pytest.raises(ValueError, match=r"context_relabel_fraction must lie in \[0, 1\], got 1.5"):
        small(PEARLSAC, walks(2), horizon=10, context_relabel_fraction=1.5)
    with pytest.raises(ValueError, match=r'preference_source must be "rollout" or "auto": .* do not share dynamics'):
        small(POEMSAC, walks(2, WindyWalk), horizon=10, preference_source="relabel")


def test_a_family_without_a_time_limit(algorithm: type[PEARLSAC]) -> None:
    with pytest.raises(ValueError, match="horizon is unknown"):
        small(algorithm, Walk())
    model = small(algorithm, Walk(), horizon=7).learn(1)  # its episodes never end
    assert model.num_timesteps == 12 * 7
    assert len(model.ep_info_buffer) == 0


# ---------------------------------------------------------------- poison


def poisoned(what: str, episode: int, step: int) -> DummyVecEnv:
    """Four copies of Walk, of which the third returns NaN once."""

    def make(copy: int) -> gym.Env:
        env = gym.wrappers.TimeLimit(Walk(), 10)
        return Poisoned(env, what, episode, step) if copy == 2 else env

    return DummyVecEnv([functools.partial(make, copy) for copy in range(4)])


@pytest.mark.parametrize("what", ["observations", "rewards", "reward features"])
def test_poison_stops_training_before_the_weights(algorithm: type[PEARLSAC], what: str) -> None:
    """In the second wave (tasks 4 to 7) of the third epoch; every wave resets twice, as SB3's DummyVecEnv does at an end."""
    seen: list[dict[str, th.Tensor]] = []

    def callback(local_variables: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.append(parameters(model))
        return True

    waves_before = 2 * 3 + 1
    model = small(algorithm, poisoned(what, episode=1 + 2 * waves_before, step=6), horizon=10)
    with pytest.raises(
        ValueError, match=rf"returned {what} that are NaN or infinite: copy 2, training task 6, episode \d+, step 6: .*nan|inf"
    ):
        model.learn(1000, callback)
    assert model.epoch == 2
    assert model._n_updates == 10
    assert not differing(seen[-1], parameters(model))  # as they were when the epoch began
    assert all(value.isfinite().all() for value in parameters(model).values())
    for task in range(model.replay_buffer.n_tasks):
        assert all(part.isfinite().all() for part in model.replay_buffer.transitions(task))
    # the environment is sane again: training can go on
    model.learn(120, reset_num_timesteps=False)
    assert all(value.isfinite().all() for value in parameters(model).values())


def test_a_loss_that_is_not_finite_changes_no_weight(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm).learn(300)
    before = parameters(model)
    model.context.transitions[:] = float("nan")  # latents, and with them all losses
    with pytest.raises(ValueError, match=r"loss or its gradient is not finite at update 5; no network was changed by it"):
        model.train(3, 16)
    assert not differing(before, parameters(model))


def overflowing(batch: TaskBatch) -> TaskBatch:
    return batch._replace(rewards=th.full_like(batch.rewards, 1e30))  # squared: infinity


def test_a_reward_that_overflows_changes_no_weight(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm).learn(300)
    before = parameters(model)
    at = model.replay_buffer.at
    model.replay_buffer.at = lambda *args: overflowing(at(*args))
    with pytest.raises(ValueError, match=r"loss or its gradient is not finite at update 5; no network was changed by it"):
        model.train(3, 16)
    assert not differing(before, parameters(model))


# ---------------------------------------------------------------- use


def test_sample_latents_and_sources(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm)
    with pytest.raises(ValueError, match='source must be "prior" or "aggregate", got \'posterior\''):
        model.sample_latents(3, np.random.default_rng(0), "posterior")


def test_no_task_family_after_all(algorithm: type[PEARLSAC]) -> None:
    """Pieces of a family that are missing are named."""

    class Half(gym.Env):
        observation_space, action_space, task_space = Walk.observation_space, Walk.action_space, Walk.task_space
        all_tasks = None

        def reset(self, **_: Any) -> tuple[np.ndarray, dict]:
            return np.zeros(2), {}

    with pytest.raises(ValueError, match="has no attribute 'shared_dynamics'"):
        small(algorithm, Half(), horizon=5, policy_kwargs={"net_arch": ARCH})


@pytest.mark.skipif(th.cuda.is_available(), reason="shows what happens without the device")
def test_a_missing_gpu_is_told() -> None:
    with pytest.warns(UserWarning, match="device is 'cuda', but torch sees no CUDA device: the CPU is used"):
        model = small(POEMSAC, device="cuda")
    assert model.device.type == "cpu"
