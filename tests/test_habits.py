"""What people type who know SB3 and Gymnasium: it works, or says what to type instead."""

from __future__ import annotations

import contextlib
import copy
import functools
import importlib
import io
import json
import pickle
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from first_hour import (
    Toy,
    check_words,
    check_works,
    made,
    names,
    refused,
    runs,
    trained,
    works,
)
from gymnasium import wrappers
from meta_toys import EPOCH, N_TASKS, POINT_GOAL, SMALL, differing, parameters
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import (
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    ProgressBarCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecVideoRecorder,
)

import sb3_poem
from poem_envs import GoalFamily
from sb3_poem import POEMSAC, AdaptationEvalCallback, PreferenceAdapter, ReturnOracle, TaskVecEnv
from sb3_poem.adaptation import AdaptedPolicy
from sb3_poem.poem_sac.policies import MlpPolicy

OBS = np.random.default_rng(0).normal(size=(6, 2))
CHEETAH = "poem/HalfCheetahVel-v0"


def learned(**arguments: Any) -> POEMSAC:
    return made(**arguments).learn(EPOCH)


def printed(call: Callable[[], Any]) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        call()
    return out.getvalue()


def same(one: th.nn.Module, two: th.nn.Module) -> bool:
    return not differing(one.state_dict(), two.state_dict())


def point(**arguments: Any) -> gym.Env:
    return gym.make(POINT_GOAL, **arguments)


def points(n: int, **arguments: Any) -> VecEnv:
    return make_vec_env(POINT_GOAL, n, **arguments)


# ---------------------------------------------------------------- the constructor


def rate(**arguments: Any) -> float:
    return learned(**arguments).policy.optimizer.param_groups[0]["lr"]


@functools.cache
def plainly_learned() -> dict[str, th.Tensor]:
    return parameters(learned())


def changed(**arguments: Any) -> bool:
    """Whether an argument has a say in what is learned."""
    return bool(differing(parameters(learned(**arguments)), plainly_learned()))


def policy(**kwargs: Any) -> MlpPolicy:
    return learned(policy_kwargs=kwargs).policy


CONSTRUCTOR = [
    works("policy", lambda _: type(POEMSAC(MlpPolicy, POINT_GOAL, **SMALL).policy), MlpPolicy),
    works("learning_rate", lambda _: rate(learning_rate=1e-3), 1e-3),
    works("LinearSchedule", lambda _: rate(learning_rate=LinearSchedule(1e-3, 5e-4, 1.0)), 5e-4),
    works("learning_rate lambda", lambda _: rate(learning_rate=lambda left: 1e-3 + left), 1e-3),
    works("buffer_size", lambda _: learned(buffer_size=9).replay_buffer.size(), 9 * N_TASKS),
    works("learning_starts", lambda _: learned(learning_starts=EPOCH)._n_updates, 0),
    works("batch_size", lambda _: changed(batch_size=7)),
    works("tau", lambda _: changed(tau=0.5)),
    works("gamma", lambda _: changed(gamma=0.5)),
    works(
        "gradient_steps", lambda _: made(gradient_steps=-1, n_train_tasks=2).learn(1)._n_updates, 50
    ),
    works("n_steps", lambda _: changed(n_steps=2)),
    works("ent_coef auto", lambda _: 0.09 < learned(ent_coef="auto_0.1").log_ent_coef.exp() < 0.11),
    works("ent_coef", lambda _: learned(ent_coef=0.25).ent_coef_tensor.item(), 0.25),
    works("target_update_interval", lambda _: changed(target_update_interval=3)),
    works("target_entropy", lambda _: learned(target_entropy=-0.5).target_entropy, -0.5),
    works("stats_window_size", lambda _: len(learned(stats_window_size=3).ep_info_buffer), 3),
    works("tensorboard_log", lambda f: learned(tensorboard_log=str(f)) and runs(f), ["POEMSAC_1"]),
    works("verbose", lambda _: "total_timesteps" in printed(lambda: learned(verbose=1))),
    works("seed", lambda _: not changed(seed=SMALL["seed"]) and changed(seed=3)),
    works("device", lambda _: learned(device=th.device("cpu")).device.type, "cpu"),
    works("net_arch list", lambda _: policy(net_arch=[8, 4]).actor.mlp.output.in_features, 4),
    works("net_arch", lambda _: policy(net_arch={"pi": [9]}).actor.mlp.output.in_features, 9),
    works("activation_fn", lambda _: policy(activation_fn=th.nn.Tanh).activation_fn, th.nn.Tanh),
    works(
        "optimizer_class",
        lambda _: type(policy(optimizer_class=th.optim.SGD).optimizer),
        th.optim.SGD,
    ),
    works("tuned for the id", lambda _: POEMSAC.from_zoo(CHEETAH, n_train_tasks=2).env_id, CHEETAH),
]

