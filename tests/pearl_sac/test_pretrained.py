"""Models as folders of safetensors and JSON."""

from __future__ import annotations

import errno
import functools
import inspect
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from meta_toys import (
    ARCH,
    EPOCH,
    POINT_GOAL,
    Shaped,
    WindyWalk,
    differing,
    parameters,
    small,
    walks,
)
from safetensors.torch import load_file, save_file
from stable_baselines3.common.env_util import make_vec_env

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.pearl_sac.saving import kept_arguments
from sb3_poem.pearl_sac.train_tasks import TrainTasks

FILES = ["README.md", "config.json", "model.safetensors"]
CARD = {
    "command": "sb3-poem train --algo poem_sac",
    "seed": 3,
    "commit": "abc123",
    "machine": "2 cores",
    "note": "Stopped by hand.",
    "results": {
        "adaptation to 30 unseen tasks": [
            {
                "inference": "bayes",
                "candidates": "prior",
                "queries": np.arange(3),
                "mean_return": [np.float64(-30.0), -20.0, -12.5],
                "known_task_return": -11.0,
            }
        ]
    },
}


@functools.cache
def trained_once(algorithm: type[PEARLSAC]) -> PEARLSAC:
    return small(algorithm, learning_rate=2e-3, ent_coef="auto_0.2").learn(2 * EPOCH)


@pytest.fixture(params=[PEARLSAC, POEMSAC])
def trained(request: pytest.FixtureRequest) -> PEARLSAC:
    """A model after two epochs; tests leave it as it is."""
    return trained_once(request.param)


@pytest.fixture
def folder(trained: PEARLSAC, tmp_path: Path) -> Path:
    """A folder of that model."""
    trained.save_pretrained(tmp_path / "folder", CARD)
    return tmp_path / "folder"


#: For what is one code in both
one_is_enough = pytest.mark.parametrize("trained", [POEMSAC], indirect=True)


def trajectories() -> list[Trajectory]:
    rng = np.random.default_rng(0)
    return [
        Trajectory(rng.normal(size=(6, 2)), rng.uniform(-1, 1, size=(5, 2)), np.zeros(5))
        for _ in range(4)
    ]


def assert_same_predictions(one: PEARLSAC, two: PEARLSAC) -> None:
    rng = np.random.default_rng(1)
    obs, latents = (
        rng.normal(size=(7, one.observation_space.shape[0])),
        rng.normal(size=(7, one.latent_dim)),
    )
    assert np.array_equal(
        one.predict(obs, latents, deterministic=True)[0],
        two.predict(obs, latents, deterministic=True)[0],
    )
    if one.observation_space.shape == (2,) and one.action_space.shape == (2,):
        assert np.array_equal(
            one.predicted_returns(latents, trajectories()),
            two.predicted_returns(latents, trajectories()),
        )
    if isinstance(one, POEMSAC):
        assert np.array_equal(
            one.similarities(latents, latents[:3]), two.similarities(latents, latents[:3])
        )
    for source in ("prior", "aggregate"):
        draws = [model.sample_latents(9, np.random.default_rng(4), source) for model in (one, two)]
        assert np.array_equal(*draws)
    assert np.array_equal(one.task_latents, two.task_latents)
    assert np.array_equal(one.train_tasks.tasks, two.train_tasks.tasks)
    for name in ("observation_space", "action_space", "task_space", "env_id", "horizon"):
        assert getattr(one, name) == getattr(two, name), name
    assert one.predicted_rewards_error == pytest.approx(
        two.predicted_rewards_error, rel=0, abs=0, nan_ok=True
    )
    for name in ("num_timesteps", "_n_updates", "latent_dim", "seed", "reward_feature_dim"):
        assert getattr(one, name) == getattr(two, name), name


def test_a_round_trip_keeps_all_predictions(trained: PEARLSAC, folder: Path) -> None:
    loaded = type(trained).from_pretrained(folder)
    assert_same_predictions(trained, loaded)
    state, other = trained.policy.state_dict(), loaded.policy.state_dict()
    assert state.keys() == other.keys()
    assert all(
        th.equal(state[name], other[name])
        for name in state
        if not name.startswith("critic_target.")
    )
    for name, value in loaded.policy.critic.state_dict().items():  # these are rebuilt
        assert th.equal(loaded.policy.critic_target.state_dict()[name], value)
    loaded.save_pretrained(folder.parent / "again", CARD)
    for file in FILES:
        assert (folder / file).read_bytes() == (folder.parent / "again" / file).read_bytes()


