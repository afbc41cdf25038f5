"""Bad arguments and broken environments: clear errors, before anything is harmed."""

from __future__ import annotations

import functools
import inspect
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from meta_toys import (
    ARCH,
    Poisoned,
    Unequal,
    Walk,
    WindyWalk,
    differing,
    experience_of,
    parameters,
    small,
    walks,
)
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.sac.policies import SACPolicy

from poem_envs import TaskFamily
from poem_envs.testing import check_task_family
from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.common.buffers import TaskBatch
from sb3_poem.pearl_sac import updater
from sb3_poem.pearl_sac.arguments import UNSUPPORTED
from sb3_poem.pearl_sac.policies import LatentPolicy

NAN = float("nan")
FRACTIONS = ("gamma", "tau", "relabel_fraction", "shaping_coef")
COEFFICIENTS = ("kl_coef", "reward_coef", "policy_coef", "preference_coef")


@pytest.mark.parametrize(
    ("argument", "value", "message"),
    [
        *[
            (name, 0, rf"`{name}` must be at least 1, but is 0")
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
                "target_update_interval",
            ]
        ],
        ("gradient_steps", -2, "`gradient_steps` must be at least -1, but is -2"),
        ("learning_starts", -1, "`learning_starts` must be at least 0, but is -1"),
        *[
            ("batch_size", value, f"`batch_size` must be a whole number, but is {value}")
            for value in (1.5, True)
        ],
        *[
            (name, -0.5, f"`{name}` must be at least 0, but is -0.5")
            for name in (*COEFFICIENTS, *FRACTIONS)
        ],
        *[(name, 1.01, f"`{name}` must be at most 1, but is 1.01") for name in FRACTIONS],
        *[
            (name, NAN, f"`{name}` must be a finite number, but is nan")
            for name in ("gamma", "preference_coef")
        ],
        *[
            ("reward_scale", value, "reward_scale must be a positive number, ")
            for value in (0, NAN, "big")
        ],
        (
            "precision",
            "fp16",
            r"`precision` must be one of \('auto', 'bf16', 'fp32'\), but is 'fp16'",
        ),
        (
            "context",
            "rewards",
            r"`context` must be one of \('optimal', 'pearl'\), but is 'rewards'",
        ),
        ("device", "tpu7", "[Dd]evice|tpu"),
    ],
)
def test_arguments_outside_their_range(argument: str, value: Any, message: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=message):
        small(POEMSAC, **{argument: value})


def test_what_only_sac_takes() -> None:
    noise = NormalActionNoise(np.zeros(2), np.ones(2))
    for name, value, instead in (
        ("action_noise", noise, "ent_coef and target_entropy"),
        ("optimize_memory_usage", True, "buffer_size"),
        ("use_sde", True, "ent_coef and target_entropy"),
        ("sde_sample_freq", 4, "ent_coef and target_entropy"),
        ("use_sde_at_warmup", True, "ent_coef and target_entropy"),
        ("train_freq", 1, "trajectories_per_task and gradient_steps"),
        (
            "replay_buffer_class",
            HerReplayBuffer,
            "as HER does .* see buffer_size, relabel_fraction",
        ),
        ("replay_buffer_kwargs", {"n_sampled_goal": 4}, "GoalFamily"),
    ):
        with pytest.raises(TypeError, match=f"POEMSAC takes no '{name}': .*{instead}"):
            small(POEMSAC, **{name: value})
    for name, value, instead in (
        ("features_extractor_class", FlattenExtractor, "net_arch"),
        ("share_features_extractor", True, "net_arch"),
        ("log_std_init", -2.0, "ent_coef and target_entropy"),
    ):
        with pytest.raises(TypeError, match=f"POEMSAC's policy takes no '{name}': .*{instead}"):
            small(POEMSAC, policy_kwargs={name: value})


