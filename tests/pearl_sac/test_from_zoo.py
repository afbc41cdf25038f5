"""Models from the hyperparameters that ship."""

from __future__ import annotations

import inspect
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import torch as th
import yaml
from meta_toys import EPOCH, POINT_GOAL, Walk, differing, parameters, small
from stable_baselines3.common.callbacks import ConvertCallback
from torch.nn.utils import parameters_to_vector

from sb3_poem import PEARLSAC, POEMSAC, TrainingCheckpointCallback
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.loading import ALGORITHMS
from sb3_poem.pearl_sac.saving import kept_arguments
from sb3_poem.resources import config_file


def test_arguments_are_those_of_the_entry(algorithm: type[PEARLSAC]) -> None:
    entry = yaml.safe_load(config_file(algorithm.zoo_name).read_text())[POINT_GOAL]
    model = algorithm.from_zoo(POINT_GOAL, seed=3, device="cpu", gamma=0.8)
    for name in entry.keys() & set(kept_arguments(algorithm)) - {"policy_kwargs", "learning_rate"}:
        assert getattr(model, name) == entry[name], name
    assert (model.gamma, model.seed) == (0.8, 3)
    assert (model.n_envs, model.n_timesteps) == (120, int(entry["n_timesteps"]))
    assert model.policy.net_arch["pi"] == [64, 64]


def test_schedules_and_python_are_read_as_rl_zoo3_reads_them() -> None:
    from rl_zoo3.exp_manager import ExperimentManager

    env_id = "poem/PointGoal-v0"
    entry = yaml.safe_load(config_file(POEMSAC.zoo_name).read_text())[env_id]
    expected: Any = ExperimentManager._preprocess_schedules(
        {"learning_rate": entry["learning_rate"]}
    )["learning_rate"]
    model = POEMSAC.from_zoo(f"poem_envs:{env_id}", n_envs=2, device="cpu")
    for remaining in (1.0, 0.37, 0.0):
        assert model.lr_schedule(remaining) == pytest.approx(expected(remaining), rel=1e-12)
    with pytest.raises(ValueError, match="`learning_rate` must be a finite number, but is '1e-3'"):
        POEMSAC.from_zoo(env_id, n_envs=2, learning_rate="1e-3")
    assert model.policy_kwargs.items() >= eval(entry["policy_kwargs"], {"nn": th.nn}).items()


def test_every_entry_makes_a_model(algorithm: type[PEARLSAC]) -> None:
    entries = yaml.safe_load(config_file(algorithm.zoo_name).read_text())
    for env_id in entries.keys() - {"default"}:
        model = algorithm.from_zoo(env_id, n_envs=1, env=POINT_GOAL, _init_setup_model=False)
        assert model.n_timesteps > 0


@pytest.mark.parametrize(
    ("env_id", "arguments", "n_envs"),
    [
        (POINT_GOAL, {"n_train_tasks": 10}, 10),  # more copies would collect tasks twice
        ("poem/HalfCheetahFwdBack-v0", {}, 120),  # two tasks, sixty rollouts of each
        (POINT_GOAL, {"n_train_tasks": 10, "n_envs": 3}, 3),
    ],
)
def test_an_epoch_s_rollouts_have_a_copy_each(
    env_id: str, arguments: dict[str, Any], n_envs: int
) -> None:
    model = POEMSAC.from_zoo(env_id, device="cpu", **arguments)
    assert model.n_envs == n_envs
    if n_envs != 3:
        rollouts = len(model.train_tasks) * model.trajectories_per_task
        assert model.epoch_steps == rollouts * model.horizon


def test_learn_takes_the_entrys_steps(tmp_path: Path) -> None:
    model = POEMSAC.from_zoo(
        POINT_GOAL, seed=0, n_timesteps=3000, gradient_steps=1, device="cpu"
    ).learn()
    assert model.num_timesteps == 3000  # an epoch of 120 tasks and 25 steps
    model.save(tmp_path / "model")
    assert (
        POEMSAC.load(tmp_path / "model", POINT_GOAL).learn(reset_num_timesteps=False).num_timesteps
        == 6000
    )
    assert model.learn(6000).num_timesteps == 6000