@one_is_enough
def test_the_folder_holds_nothing_that_can_run(trained: PEARLSAC, folder: Path) -> None:
    assert sorted(os.listdir(folder)) == FILES
    assert all((folder / file).read_bytes().isascii() for file in ("README.md", "config.json"))
    content = (folder / "model.safetensors").read_bytes()
    assert load_file(folder / "model.safetensors")
    for mark in (b"PK\x03\x04", b"\x80\x02", b"\x80\x04\x95", b"\x80\x05\x95"):
        assert not content.startswith(mark)
    # the tensors fill the file, so that nothing else is inside
    header = int.from_bytes(content[:8], "little")
    sizes = [
        entry["data_offsets"]
        for name, entry in json.loads(content[8 : 8 + header]).items()
        if name != "__metadata__"
    ]
    assert sum(end - start for start, end in sizes) == len(content) - 8 - header


def test_a_model_of_the_default_size_is_below_three_megabytes(tmp_path: Path) -> None:
    model = POEMSAC("MlpPolicy", "poem/HalfCheetahVel-v0", n_train_tasks=2, device="cpu")
    model.env.close()
    model.train_tasks = TrainTasks.of_prior(np.linspace(0.0, 3.0, 120)[:, None], model.latent_dim)
    model.save_pretrained(tmp_path / "m")
    assert sum(path.stat().st_size for path in (tmp_path / "m").iterdir()) < 3_000_000


@one_is_enough
def test_the_card_says_where_the_model_comes_from(trained: PEARLSAC, folder: Path) -> None:
    text = (folder / "README.md").read_text()
    name = type(trained).__name__
    for part in (
        f"# {name} on `{POINT_GOAL}`",
        "| environment steps | 600 |",
        "| gradient steps | 10 |",
        "| machine | 2 cores |",
        CARD["command"],
        f"`config.json` notes: {CARD['note']}",
        "| `Bayes()` | prior | -30.0 | -20.0 | -12.5 | -11.0 |",
    ):
        assert str(part) in text, part
    config = json.loads((folder / "config.json").read_text())
    (results,) = config["card"]["results"]["adaptation to 30 unseen tasks"]
    assert results["queries"] == [0, 1, 2]
    assert config["card"]["note"] == CARD["note"]
    assert config["card"]["commit"] == "abc123"
    assert config["card"]["seed"] == 3
    assert config["algorithm"] == name


def test_continues_training(trained: PEARLSAC, folder: Path) -> None:
    cls = type(trained)
    with pytest.raises(ValueError, match="the model has no environment; give it one with set_env"):
        cls.from_pretrained(folder).learn(EPOCH)
    loaded = cls.from_pretrained(folder, env=make_vec_env(POINT_GOAL, 5))
    assert_same_predictions(trained, loaded)
    # it goes on at the rate and the entropy at which it stopped
    assert loaded.lr_schedule(1.0) == 2e-3
    assert loaded.entropy_coefficient.value.item() == pytest.approx(
        trained.entropy_coefficient.value.item(), rel=1e-4
    )
    assert loaded.target_entropy == trained.target_entropy
    before = parameters(loaded)
    loaded.learn(EPOCH, reset_num_timesteps=False)
    assert loaded.num_timesteps >= 3 * EPOCH
    changed = differing(before, parameters(loaded))
    assert {
        "policy.actor.mlp.output.weight",
        "policy.decoder.mlp.output.weight",
        "log_ent_coef",
    } <= set(changed)
    assert "policy.obs_norm.mean" in changed
    assert (
        loaded.policy.obs_norm.count
        == trained.policy.obs_norm.count + loaded.num_timesteps - trained.num_timesteps
    )