NOISE = NormalActionNoise(np.zeros(2), np.ones(2))
EPISODES = "train_freq...trajectories_per_task|gradient_steps"

WITHOUT = [
    refused("CnnPolicy", lambda _: POEMSAC("CnnPolicy", POINT_GOAL), "CnnPolicy...MlpPolicy"),
    refused(
        "MultiInputPolicy",
        lambda _: POEMSAC("MultiInputPolicy", POINT_GOAL),
        "GoalFamily|MlpPolicy",
    ),
    refused("train_freq", lambda _: made(train_freq=1), EPISODES),
    refused("train_freq tuple", lambda _: made(train_freq=(1, "episode")), EPISODES),
    refused("action_noise", lambda _: made(action_noise=NOISE), "action_noise...target_entropy"),
    refused(
        "optimize_memory_usage",
        lambda _: made(optimize_memory_usage=True),
        "optimize_memory_usage...buffer_size",
    ),
    refused(
        "HER",
        lambda _: made(replay_buffer_class=HerReplayBuffer),
        "replay_buffer_class...GoalFamily|relabel",
    ),
    refused(
        "replay_buffer_kwargs",
        lambda _: made(replay_buffer_kwargs={}),
        "replay_buffer_kwargs...buffer_size|relabel",
    ),
    refused("use_sde", lambda _: made(use_sde=True), "use_sde...target_entropy"),
    refused(
        "sde_sample_freq", lambda _: made(sde_sample_freq=4), "sde_sample_freq...target_entropy"
    ),
    refused(
        "use_sde_at_warmup",
        lambda _: made(use_sde_at_warmup=True),
        "use_sde_at_warmup...target_entropy",
    ),
    refused("use_sde of the policy", lambda _: policy(use_sde=True), "use_sde...target_entropy"),
    refused(
        "log_std_init",
        lambda _: policy(log_std_init=-3),
        "log_std_init...ent_coef|target_entropy",
    ),
    refused(
        "features_extractor_class",
        lambda _: policy(features_extractor_class=FlattenExtractor),
        "features_extractor_class...net_arch",
    ),
]

# ---------------------------------------------------------------- learning


def called(callback: Any, steps: int = 2 * EPOCH, **arguments: Any) -> POEMSAC:
    return made().learn(steps, callback, **arguments)


def seen_by_a_function(_: Path) -> set[str]:
    seen: set[str] = set()
    called(lambda local, _: seen.update(local) or True)  # type: ignore[func-returns-value]
    return seen


def logged(folder: Path) -> list[int]:
    model = made()
    model.set_logger(configure(str(folder), ["json", "csv", "log"]))
    model.learn(4 * EPOCH, log_interval=2)
    assert names(folder) == ["log.txt", "progress.csv", "progress.json"]
    lines = (folder / "progress.json").read_text().splitlines()
    return [json.loads(line)["time/total_timesteps"] for line in lines]


def again(**arguments: Any) -> int:
    return learned().learn(EPOCH, **arguments).num_timesteps