def test_every_argument_of_sac_is_taken_or_refused_with_a_reason() -> None:
    of_sac, of_its_policy, ours = (
        set(inspect.signature(kind).parameters) for kind in (SAC, SACPolicy, POEMSAC)
    )
    of_our_policy = set(inspect.signature(LatentPolicy).parameters)
    assert of_sac - ours <= UNSUPPORTED.keys()
    assert of_its_policy - of_our_policy <= UNSUPPORTED.keys()
    assert not UNSUPPORTED.keys() & (ours | of_our_policy)


def test_an_unknown_argument() -> None:
    message = (
        "PEARLSAC got an unexpected keyword argument 'learning_rat'; did you mean 'learning_rate'"
    )
    with pytest.raises(TypeError, match=message):
        small(PEARLSAC, learning_rat=1)
    for name in ("xyz", "context_relabel_fraction"):
        with pytest.raises(TypeError, match=f"POEMSAC got an unexpected keyword argument '{name}'"):
            small(POEMSAC, **{name: 0.5})


# ---------------------------------------------------------------- environments


class DictObservations(gym.Env):
    observation_space = spaces.Dict(observation=Walk.observation_space)
    action_space = Walk.action_space


NO_FAMILY = r"env <.*> is no task family.*poem_envs\.TaskFamily.*poem_envs\.GoalFamily.*docs/guides/families\.md"


class Half(gym.Env):
    """It has some of what a family has."""

    observation_space, action_space, task_space = (
        Walk.observation_space,
        Walk.action_space,
        Walk.task_space,
    )
    all_tasks = None

    def reset(self, **_: Any) -> tuple[np.ndarray, dict]:
        return np.zeros(2), {}


@pytest.mark.parametrize(
    "env",
    [
        "Pendulum-v1",
        functools.partial(gym.make, "CartPole-v1"),  # with discrete actions
        DictObservations,
        Half,
    ],
)
def test_no_task_family(env: Any) -> None:
    with pytest.raises(ValueError, match=NO_FAMILY):
        small(POEMSAC, env() if callable(env) else env)


def test_no_environment_at_all() -> None:
    with pytest.raises(
        gym.error.NameNotFound, match=r"No environment 'xyzzy' is registered .* nor any like it"
    ):
        small(POEMSAC, "xyzzy")
    for name in ("poem/HalfCheetahVel", "HalfCheetahVel-v0", "poem/HalfCheetaVel-v0"):
        with pytest.raises(gym.error.NameNotFound, match="did you mean 'poem/HalfCheetahVel-v0'"):
            small(POEMSAC, name)
    for env in (None, 3, Walk):
        with pytest.raises(
            TypeError,
            match=r"env is .*, but must be an environment.*, a vectorised one.*, or a registered id",
        ):
            small(POEMSAC, env)


class FlatAllTasks(Walk):
    all_tasks = np.array([0.5, 1.0])


def test_a_family_that_is_not_whole_cannot_be_made() -> None:
    for make in (FlatAllTasks, functools.partial(check_task_family, FlatAllTasks)):
        with pytest.raises(
            TypeError, match=r"family FlatAllTasks: all_tasks must have shape \(n, 1\)"
        ):
            make()


@pytest.mark.parametrize("method", ["_reward", "_simulate", "_begin_episode"])
def test_a_family_without_a_method_cannot_be_made(method: str) -> None:
    family = type("Part", (Walk,), {method: getattr(TaskFamily, method)})
    with pytest.raises(TypeError, match=f"abstract class Part with.* abstract method '?{method}"):
        family()


def test_relabelling_needs_shared_dynamics() -> None:
    with pytest.raises(
        ValueError, match=r"relabel_fraction must be 0: the tasks of .* do not share dynamics"
    ):
        small(POEMSAC, walks(2, WindyWalk), horizon=10, relabel_fraction=0.5)
    with pytest.raises(
        ValueError,
        match=r"context_relabel_fraction must be 0: the tasks of .* do not share dynamics",
    ):
        small(PEARLSAC, walks(2, WindyWalk), horizon=10, context_relabel_fraction=0.5)
    with pytest.raises(
        ValueError, match=r"`context_relabel_fraction` must be at most 1, but is 1\.5"
    ):
        small(PEARLSAC, walks(2), horizon=10, context_relabel_fraction=1.5)