VARIANTS = {
    "activation": ({"policy_kwargs": {"net_arch": ARCH, "activation_fn": th.nn.Tanh}}, POINT_GOAL),
    "layer-norm": ({"policy_kwargs": {"net_arch": ARCH, "layer_norm": True}}, POINT_GOAL),
    "critics": ({"policy_kwargs": {"net_arch": ARCH, "n_critics": 3}}, POINT_GOAL),
    "fixed-entropy": ({"ent_coef": 0.3}, POINT_GOAL),
    "schedule": ({"learning_rate": lambda remaining: 1e-3 * remaining}, POINT_GOAL),
    "ablations": ({"similarity": "inner", "context": "pearl", "latent_dim": 3}, POINT_GOAL),
    "own-dynamics": ({"horizon": 10}, lambda: walks(2, WindyWalk)),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_kind_of_model(variant: str, tmp_path: Path) -> None:
    arguments, env = VARIANTS[variant]
    model = small(POEMSAC, env() if callable(env) else env, **arguments)
    model.save_pretrained(tmp_path / "m")
    json.loads(
        (tmp_path / "m" / "config.json").read_text(), parse_constant=pytest.fail
    )  # NaN, which only Python reads
    loaded = POEMSAC.from_pretrained(tmp_path / "m", env=env() if callable(env) else env)
    assert_same_predictions(model, loaded)
    assert loaded.policy.layer_norm == model.policy.layer_norm == (variant == "layer-norm")
    assert len(loaded.policy.critic.members) == len(model.policy.critic.members)
    if variant == "fixed-entropy":
        assert loaded.ent_coef_optimizer is None
        assert loaded.entropy_coefficient.value.item() == pytest.approx(0.3)
    loaded.learn(1)


#: Another value than its default for each argument that is kept
OTHER_ARGUMENTS: dict[str, Any] = {
    **{"learning_rate": 2e-3, "buffer_size": 50, "batch_size": 8, "tau": 0.2, "gamma": 0.8},
    **{"gradient_steps": 2, "target_update_interval": 2, "target_entropy": -0.5, "seed": 3},
    **{"n_train_tasks": 4, "meta_batch_size": 3, "context_size": 5, "trajectories_per_task": 2},
    **{"latent_dim": 3, "kl_coef": 0.3, "reward_coef": 0.4, "policy_coef": 0.6, "n_steps": 2},
    **{"relabel_fraction": 0.25, "reward_scale": "per-task", "shaping_coef": 0.5},
    **{"policy_delay": 3, "horizon": 10, "precision": "fp32"},
}
OTHERS_OF_PEARL: dict[str, Any] = {"context_relabel_fraction": 0.25}
OTHERS_OF_POEM: dict[str, Any] = {
    **{"preference_coef": 2.0, "similarity": "cosine", "similarity_temperature": 0.3},
    "context": "pearl",
}


def test_every_argument_comes_back(algorithm: type[PEARLSAC], tmp_path: Path) -> None:
    """With both forms of a model."""
    given = OTHER_ARGUMENTS | (OTHERS_OF_POEM if algorithm is POEMSAC else OTHERS_OF_PEARL)
    defaults = inspect.signature(algorithm).parameters
    assert given.keys() >= set(kept_arguments(algorithm))
    assert all(defaults[name].default != value for name, value in given.items())
    model = small(algorithm, walks(2, Shaped), **given)
    model.save_pretrained(tmp_path / "folder")
    model.save(tmp_path / "model.zip")
    for loaded in (
        algorithm.from_pretrained(tmp_path / "folder"),
        algorithm.load(tmp_path / "model.zip"),
    ):
        assert {name: getattr(loaded, name) for name in given} == given


def test_an_activation_that_cannot_be_named_is_refused(tmp_path: Path) -> None:
    class Squared(th.nn.Module):
        def forward(self, x: th.Tensor) -> th.Tensor:
            return x * x

    model = small(POEMSAC, policy_kwargs={"net_arch": ARCH, "activation_fn": Squared})
    with pytest.raises(ValueError, match=r"activation_fn must be in torch\.nn.*Squared"):
        model.save_pretrained(tmp_path / "m")
    assert not (tmp_path / "m").exists()


def test_the_optimiser_is_kept(tmp_path: Path) -> None:
    policy_kwargs = {
        "net_arch": ARCH,
        "optimizer_class": th.optim.AdamW,
        "optimizer_kwargs": {"weight_decay": 0.3},
    }
    small(POEMSAC, policy_kwargs=policy_kwargs).save_pretrained(tmp_path / "m")
    optimizer = POEMSAC.from_pretrained(tmp_path / "m").policy.optimizer
    assert type(optimizer) is th.optim.AdamW
    assert optimizer.param_groups[0]["weight_decay"] == 0.3


def test_an_optimiser_that_cannot_be_named_is_refused(tmp_path: Path) -> None:
    class Mine(th.optim.Adam):
        pass

    model = small(POEMSAC, policy_kwargs={"net_arch": ARCH, "optimizer_class": Mine})
    with pytest.raises(ValueError, match=r"optimizer_class must be in torch\.optim.*Mine"):
        model.save_pretrained(tmp_path / "m")


# ---------------------------------------------------------------- what goes wrong


@one_is_enough
def test_missing_files(trained: PEARLSAC, folder: Path) -> None:
    cls = type(trained)
    with pytest.raises(
        FileNotFoundError, match="nowhere: there is no such file or folder of a model"
    ):
        cls.from_pretrained(folder.parent / "nowhere")
    (folder / "model.safetensors").rename(folder / "elsewhere")
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors"):
        cls.from_pretrained(folder)
    (folder / "config.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"it has no config\.json"):
        cls.from_pretrained(folder)


@one_is_enough
def test_truncated_files(trained: PEARLSAC, folder: Path) -> None:
    for file in ("model.safetensors", "config.json"):
        content = (folder / file).read_bytes()
        for part in (content[: len(content) // 2], content[:-2], b"", content[:5]):
            (folder / file).write_bytes(part)
            with pytest.raises(ValueError, match=rf"{file} is truncated, or no"):
                type(trained).from_pretrained(folder)
        (folder / file).write_bytes(content)
    type(trained).from_pretrained(folder)


@one_is_enough
@pytest.mark.parametrize("text", ["[]", '{"format": "something else"}', "\x00\xff"])
def test_foreign_configurations(trained: PEARLSAC, folder: Path, text: str) -> None:
    (folder / "config.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"config\.json is (not of this version|truncated)"):
        type(trained).from_pretrained(folder)


@one_is_enough
@pytest.mark.parametrize(
    "key", ["arguments", "net_arch", "observation_space", "env_id", "num_timesteps"]
)
def test_incomplete_configurations(trained: PEARLSAC, folder: Path, key: str) -> None:
    config = json.loads((folder / "config.json").read_text())
    del config[key]
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=rf"folder.*{key}"):
        type(trained).from_pretrained(folder)


@one_is_enough
def test_foreign_weights(trained: PEARLSAC, folder: Path) -> None:
    path, cls = folder / "model.safetensors", type(trained)
    tensors = load_file(path)
    save_file({"weights": th.zeros(3)}, path)
    with pytest.raises(ValueError, match="folder does not hold a complete"):
        cls.from_pretrained(folder)
    one_missing = {
        name: value for name, value in tensors.items() if name != "policy.actor.mlp.output.bias"
    }
    save_file(one_missing, path)
    with pytest.raises(
        ValueError,
        match=r"folder does not hold a complete .*policy\.actor\.mlp\.output\.bias .*but it is missing",
    ):
        cls.from_pretrained(folder)
    save_file({**tensors, "policy.actor.mlp.output.bias": th.zeros(7)}, path)
    with pytest.raises(ValueError, match="folder does not hold a complete"):
        cls.from_pretrained(folder)
    path.write_bytes(b"hello world, this is no safetensors file")
    with pytest.raises(ValueError, match="truncated, or no safetensors file"):
        cls.from_pretrained(folder)


@one_is_enough
def test_another_algorithm_or_family(trained: PEARLSAC, folder: Path) -> None:
    cls = type(trained)
    other = POEMSAC if cls is PEARLSAC else PEARLSAC
    with pytest.raises(
        ValueError,
        match=rf"folder holds a {cls.__name__}; load it with {cls.__name__}\.from_pretrained",
    ):
        other.from_pretrained(folder)
    for env in ("poem/HalfCheetahVel-v0", make_vec_env("poem/HalfCheetahVel-v0", 1)):
        with pytest.raises(ValueError, match=r"own family|[Oo]bservation spaces do not match"):
            cls.from_pretrained(folder, env=env)


@one_is_enough
def test_a_full_disk_or_a_bad_card_leaves_the_previous_model_whole(
    trained: PEARLSAC, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {file: (folder / file).read_bytes() for file in FILES}
    other = small(type(trained), seed=9)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(
            OSError, match=r"could not write .*model\.safetensors \(No space left on device\)"
        ):
            other.save_pretrained(folder)
    assert {file: (folder / file).read_bytes() for file in os.listdir(folder)} == before
    with pytest.raises(TypeError, match="cannot be written as JSON"):
        other.save_pretrained(folder, {"results": object()})
    assert {file: (folder / file).read_bytes() for file in os.listdir(folder)} == before


@one_is_enough
def test_a_folder_that_cannot_be_written(trained: PEARLSAC, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OSError, match=r"could not write .*file"):
        trained.save_pretrained(tmp_path / "file")
