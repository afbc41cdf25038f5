"""``sb3-poem enjoy`` and ``record-video``: which policy is shown, on which task, and where."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v3 as imageio
import numpy as np
import pytest

from poem_envs.point_goal import PointGoalEnv
from sb3_poem import cli
from sb3_poem.adaptation import AdaptedPolicy
from sb3_poem.loading import load_model

QUICK = ["--queries", "2", "--episodes", "2"]
TINY = ["--env-kwargs", "width:48", "height:48"]


def show(command: str, *arguments: object) -> int:
    return cli.main([command, *map(str, arguments)])


class WatchedEnv(PointGoalEnv):
    """Keeps what its window would have shown."""

    tasks: list[float] = []  # noqa: RUF012

    def render(self) -> Any:
        assert (self.render_mode, self.render_task) == ("human", True)
        self.tasks.append(float(self.task[0]))


def test_enjoy_adapts_then_shows_the_policy_in_a_window(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    gym.register("Watched-v0", WatchedEnv, max_episode_steps=25)
    try:
        assert (
            show("enjoy", "--model", "PointGoal", "--env", "Watched-v0", "--task", 1.0, *QUICK) == 0
        )
    finally:
        del gym.registry["Watched-v0"]
    assert len(WatchedEnv.tasks) >= 2 * 25
    assert set(WatchedEnv.tasks) == {1.0}
    task, policy, *episodes = capsys.readouterr().out.splitlines()
    assert task == "Task of Watched-v0: 1"
    assert policy.startswith(
        "Policy of PointGoal, adapted by the oracle that knows the return: return -"
    )
    assert policy.endswith(" after 2 answers")
    adapted = float(policy.rpartition("return ")[2].split()[0])
    shown = [float(line.split("return ")[1].split()[0]) for line in episodes]
    assert np.mean(shown) == pytest.approx(adapted, abs=1.0)


def test_the_best_policy_for_a_known_task(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        show(
            "enjoy",
            "--model",
            "PointGoal",
            "--task",
            1.0,
            "--known-task",
            "--no-render",
            "--episodes",
            2,
        )
        == 0
    )
    shown = capsys.readouterr().out
    assert "Policy of PointGoal: the best of 300 for this task; return -" in shown
    assert float(shown.splitlines()[-1].split("return ")[1].split()[0]) > -14


def test_a_policy_that_was_saved_is_shown_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, file = load_model("PointGoal", "cpu"), tmp_path / "policy.safetensors"
    AdaptedPolicy(model, np.zeros(model.latent_dim)).save(file)
    assert show("enjoy", "--model", file, "--no-render", "--episodes", 1) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"Policy: that in {file}, which is adapted already",
        "Episode 1: 25 steps",
    ]
    assert show("enjoy", "--model", file, "--no-render", "--episodes", 1, "--task", 1.0) == 0
    assert "return -" in capsys.readouterr().out
    assert show("enjoy", "--model", file, "--no-render", "--known-task") == 1
    assert "--known-task chooses a policy of a model" in capsys.readouterr().err
    assert cli.main(["adapt", "--model", str(file)]) == 1
    assert "is a policy that is adapted already" in capsys.readouterr().err


class UndrawnEnv(PointGoalEnv):
    metadata = {"render_modes": []}  # noqa: RUF012


@pytest.mark.parametrize(
    "command", ["record-video --out a.gif", "adapt --tasks 1 --video a.gif", "label --port 0"]
)
def test_what_cannot_be_drawn_is_refused_before_it_is_adapted_or_served(
    command: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    gym.register("Undrawn-v0", UndrawnEnv, max_episode_steps=25)
    try:
        assert show(*command.split(), "--model", "PointGoal", "--env", "Undrawn-v0") == 1
    finally:
        del gym.registry["Undrawn-v0"]
    said = capsys.readouterr()
    assert 'needs metadata = {"render_modes": ["rgb_array"]}, and a render()' in said.err
    assert not said.out


def test_a_family_of_one_s_own_is_named_with_the_module_that_registers_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for command in ("record-video --out a.gif", "label --port 0"):
        assert show(*command.split(), "--model", "PointGoal", "--env", "my/Own-v0") == 1
        assert "on the command line --gym-packages" in capsys.readouterr().err


def test_record_video_films_before_and_after_or_one_policy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair, one = tmp_path / "pair.gif", tmp_path / "one.gif"
    assert show("record-video", "--model", "PointGoal", "--out", pair, *QUICK, *TINY) == 0
    assert "after 2 answers" in capsys.readouterr().out
    assert (
        show(
            "record-video",
            "--model",
            "PointGoal",
            "--out",
            one,
            "--queries",
            0,
            "--episodes",
            1,
            *TINY,
        )
        == 0
    )
    two_clips, clip = imageio.imread(pair, index=None), imageio.imread(one, index=None)
    assert len(two_clips) == len(clip) == 25
    assert two_clips.shape[2] > 2 * clip.shape[2]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (
            ["enjoy", "--model", "PointGoal", "--seed", 3],
            "`sb3-poem record-video --model PointGoal --seed 3 --out ",
        ),
        (["enjoy", "--no-render"], "name a model by --model, or by --env the environment"),
        (
            ["enjoy", "--env", "poem/AntVel-v0", "-f", "none"],
            "no run of poem_sac on poem/AntVel-v0 in",
        ),
        (["enjoy", "--no-render", "--model", "PointGoaal"], "did you mean 'PointGoal'?"),
        (["enjoy", "--algo", "ppo", "--env", "Pendulum-v1"], "add --no-render"),
        (
            ["enjoy", "--model", "PointGoal", "--no-render", "--device", "gpu"],
            "--device gpu: there is no such device",
        ),
        (
            ["record-video", "--model", "PointGoal", "--out", "a.avi"],
            "--out a.avi: the name must end in .mp4 or .gif",
        ),
        (
            ["record-video", "--model", "PointGoal", "--out", "a.gif", "--task", 1, 2],
            "--task needs 1 number for",
        ),
    ],
)
def test_what_cannot_be_shown_is_said(
    command: list, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert show(*command) == 1
    assert words in capsys.readouterr().err


def test_without_a_display_the_film_that_is_named_can_be_made(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sb3_poem.cli.show.has_display", lambda: False)
    assert cli.main(["enjoy", "--model", "PointGoal", "-n", "30", "--task", "1"]) == 1
    film = "sb3-poem record-video --model PointGoal --task 1 --out policy.mp4"
    assert f"film it by `{film}`" in capsys.readouterr().err