STOP = StopTrainingOnMaxEpisodes
LEARN = [
    works("StopTrainingOnMaxEpisodes", lambda _: called(STOP(1)).num_timesteps, EPOCH),
    works(
        "CallbackList",
        lambda _: called(CallbackList([STOP(1), ProgressBarCallback()])).num_timesteps,
        EPOCH,
    ),
    works(
        "a list of callbacks",
        lambda _: called([STOP(1), ProgressBarCallback()]).num_timesteps,
        EPOCH,
    ),
    works(
        "EveryNTimesteps",
        lambda f: called(EveryNTimesteps(EPOCH, CheckpointCallback(1, f))) and len(names(f)),
        2,
    ),
    works(
        "CheckpointCallback",
        lambda f: called(CheckpointCallback(25, f, "my", True), EPOCH) and names(f),
        ["my_300_steps.zip", "my_replay_buffer_300_steps.pkl"],
    ),
    works(
        "AdaptationEvalCallback",
        lambda f: called(AdaptationEvalCallback(2, 2, (0, 1), 1, f)) and names(f),
        ["best_model.zip"],
    ),
    works(
        "a function",
        seen_by_a_function,
        {"infos", "rewards", "dones", "actions", "new_obs"}.issubset,
    ),
    works(
        "StopTrainingOnMaxEpisodes verbose",
        lambda _: "the POEMSAC model" in printed(lambda: called(STOP(1, verbose=1))),
    ),
    works("a function that stops", lambda _: called(lambda *_: False).num_timesteps, N_TASKS),
    works("progress_bar", lambda _: "600/600" in printed(lambda: called(None, progress_bar=True))),
    works("log_interval", logged, [2 * EPOCH, 4 * EPOCH]),
    works(
        "tb_log_name",
        lambda f: made(tensorboard_log=str(f)).learn(1, tb_log_name="my") and runs(f),
        ["my_1"],
    ),
    works("reset_num_timesteps", lambda _: again(reset_num_timesteps=True), EPOCH),
    works("no reset_num_timesteps", lambda _: again(reset_num_timesteps=False), 2 * EPOCH),
    works("total_timesteps as a float", lambda _: made().learn(1e2).num_timesteps, EPOCH),
]

# ---------------------------------------------------------------- files, and a model's attributes


def saved(folder: Path) -> Path:
    trained().save(folder / "model", exclude=["tensorboard_log"], include=["train_tasks"])
    return folder / "model.zip"


def loaded(folder: Path, **arguments: Any) -> POEMSAC:
    return POEMSAC.load(saved(folder), **arguments)


def without_its_module(folder: Path) -> float:
    (folder / "schedules.py").write_text("def rate(progress): return 1e-3")
    sys.path.insert(0, str(folder))
    made(learning_rate=importlib.import_module("schedules").rate).save(folder / "model")
    sys.path.remove(str(folder))
    del sys.modules["schedules"]
    others = {"learning_rate": 1e-5, "lr_schedule": lambda _: 1e-5}
    return POEMSAC.load(folder / "model", custom_objects=others).learning_rate


def with_its_parameters(_: Path) -> bool:
    other = made(seed=9)
    other.set_parameters(trained().get_parameters())
    return same(other.policy, trained().policy)


def with_its_buffer(folder: Path) -> int:
    model, other = learned(), made()
    model.save_replay_buffer(folder / "buffer")
    other.load_replay_buffer(folder / "buffer")
    return other.replay_buffer.size()


def in_memory(_: Path) -> bool:
    buffer = io.BytesIO()
    trained().save(buffer)
    buffer.seek(0)
    return same(POEMSAC.load(buffer).policy, trained().policy)


def policy_alone(folder: Path) -> bool:
    trained().policy.save(folder / "policy")
    return same(MlpPolicy.load(folder / "policy"), trained().policy)


def with_another_env(_: Path) -> int:
    model = learned()
    model.set_env(points(4))
    return model.learn(EPOCH, reset_num_timesteps=False).get_env().num_envs


def reseeded(seed: int) -> dict[str, th.Tensor]:
    model = learned()
    model.set_random_seed(seed)
    return parameters(model.learn(EPOCH))


@functools.cache
def adapted(model: str | None = None) -> AdaptedPolicy:
    """A policy of a model that ships, or of the one that is trained here; rows leave it as it is."""
    arguments: dict[str, Any] = {"n_queries": 2, "oracle": ReturnOracle(), "seed": 0}
    return PreferenceAdapter(model or trained(), POINT_GOAL, **arguments).adapt()


def kept(keep: Callable[[AdaptedPolicy], AdaptedPolicy]) -> bool:
    one = adapted()
    return np.array_equal(one.predict(OBS)[0], keep(one).predict(OBS)[0])


def in_a_file(folder: Path) -> bool:
    def keep(policy: AdaptedPolicy) -> AdaptedPolicy:
        policy.save(folder / "policy.safetensors")
        return AdaptedPolicy.load(folder / "policy.safetensors")

    return kept(keep)