def test_a_family_without_a_time_limit() -> None:
    with pytest.raises(ValueError, match="horizon is unknown"):
        small(POEMSAC, Walk())
    model = small(POEMSAC, Walk(), horizon=7).learn(1)  # its episodes never end
    assert model.num_timesteps == 12 * 7
    assert len(model.ep_info_buffer) == 0


# ---------------------------------------------------------------- poison


def poisoned(episode: int, step: int) -> DummyVecEnv:
    """Four copies of Walk, of which the third returns NaN once."""

    def make(copy: int) -> gym.Env:
        env = gym.wrappers.TimeLimit(Walk(), 10)
        return Poisoned(env, "observations", episode, step) if copy == 2 else env

    return DummyVecEnv([functools.partial(make, copy) for copy in range(4)])


def test_poison_stops_training_before_the_weights() -> None:
    """In the second wave (tasks 4 to 7) of the third epoch; every wave resets twice, as SB3's
    DummyVecEnv does at an end.
    """
    seen: list[dict[str, th.Tensor]] = []

    def callback(local_variables: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.append(parameters(model))
        return True

    waves_before = 2 * 3 + 1
    model = small(POEMSAC, poisoned(episode=1 + 2 * waves_before, step=6), horizon=10)
    with pytest.raises(
        ValueError,
        match=r"returned observations that are NaN or infinite: copy 2, training task 6, episode \d+, step 6: .*nan",
    ):
        model.learn(1000, callback)
    assert model.epoch == 2
    assert model._n_updates == 10
    assert not differing(seen[-1], parameters(model))  # as they were when the epoch began
    assert all(value.isfinite().all() for value in parameters(model).values())
    for task in range(model.replay_buffer.n_tasks):
        assert all(part.isfinite().all() for part in experience_of(model.replay_buffer, task))
    # the environment is sane again: training can go on
    model.learn(120, reset_num_timesteps=False)
    assert all(value.isfinite().all() for value in parameters(model).values())


def test_a_loss_that_is_not_finite_changes_no_weight() -> None:
    model = small(POEMSAC).learn(300)
    before = parameters(model)
    model.epoch_context.transitions[:] = float("nan")  # latents, and with them all losses
    with pytest.raises(
        ValueError,
        match=r"loss or its gradient is not finite at update 5; no network was changed by it",
    ):
        model.train(3, 16)
    assert not differing(before, parameters(model))


def test_an_optimiser_that_takes_every_gradient_waits_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On a GPU, for which this processor stands in."""
    kwargs = {"net_arch": ARCH, "optimizer_class": th.optim.SGD, "optimizer_kwargs": {}}
    model = small(POEMSAC, policy_kwargs=kwargs, ent_coef=0.1).learn(300)
    before = parameters(model)
    model.epoch_context.transitions[:] = float("nan")
    [batch] = model.make_sampler().sample(1, 16)
    monkeypatch.setattr(type(model.policy), "device", th.device("cuda"))
    monkeypatch.setattr(updater, "GraphedStep", lambda step: step)
    with pytest.raises(ValueError, match="not finite at update 5; no network was changed by it"):
        model.make_updater().step(batch)
    assert not differing(before, parameters(model))


def overflowing(batch: TaskBatch) -> TaskBatch:
    return batch._replace(rewards=th.full_like(batch.rewards, 1e30))  # squared: infinity


def test_a_reward_that_overflows_changes_no_weight() -> None:
    model = small(POEMSAC).learn(300)
    before = parameters(model)
    at = model.replay_buffer.at
    model.replay_buffer.at = lambda *args: overflowing(at(*args))
    with pytest.raises(
        ValueError,
        match=r"loss or its gradient is not finite at update 5; no network was changed by it",
    ):
        model.train(3, 16)
    assert not differing(before, parameters(model))


# ---------------------------------------------------------------- use


def test_sample_latents_and_sources() -> None:
    model = small(POEMSAC)
    with pytest.raises(
        ValueError, match=r"`source` must be one of \('prior', 'aggregate'\), but is 'posterior'"
    ):
        model.sample_latents(3, np.random.default_rng(0), "posterior")


class Distant(Walk):
    """Rewards are far away: in the first epoch there is none."""

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return 0.1 + (np.abs(features[..., 0] - tasks[..., 0]) > 100.0)


class Tiny(Walk):
    """Rewards are in units of their own."""

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return 1e-3 * super()._reward(tasks, features)


def test_tiny_rewards_are_measured_by_their_deviation() -> None:
    model = small(POEMSAC, walks(4, Tiny), horizon=10).learn(1)
    assert model.make_objective().reward_scale.tolist() == pytest.approx([1000.0] * 12)


def test_each_task_is_measured_by_its_own_rewards() -> None:
    """Also by what came after the first epoch."""
    model = small(POEMSAC, walks(4, Unequal), horizon=10, reward_scale="per-task").learn(200)
    scale = model.make_objective().reward_scale
    for task, factor in enumerate(scale.tolist()):
        rewards = factor * experience_of(model.replay_buffer, task).rewards.numpy()
        assert np.square(rewards).mean() == pytest.approx(1.0, rel=1e-4)
    assert scale.max() > 100 * scale.min()


class Sparse(Walk):
    """Only tasks to the right have paid yet."""

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return np.where(tasks[..., 0] > 0, 2.0, 0.0) * np.ones_like(features[..., 0])


def test_a_task_without_rewards_has_the_scale_of_the_others() -> None:
    model = small(POEMSAC, walks(4, Sparse), horizon=10, reward_scale="per-task").learn(1)
    assert model.make_objective().reward_scale.tolist() == [0.5] * 12


def test_rewards_that_do_not_differ_yet_keep_their_unit() -> None:
    model = small(POEMSAC, walks(4, Distant), horizon=10).learn(1)
    assert model.make_objective().reward_scale.tolist() == [1.0] * 12
    assert model.make_objective().reward_variance == 1.0
    assert model.context_reward_statistics == pytest.approx((0.1, 1.0))
    assert model.policy.reward_norm.std == 1.0


@pytest.mark.filterwarnings("ignore:.*degrees of freedom")
def test_one_step_of_one_task(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm, walks(1, steps=1), horizon=1, n_train_tasks=1).learn(3)
    assert (model.epoch, model._n_updates) == (3, 15)


def test_numbers_of_numpy() -> None:
    numbers = {"seed": np.int64(3), "reward_scale": np.float32(0.5), "latent_dim": np.int32(2)}
    model = small(POEMSAC, **numbers).learn(1)
    plain = small(POEMSAC, seed=3, reward_scale=0.5, latent_dim=2).learn(1)
    assert not differing(parameters(model), parameters(plain))


@pytest.mark.skipif(th.cuda.is_available(), reason="shows what happens without the device")
def test_a_missing_gpu_is_told() -> None:
    with pytest.warns(
        UserWarning, match="device is 'cuda', but torch sees no CUDA device: the CPU is used"
    ):
        model = small(POEMSAC, device="cuda")
    assert model.device.type == "cpu"


def test_the_documents_name_what_only_sac_takes() -> None:
    page = (Path(__file__).parents[2] / "docs" / "algorithms" / "index.md").read_text()
    table = page.partition("## What SAC takes and these do not")[2]
    assert {name for name in UNSUPPORTED if f"`{name}`" in table} == UNSUPPORTED.keys()
