"""What people get wrong: an error at once that says what would be right, and nothing is written."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import uvicorn
from first_hour import Toy, check_words, config_file, foreign, made, refused, shell, trained
from meta_toys import EPOCH, POINT_GOAL, Walk, walks
from stable_baselines3.common.callbacks import CheckpointCallback

from poem_envs import GoalFamily, TaskFamily
from poem_envs.point_goal import PointGoalEnv
from poem_envs.testing import check_task_family
from sb3_poem import (
    ANOLE,
    PEARLSAC,
    POEMSAC,
    AdaptationEvalCallback,
    Bayes,
    BoltzmannOracle,
    HumanOracle,
    MAMLReward,
    MistakeOracle,
    Paper,
    PreferenceAdapter,
    ReturnOracle,
    RewardOracle,
    TaskVecEnv,
    TrainingCheckpointCallback,
)
from sb3_poem.adaptation import AdaptedPolicy, evaluate_adaptation
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.label import LabelWidget

NAN = float("nan")
OBS = np.zeros((3, 2))
CHEETAH = "poem/HalfCheetahVel-v0"
QUICK = 5.0  # seconds of the processor


class Boundless(Walk):
    task_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)


def argument(make: Callable[..., Any], name: str, value: Any, words: str = "") -> Any:
    """A row: an argument with a value that it cannot have, both of which the error names."""
    more = words and f"...{words}"
    row = f"{make.__name__} {name}={value!r}"
    return refused(row, lambda _: make(**{name: value}), f"{name}...{re.escape(str(value))}{more}")


def adapter(model: Any = None, env: Any = POINT_GOAL, **arguments: Any) -> PreferenceAdapter:
    return PreferenceAdapter(trained() if model is None else model, env, **arguments)


def asked() -> PreferenceAdapter:
    one = adapter(n_queries=1, rule=Bayes(n_particles=20), seed=0)
    one.ask()
    return one


def finished() -> PreferenceAdapter:
    one = asked()
    one.tell("left")
    return one


def moved_to(model: POEMSAC, stock: Path) -> PreferenceAdapter:
    return PreferenceAdapter.load(stock / "state.json", model, POINT_GOAL)


def pair() -> tuple[Any, Any]:
    query = asked().pending
    assert query is not None
    return query.left, query.right


def evaluated(tasks: Any = ((1.0,),), **options: Any) -> Any:
    arguments = {"record_at": [1], "n_episodes": 1, **options}
    return evaluate_adaptation(trained(), vec(), np.array(tasks), **arguments)


def vec() -> TaskVecEnv:
    return make_task_vec_env(POINT_GOAL, 2)


def policy(**kwargs: Any) -> POEMSAC:
    return made(policy_kwargs=kwargs)


class Unrewarded(Walk):
    """A family whose reward was forgotten."""

    _reward = TaskFamily._reward


class Untasked(Walk):
    """A family that does not say where its tasks lie."""

    task_space = property()  # type: ignore[assignment]


class Rowwise(Toy):
    """A family whose reward keeps the last dimension."""

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return super()._reward(tasks, features)[..., None]


class Informing(Toy):
    """A family whose step returns an info, as Gymnasium's."""

    def _simulate(self, action: np.ndarray) -> Any:
        return (*super()._simulate(action), {})


# ---------------------------------------------------------------- files

#: Configurations of a model's folder that somebody sent.
SPOILT: dict[str, dict[str, Any]] = {
    "importing": {"env_id": "this:Foo-v0"},
    "huge": {"net_arch": {"pi": [10**15]}},
    "endless": {"env_kwargs": {"max_episode_steps": 10**9}},
}
#: Entries of files of hyperparameters.
ENTRIES: dict[str, dict[str, Any]] = {
    "good": {},
    "stacked": {"frame_stack": 4},
    "wrapped": {"env_wrapper": "gymnasium.wrappers.NormalizeReward"},
    "normalized": {"normalize": True},
    "misspelt": {"latent_dims": 3},
    "seeded": {"seed": 3},
    "textual": {"learning_rate": "1e-3"},
}


