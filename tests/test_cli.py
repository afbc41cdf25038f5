"""The command line, run as a user runs it, or in this process where that is slow."""

import contextlib
import multiprocessing
import os
import resource
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from poem_envs import headless, sawyer
from sb3_poem import cli, resources


def sb3_poem(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sb3_poem", *arguments], capture_output=True, text=True, check=False
    )


def processor_seconds_of_children() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def test_help_is_immediate_and_names_every_command() -> None:
    start = processor_seconds_of_children()  # not the clock's time, which other tests share
    done = sb3_poem("--help")
    seconds = processor_seconds_of_children() - start
    assert done.returncode == 0, done.stderr
    for command in cli.COMMANDS:
        assert f"\n    {command} " in done.stdout
    assert seconds < 1.0


@pytest.mark.parametrize("call", ["build_parser().format_help()", "main(['models'])"])
def test_help_and_models_do_not_import_what_is_slow(call: str) -> None:
    slow = {"torch", "mujoco", "rl_zoo3", "matplotlib"}
    code = f"import sys, sb3_poem.cli; sb3_poem.cli.{call}; print({slow} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "set()"


PARTS = [
    *([command] for command in cli.COMMANDS),
    ["label", "export"],
    ["label", "replay"],
    ["benchmark", "run"],
]


@pytest.mark.parametrize("command", [*PARTS, ["benchmark", "report"]], ids=" ".join)
def test_help_ends_with_an_example(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([*command, "--help"])
    assert stop.value.code == 0
    last = capsys.readouterr().out.strip().splitlines()[-1]
    example = shlex.split(last.removeprefix("example:"))
    assert example[: len(command) + 1] == ["sb3-poem", *command], last
    if command[0] != "train":  # whose arguments are rl_zoo3's
        cli.build_parser().parse_args(example[1:])


def test_models_are_listed_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1 : lines.index("")]] == resources.pretrained_names()
    (vel,) = (line for line in lines if line.startswith("HalfCheetahVel "))
    for word in ("poem/HalfCheetahVel-v0", "POEMSAC", "720,000", "-163.9 -> -28.7"):
        assert word in vel


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("sb3-poem rec", {"record-video"}),
        ("sb3-poem adapt --model HalfCheetahV", {"HalfCheetahVel"}),
        ("sb3-poem enjoy --env poem/AntG", {"poem/AntGoal-v0"}),
        ("sb3-poem adapt --oracle ", {"return", "boltzmann", "mistake", "human"}),
    ],
)
def test_a_shell_completes_the_line(
    line: str, expected: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = {
        "_ARGCOMPLETE": "1",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "_ARGCOMPLETE_IFS": "\n",
    }
    request["_ARGCOMPLETE_STDOUT_FILENAME"] = str(tmp_path / "out")
    for name, value in request.items():
        monkeypatch.setenv(name, value)
    asked = multiprocessing.get_context("fork").Process(target=cli.main)  # which ends by itself
    asked.start()
    asked.join(60)
    assert asked.exitcode == 0
    assert {word.strip() for word in (tmp_path / "out").read_text().splitlines()} == expected


def test_a_flag_that_is_none_ends_as_a_wrong_command_does(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["adapt", "--model", "x", "--colour", "red"])
    assert stop.value.code == 2
    assert "--colour" in capsys.readouterr().err


def test_a_missing_extra_is_named(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(name: str) -> None:
        raise sawyer.PackageNotFoundError(name)

    monkeypatch.setattr(sawyer, "version", absent)
    assert cli.main(["adapt", "--model", "MetaWorldML1"]) == 1
    assert "error: the Meta-World families need metaworld" in capsys.readouterr().err


def test_unknown_model_lists_the_shipped_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["adapt", "--model", "HalfCheetahVell"]) == 1
    error = capsys.readouterr().err
    assert "HalfCheetahVell" in error
    assert all(name in error for name in resources.pretrained_names())


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut off"])
def test_a_truncated_model_file_is_refused(
    content: bytes, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "model.zip"
    path.write_bytes(content)
    assert cli.main(["adapt", "--model", str(path)]) == 1
    assert "truncated" in capsys.readouterr().err


def test_shipped_files_of_other_names_are_not_found() -> None:
    with pytest.raises(FileNotFoundError, match="poem_sac"):
        resources.config_file("poem_zac")
    with pytest.raises(FileNotFoundError, match="those shipped are:"):
        resources.pretrained_folder("Nobody")


@pytest.mark.parametrize(
    "command",
    [
        ["train", "--env", "poem/PointGoal-v0", "-c", "missing.yml"],
        ["enjoy", "--algo", "ppo", "--env", "poem/PointGoal-v0", "--no-render", "-f", "missing"],
        ["adapt", "--model", "missing.zip"],
        ["label", "--model", "missing.zip"],
        ["benchmark", "run", "--suite", "smoke", "--models", "missing"],
    ],
    ids=lambda command: command[0],
)
def test_modules_that_register_environments_are_found_in_the_working_folder(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    # as for the console script, which has its own folder there
    monkeypatch.setattr(
        sys, "path", [folder for folder in sys.path if folder not in ("", os.getcwd())]
    )
    (tmp_path / "families_here.py").write_text("print('families are registered')")
    monkeypatch.delitem(sys.modules, "families_here", raising=False)
    assert cli.main([*command, "--gym-packages", "families_here"]) == 1
    shown = capsys.readouterr()
    assert "families are registered" in shown.out
    assert "missing" in shown.err
    for name in ("families_there", "families_here.py"):
        assert cli.main([*command, "--gym-packages", name]) == 1
        assert (
            f"--gym-packages {name}: there is no such module, neither installed nor in {tmp_path}"
            in capsys.readouterr().err
        )


def test_a_closed_standard_input_is_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    assert cli.main(["adapt", "--model", "missing.zip"]) == 1
    with pytest.raises(EOFError):
        input()


def without_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")


@pytest.mark.parametrize(
    ("libraries", "expected"), [({"EGL", "OSMesa"}, "egl"), ({"OSMesa"}, "osmesa"), (set(), None)]
)
def test_rendering_without_a_display(
    monkeypatch: pytest.MonkeyPatch, libraries: set[str], expected: str | None
) -> None:
    without_display(monkeypatch)
    monkeypatch.setattr(
        "ctypes.util.find_library", lambda name: f"lib{name}.so" if name in libraries else None
    )
    monkeypatch.setenv("MUJOCO_GL", "")  # so that monkeypatch restores it afterwards
    monkeypatch.delenv("MUJOCO_GL")
    assert headless.can_draw() == (expected is not None)
    with (
        contextlib.nullcontext()
        if expected
        else pytest.raises(RuntimeError, match="install libegl1")
    ):
        headless.choose_headless_backend()
    assert os.environ.get("MUJOCO_GL") == expected


def test_the_users_choice_of_rendering_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    without_display(monkeypatch)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    headless.choose_headless_backend()
    assert os.environ["MUJOCO_GL"] == "osmesa"
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setenv("DISPLAY", ":0")
    headless.choose_headless_backend()
    assert "MUJOCO_GL" not in os.environ