FILES = [
    works("save and load", lambda f: same(loaded(f).policy, trained().policy)),
    works("load an env", lambda f: loaded(f, env=points(3)).learn(1).num_timesteps, EPOCH),
    works(
        "load custom_objects",
        lambda f: loaded(f, custom_objects={"learning_rate": 1e-5}).learning_rate,
        1e-5,
    ),
    works("load custom_objects of a module that is gone", without_its_module, 1e-5),
    works("load an argument", lambda f: loaded(f, gamma=0.5).gamma, 0.5),
    works(
        "print_system_info",
        lambda f: "PyTorch" in printed(lambda: loaded(f, print_system_info=True)),
    ),
    works("save to memory", in_memory),
    works("get_parameters", with_its_parameters),
    works("save_replay_buffer", with_its_buffer, EPOCH),
    works("policy.save", policy_alone),
    works("set_env", with_another_env, 4),
    works("get_vec_normalize_env", lambda _: trained().get_vec_normalize_env() is None),
    works("set_random_seed", lambda _: differing(reseeded(5), reseeded(5)), []),
    works("actor", lambda _: trained().actor is trained().policy.actor),
    works("critic_target", lambda _: not same(trained().critic, trained().critic_target)),
    works(
        "deepcopy of a policy", lambda _: same(copy.deepcopy(trained().policy), trained().policy)
    ),
    works("deepcopy of a model", lambda _: copy.deepcopy(trained()).learn(1).num_timesteps, EPOCH),
    works(
        "from_pretrained a name", lambda _: POEMSAC.from_pretrained("PointGoal").env_id, POINT_GOAL
    ),
    works(
        "pickle an adapted policy",
        lambda _: kept(lambda policy: pickle.loads(pickle.dumps(policy))),
    ),
    works("save an adapted policy", in_a_file),
    works(
        "print an adapted policy",
        lambda _: POINT_GOAL in repr(adapted()) and "0x" not in repr(adapted()),
    ),
]

# ---------------------------------------------------------------- predicting and evaluating


def evaluated(env: Any) -> bool:
    returns, lengths = evaluate_policy(adapted(), env, 4, return_episode_rewards=True)
    return lengths == [25] * 4 and -60 < np.mean(returns) < 0


PREDICT = [
    works("one observation", lambda _: trained().predict(OBS[0], np.zeros(5))[0].shape, (2,)),
    works(
        "episode_start",
        lambda _: trained().predict(OBS, np.zeros(5), np.ones(6, bool))[0].shape,
        (6, 2),
    ),
    works(
        "deterministic",
        lambda _: np.array_equal(
            *(trained().predict(OBS, np.zeros(5), deterministic=True)[0] for _ in "12")
        ),
    ),
    works("policy.predict", lambda _: trained().policy.predict(OBS, np.zeros(5))[0].shape, (6, 2)),
    works(
        "obs_to_tensor",
        lambda _: trained().policy(trained().policy.obs_to_tensor(OBS)[0]).shape,
        (6, 2),
    ),
    works("no observation", lambda _: trained().predict(OBS[:0], np.zeros(5))[0].shape, (0, 2)),
    works("adapted, no observation", lambda _: adapted().predict(OBS[:0])[0].shape, (0, 2)),
    works("evaluate_policy", lambda _: evaluated(points(2))),
    works("evaluate_policy with Monitor", lambda _: evaluated(Monitor(point()))),
]

# ---------------------------------------------------------------- environments


@pytest.fixture(autouse=True, scope="module")
def own_family() -> Iterator[None]:
    """A family of the user's own."""
    gym.register("Toy-v0", Toy, max_episode_steps=10)
    yield
    del gym.registry["Toy-v0"]


def on(env: Any) -> POEMSAC:
    model = made(env).learn(1)
    model.get_env().close()
    return model


def filmed(folder: Path, make: Callable[[str], Any]) -> list[str]:
    env = make(str(folder / "films"))
    env.reset()
    for _ in range(25):
        env.step(np.zeros((env.num_envs, 2)) if hasattr(env, "num_envs") else np.zeros(2))
    env.close()
    return [path.suffix for path in (folder / "films").glob("*.mp4")]