@pytest.fixture(scope="module")
def stock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of all kinds."""
    folder = tmp_path_factory.mktemp("stock")
    for name, model in (
        ("poem", trained()),
        ("pearl", trained(PEARLSAC)),
        ("other", made(seed=5).learn(EPOCH)),
    ):
        model.save(folder / f"{name}.zip")
        model.save_pretrained(folder / name)
    foreign().save(folder / "sac.zip")
    trained().save_checkpoint(folder / "checkpoint.zip")
    finished().save(folder / "state.json")
    for name in ("text.zip", "text.json"):
        (folder / name).write_text("hello")
    for name, changes in SPOILT.items():
        shutil.copytree(folder / "poem", folder / name)
        config = json.loads((folder / name / "config.json").read_text())
        (folder / name / "config.json").write_text(json.dumps({**config, **changes}))
    shutil.copytree(folder / "poem", folder / "half")
    weights = folder / "half" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    for name, changes in ENTRIES.items():
        config_file(folder / name, **changes)
    (folder / "broken.yml").write_text("poem/PointGoal-v0: {policy: [")
    return folder


@contextlib.contextmanager
def quick_and_untouched(*folders: Path) -> Iterator[None]:
    """The folders are afterwards as they were, and little time has passed."""
    before, start = [listing(folder) for folder in folders], time.process_time()
    yield
    assert time.process_time() - start < QUICK
    assert [listing(folder) for folder in folders] == before


def listing(folder: Path) -> dict[str, int]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


# ---------------------------------------------------------------- POEMSAC, PEARLSAC

ALGORITHMS = [
    refused("policy misspelt", lambda _: POEMSAC("MlpPolcy", POINT_GOAL), "MlpPolcy...MlpPolicy"),
    refused("env misspelt", lambda _: made("poem/PointGaol-v0"), "PointGaol...PointGoal"),
    refused(
        "CartPole by id",
        lambda _: made("CartPole-v1"),
        "^(?!.*DummyVecEnv).*task family...TaskFamily",
    ),
    refused(
        "CartPole",
        lambda _: made(gym.make("CartPole-v1")),
        "^(?!.*DummyVecEnv).*task family...TaskFamily",
    ),
    refused("env a class", lambda _: made(PointGoalEnv), "env...class"),
    refused("env None", lambda _: made(None), "env...id|task family"),
    refused("env a list", lambda _: made([gym.make(POINT_GOAL)]), "env...list|DummyVecEnv"),
    refused("no _reward", lambda _: made(Unrewarded(), horizon=5), "Unrewarded..._reward"),
    refused("no task_space", lambda _: made(Untasked(), horizon=5), "Untasked...task_space"),
    argument(made, "horizon", 30, "25"),
    argument(made, "learning_rate", "1e-3"),
    argument(made, "learning_rate", NAN),
    argument(made, "batch_size", 0, "at least 1"),
    argument(made, "batch_size", 2.5),
    argument(made, "batch_size", "big"),
    argument(made, "gamma", 1.5, "at most 1"),
    argument(made, "ent_coef", "little", "auto"),
    argument(made, "ent_coef", -0.1),
    argument(made, "target_entropy", "low", "auto"),
    argument(made, "seed", -1),
    argument(made, "similarity", "dot", "two-encoder"),
    refused(
        "n_train_tasks",
        lambda _: made("poem/HalfCheetahFwdBack-v0", n_train_tasks=3),
        "n_train_tasks is 3...at most 2",
    ),
    refused("an argument misspelt", lambda _: made(preference_coeff=1.0), "'preference_coeff'"),
    refused(
        "of PEARLSAC", lambda _: made(context_relabel_fraction=0.5), "context_relabel_fraction"
    ),
    refused("net_arch outside", lambda _: made(net_arch=[8]), "net_arch...policy_kwargs"),
    refused("net_arch vf", lambda _: policy(net_arch={"vf": [8]}), r"net_arch...\['vf'\]...qf"),
    argument(policy, "activation_fn", "ReLU"),
    argument(policy, "net_arch", 64),
    refused("net_arch of SB3's past", lambda _: policy(net_arch=[{"pi": [8]}]), "net_arch...pi"),
    refused("policy_kwargs misspelt", lambda _: policy(netarch=[8]), "'netarch'...net_arch"),
    refused("widths outside", lambda _: policy(encoder=[8]), r"'encoder'...net_arch=dict\(encoder"),
    argument(made, "policy_kwargs", [64, 64]),
    argument(policy, "n_critics", 0, "at least 1"),
    argument(policy, "optimizer_class", "Adam", "must be a class"),
    argument(made, "seed", 2**32, str(2**32 - 1)),
    refused("set_random_seed", lambda _: made().set_random_seed(1.5), "`seed`...whole...1.5"),
    refused("load seed", lambda s: POEMSAC.load(s / "poem.zip", seed="1"), "`seed`...'1'"),
    refused(
        "tensorboard_log", lambda s: made(tensorboard_log=str(s / "text.zip")).learn(1), "text.zip"
    ),
    refused("learn a text", lambda _: made().learn("1000"), "total_timesteps...1000"),
    refused("learn misspelt", lambda _: made().learn(1, callbacks=[]), "callbacks"),
    refused("callback=3", lambda _: made().learn(1, callback=3), "callback must be...is 3"),
    refused("an environment", lambda _: POEMSAC.from_zoo(gym.make(POINT_GOAL)), "env_id...by env="),
    refused(
        "steps in words", lambda _: POEMSAC.from_zoo(POINT_GOAL, n_timesteps="many"), "n_timesteps"
    ),
    refused("steps below 0", lambda _: POEMSAC.from_zoo(POINT_GOAL, n_timesteps=-4), "n_timesteps"),
    refused(
        "tasks without bounds",
        lambda _: made(walks(2, Boundless), horizon=10),
        "task_space must be bounded",
    ),
    refused(
        "a callback's class",
        lambda _: made().learn(1, CheckpointCallback),
        "callback must be an object...class .*CheckpointCallback",
    ),
    refused(
        "functions in a list",
        lambda _: made().learn(1, [lambda *_: True]),
        "callback must be...list...function.*is .<function",
    ),
    refused(
        "set_env",
        lambda _: made().set_env(gym.make("Pendulum-v1")),
        "task family|spaces do not match",
    ),
    refused(
        "predict shape",
        lambda _: trained().predict(np.zeros(3)),
        r"observation has shape \(3,\)...\(2,\)",
    ),
    refused(
        "predict what reset returns",
        lambda _: trained().predict((OBS[0], {})),
        r"observation...obs, info = env\.reset\(\)",
    ),
    refused(
        "predict a dictionary",
        lambda _: AdaptedPolicy(trained(), np.zeros(5)).predict({"observation": OBS[0]}),
        r"observation...\(2,\)...dictionary",
    ),
    refused("predict NaN", lambda _: trained().predict(OBS * NAN), "observation 0 holds NaN"),
    refused("load nothing", lambda s: POEMSAC.load(s / "peom.zip"), r"no file.*peom\.zip$"),
    refused("load a SAC", lambda s: POEMSAC.load(s / "sac.zip"), "sac.zip...another algorithm"),
    refused(
        "load PEARLSAC",
        lambda s: POEMSAC.load(s / "pearl.zip"),
        "pearl.zip...holds a PEARLSAC, not a POEMSAC",
    ),
    refused("load a checkpoint", lambda s: POEMSAC.load(s / "checkpoint.zip"), "load_checkpoint"),
    refused("load and misspell", lambda s: POEMSAC.load(s / "poem.zip", gama=0.5), "gama"),
    refused(
        "load and another family",
        lambda s: POEMSAC.load(s / "poem.zip", CHEETAH),
        "spaces do not match|own family",
    ),
    refused(
        "load_checkpoint",
        lambda s: POEMSAC.load_checkpoint(s / "poem.zip"),
        "poem.zip...is a model, no checkpoint: use POEMSAC.load",
    ),
    refused("load_replay_buffer", lambda s: made().load_replay_buffer(s / "bufer"), "bufer"),
    refused("save in file", lambda s: trained().save(s / "text.zip" / "m"), "text.zip"),
    refused(
        "from_pretrained", lambda _: POEMSAC.from_pretrained("PointGaol"), "PointGaol...PointGoal"
    ),
    refused(
        "from_pretrained device",
        lambda _: POEMSAC.from_pretrained("PointGoal", device="gpu"),
        "^device gpu...cuda",
    ),
    refused("load device", lambda s: POEMSAC.load(s / "poem.zip", device="gpu"), "^device gpu"),
    refused(
        "from_pretrained of an id",
        lambda _: POEMSAC.from_pretrained("poem/PointGoal-v0"),
        "is an environment; the model that ships is 'PointGoal'",
    ),
    refused(
        "from_pretrained of a zip", lambda s: POEMSAC.from_pretrained(s / "poem.zip"), r"\bload\b"
    ),
    refused(
        "from_pretrained of PEARLSAC",
        lambda s: POEMSAC.from_pretrained(s / "pearl"),
        "PEARLSAC.from_pretrained",
    ),
    refused(
        "from_pretrained cut off",
        lambda s: POEMSAC.from_pretrained(s / "half"),
        "model.safetensors...truncated",
    ),
    refused(
        "from_pretrained endless",
        lambda s: adapter(POEMSAC.from_pretrained(s / "endless")),
        "max_episode_steps",
    ),
    refused("from_zoo", lambda _: POEMSAC.from_zoo("poem/PointGaol-v0"), "PointGaol...PointGoal"),
]

# ---------------------------------------------------------------- adapters and oracles

ADAPTERS = [
    refused("model of SB3", lambda _: adapter(foreign()), "model...SAC...POEMSAC"),
    refused("model misspelt", lambda _: adapter("PointGaol"), "PointGaol...PointGoal"),
    refused("model a class", lambda _: adapter(POEMSAC), "model...class POEMSAC"),
    refused("adapter env None", lambda _: adapter(env=None), "env...id...VecEnv"),
    refused(
        "adapter env misspelt", lambda _: adapter(env="poem/PointGaol-v0"), "PointGaol...PointGoal"
    ),
    refused(
        "env of another family", lambda _: adapter(env=CHEETAH), "observation_space...PointGoal"
    ),
    argument(adapter, "n_queries", 0, "at least 1"),
    argument(adapter, "n_queries", 2.5),
    argument(adapter, "n_queries", "ten"),
    argument(adapter, "rule", "bayes", r"rule=Bayes\(\)"),
    refused("rule a class", lambda _: adapter(rule=Paper), r"rule...class Paper...Paper\(\)"),
    argument(Bayes, "query_rule", "best", "information-gain"),
    argument(Bayes, "n_particles", 1, "2"),
    argument(Bayes, "candidates", "posterior", "aggregate"),
    argument(Bayes, "likelihood", "logistic", "decoder"),
    argument(Bayes, "decision", "mean", "posterior-mean"),
    argument(Bayes, "noise_model", 0.2, "NoiseModel|MistakeNoise"),
    argument(Paper, "n_candidates", 1, "2"),
    refused(
        "oracle a class",
        lambda _: adapter(oracle=ReturnOracle),
        r"oracle...class ReturnOracle...ReturnOracle\(\)",
    ),
    argument(adapter, "oracle", "return"),
    refused(
        "an oracle's environment by its id", lambda _: ReturnOracle(CHEETAH), r"env...gym\.make"
    ),
    argument(adapter, "seed", -1),
    refused("library empty", lambda _: adapter(library=[]), "library...2"),
    refused("adapter argument misspelt", lambda _: adapter(queries=5), "'queries'"),
    refused("tell before ask", lambda _: adapter().tell("left"), r"ask\(\)", error=RuntimeError),
    refused("tell a number", lambda _: asked().tell(1), "answer...left...1"),
    refused("tell another word", lambda _: asked().tell("better"), '"left"...better'),
    refused("ask when done", lambda _: finished().ask(), r"policy\(\)", error=RuntimeError),
    refused("adapt without an oracle", lambda _: adapter().adapt(), r"oracle...ask\(\)"),
    refused(
        "an oracle without an answer",
        lambda _: asked().adapt(lambda left, right: None),
        "answer...left...None...oracle return nothing",
    ),
    refused(
        "load misspelt",
        lambda s: PreferenceAdapter.load(s / "stat.json", trained(), POINT_GOAL),
        "stat.json",
    ),
    refused(
        "adapter load a text",
        lambda s: PreferenceAdapter.load(s / "text.json", trained(), POINT_GOAL),
        "text.json is not",
    ),
    refused("load elsewhere", lambda s: moved_to(POEMSAC.load(s / "other.zip"), s), "weights"),
    argument(ANOLE, "strategy", "best", "berlekamp"),
    argument(ANOLE, "mistake_rate", 0.7, r"0\.5"),
    refused(
        "ANOLE without experience",
        lambda s: adapter(POEMSAC.load(s / "poem.zip"), rule=ANOLE()),
        "load_replay_buffer",
    ),
    refused(
        "MAML of POEMSAC",
        lambda _: adapter(rule=MAMLReward()),
        "MAMLRewardModel...meta_train_reward",
    ),
    refused("RewardOracle of POEMSAC", lambda _: adapter(rule=RewardOracle()), "PEARLSAC"),
    refused(
        "RewardOracle n_queries",
        lambda _: adapter(trained(PEARLSAC), rule=RewardOracle(), n_queries=2.5),
        "n_queries...2.5",
    ),
    refused(
        "ReturnOracle without env",
        lambda _: ReturnOracle()(*pair()),
        r"bind\(env\)",
        error=RuntimeError,
    ),
    refused(
        "ReturnOracle's task",
        lambda _: ReturnOracle(vec(), task=[1.0, 2.0])(*pair()),
        r"task...\(2,\)",
    ),
    argument(BoltzmannOracle, "beta", -1.0, "above 0"),
    argument(MistakeOracle, "rate", 1.5, "at most 1"),
    argument(HumanOracle, "video_format", "avi", "gif"),
    refused("HumanOracle without frames", lambda _: HumanOracle()(*pair()), "render_mode"),
    refused(
        "evaluate with an object",
        lambda _: evaluated(oracle_factory=ReturnOracle()),
        "oracle_factory...ReturnOracle",
    ),
    refused(
        "a factory of nothing",
        lambda _: evaluated(oracle_factory=lambda **_: None),
        "oracle_factory...None",
    ),
    refused("no tasks", lambda _: evaluate_adaptation(trained(), vec(), 0), "tasks...0"),
    refused(
        "an observation without its dimension",
        lambda _: AdaptedPolicy(trained(), np.zeros(5)).predict(None),
        "observation",
        ValueError,
    ),
    refused(
        "evaluate tasks", lambda _: evaluated(tasks=[[1.0, 2.0]]), r"\(n_tasks, 1\)...\(1, 2\)"
    ),
    argument(evaluated, "record_at", (), "at least one"),
    refused("AdaptedPolicy of nothing", lambda s: AdaptedPolicy.load(s / "no"), "no such file"),
    refused(
        "AdaptedPolicy of a text",
        lambda s: AdaptedPolicy.load(s / "text.zip"),
        "text.zip is truncated",
    ),
    refused(
        "AdaptedPolicy's latent",
        lambda _: AdaptedPolicy(trained(), np.zeros(3)),
        r"latent...\(3,\)...\(5,\)",
    ),
]

# ---------------------------------------------------------------- environments, callbacks, tools


def began(action: Any = None, **arguments: Any) -> None:
    env = gym.make(POINT_GOAL)
    env.reset(seed=0, **arguments)
    env.step(action)


TOOLS = [
    refused("gym.make", lambda _: gym.make(POINT_GOAL, step_size=0.1), "step_size"),
    refused(
        "render_mode",
        lambda _: gym.make(POINT_GOAL, render_mode="ansi"),
        "render_mode...'ansi'...rgb_array",
    ),
    refused("reset's options", lambda _: began(options={"goal": 1}), "goal...task"),
    refused("a task outside", lambda _: began(options={"task": [9.0]}), "task...9.0...inside"),
    refused("a task of NaN", lambda _: began(options={"task": [NAN]}), "task...nan...finite"),
    refused("an action outside", lambda _: began(np.full(2, 3.0)), r"action...3.0...\[-1, 1\]"),
    refused("an action of NaN", lambda _: began(np.full(2, NAN)), "action...nan...finite"),
    refused(
        "TaskVecEnv of environments",
        lambda _: TaskVecEnv([gym.make(POINT_GOAL)]),
        "env_fns...function",
    ),
    refused(
        "TaskVecEnv's tasks", lambda _: vec().set_tasks([[1.0]]), r"tasks...\(1, 1\)...\(2, 1\)"
    ),
    argument(AdaptationEvalCallback, "every", 0, "at least 1"),
    refused(
        "AdaptationEvalCallback as EvalCallback",
        lambda _: AdaptationEvalCallback(vec()),
        "every...whole number...TaskVecEnv",
    ),
    argument(AdaptationEvalCallback, "n_tasks", 0, "at least 1"),
    argument(AdaptationEvalCallback, "record_at", (), "at least one"),
    refused(
        "AdaptationEvalCallback's options",
        lambda _: AdaptationEvalCallback(adaptation_kwargs={"inference": "paper"}),
        "inference...rule|rule...inference",
    ),
    refused(
        "AdaptationEvalCallback on SAC",
        lambda _: foreign().learn(1, AdaptationEvalCallback()),
        r"POEMSAC...\bSAC",
    ),
    refused(
        "AdaptationEvalCallback unregistered",
        lambda _: unregistered(AdaptationEvalCallback(1, 1)),
        "registered",
    ),
    refused(
        "TrainingCheckpointCallback",
        lambda s: made().learn(1, TrainingCheckpointCallback(s / "poem")),
        "poem",
    ),
    refused("GoalFamily of Pendulum", lambda _: GoalFamily("Pendulum-v1"), "desired_goal"),
    refused(
        "check a reward of another shape",
        lambda _: check_task_family(Rowwise),
        r"_reward...\(1,\)",
        error=AssertionError,
    ),
    refused(
        "check four values",
        lambda _: check_task_family(Informing),
        "_simulate must return three values",
        error=AssertionError,
    ),
    refused("check an object", lambda _: check_task_family(Toy()), "env...class...id"),
    refused(
        "LabelWidget of a model",
        lambda _: LabelWidget(trained()),
        "adapter...PreferenceAdapter...POEMSAC",
    ),
    refused("LabelWidget without images", lambda _: LabelWidget(adapter()), "render_mode"),
]


def unregistered(callback: Any) -> Any:
    return made(walks(2), horizon=10).learn(1, callback)


# ---------------------------------------------------------------- the command line


def command(words: str, *arguments: Any) -> Any:
    """A row.

    :param words: As those of :func:`refused`
    :param arguments: Those of ``sb3-poem``; what begins with ``stock/`` is in the folder of files
    """
    name = " ".join(map(str, arguments[:1] + arguments[-2:] if len(arguments) > 2 else arguments))
    return pytest.param(arguments, words, id=name)


TRAIN = ("train", "--env", POINT_GOAL, "-c", "stock/good/my.yml", "--eval-freq", -1)
ADAPT = ("adapt", "--model", "stock/poem", "--queries", 1, "--tasks", 1, "--episodes", 1)
BENCHMARK = ("benchmark", "run", "--suite", "smoke", "--list")

COMMANDS = [
    command("train...adapt"),
    command("'trian'...train", "trian"),
    command("PointGaol...PointGoal", *TRAIN, "--env", "poem/PointGaol-v0"),
    command("CartPole-v1 is no task family", *TRAIN, "--env", "CartPole-v1"),
    command("--algo...poem_sac", *TRAIN, "--algo", "poem"),
    command("-n...many", *TRAIN, "-n", "many"),
    command("kl_coef:abc...abc", *TRAIN, "-params", "kl_coef:abc"),
    command("'gama'...'gamma'", *TRAIN, "-params", "gama:0.9"),
    command("-params...gamma=0.9", *TRAIN, "-params", "gamma=0.9"),
    command("missing.yml", *TRAIN, "-c", "missing.yml"),
    command("broken.yml is not valid YAML", *TRAIN, "-c", "stock/broken.yml"),
    command("poem/AntVel-v0", *TRAIN, "--env", "poem/AntVel-v0"),
    command("frame_stack...my.yml", *TRAIN, "-c", "stock/stacked/my.yml"),
    command("env_wrapper...my.yml", *TRAIN, "-c", "stock/wrapped/my.yml"),
    command("normalize...my.yml", *TRAIN, "-c", "stock/normalized/my.yml"),
    command("'latent_dims'...'latent_dim'", *TRAIN, "-c", "stock/misspelt/my.yml"),
    command("'seed'...--seed", *TRAIN, "-c", "stock/seeded/my.yml"),
    command("learning_rate...write 0.001", *TRAIN, "-c", "stock/textual/my.yml"),
    command("--env is missing", "train", "--seed", 0),
    command("missing.zip", *TRAIN, "-i", "missing.zip"),
    command("text.zip is truncated", *TRAIN, "-i", "stock/text.zip"),
    command("pearl.zip holds", *TRAIN, "-i", "stock/pearl.zip"),
    command("text.zip", *TRAIN, "-f", "stock/text.zip/logs"),
    command("colour", *TRAIN, "--env-kwargs", "colour:3"),
    command("--gym-packages...nothing_like_it", *TRAIN, "--gym-packages", "nothing_like_it"),
    command("gpu...cuda", *TRAIN, "--device", "gpu"),
    command("--colour", *TRAIN, "--colour", "red"),
    command("--resume...-i", *TRAIN, "--resume", "-i", "stock/poem.zip"),
    command("logs", "enjoy", "--no-render", "--env", POINT_GOAL),
    command("--model", "adapt"),
    command("PointGaol...PointGoal", *ADAPT, "--model", "PointGaol"),
    command("missing.zip: there is no such file", *ADAPT, "--model", "missing.zip"),
    command("text.zip is truncated", *ADAPT, "--model", "stock/text.zip"),
    command("sac.zip...another algorithm", *ADAPT, "--model", "stock/sac.zip"),
    command("this:Foo", *ADAPT, "--model", "stock/importing"),
    command("net_arch", *ADAPT, "--model", "stock/huge"),
    command("--env poem/HalfCheetahVel-v0...PointGoal", *ADAPT, "--env", CHEETAH),
    command("--oracle...'coin'...return", *ADAPT, "--oracle", "coin"),
    command("--queries...at least 1", *ADAPT, "--queries", 0),
    command("--queries...2.5", *ADAPT, "--queries", 2.5),
    command("task...99", *ADAPT, "--task", 99.0),
    command("--task needs 1 number", *ADAPT, "--task", 1.0, 2.0),
    command("--record 6...--queries 1", *ADAPT, "--record", 6),
    command(
        "--mistake-rate...from 0 to 0.5...1.5", *ADAPT, "--oracle", "mistake", "--mistake-rate", 1.5
    ),
    command("--env-kwargs nonsense...KEY:VALUE", *ADAPT, "--env-kwargs", "nonsense"),
    command("--gym-packages...nothing_like_it", *ADAPT, "--gym-packages", "nothing_like_it"),
    command("gpu...cuda", *ADAPT, "--device", "gpu"),
    command("--json a.txt....json", *ADAPT, "--json", "a.txt"),
    command("--video a.avi....mp4", *ADAPT, "--video", "a.avi"),
    command("--port...99999999...65535", "label", "--port", 99999999),
    command("--auth...12", "label", "--auth", "me:short"),
    command("--host...--token", "label", "--host", "0.0.0.0"),
    command("PointGaol...PointGoal", "label", "--model", "PointGaol"),
    command("--seed...63...9999999999999999999", "label", "--seed", 10**19 - 1),
    command("--store...text.zip/answers", "label", "--store", "stock/text.zip/answers"),
    command("--mistake-rate...from 0 to 0.5...2", "label", "--mistake-rate", 2),
    command("pairs...graded", "label", "--inference", "paper", "--question", "graded"),
    command("pairs...best-of-four", *ADAPT, "--inference", "paper", "--question", "best-of-four"),
    command(
        "worst-case...pairs", *ADAPT, "--query-rule", "worst-case", "--question", "best-of-four"
    ),
    command("--store...no answers", "label", "export", "--out", "a.jsonl"),
    command("--out a.csv....jsonl", "label", "export", "--out", "a.csv"),
    command("--store...no answers", "label", "replay"),
    command("--suite...'table4'...table3", "benchmark", "run", "--suite", "table4"),
    command("Nowhere", *BENCHMARK, "--families", "Nowhere"),
    command("anol:...anole", *BENCHMARK, "--methods", "anol"),
    command("--model nonsense...FAMILY:VARIANT:SEED=PATH", *BENCHMARK, "--model", "nonsense"),
    command("benchmark.sqlite", "benchmark", "report", "--suite", "smoke"),
    command("PointGaol...PointGoal", "record-video", "--out", "a.gif", "--model", "PointGaol"),
]


# ---------------------------------------------------------------- the rows


@pytest.fixture(autouse=True)
def no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that should have been refused ends the row instead of waiting for people."""
    monkeypatch.setattr(uvicorn.Server, "run", lambda *_, **__: pytest.fail("the page was served"))


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(("call", "words", "error"), [*ALGORITHMS, *ADAPTERS, *TOOLS])
def test_a_wrong_call(call: Any, words: str, error: Any, stock: Path, tmp_path: Path) -> None:
    with quick_and_untouched(stock, tmp_path), pytest.raises(error) as caught:
        call(stock)
    check_words(str(caught.value), words)


@pytest.mark.parametrize(("arguments", "words"), COMMANDS)
def test_a_wrong_command(arguments: Any, words: str, stock: Path, tmp_path: Path) -> None:
    given = [re.sub("^stock/", f"{stock}/", str(argument)) for argument in arguments]
    with quick_and_untouched(stock, tmp_path):
        status, _, err = shell(*given)
    assert status in (1, 2)
    _, found, message = err.rpartition(": error: ")
    assert found, err
    sentence, *rest = message.strip().splitlines()
    assert not rest or rest == ["(SB3_POEM_TRACEBACK=1 shows where it was raised)"]
    check_words(sentence, words)


def test_a_person_who_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Standard input is closed."""
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    status, _, err = shell("adapt", "--model", "PointGoal", "--oracle", "human", "--queries", 1)
    assert status == 1
    check_words(err, "error: ...standard input")
