"""What people type at ``sb3-poem train`` who know rl_zoo3; test_cli_zoo.py has the rest."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
import pytest
from first_hour import ENTRY, config_file, names, runs, shell
from meta_toys import POINT_GOAL

from sb3_poem import POEMSAC


@pytest.fixture(autouse=True)
def working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def train(folder: Path, *flags: object, env_id: str = POINT_GOAL) -> str:
    """What a training prints, whose models are in ``logs``."""
    given = ("-c", config_file(folder, env_id), "-f", folder / "logs", "--eval-freq", -1)
    done = shell("train", "--env", env_id, *given, *flags)
    assert done.status == 0, done.err
    return done.out + done.err


def result(folder: Path, number: int = 1) -> POEMSAC:
    return POEMSAC.load(folder / f"logs/poem_sac/poem-PointGoal-v0_{number}/poem-PointGoal-v0.zip")


def test_flags_of_train(tmp_path: Path) -> None:
    flags = ["-params", "gamma:0.9", "policy_kwargs:dict(net_arch=[8])", "-n", 450, "--seed", 0]
    flags += ["-P", "-tb", tmp_path / "tb", "--save-freq", 150, "--env-kwargs", "step_length:0.1"]
    assert "450/450" in train(tmp_path, *flags)  # -P
    model = result(tmp_path)
    assert (model.gamma, model.policy.net_arch["pi"]) == (0.9, [8])  # -params
    assert model.num_timesteps == 450  # -n
    assert model.seed == 0  # --seed
    assert len(runs(tmp_path / "tb")) == 1  # -tb
    files = names(tmp_path / "logs/poem_sac/poem-PointGoal-v0_1")
    assert {"checkpoint.zip", "rl_model_150_steps.zip"} <= set(files)  # --save-freq
    assert dict(model.env_kwargs) == {"step_length": 0.1}  # --env-kwargs
    assert model.batch_size == ENTRY["batch_size"]  # -c
    assert model._n_updates == 9
    first = tmp_path / "logs/poem_sac/poem-PointGoal-v0_1/poem-PointGoal-v0.zip"
    train(tmp_path, "-i", first, "-n", 150)
    assert result(tmp_path, 2)._n_updates == 12


def test_a_module_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the working folder, as beside a user's own scripts."""
    lines = ("import gymnasium", "import first_hour")
    lines += ("gymnasium.register('Mine-v0', first_hour.Toy, max_episode_steps=10)",)
    (tmp_path / "my_families.py").write_text("\n".join(lines))
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", ".")])
    try:
        train(tmp_path, "--gym-packages", "my_families", "-n", 60, env_id="Mine-v0")
    finally:
        gym.registry.pop("Mine-v0", None)
        sys.modules.pop("my_families", None)
    assert (tmp_path / "logs/poem_sac/Mine-v0_1/Mine-v0.zip").is_file()


def test_the_other_algorithm(tmp_path: Path) -> None:
    train(tmp_path, "--algo", "pearl_sac")
    assert (tmp_path / "logs/pearl_sac/poem-PointGoal-v0_1/poem-PointGoal-v0.zip").is_file()