def recorder(folder: str) -> gym.Env:
    env = point(render_mode="rgb_array")
    return wrappers.RecordVideo(env, folder, disable_logger=True)


def vec_recorder(folder: str) -> VecVideoRecorder:
    env = points(2, env_kwargs={"render_mode": "rgb_array"})
    return VecVideoRecorder(env, folder, lambda step: step == 0, video_length=20)


def tasks(env: gym.Env, *calls: Callable[[Any], Any]) -> list[float]:
    """The tasks of two episodes after some calls."""
    for call in calls:
        call(env)
    seen = []
    for seed in (1, 2):
        env.reset(seed=seed)
        seen.append(float(env.get_wrapper_attr("task")[0]))
    return seen


def copies(env: gym.Env) -> gym.Env:
    return pickle.loads(pickle.dumps(copy.deepcopy(env)))


def copies_of_a_robot(_: Path) -> bool:
    env = gym.make(CHEETAH)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    copied, action = copies(env), env.action_space.sample()
    return np.array_equal(copied.step(action)[0], env.step(action)[0])


def film_of_a_question(folder: Path) -> bool:
    PreferenceAdapter(trained(), POINT_GOAL, render=True).ask().to_video(folder / "question.gif")
    return (folder / "question.gif").stat().st_size > 0


FETCH = "gymnasium_robotics:FetchReach-v4"
FORK = {"vec_env_cls": SubprocVecEnv, "vec_env_kwargs": {"start_method": "fork"}}
MADE = functools.partial(gym.make_vec, POINT_GOAL, 3)

ENVIRONMENTS = [
    works("an id", lambda _: on(POINT_GOAL).n_envs, N_TASKS),
    works("module:id", lambda _: on(f"poem_envs:{POINT_GOAL}").env_id, POINT_GOAL),
    works("gym.make", lambda _: on(point()).num_timesteps, EPOCH),
    works("max_episode_steps", lambda _: on(point(max_episode_steps=9)).horizon, 9),
    works("render_mode", lambda _: on(point(render_mode="rgb_array")).n_envs, 1),
    works("TimeLimit", lambda _: on(wrappers.TimeLimit(point().unwrapped, 25)).horizon, 25),
    works(
        "RecordEpisodeStatistics", lambda _: on(wrappers.RecordEpisodeStatistics(point())).n_envs, 1
    ),
    works("Monitor", lambda f: on(Monitor(point(), str(f / "a"))) and names(f), ["a.monitor.csv"]),
    works("DummyVecEnv", lambda _: on(DummyVecEnv([point] * 3)).n_envs, 3),
    works("make_vec_env", lambda f: on(points(4, seed=1, monitor_dir=f)) and len(names(f)), 4),
    works(
        "env_kwargs",
        lambda _: on(points(2, env_kwargs={"step_length": 0.1})).env_kwargs,
        {"step_length": 0.1},
    ),
    works("SubprocVecEnv", lambda _: on(points(2, **FORK)).n_envs, 2),
    works("TaskVecEnv", lambda _: on(points(4, vec_env_cls=TaskVecEnv)).n_envs, 4),
    works(
        "VecMonitor",
        lambda f: on(VecMonitor(DummyVecEnv([point]), str(f / "a"))) and names(f),
        ["a.monitor.csv"],
    ),
    works(
        "make_vec vector_entry_point",
        lambda _: on(MADE(vectorization_mode="vector_entry_point")).n_envs,
        3,
    ),
    works("make_vec sync", lambda _: on(MADE(vectorization_mode="sync")).n_envs, 3),
    works("GoalFamily", lambda _: made(GoalFamily(FETCH), n_train_tasks=2).horizon, 50),
    works(
        "TimeLimit around one's own family",
        lambda _: made(wrappers.TimeLimit(Toy(), 9)).learn(1).horizon,
        9,
    ),
    works("one's own family", lambda _: on(gym.make("Toy-v0")).horizon, 10),
    works("one's own family by its id", lambda _: on("Toy-v0").horizon, 10),
    works("RecordVideo", lambda f: filmed(f, recorder), [".mp4"]),
    works("VecVideoRecorder", lambda f: filmed(f, vec_recorder), [".mp4"]),
    works(
        "set_task", lambda _: tasks(point(), lambda env: sb3_poem.set_task(env, [1.25])), [1.25] * 2
    ),
    works(
        "get_wrapper_attr",
        lambda _: tasks(point(), lambda env: env.get_wrapper_attr("set_task")([1.25])),
        [1.25] * 2,
    ),
    works(
        "reset options",
        lambda _: tasks(point(), lambda env: env.reset(options={"task": [1.25]})),
        [1.25] * 2,
    ),
    works("reset seed", lambda _: tasks(point()) == tasks(point())),
    works("spec", lambda _: gym.spec(POINT_GOAL).max_episode_steps, 25),
    works("deepcopy", lambda _: tasks(copies(point())) == tasks(point())),
    works("deepcopy of a robot that has moved", copies_of_a_robot),
    works(
        "the adapter's environment",
        lambda _: PreferenceAdapter(trained(), POINT_GOAL).env.num_envs,
        1,
    ),
    works("adapt a name", lambda _: adapted(model="PointGoal").predict(OBS)[0].shape, (6, 2)),
    works("film a question", film_of_a_question),
]