def test_learn_does_not_guess_how_long() -> None:
    message = f"total_timesteps is missing, which only a model that from_zoo made knows: .* an epoch has {EPOCH}"
    with pytest.raises(ValueError, match=message):
        small(POEMSAC).learn()


def test_another_family_by_an_entry() -> None:
    gym.register("test/Walk-v0", Walk, max_episode_steps=10)
    try:
        for env in ("test/Walk-v0", gym.make("test/Walk-v0")):
            model = POEMSAC.from_zoo(POINT_GOAL, env=env, n_envs=3, seed=0)
            assert model.env_id == "test/Walk-v0"
            assert model.n_envs == (3 if isinstance(env, str) else 1)
    finally:
        del gym.registry["test/Walk-v0"]


def test_it_is_what_the_constructor_makes() -> None:
    """With the same arguments, the same model."""
    of_zoo = POEMSAC.from_zoo(
        POINT_GOAL, seed=0, n_timesteps=3000, gradient_steps=2, learning_rate=5e-3
    ).learn()
    entry = yaml.safe_load(config_file("poem_sac").read_text())[POINT_GOAL]
    arguments = {
        name: entry[name] for name in entry.keys() & inspect.signature(POEMSAC).parameters.keys()
    }
    changed = {
        "seed": 0,
        "gradient_steps": 2,
        "learning_rate": 5e-3,
        "env": make_task_vec_env(POINT_GOAL, 120),
    }
    policy_kwargs = eval(entry["policy_kwargs"])
    by_hand = POEMSAC(**{**arguments, **changed, "policy_kwargs": policy_kwargs}).learn(3000)
    assert not differing(parameters(of_zoo), parameters(by_hand))


def test_a_family_without_an_entry_takes_the_default_one(algorithm: type[PEARLSAC]) -> None:
    entries = yaml.safe_load(config_file(algorithm.zoo_name).read_text())
    gym.register("test/Walk-v0", Walk, max_episode_steps=10)
    try:
        model = algorithm.from_zoo("test/Walk-v0", n_envs=3, device="cpu")
    finally:
        del gym.registry["test/Walk-v0"]
    assert (model.env_id, model.n_timesteps) == (
        "test/Walk-v0",
        int(entries["default"]["n_timesteps"]),
    )
    with pytest.raises(ValueError, match="Pendulum"):
        algorithm.from_zoo("Pendulum-v1")
    with pytest.raises(gym.error.NameNotFound, match="did you mean 'poem/PointGoal-v0'"):
        algorithm.from_zoo("poem/PointGoal")


def test_the_names_are_those_of_the_command_line() -> None:
    assert {name: kind.zoo_name for name, kind in ALGORITHMS.items()} == {
        name: name for name in ALGORITHMS
    }


def test_a_run_of_one_epoch_says_that_a_falling_rate_is_0_in_it(tmp_path: Path) -> None:
    few = {"seed": 0, "n_train_tasks": 4, "gradient_steps": 2}
    model = POEMSAC.from_zoo(POINT_GOAL, n_envs=4, **few)
    before = parameters_to_vector(model.policy.actor.parameters())
    with pytest.warns(UserWarning, match="`learning_rate` falls to 0.*more than 100 steps"):
        model.learn(100)
    assert th.equal(parameters_to_vector(model.policy.actor.parameters()), before)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(200)
        assert not th.equal(parameters_to_vector(model.policy.actor.parameters()), before)
        POEMSAC("MlpPolicy", POINT_GOAL, **few).learn(100)
        in_second_epoch = ConvertCallback(lambda *_: model.num_timesteps <= 100)
        model.learn(200, [TrainingCheckpointCallback(tmp_path / "c.zip"), in_second_epoch])
        last = POEMSAC.load_checkpoint(tmp_path / "c.zip", POINT_GOAL)
        assert last.num_timesteps == 100
        assert last.resume().num_timesteps == 200
