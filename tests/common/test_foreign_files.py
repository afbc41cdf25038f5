"""Models' files from somebody who means harm: each is refused with a message, soon, and nothing of
theirs is run.
"""

from __future__ import annotations

import itertools
import json
import math
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from meta_toys import ARCH, POINT_GOAL, Walk, small
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from sb3_poem import PEARLSAC, POEMSAC, Bayes, PreferenceAdapter, cli
from sb3_poem.adaptation import AdaptedPolicy
from sb3_poem.common.foreign import environment_of
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.label.families import find_models
from sb3_poem.loading import load_model

ADAPT = ["--queries", "1", "--tasks", "1", "--episodes", "1", "--record", "0"]
FORMAT = "sb3_poem pretrained 2"
NAN = float("nan")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sound model, and an adapted policy of it beside."""
    folder = tmp_path_factory.mktemp("sound")
    model = small(POEMSAC)
    model.save_pretrained(folder / "model")
    AdaptedPolicy(model, np.zeros(5), 3).save(folder / "policy.safetensors")
    return folder


@pytest.fixture
def folder(sound: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    shutil.copytree(sound, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module ``trap`` in the working folder, and the file that it would write if it were
    imported.
    """
    (tmp_path / "trap.py").write_text(
        "from pathlib import Path\nPath(__file__).with_name('sprung').touch()\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path / "sprung"


@contextmanager
def refused(message: str, error: type[Exception] = ValueError) -> Iterator[None]:
    """The block ends with this error, within a second and a half of computing."""
    started = time.process_time()
    with pytest.raises(error, match=message):
        yield
    assert time.process_time() - started < 1.5


def spoil(folder: Path, changes: dict[str, Any], arguments: dict[str, Any] | None = None) -> None:
    """Change the configuration of the model, and of the adapted policy."""
    config = json.loads((folder / "model" / "config.json").read_text())
    config |= changes
    config["arguments"] |= arguments or {}
    text = json.dumps(config)
    (folder / "model" / "config.json").write_text(text)
    policy = folder / "policy.safetensors"
    tensors = load_file(policy)
    with safe_open(policy, "pt") as file:
        facts = file.metadata()
    save_file(tensors, policy, {**facts, "config": text})


READERS: dict[str, Callable[[Path], Any]] = {
    "from_pretrained": lambda folder: POEMSAC.from_pretrained(folder / "model"),
    "load_model": lambda folder: load_model(folder / "model"),
    "AdaptedPolicy": lambda folder: AdaptedPolicy.load(folder / "policy.safetensors"),
}


def test_the_working_folder_may_be_the_models(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder / "model")
    assert load_model(".").digest == load_model(folder / "model").digest


def test_a_sound_file_is_read(folder: Path) -> None:
    spoil(folder, {"card": {"note": "of somebody else"}})
    for read in READERS.values():
        read(folder)


@pytest.mark.parametrize(
    "env_id",
    [
        "trap:Foo-v0",
        "trap:poem/PointGoal-v0",
        "../trap",
        ["trap"],
        3,
        "poem/PointGoal-v0\n",
        "x" * 1000,
    ],
)
def test_an_id_imports_nothing(folder: Path, trap: Path, env_id: Any) -> None:
    spoil(folder, {"env_id": env_id})
    for read in (*READERS.values(), lambda folder: find_models(str(folder))):
        with refused("env_id is .* must be a plain one"):
            read(folder)
    assert not trap.exists()


def test_the_command_line_imports_nothing(
    folder: Path, trap: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(folder, {"env_id": "trap:Foo-v0"})
    model = POEMSAC.load(small_zip(folder, env_id="trap:Foo-v0"))
    assert (
        model.env_id == "trap:Foo-v0"
    )  # it may still be used on an environment that the user names
    model.save_checkpoint(folder / "checkpoint.zip")
    for name in ("model", "model.zip", "checkpoint.zip"):
        assert cli.main(["adapt", "--model", str(folder / name), *ADAPT]) == 1
        assert "env_id is 'trap:Foo-v0'" in capsys.readouterr().err
    assert (
        cli.main(["label", "--model", str(folder / "model"), "--store", str(folder / "store")]) == 1
    )
    assert "env_id is 'trap:Foo-v0'" in capsys.readouterr().err
    assert not trap.exists()
    # the user's own word is another matter
    words = ["--env", "trap:poem/PointGoal-v0", "--no-render", "--queries", "1", "--episodes", "1"]
    assert cli.main(["enjoy", "--model", str(folder / "model.zip"), *words]) == 0
    assert trap.exists()


def small_zip(folder: Path, **attributes: Any) -> Path:
    model = small(POEMSAC)
    for name, value in attributes.items():
        setattr(model, name, value)
    model.save(folder / "model.zip")
    return folder / "model.zip"


def test_a_saved_adaptation_names_no_environment_to_make(trap: Path) -> None:
    model, env = small(POEMSAC), make_task_vec_env(POINT_GOAL, 1)
    data = PreferenceAdapter(model, env, seed=0, rule=Bayes(n_particles=10)).to_dict()
    data["model"]["env_id"] = "trap:Foo-v0"
    with refused("saved with a model for trap:Foo-v0, but this one is for poem/PointGoal-v0"):
        PreferenceAdapter.from_json(json.dumps(data), model, env)
    with refused("not a saved adaptation"):
        PreferenceAdapter.from_json("[" * 100_000, model, env)
    assert not trap.exists()


CHEETAH, ANT = "poem/HalfCheetahVel-v0", "poem/AntVel-v0"
REFUSED_ARGUMENTS = [
    (CHEETAH, {"xml_file": "/etc/passwd"}, "names another file"),
    (CHEETAH, {"xml_file": "humanoid.xml"}, "names another file"),
    (CHEETAH, {"width": 100_000}, "does not say how it is drawn"),
    (CHEETAH, {"camera_name": "track"}, "does not say how it is drawn"),
    (
        CHEETAH,
        {"max_episode_steps": 1e9},
        "no such argument, it has ctrl_cost_weight, .*frame_skip",
    ),
    (CHEETAH, {"nthread": 10_000}, "no such argument"),
    (CHEETAH, {"observation_space": 3}, "no such argument"),
    (CHEETAH, {"self": 3}, "no such argument"),
    (CHEETAH, {"frame_skip": 10**9}, "must be the like of 5: .*no number more than 100 times"),
    (CHEETAH, {"frame_skip": 2.5}, "must be the like of 5"),
    (CHEETAH, {"frame_skip": True}, "must be the like of 5"),
    (CHEETAH, {"ctrl_cost_weight": NAN}, "must be the like of 0.05"),
    (CHEETAH, {"ctrl_cost_weight": -math.inf}, "must be the like of 0.05"),
    (CHEETAH, {"ctrl_cost_weight": "1"}, "must be the like of 0.05"),
    (CHEETAH, {"ctrl_cost_weight": {"a": 1}}, "must be the like of 0.05"),
    (CHEETAH, {"ctrl_cost_weight": [1.0]}, "must be the like of 0.05"),
    ("poem/MetaWorldML1-v0", {"split": "../train"}, "must be the like of 'train'"),
    ("poem/MetaWorldML1-v0", {"split": "x" * 10_000}, "must be the like of 'train'"),
    (ANT, {"healthy_z_range": [0.0] * 100_000}, "must be the like of .0.2, 1.0."),
    (ANT, {"healthy_z_range": [0.0, 1e9]}, "must be the like of .0.2, 1.0."),
    (ANT, {"healthy_z_range": [[[0.0]]]}, "must be the like of .0.2, 1.0."),
    ("poem/MetaWorldML1-v0", {"env_name": "../../reach"}, "must be the like of 'reach'"),
    ("poem/FetchReach-v0", {"env": "trap:Foo-v0"}, "no such argument"),
    ("poem/FetchReach-v0", {"set_goal": {"module": "trap"}}, "must be numbers or words"),
    ("poem/FetchReach-v0", {"goal_low": [1e300] * 3}, "must be numbers or words"),
    ("CartPole-v1", {"render_mode": "human"}, "does not say how it is drawn"),
]


@pytest.mark.parametrize(("env_id", "env_kwargs", "message"), REFUSED_ARGUMENTS)
def test_arguments_that_a_file_may_not_give(
    folder: Path, trap: Path, env_id: str, env_kwargs: dict[str, Any], message: str
) -> None:
    spoil(folder, {"env_id": env_id, "env_kwargs": env_kwargs})
    with refused(
        f"model asks for {env_id} with {next(iter(env_kwargs))}=.*{message}.*say so yourself: "
        "--env-kwargs"
    ):
        find_models(str(folder))
    assert not trap.exists()


@pytest.mark.parametrize(
    "env_kwargs", [{"width": 10**5}, {"max_episode_steps": 1e9}, {"step_length": [[1]]}, [1], 3]
)
def test_the_command_line_makes_no_such_environment(
    folder: Path, env_kwargs: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(folder, {"env_kwargs": env_kwargs})
    assert cli.main(["adapt", "--model", str(folder / "model"), *ADAPT]) == 1
    said = capsys.readouterr().err
    assert "asks for poem/PointGoal-v0 with" in said or "env_kwargs must be an object" in said


@pytest.mark.parametrize(
    ("env_id", "env_kwargs"),
    [
        (CHEETAH, {"ctrl_cost_weight": 0.2, "frame_skip": 4, "reset_noise_scale": 0}),
        (ANT, {"healthy_z_range": [0.3, 1.2], "terminate_when_unhealthy": False}),
        ("poem/MetaWorldML1-v0", {"env_name": "door-open", "split": "test"}),
        (
            "poem/FetchReach-v0",
            {"reward_type": "sparse", "goal_low": [1.0, 0.5, 0.4], "observe_achieved_goal": True},
        ),
    ],
)
def test_a_familys_own_arguments(env_id: str, env_kwargs: dict[str, Any]) -> None:
    chosen, arguments = environment_of("a model", env_id, env_kwargs)
    assert chosen == env_id
    assert {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in arguments.items()
    } == env_kwargs


def test_what_the_user_says_is_taken() -> None:
    theirs = {"xml_file": "/etc/passwd", "width": 10**5, "frame_skip": 4}
    given = {"xml_file": "mine.xml", "width": 64}
    assert environment_of("a model", CHEETAH, theirs, None, given) == (
        CHEETAH,
        {**given, "frame_skip": 4},
    )
    assert environment_of("a model", "trap:Foo-v0", theirs, ANT, given) == (ANT, given)
    with pytest.raises(ValueError, match="--env is needed: a model does not say"):
        environment_of("a model", None, {})


def test_a_model_keeps_what_its_environment_was_made_with_beyond_its_registration(
    tmp_path: Path,
) -> None:
    def register(**kwargs: Any) -> None:
        gym.register("test/Edge-v0", Walk, max_episode_steps=5, kwargs=kwargs)

    try:
        for registered, given in (
            ({"edge": 3.0}, {}),
            ({}, {"edge": 3.0}),
            ({"edge": 2.0}, {"edge": 3.0}),
        ):
            register(**registered)
            small(POEMSAC, make_task_vec_env("test/Edge-v0", 1, **given)).save_pretrained(tmp_path)
            assert dict(find_models(str(tmp_path))[0].env_kwargs) == given
    finally:
        del gym.registry["test/Edge-v0"]


HUGE = 10**7
REFUSED_NUMBERS: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    (
        {"net_arch": {**ARCH, "pi": [HUGE, HUGE]}},
        {},
        r"make the tensor policy.actor.mlp.hidden.0.weight \(10000000, 7\), but it is \(32, 7\)",
    ),
    ({"net_arch": {**ARCH, "embedding": [HUGE**3]}}, {}, "does not hold a complete POEMSAC"),
    ({"net_arch": {**ARCH, "qf": [1] * 100_000}}, {}, "ask for .* layers, but there are"),
    ({"net_arch": {**ARCH, "pi": [32.0]}}, {}, "`net_arch` must be a whole number, but is 32.0"),
    ({"net_arch": {**ARCH, "pi": [-1]}}, {}, "`net_arch` must be at least 1"),
    ({"net_arch": [HUGE, HUGE]}, {}, "does not hold a complete POEMSAC"),
    ({"n_critics": 10**9}, {}, "ask for .* layers, but there are"),
    ({"n_critics": -1}, {}, "`n_critics` must be at least 1"),
    ({}, {"latent_dim": 10**9}, "`latent_dim` must be at most"),
    ({}, {"latent_dim": 10**6}, r"tensor latent_means \(12, 1000000\), but it is \(12, 5\)"),
    ({}, {"latent_dim": 4}, r"tensor latent_means \(12, 4\), but it is \(12, 5\)"),
    ({}, {"n_train_tasks": 10**5}, "`n_train_tasks` is 100000, but there are 12 train_tasks"),
    ({}, {"buffer_size": 10**15}, "`buffer_size` must be at most"),
    ({}, {"buffer_size": 1e15}, "`buffer_size` must be a whole number"),
    ({}, {"batch_size": 10**12}, "`batch_size` must be at most"),
    ({}, {"context_size": 10**12}, "`context_size` must be at most"),
    ({}, {"trajectories_per_task": 10**12}, "`trajectories_per_task` must be at most"),
    ({}, {"horizon": 10**12}, "`horizon` must be at most"),
    ({}, {"horizon": 1e12}, "`horizon` must be a whole number"),
    ({}, {"kl_coef": NAN}, "`kl_coef` must be a finite number, but is nan"),
    ({}, {"seed": -1}, "does not hold a complete POEMSAC"),
    (
        {},
        {"tensorboard_log": "logs"},
        "`tensorboard_log` is no argument that a model is saved with",
    ),
    ({}, {"policy_kwargs": {"net_arch": [HUGE]}}, "`policy_kwargs` is no argument"),
    ({"n_envs": 10**9}, {}, "`n_envs` must be at most 10000"),
    ({"n_envs": 1e9}, {}, "`n_envs` must be a whole number"),
    ({"reward_feature_dim": 10**9}, {}, "`reward_feature_dim` must be at most"),
    ({"num_timesteps": "many"}, {}, "`num_timesteps` must be a whole number"),
    ({"activation_fn": "init"}, {}, "'init' is no Module of torch.nn"),
    ({"activation_fn": "Transformer"}, {}, "does not hold a complete POEMSAC"),
    ({"optimizer_class": "lr_scheduler"}, {}, "'lr_scheduler' is no Optimizer of torch.optim"),
    ({"optimizer_kwargs": {"params": []}}, {}, "does not hold a complete POEMSAC"),
    ({"observation_space": {"dtype": "S1000000000"}}, {}, "does not hold a complete POEMSAC"),
    ({"algorithm": ["POEMSAC"]}, {}, "names no algorithm"),
    ({"algorithm": "SAC"}, {}, "holds a SAC"),
    ({"arguments": {}, "card": [1]}, {}, "card must be an object"),
    (
        {"format": "sb3_poem pretrained 1"},
        {},
        f"its format is 'sb3_poem pretrained 1', expected '{FORMAT}'",
    ),
]


@pytest.mark.parametrize(("changes", "arguments", "message"), REFUSED_NUMBERS)
def test_numbers_that_do_not_fit(
    folder: Path, changes: dict[str, Any], arguments: dict[str, Any], message: str
) -> None:
    spoil(folder, changes, arguments)
    for read in READERS.values():
        with refused(message):
            read(folder)


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"format": ' + "[" * 100_000, '{"a": ' + "9" * 10_000 + "}", "null", ""],
)
def test_json_that_only_looks_small(folder: Path, text: str) -> None:
    (folder / "model" / "config.json").write_text(text)
    for read in (
        READERS["from_pretrained"],
        READERS["load_model"],
        lambda folder: find_models(str(folder)),
    ):
        with refused("config.json is (truncated, or no configuration|not of this version)"):
            read(folder)
    policy = folder / "policy.safetensors"
    save_file(
        load_file(policy),
        policy,
        {"format": "sb3_poem adapted policy 2", "config": text, "n_answers": "1"},
    )
    with refused("policy.safetensors is (truncated, or no configuration|not of this version)"):
        AdaptedPolicy.load(policy)


@pytest.mark.parametrize(
    ("latent", "n_answers"),
    [(np.zeros(4), "3"), (np.full(5, np.nan), "3"), (np.zeros(5), "9" * 5000), (np.zeros(5), "-1")],
)
def test_a_broken_adapted_policy(folder: Path, latent: np.ndarray, n_answers: str) -> None:
    policy = folder / "policy.safetensors"
    with safe_open(policy, "pt") as file:
        facts = file.metadata()
    save_file(
        {**load_file(policy), "latent": th.as_tensor(latent)},
        policy,
        {**facts, "n_answers": n_answers},
    )
    with refused(
        "policy.safetensors is broken: "
        "(`latent` has shape|`latent` must be finite|n_answers must be a whole number)"
    ):
        AdaptedPolicy.load(policy)


def test_files_of_the_wrong_kind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    Path("text.zip").write_text("I am no archive")
    Path("empty").mkdir()
    th.save({"a": th.zeros(3)}, "weights.zip")
    for read, name in itertools.product((load_model, POEMSAC.load), ("text.zip", "weights.zip")):
        with refused(f"{name} is truncated, or no model saved by POEMSAC"):
            read(name)
    for read in (load_model, POEMSAC.from_pretrained):
        with refused("empty is no folder of a pretrained model", FileNotFoundError):
            read("empty")
    with refused("use POEMSAC.from_pretrained\\('model'\\)"):
        POEMSAC.load("model")
    with refused(
        "HalfCheetahVel is the name of a model that ships: "
        r"use PEARLSAC.from_pretrained\('HalfCheetahVel'\)"
    ):
        PEARLSAC.load("HalfCheetahVel")
    with refused("model.zip: there is no such file or folder", FileNotFoundError):
        POEMSAC.from_pretrained("model.zip")
    with refused("text.zip is a file, but must be the folder of a model", FileNotFoundError):
        POEMSAC.from_pretrained("text.zip")
    with refused("did you mean 'HalfCheetahVel'", FileNotFoundError):
        POEMSAC.from_pretrained("HalfCheetahVell")
    with refused("HalfCheetahVel holds a POEMSAC; load it with POEMSAC.from_pretrained"):
        PEARLSAC.from_pretrained("HalfCheetahVel")
    assert POEMSAC.from_pretrained("PointGoal").num_timesteps == 105_000
    for name in ("policy.safetensors", "model/model.safetensors"):
        with refused(f"{name} holds no whole model: AdaptedPolicy.load reads a policy"):
            load_model(name)
    for content in (b"", b"text", Path("policy.safetensors").read_bytes()[:1000]):
        Path("cut.safetensors").write_bytes(content)
        with refused("cut.safetensors is truncated, or no safetensors file"):
            AdaptedPolicy.load("cut.safetensors")
    with refused("its format is None, expected 'sb3_poem adapted policy 2'"):
        AdaptedPolicy.load("model/model.safetensors")