def inside(wrapper: Any, *arguments: Any) -> POEMSAC:
    return on(wrapper(point(), *arguments))


def stacked(env: gym.Env, size: int) -> gym.Env:
    return wrappers.FlattenObservation(wrappers.FrameStackObservation(env, size))


REWARDS, OBSERVATIONS = "(?i)reward...(?i)wrap|without", "(?i)observation...(?i)wrap|without"
CHANGED = [
    refused("VecNormalize", lambda _: on(VecNormalize(points(2))), "VecNormalize...without it"),
    refused("VecFrameStack", lambda _: on(VecFrameStack(points(2), 4)), OBSERVATIONS),
    refused(
        "TransformReward", lambda _: inside(wrappers.TransformReward, lambda r: 10 * r), REWARDS
    ),
    refused(
        "NormalizeReward", lambda _: on(points(2, wrapper_class=wrappers.NormalizeReward)), REWARDS
    ),
    refused("NormalizeObservation", lambda _: inside(wrappers.NormalizeObservation), OBSERVATIONS),
    refused("FrameStackObservation", lambda _: inside(stacked, 2), OBSERVATIONS),
    refused(
        "ClipAction", lambda _: inside(wrappers.ClipAction), "(?i)action...(?i)wrap|without|bound"
    ),
    refused(
        "RescaleAction",
        lambda _: inside(wrappers.RescaleAction, np.float32(-2), np.float32(2)),
        "(?i)action...(?i)wrap|without",
    ),
    refused(
        "a dictionary of observations", lambda _: on(BitFlippingEnv(continuous=True)), "GoalFamily"
    ),
]

# ---------------------------------------------------------------- what would mislead


def best_model(folder: Path) -> None:
    evaluation = EvalCallback(points(1), None, None, 1, 25, folder, str(folder), verbose=0)
    called(evaluation)
    assert names(folder) == ["best_model.zip", "evaluations.npz"]


MISLEADING = [
    pytest.param(best_model, "AdaptationEvalCallback", id="EvalCallback"),
    pytest.param(
        lambda _: evaluate_policy(learned(), points(1), 1),
        "AdaptationEvalCallback|PreferenceAdapter",
        id="evaluate_policy",
    ),
    pytest.param(
        lambda _: PreferenceAdapter(made(), POINT_GOAL), "(?i)train", id="an untrained model"
    ),
]

# ---------------------------------------------------------------- the rows


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


WORKING = [*CONSTRUCTOR, *LEARN, *FILES, *PREDICT, *ENVIRONMENTS]


@pytest.mark.parametrize(("call", "outcome"), WORKING)
def test_works(call: Callable[[Path], Any], outcome: Any, tmp_path: Path) -> None:
    check_works(call, outcome, tmp_path)


@pytest.mark.parametrize(("call", "words", "error"), [*WITHOUT, *CHANGED])
def test_says_what_to_do_instead(call: Any, words: str, error: Any, tmp_path: Path) -> None:
    with pytest.raises(error) as caught:
        call(tmp_path)
    check_words(str(caught.value), words)


@pytest.mark.parametrize(("call", "words"), MISLEADING)
def test_warns(call: Callable[[Path], Any], words: str, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match=words):
        call(tmp_path)
