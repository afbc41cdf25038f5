"""What works on Stable-Baselines3's SAC works on PEARLSAC and POEMSAC."""

from __future__ import annotations

import csv
import functools
import io
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from meta_toys import ARCH, EPOCH, N_TASKS, POINT_GOAL, OtherWalk, Walk, WindyWalk, differing, parameters, small, walks
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.common.vec_env import TaskVecEnv
from sb3_poem.pearl_sac.policies import LatentPolicy
from sb3_poem.poem_sac.policies import POEMPolicy


@pytest.fixture(params=[PEARLSAC, POEMSAC])
def algorithm(request: pytest.FixtureRequest) -> type[PEARLSAC]:
    """Both algorithms in turn."""
    return request.param


#: For what is one code in both
one_is_enough = pytest.mark.parametrize("algorithm", [POEMSAC])


@pytest.fixture(scope="module", params=[PEARLSAC, POEMSAC])
def trained(request: pytest.FixtureRequest) -> PEARLSAC:
    """A model after two epochs; tests leave it as it is."""
    return small(request.param).learn(2 * EPOCH)


OBS = np.random.default_rng(0).normal(size=(6, 2))


# ---------------------------------------------------------------- environments


@pytest.mark.parametrize(
    "make_env",
    [
        pytest.param(lambda: POINT_GOAL, id="id"),
        pytest.param(lambda: gym.make(POINT_GOAL), id="single"),
        pytest.param(lambda: Monitor(gym.make(POINT_GOAL)), id="monitor"),
        pytest.param(lambda: make_vec_env(POINT_GOAL, 5), id="dummy"),
        pytest.param(lambda: VecMonitor(DummyVecEnv([functools.partial(gym.make, POINT_GOAL)] * 5)), id="vec-monitor"),
        pytest.param(lambda: make_vec_env(POINT_GOAL, 5, vec_env_cls=TaskVecEnv), id="task-vec-env"),
        pytest.param(lambda: TaskVecEnv.from_id(POINT_GOAL, 30), id="more-copies-than-tasks"),
    ],
)
def test_any_number_of_environments(algorithm: type[PEARLSAC], make_env: Any) -> None:
    """Copies that do not divide the tasks: the last wave is filled up, and the steps count."""
    model = small(algorithm, make_env()).learn(1)
    n_envs = model.env.num_envs
    waves = -(-N_TASKS // n_envs)
    assert model.num_timesteps == waves * n_envs * 25
    assert model.n_envs == n_envs
    counts = model.replay_buffer.counts
    assert counts.sum() == model.num_timesteps
    assert counts.min() == 25 * (waves * n_envs // N_TASKS)
    assert len(model.ep_info_buffer) == min(100, waves * n_envs)
    assert model._n_updates == 5
    # the stored transitions are the tasks' own
    for task in range(N_TASKS):
        stored = model.replay_buffer.transitions(task)
        expected = model.family.compute_reward(model.train_tasks[task], stored.features.numpy())
        np.testing.assert_allclose(stored.rewards.numpy(), expected, atol=1e-5)


def test_an_id_gets_a_copy_for_every_task(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm)
    assert isinstance(model.env, TaskVecEnv)
    assert model.env.num_envs == N_TASKS
    assert model.env_id == POINT_GOAL


@one_is_enough
def test_subprocesses(algorithm: type[PEARLSAC]) -> None:
    env = SubprocVecEnv([functools.partial(gym.make, f"poem_envs:{POINT_GOAL}")] * 2, start_method="forkserver")
    try:
        model = small(algorithm, env).learn(EPOCH)
        same = small(algorithm, DummyVecEnv([functools.partial(gym.make, POINT_GOAL)] * 2)).learn(EPOCH)
        assert not differing(parameters(model), parameters(same))
    finally:
        env.close()


def test_early_ends_and_unsymmetric_actions(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm, walks(4, edge=0.4), horizon=10).learn(240)
    assert model.num_timesteps == 240
    terminated = th.cat([model.replay_buffer.transitions(task).terminated for task in range(N_TASKS)], dim=1)
    assert 0 < terminated.sum() < terminated.numel()
    assert model._episode_num > 24
    actions, _ = model.predict(OBS, deterministic=False)
    assert (actions >= -2.0).all()
    assert (actions <= 4.0).all()


def test_the_toys_are_environments() -> None:
    check_env(Walk(edge=0.4))


# ---------------------------------------------------------------- predict


def test_predict_takes_latents_as_state(trained: PEARLSAC) -> None:
    latents = np.random.default_rng(1).normal(size=(6, 5))
    actions, state = trained.predict(OBS, state=latents, deterministic=True)
    assert actions.shape == (6, 2)
    assert np.array_equal(state, latents)
    for index in range(6):  # one by one, with a single observation
        action, state = trained.predict(OBS[index], state=latents[index], deterministic=True)
        assert action.shape == (2,)
        np.testing.assert_allclose(action, actions[index], atol=1e-6)
        assert np.array_equal(state, latents[index : index + 1])
        again, _ = trained.predict(OBS[index], state=state, deterministic=True)  # the state that came back
        assert np.array_equal(again, action)
    assert np.ptp(actions, axis=0).min() > 1e-4


def test_predict_with_one_latent_for_all_and_with_none(trained: PEARLSAC) -> None:
    latent = np.random.default_rng(1).normal(size=5)
    for_all, state = trained.predict(OBS, state=latent, deterministic=True)
    expected, _ = trained.predict(OBS, state=np.tile(latent, (6, 1)), deterministic=True)
    np.testing.assert_allclose(for_all, expected, atol=1e-6)
    assert state.shape == (6, 5)
    nothing, state = trained.predict(OBS, deterministic=True)
    prior_mean, _ = trained.predict(OBS, state=np.zeros((6, 5)), deterministic=True)
    np.testing.assert_allclose(nothing, prior_mean, atol=1e-6)
    assert np.array_equal(state, np.zeros((6, 5)))


def test_predict_is_the_actor(trained: PEARLSAC) -> None:
    """Against the networks put together by hand."""
    latents = np.random.default_rng(1).normal(size=(6, 5))
    policy = trained.policy
    obs = ((th.as_tensor(OBS).float() - policy.obs_mean) / policy.obs_std).clamp(-10, 10)
    embedding = th.as_tensor(latents).float()
    if isinstance(policy, POEMPolicy):
        embedding = policy.policy_mapping(embedding)
    mean = policy.actor.mlp(th.cat([obs, embedding], dim=1))[:, :2]
    actions, _ = trained.predict(OBS, state=latents, deterministic=True)
    np.testing.assert_allclose(actions, th.tanh(mean).detach().numpy(), atol=1e-6)


def test_actions_are_scaled_to_the_environment(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm, walks(2), horizon=10)
    latents = np.random.default_rng(1).normal(size=(6, 5))
    actions, _ = model.predict(OBS, state=latents, deterministic=True)
    scaled = model.policy.act(OBS, latents)
    np.testing.assert_allclose(actions, -2.0 + 3.0 * (scaled + 1.0), atol=1e-5)
    back = model.policy.scale_action_batch(th.as_tensor(actions))
    np.testing.assert_allclose(back.numpy(), scaled, atol=1e-6)


def test_predict_without_determinism_explores(trained: PEARLSAC) -> None:
    many = np.tile(OBS[0], (200, 1))
    th.manual_seed(0)
    actions, _ = trained.predict(many, deterministic=False)
    assert actions.std(axis=0).min() > 0.05
    assert np.abs(actions).max() <= 1.0
    th.manual_seed(0)
    assert np.array_equal(trained.predict(many, deterministic=False)[0], actions)


@pytest.mark.parametrize(
    ("obs", "state", "message"),
    [
        (OBS, np.zeros(4), r"state has shape \(4,\), but a latent is \(5,\), or \(6, 5\)"),
        (OBS, np.zeros((5, 5)), r"state has shape \(5, 5\)"),
        (OBS, np.zeros((6, 4)), r"state has shape \(6, 4\)"),
        (OBS, np.zeros((1, 6, 5)), r"state has shape"),
        (OBS[0], np.zeros((2, 5)), r"state has shape \(2, 5\)"),
        (OBS[:, :1], None, r"observation has shape \(1,\), but the policy takes \(2,\)"),
        (np.zeros(3), None, r"observation has shape \(3,\)"),
        (np.where(np.eye(6, 2, -3), np.nan, OBS), None, "observation 3 holds NaN or infinity"),
        (np.where(np.eye(6, 2, -4), np.inf, OBS), None, "observation 4 holds NaN or infinity"),
        (OBS, np.full(5, np.nan), "state .*NaN"),
        (OBS, np.where(np.eye(6, 5, -2), np.nan, 0.0), "state .*NaN"),
    ],
)
def test_predict_refuses(trained: PEARLSAC, obs: np.ndarray, state: np.ndarray | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trained.predict(obs, state=state)


def test_policy_forward_is_predict_at_the_priors_mean(trained: PEARLSAC) -> None:
    scaled = trained.policy._predict(th.as_tensor(OBS), deterministic=True)
    np.testing.assert_allclose(scaled.numpy(), trained.predict(OBS, deterministic=True)[0], atol=1e-6)


def test_evaluate_policy(trained: PEARLSAC) -> None:
    env = make_vec_env(POINT_GOAL, 3, seed=0)
    mean, std = evaluate_policy(trained, env, n_eval_episodes=6)
    assert -60.0 < mean < 0.0
    assert std >= 0.0
    lengths = evaluate_policy(trained, env, n_eval_episodes=3, return_episode_rewards=True)[1]
    assert lengths == [25, 25, 25]


# ---------------------------------------------------------------- saving and loading


def assert_same_model(one: PEARLSAC, two: PEARLSAC) -> None:
    assert not differing(parameters(one), parameters(two))
    for name in ("train_tasks", "latent_means", "latent_variances", "task_latents"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name
    for name in ("num_timesteps", "epoch", "env_id", "horizon", "predicted_rewards_error", "seed", "_n_updates"):
        assert getattr(one, name) == getattr(two, name), name
    latents = np.random.default_rng(1).normal(size=(6, 5))
    assert np.array_equal(one.predict(OBS, latents, deterministic=True)[0], two.predict(OBS, latents, deterministic=True)[0])
    if isinstance(one, POEMSAC):
        assert np.array_equal(one.similarity(latents, latents), two.similarity(latents, latents))
    for source in ("prior", "aggregate"):
        draws = [model.sample_latents(9, np.random.default_rng(4), source) for model in (one, two)]
        assert np.array_equal(*draws)


@pytest.mark.parametrize("name", ["model", "model.zip", "deep/er/model"])
def test_save_and_load(trained: PEARLSAC, tmp_path: Path, name: str) -> None:
    trained.save(tmp_path / name)
    assert (tmp_path / name).with_suffix(".zip").is_file()
    loaded = type(trained).load(tmp_path / name)
    assert_same_model(trained, loaded)
    assert loaded.env is None
    with pytest.raises(ValueError, match="has no environment"):
        _ = loaded.family
    loaded.save(str(tmp_path / "again"))
    assert_same_model(trained, type(trained).load(str(tmp_path / "again.zip"), device="cpu"))


def test_save_to_a_buffer(trained: PEARLSAC) -> None:
    buffer = io.BytesIO()
    trained.save(buffer)
    buffer.seek(0)
    assert_same_model(trained, type(trained).load(buffer))


@pytest.mark.parametrize("make_env", [lambda: make_vec_env(POINT_GOAL, 3), lambda: gym.make(POINT_GOAL), lambda: POINT_GOAL])
def test_loaded_models_continue_with_any_number_of_copies(trained: PEARLSAC, tmp_path: Path, make_env: Any) -> None:
    trained.save(tmp_path / "model")
    loaded = type(trained).load(tmp_path / "model", env=make_env())
    assert_same_model(trained, loaded)
    before = parameters(loaded)
    loaded.learn(1, reset_num_timesteps=False)
    assert loaded.num_timesteps == 2 * EPOCH + EPOCH
    assert (loaded.epoch, loaded._n_updates) == (3, 15)
    changed = differing(before, parameters(loaded))
    assert {"policy.actor.mlp.output.weight", "policy.encoder.mlp.output.weight", "log_ent_coef"} <= set(changed)
    assert not {"policy.obs_mean", "policy.reward_std"} & set(changed)  # statistics stay those of the first epoch
    assert np.array_equal(loaded.train_tasks, trained.train_tasks)


@one_is_enough
def test_set_env_takes_another_number_of_copies(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm).learn(EPOCH)
    for env in (make_vec_env(POINT_GOAL, 2), TaskVecEnv.from_id(POINT_GOAL, 30), gym.make(POINT_GOAL)):
        model.set_env(env)
        model.learn(1, reset_num_timesteps=False)
    assert model.num_timesteps == EPOCH + 300 + 750 + 300


@one_is_enough
def test_set_env_of_a_family_that_is_not_registered(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    """Its episodes' length is the model's to know."""
    model = small(algorithm, walks(2), horizon=10).learn(1)
    model.set_env(walks(3))
    model.learn(1, reset_num_timesteps=False)
    assert model.num_timesteps == 240
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    loaded.set_env(walks(4))
    loaded.learn(1, reset_num_timesteps=False)
    assert loaded.num_timesteps == 360
    algorithm.load(tmp_path / "model", env=walks(5)).learn(1)
    for env in (walks(2, OtherWalk), DummyVecEnv([OtherWalk])):
        with pytest.raises(ValueError, match="own family"):
            model.set_env(env)


def test_set_env_of_another_family(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm, "poem/HalfCheetahVel-v0", n_train_tasks=2)
    env, family = model.env, model.family
    for other in ("poem/HalfCheetahFwdBack-v0", "poem/AntVel-v0", POINT_GOAL):
        with pytest.raises(ValueError, match=r"own family|[Oo]bservation spaces do not match"):
            model.set_env(make_vec_env(other, 1))
        with pytest.raises(ValueError, match="must not be wrapped in VecNormalize"):
            model.set_env(VecNormalize(make_vec_env("poem/HalfCheetahVel-v0", 1)))
        assert model.env is env  # a refused environment leaves the model as it was
        assert model.family is family
        assert model.n_envs == 2
    with pytest.raises(ValueError, match="horizon is 200, but the environment ends episodes after 50 steps"):
        model.set_env(make_vec_env("poem/HalfCheetahVel-v0", 1, env_kwargs={"max_episode_steps": 50}))


def test_load_with_another_family(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    small(algorithm, "poem/HalfCheetahVel-v0", n_train_tasks=2).save(tmp_path / "model")
    for other in ("poem/HalfCheetahFwdBack-v0", "poem/AntVel-v0"):
        with pytest.raises(ValueError, match=r"own family|[Oo]bservation spaces do not match"):
            algorithm.load(tmp_path / "model", env=make_vec_env(other, 1))
        with pytest.raises(ValueError, match=r"own family|[Oo]bservation spaces do not match"):
            algorithm.load(tmp_path / "model", env=other)


def test_broken_and_foreign_files(trained: PEARLSAC, tmp_path: Path) -> None:
    cls = type(trained)
    trained.save(tmp_path / "model.zip")
    content = (tmp_path / "model.zip").read_bytes()
    broken = tmp_path / "broken.zip"
    for bad in (content[: len(content) // 2], content[:-30], b"", b"hello", np.random.default_rng(0).bytes(5000)):
        broken.write_bytes(bad)
        with pytest.raises(ValueError, match=r"broken\.zip is truncated, or no model saved by"):
            cls.load(broken)
    middle = bytearray(content)
    middle[len(content) // 2] ^= 0xFF
    broken.write_bytes(middle)
    with pytest.raises(ValueError, match=r"broken\.zip is truncated, or no model saved by"):
        cls.load(broken)
    with pytest.raises(FileNotFoundError):
        cls.load(tmp_path / "nothing.zip")
    SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [4]}, buffer_size=10).save(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match=r"sac\.zip holds a model of another algorithm"):
        cls.load(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match=r"model\.zip holds a model of another algorithm"):
        (POEMSAC if cls is PEARLSAC else PEARLSAC).load(tmp_path / "model.zip")


def test_get_and_set_parameters(trained: PEARLSAC, tmp_path: Path) -> None:
    other = small(type(trained), seed=7)
    assert differing(parameters(other), parameters(trained))
    other.set_parameters(trained.get_parameters())
    mine, theirs = parameters(other), parameters(trained)
    assert not [name for name in differing(mine, theirs) if name != "log_ent_coef"]  # SB3 keeps it beside the parameters
    latents = np.random.default_rng(1).normal(size=(6, 5))
    actions = [model.predict(OBS, latents, deterministic=True)[0] for model in (other, trained)]
    assert np.array_equal(*actions)
    trained.save(tmp_path / "model")
    third = small(type(trained), seed=8)
    third.set_parameters(tmp_path / "model")
    assert np.array_equal(third.predict(OBS, latents, deterministic=True)[0], actions[0])
    with pytest.raises(ValueError, match="parameters do not match"):
        third.set_parameters({"policy": trained.policy.state_dict()})
    third.set_parameters({"policy": trained.policy.state_dict()}, exact_match=False)


def test_policy_saves_alone(trained: PEARLSAC, tmp_path: Path) -> None:
    """rl_zoo3 and users export ``model.policy``."""
    trained.policy.save(tmp_path / "policy")
    policy = type(trained.policy).load(tmp_path / "policy")
    latents = np.random.default_rng(1).normal(size=(6, 5))
    expected = trained.predict(OBS, latents, deterministic=True)[0]
    assert np.array_equal(policy.predict(OBS, latents, deterministic=True)[0], expected)


@one_is_enough
def test_replay_buffer_saves_alone(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    model = small(algorithm).learn(EPOCH)
    model.save_replay_buffer(tmp_path / "buffer")
    other = small(algorithm)
    other.load_replay_buffer(tmp_path / "buffer")
    for task in range(N_TASKS):
        stored = zip(other.replay_buffer.transitions(task), model.replay_buffer.transitions(task), strict=True)
        assert all(th.equal(one, two) for one, two in stored)
    other.learn(EPOCH)
    assert other.replay_buffer.size() == 2 * EPOCH


# ---------------------------------------------------------------- seeds


def test_a_seed_determines_everything(algorithm: type[PEARLSAC]) -> None:
    first = small(algorithm).learn(2 * EPOCH)
    th.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002 (to show that it does not matter)
    second = small(algorithm).learn(2 * EPOCH)
    assert_same_model(first, second)
    assert th.equal(first.context.transitions, second.context.transitions)
    third = small(algorithm, seed=1).learn(2 * EPOCH)
    assert not np.array_equal(first.train_tasks, third.train_tasks)
    different = differing(parameters(first), parameters(third))
    assert sum(name.startswith("policy.") for name in different) > 20


def test_training_leaves_the_global_generators_alone(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm)
    np.random.seed(3)  # noqa: NPY002
    before_torch, before_numpy = th.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    model.learn(EPOCH)
    assert th.equal(th.get_rng_state(), before_torch)
    assert np.array_equal(np.random.get_state()[1], before_numpy)  # noqa: NPY002


def test_the_kind_of_environment_does_not_matter(algorithm: type[PEARLSAC]) -> None:
    ours = small(algorithm, TaskVecEnv.from_id(POINT_GOAL, 5)).learn(EPOCH)
    theirs = small(algorithm, make_vec_env(POINT_GOAL, 5)).learn(EPOCH)
    assert_same_model(ours, theirs)


def test_tasks_come_from_the_family_and_the_seed(algorithm: type[PEARLSAC]) -> None:
    tasks = small(algorithm, n_train_tasks=200).train_tasks
    assert tasks.shape == (200, 1)
    assert np.unique(tasks).size == 200
    # uniform on [0, pi]: Kolmogorov-Smirnov at 1 %
    deviation = np.abs(np.sort(tasks[:, 0]) / np.pi - (np.arange(200) + 0.5) / 200).max()
    assert deviation < 1.63 / np.sqrt(200)
    assert small(algorithm, walks(1), horizon=10, n_train_tasks=None).train_tasks.shape == (120, 1)


# ---------------------------------------------------------------- arguments


def test_the_callers_policy_kwargs_stay_as_they_are(algorithm: type[PEARLSAC]) -> None:
    policy_kwargs = {"net_arch": {key: list(value) for key, value in ARCH.items()}, "n_critics": 3}
    model = small(algorithm, policy_kwargs=policy_kwargs)
    assert policy_kwargs == {"net_arch": ARCH, "n_critics": 3}
    assert len(model.policy.critic.members) == 3
    small(algorithm, policy_kwargs=policy_kwargs)


def test_net_arch_as_a_list_is_for_actor_and_critics(algorithm: type[PEARLSAC]) -> None:
    policy = small(algorithm, policy_kwargs={"net_arch": [24, 12], "activation_fn": th.nn.Tanh}).policy
    assert policy.net_arch["pi"] == policy.net_arch["qf"] == [24, 12]
    assert policy.actor.mlp.output.in_features == 12
    assert policy.encoder.mlp.output.in_features == 200
    assert isinstance(policy.actor.mlp.activation, th.nn.Tanh)
    with pytest.raises(ValueError, match=r"net_arch has unknown keys \['vf'\]; known are .*'decoder'.*"):
        small(algorithm, policy_kwargs={"net_arch": {"vf": [1]}})


def test_the_policy_can_be_a_class(algorithm: type[PEARLSAC]) -> None:
    policy_class = {PEARLSAC: LatentPolicy, POEMSAC: POEMPolicy}[algorithm]
    arguments = {"n_train_tasks": 2, "device": "cpu", "policy_kwargs": {"net_arch": ARCH}}
    assert isinstance(algorithm(policy_class, POINT_GOAL, **arguments).policy, policy_class)
    with pytest.raises(ValueError, match="Policy CnnPolicy unknown"):
        algorithm("CnnPolicy", POINT_GOAL, **arguments)


@one_is_enough
def test_another_optimizer(algorithm: type[PEARLSAC]) -> None:
    kwargs = {"net_arch": ARCH, "optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.9}}
    model = small(algorithm, policy_kwargs=kwargs).learn(EPOCH)
    assert isinstance(model.policy.optimizer, th.optim.SGD)
    assert model.policy.optimizer.param_groups[0]["momentum"] == 0.9


class Record(BaseCallback):
    """Notes a value at the start of every epoch and at the end."""

    def __init__(self, read: Any) -> None:
        super().__init__()
        self.read, self.values = read, []

    def _on_rollout_start(self) -> None:
        self.values.append(self.read(self.model))

    def _on_training_end(self) -> None:
        self.values.append(self.read(self.model))

    def _on_step(self) -> bool:
        return True


def learning_rates(model: PEARLSAC) -> tuple[float, ...]:
    optimizers = [model.policy.optimizer, model.ent_coef_optimizer]
    return tuple(optimizer.param_groups[0]["lr"] for optimizer in optimizers)


@one_is_enough
def test_learning_rate_schedules_reach_the_optimisers(algorithm: type[PEARLSAC]) -> None:
    record = Record(learning_rates)
    small(algorithm, learning_rate=lambda remaining: 1e-3 * remaining).learn(4 * EPOCH, record)
    # epochs train after their collection: with 3/4, 2/4, 1/4 and 0 of the run remaining
    expected = [1e-3, 0.75e-3, 0.5e-3, 0.25e-3, 0.0]
    np.testing.assert_allclose(record.values, np.repeat(np.array(expected)[:, None], 2, axis=1), atol=1e-12)


@one_is_enough
def test_a_schedule_never_turns_negative(algorithm: type[PEARLSAC]) -> None:
    """Whole epochs overshoot the total; a learning rate below 0 would climb the loss."""
    record = Record(learning_rates)
    small(algorithm, learning_rate=lambda remaining: 1e-3 * remaining).learn(EPOCH + 1, record)
    assert min(min(rates) for rates in record.values) >= 0.0


@one_is_enough
def test_entropy_coefficient(algorithm: type[PEARLSAC]) -> None:
    fixed = small(algorithm, ent_coef=0.3).learn(EPOCH)
    assert fixed.ent_coef_optimizer is None
    assert fixed._entropy_coefficient().item() == pytest.approx(0.3)
    learned = small(algorithm, ent_coef="auto_0.1")
    assert learned._entropy_coefficient().item() == pytest.approx(0.1)
    learned.learn(2 * EPOCH)
    assert learned._entropy_coefficient().item() != pytest.approx(0.1, abs=1e-5)
    # ten Adam steps of 3e-4 on the logarithm
    assert abs(np.log(learned._entropy_coefficient().item() / 0.1)) <= 10 * 3e-4 * 1.01
    with pytest.raises(ValueError, match="could not convert string to float"):
        small(algorithm, ent_coef="little")


@one_is_enough
def test_target_entropy(algorithm: type[PEARLSAC]) -> None:
    assert small(algorithm).target_entropy == -2.0
    assert small(algorithm, target_entropy=-0.5).target_entropy == -0.5
    # far below the policy's entropy alpha falls, far above it rises
    falling = small(algorithm, target_entropy=-50.0).learn(EPOCH)._entropy_coefficient().item()
    rising = small(algorithm, target_entropy=50.0).learn(EPOCH)._entropy_coefficient().item()
    assert falling < 1.0 < rising


def target_networks(model: PEARLSAC) -> th.Tensor:
    return th.cat([parameter.flatten() for parameter in model.policy.critic_target.parameters()])


def critic_networks(model: PEARLSAC) -> th.Tensor:
    return th.cat([parameter.detach().flatten() for parameter in model.policy.critic.parameters()])


@one_is_enough
def test_target_critics_follow_slowly(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm, gradient_steps=1, tau=0.25)
    before = target_networks(model).clone()
    assert th.equal(before, critic_networks(model))
    model.learn(1)
    th.testing.assert_close(target_networks(model), 0.75 * before + 0.25 * critic_networks(model))


@one_is_enough
def test_target_update_interval(algorithm: type[PEARLSAC]) -> None:
    """Updates at gradient steps 0, 3, 6, ... with tau = 1 copy the critics."""
    model, seen = small(algorithm, gradient_steps=7, target_update_interval=3, tau=1.0), []
    update = model._update_targets

    def spy() -> None:
        update()
        seen.append(model._n_updates)
        assert th.equal(target_networks(model), critic_networks(model))

    model._update_targets = spy  # type: ignore[method-assign]
    model.learn(1)
    assert seen == [0, 3, 6]


@one_is_enough
def test_gradient_steps_and_learning_starts(algorithm: type[PEARLSAC]) -> None:
    assert small(algorithm, gradient_steps=0).learn(EPOCH)._n_updates == 0
    assert small(algorithm, gradient_steps=-1, n_train_tasks=2).learn(1)._n_updates == 50
    model = small(algorithm, learning_starts=EPOCH).learn(2 * EPOCH)  # the first epoch acts at random and learns nothing
    assert model._n_updates == 5
    first_actions = th.cat([model.replay_buffer.transitions(task).actions[:, :25] for task in range(N_TASKS)])
    assert first_actions.abs().max() < 1.0
    assert abs(first_actions.mean().item()) < 0.1
    assert first_actions.std().item() == pytest.approx(1 / np.sqrt(3), rel=0.1)


@one_is_enough
def test_horizons_per_task_and_epoch(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm, trajectories_per_task=3).learn(1)
    assert model.num_timesteps == 3 * EPOCH
    assert model.context.transitions.shape[:2] == (N_TASKS, 75)
    assert (model.replay_buffer.counts == 75).all()
    # contexts are the tasks' own
    raw = model.replay_buffer.transitions(4).rewards[0]
    assert sorted(model.context.rewards[4].tolist()) == pytest.approx(sorted(raw.tolist()), abs=1e-5)


@one_is_enough
def test_buffer_size_bounds_memory(algorithm: type[PEARLSAC]) -> None:
    model = small(algorithm, buffer_size=30).learn(3 * EPOCH)
    assert (model.replay_buffer.counts == 30).all()


@pytest.mark.parametrize("precision", ["fp32", "bf16", "auto"])
def test_precision(algorithm: type[PEARLSAC], precision: str) -> None:
    model = small(algorithm, precision=precision).learn(EPOCH)
    assert all(value.isfinite().all() for value in parameters(model).values())
    assert all(value.dtype == th.float32 for value in model.policy.parameters())


# ---------------------------------------------------------------- callbacks and logs


class StopAt(BaseCallback):
    """Stops after some steps of the vectorised environment."""

    def __init__(self, calls: int) -> None:
        super().__init__()
        self.last = calls

    def _on_step(self) -> bool:
        assert self.training_env is self.model.get_env()
        return self.n_calls < self.last


@pytest.mark.parametrize("calls", [1, 25, 26, 40])
def test_a_callback_stops_training(algorithm: type[PEARLSAC], calls: int) -> None:
    model = small(algorithm)
    model.learn(10 * EPOCH, StopAt(calls))
    assert model.num_timesteps == calls * N_TASKS
    assert model._n_updates == 5 * ((calls - 1) // 25)
    model.learn(EPOCH, reset_num_timesteps=False)  # and it goes on
    assert model.num_timesteps == calls * N_TASKS + EPOCH


@one_is_enough
def test_sb3s_callbacks(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    events: list[int] = []

    class Count(BaseCallback):
        def _on_step(self) -> bool:
            events.append(self.model.num_timesteps)
            return True

    evaluation = EvalCallback(
        make_vec_env(POINT_GOAL, 1), n_eval_episodes=2, eval_freq=20, best_model_save_path=str(tmp_path), verbose=0
    )
    callbacks = CallbackList(
        [
            EveryNTimesteps(EPOCH, Count()),
            CheckpointCallback(30, str(tmp_path), save_replay_buffer=True),
            evaluation,
            StopTrainingOnMaxEpisodes(3, verbose=0),  # of each copy
        ]
    )
    model = small(algorithm)
    model.learn(10 * EPOCH, callbacks)
    assert model.num_timesteps == 3 * EPOCH
    assert events == [EPOCH, 2 * EPOCH, 3 * EPOCH]
    assert (tmp_path / "best_model.zip").is_file()
    assert np.isfinite(evaluation.last_mean_reward)
    saved = algorithm.load(tmp_path / f"rl_model_{30 * N_TASKS}_steps")
    assert saved.num_timesteps == 30 * N_TASKS


@one_is_enough
def test_a_function_as_callback(algorithm: type[PEARLSAC]) -> None:
    """SB3 takes a function of locals and globals too; it sees what it would see on SAC."""
    seen: list[set[str]] = []

    def callback(local_variables: dict[str, Any], _: dict[str, Any]) -> bool:
        seen.append(set(local_variables))
        return True

    small(algorithm).learn(EPOCH, callback)
    assert len(seen) == 25
    assert {"infos", "dones", "rewards", "actions", "new_obs"} <= seen[0]


@one_is_enough
def test_progress_bar(algorithm: type[PEARLSAC], capsys: pytest.CaptureFixture[str]) -> None:
    small(algorithm).learn(2 * EPOCH, progress_bar=True)
    captured = capsys.readouterr()
    assert "600/600" in captured.out + captured.err


LOGGED = {
    "rollout/train_task_return",
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "time/collection_fps",
    "time/updates_per_second",
    "time/fps",
    "train/learning_rate",
    "train/critic_loss",
    "train/actor_loss",
    "train/decoder_loss",
    "train/kl",
    "train/kl_ideal",
    "train/aggregate_to_prior_kl",
    "train/decoder_error",
    "train/ent_coef",
}
LOGGED_BY_POEM = {"train/preference_loss", "train/preference_accuracy"}


def test_csv_and_json_logs(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    model = small(algorithm)
    model.set_logger(configure(str(tmp_path), ["csv", "json"]))
    model.learn(3 * EPOCH)
    rows = list(csv.DictReader((tmp_path / "progress.csv").open()))
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    promised = LOGGED | (LOGGED_BY_POEM if algorithm is POEMSAC else set())
    for entries in (rows, lines):
        assert [int(float(entry["time/total_timesteps"])) for entry in entries] == [EPOCH, 2 * EPOCH, 3 * EPOCH]
        for entry in entries:
            assert promised <= set(entry)
            assert np.isfinite([float(entry[name]) for name in promised]).all()
    assert float(rows[0]["train/kl_ideal"]) == pytest.approx(np.log(N_TASKS))
    assert float(rows[0]["rollout/ep_len_mean"]) == 25
    assert [int(row["train/n_updates"]) for row in rows] == [5, 10, 15]
    # the first row is of the first epoch alone: twelve episodes, whose returns Monitor saw too
    assert float(rows[0]["rollout/train_task_return"]) == pytest.approx(float(rows[0]["rollout/ep_rew_mean"]), rel=1e-5)


@one_is_enough
@pytest.mark.parametrize(("log_interval", "expected"), [(2, [2, 4]), (None, []), (1, [1, 2, 3, 4])])
def test_log_interval_counts_epochs(
    algorithm: type[PEARLSAC], tmp_path: Path, log_interval: int | None, expected: list[int]
) -> None:
    model = small(algorithm)
    model.set_logger(configure(str(tmp_path), ["json"]))
    model.learn(4 * EPOCH, log_interval=log_interval)
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert [line["time/total_timesteps"] // EPOCH for line in lines] == expected


@one_is_enough
def test_tensorboard(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    model = small(algorithm, tensorboard_log=str(tmp_path))
    model.learn(2 * EPOCH)
    model.learn(EPOCH, reset_num_timesteps=False)
    model.learn(EPOCH, tb_log_name="named")
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{algorithm.__name__}_1", "named_1"]
    events = EventAccumulator(str(tmp_path / f"{algorithm.__name__}_1"))
    events.Reload()
    promised = LOGGED | (LOGGED_BY_POEM if algorithm is POEMSAC else set())
    assert promised <= set(events.Tags()["scalars"])
    assert [event.step for event in events.Scalars("train/kl")] == [EPOCH, 2 * EPOCH, 3 * EPOCH]


@one_is_enough
def test_verbose_prints_a_table(algorithm: type[PEARLSAC], capsys: pytest.CaptureFixture[str]) -> None:
    small(algorithm, verbose=1).learn(EPOCH)
    printed = capsys.readouterr().out
    assert "Using cpu device" in printed
    assert "decoder_error" in printed
    small(algorithm, verbose=0).learn(EPOCH)
    assert capsys.readouterr().out == ""


@one_is_enough
def test_monitors_episode_info(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    """Returns as SB3 logs them are those of the tasks; a Monitor file is written."""
    env = make_vec_env(POINT_GOAL, 3, monitor_dir=str(tmp_path / "monitor"))
    model = small(algorithm, env).learn(EPOCH)
    episodes = list(model.ep_info_buffer)
    assert [episode["l"] for episode in episodes] == [25] * N_TASKS
    # copies end together, in waves of three tasks
    own = [model.replay_buffer.transitions(task).rewards.sum() for task in range(N_TASKS)]
    np.testing.assert_allclose([episode["r"] for episode in episodes], own, rtol=1e-4)
    assert len(list((tmp_path / "monitor").glob("*.monitor.csv"))) == 3


def test_a_model_from_a_gpu_goes_on_training_here(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    """There optimisers are captured in a graph, which Adam refuses on a processor."""
    model = small(algorithm).learn(EPOCH)
    for optimizer in (model.policy.optimizer, model.ent_coef_optimizer):
        optimizer.param_groups[0]["capturable"] = True
    model.save(tmp_path / "model.zip")
    loaded = algorithm.load(tmp_path / "model.zip", env=POINT_GOAL, device="cpu")
    loaded.learn(EPOCH, reset_num_timesteps=False)
    assert loaded._n_updates == 10


# ---------------------------------------------------------------- what a loaded model keeps, and what it is told anew


def test_parameters_come_with_their_standardisation(trained: PEARLSAC) -> None:
    copy = small(type(trained), gradient_steps=0)
    copy.set_parameters(trained.get_parameters())
    before = copy.predict(OBS, deterministic=True)[0]
    copy.learn(EPOCH)  # which collects, and learns nothing
    assert np.array_equal(copy.predict(OBS, deterministic=True)[0], before)
    assert np.array_equal(trained.predict(OBS, deterministic=True)[0], before)
    fresh = small(type(trained), seed=5)
    fresh.set_parameters(small(type(trained)).get_parameters())  # of a model that has seen nothing
    assert th.equal(fresh.policy.obs_std, th.ones(2))
    fresh.learn(EPOCH)
    assert not th.equal(fresh.policy.obs_std, th.ones(2))


@one_is_enough
def test_arguments_of_a_model_that_is_loaded(algorithm: type[POEMSAC], trained: PEARLSAC, tmp_path: Path) -> None:
    model = small(algorithm, similarity="inner", context="pearl", latent_dim=3)
    model.save(tmp_path / "m.zip")
    same = {"similarity": "inner", "context": "pearl", "latent_dim": 3}
    loaded = algorithm.load(tmp_path / "m.zip", n_steps=5, kl_coef=0.7, device="cpu", **same)
    assert (loaded.target_steps, loaded.kl_coef) == (5, 0.7)
    assert loaded.similarity(np.zeros((2, 3)), np.zeros((1, 3))).shape == (2, 1)
    for name, value in {"similarity": "two", "context": "poem", "latent_dim": 5}.items():
        with pytest.raises(ValueError, match=f"{name} is .* in .*m.zip, and cannot become {value!r}"):
            algorithm.load(tmp_path / "m.zip", **{name: value})


def test_a_seed_changes_what_follows(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    small(algorithm).learn(EPOCH).save(tmp_path / "m.zip")

    def further(seed: int | None, later: int | None = None) -> dict[str, th.Tensor]:
        arguments = {} if seed is None else {"seed": seed}
        model = algorithm.load(tmp_path / "m.zip", env=POINT_GOAL, device="cpu", **arguments)
        if later is not None:
            model.set_random_seed(later)
        return parameters(model.learn(EPOCH, reset_num_timesteps=False))

    one, two = further(1), further(2)
    assert differing(one, two)
    assert not differing(one, further(1))
    assert not differing(two, further(None, 2))
    assert not differing(further(None), further(None))
    assert differing(further(None), one)


@one_is_enough
def test_an_id_becomes_as_many_copies_as_in_training(algorithm: type[POEMSAC], tmp_path: Path) -> None:
    arguments = {"n_train_tasks": 4, "trajectories_per_task": 3, "meta_batch_size": 4}
    whole = small(algorithm, **arguments).learn(3 * 12 * 25)
    half = small(algorithm, **arguments).learn(12 * 25)
    half.save_checkpoint(tmp_path / "c.pt")
    half.save(tmp_path / "m.zip")
    half.save_pretrained(tmp_path / "p")
    resumed = algorithm.load_checkpoint(tmp_path / "c.pt", POINT_GOAL, device="cpu")
    for loaded in (
        resumed,
        algorithm.load(tmp_path / "m.zip", POINT_GOAL),
        algorithm.from_pretrained(tmp_path / "p", POINT_GOAL),
    ):
        assert loaded.n_envs == whole.n_envs == 12
    resumed.learn(2 * 12 * 25, reset_num_timesteps=False)
    assert not differing(parameters(resumed), parameters(whole))
    other = small(algorithm, TaskVecEnv.from_id(POINT_GOAL, 5), **arguments)
    other.save(tmp_path / "o.zip")
    assert algorithm.load(tmp_path / "o.zip", POINT_GOAL).n_envs == 5


@one_is_enough
def test_an_id_without_a_vectorised_version(algorithm: type[POEMSAC], tmp_path: Path) -> None:
    gym.register("Strolling-v0", Walk, max_episode_steps=10)
    try:
        whole = small(algorithm, "Strolling-v0", n_train_tasks=4, meta_batch_size=4).learn(2 * 40)
        half = small(algorithm, "Strolling-v0", n_train_tasks=4, meta_batch_size=4).learn(40)
        half.save_checkpoint(tmp_path / "c.pt")
        half.save(tmp_path / "m.zip")
        half.save_pretrained(tmp_path / "p")
        resumed = algorithm.load_checkpoint(tmp_path / "c.pt", "Strolling-v0", device="cpu").learn(
            40, reset_num_timesteps=False
        )
        assert not differing(parameters(resumed), parameters(whole))
        for loaded in (
            algorithm.load(tmp_path / "m.zip", "Strolling-v0"),
            algorithm.from_pretrained(tmp_path / "p", "Strolling-v0"),
        ):
            assert loaded.n_envs == 1
    finally:
        del gym.registry["Strolling-v0"]


def test_arguments_that_the_family_cannot_have(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    small(algorithm, walks(3, WindyWalk), horizon=10, n_train_tasks=4).save(tmp_path / "windy.zip")
    calm = small(algorithm, walks(3), horizon=10, n_train_tasks=4, relabel_fraction=0.5)
    calm.save(tmp_path / "calm.zip")
    with pytest.raises(ValueError, match=r"relabel_fraction must be 0: the tasks of .* do not share dynamics"):
        algorithm.load(tmp_path / "windy.zip", walks(3, WindyWalk), relabel_fraction=0.5)
    with pytest.raises(ValueError, match="relabel_fraction must be 0"):
        calm.set_env(walks(3, WindyWalk))
    with pytest.raises(ValueError, match=r"n_train_tasks is 4 in .*calm\.zip, and cannot become 2"):
        algorithm.load(tmp_path / "calm.zip", n_train_tasks=2)
    with pytest.raises(ValueError, match=r"ent_coef is 'auto' in .*calm\.zip, and cannot become 0\.1"):
        algorithm.load(tmp_path / "calm.zip", ent_coef=0.1)
