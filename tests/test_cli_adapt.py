"""``sb3-poem adapt``, against what the library gives when it is called directly."""

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rl_zoo3.utils import SimpleLinearSchedule

from sb3_poem import PEARLSAC, POEMSAC, MistakeOracle, PreferenceAdapter, TaskVecEnv, cli
from sb3_poem.adaptation import evaluate_adaptation, information_limit, known_task_return
from sb3_poem.cli.adapt import parse_env_kwargs

SMALL = {"gradient_steps": 5, "meta_batch_size": 4, "batch_size": 16, "context_size": 16, "n_train_tasks": 12, "seed": 3}
ENV_ID = "poem/PointGoal-v0"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> tuple[POEMSAC, str]:
    """A model that has hardly learned, and its file."""
    model = POEMSAC("MlpPolicy", ENV_ID, policy_kwargs={"net_arch": [16, 16]}, **SMALL).learn(600)
    path = tmp_path_factory.mktemp("model") / "model.zip"
    model.save(path)
    return model, str(path)


def adapt(model_file: str, *arguments: object) -> int:
    return cli.main(["adapt", "--model", model_file, *map(str, arguments)])


@pytest.mark.parametrize(("inference", "options"), [("bayes", {"n_candidates": 20}), ("paper", {})])
def test_json_holds_what_the_library_measures(
    model: tuple[POEMSAC, str], tmp_path: Path, inference: str, options: dict[str, int]
) -> None:
    file = tmp_path / "new" / "result.json"
    flags = ["--oracle", "mistake", "--mistake-rate", 0.0, "--queries", 3, "--tasks", 4, "--episodes", 2, "--seed", 5]
    flags += [flag for name, value in options.items() for flag in (f"--{name.replace('_', '-')}", value)]
    assert adapt(model[1], *flags, "--inference", inference, "--json", file) == 0
    result = json.loads(file.read_text())

    tasks = np.array(result["tasks"])
    assert tasks.shape == (4, 1)
    vec_env = TaskVecEnv.from_id(ENV_ID, 8)
    expected = evaluate_adaptation(
        POEMSAC.load(model[1]),
        vec_env,
        tasks,
        lambda **kwargs: MistakeOracle(0.0, **kwargs),
        record_at=range(4),
        n_episodes=2,
        seed=5,
        inference=inference,
        **options,
    )
    assert options.items() <= result.items()
    assert result["queries"] == [0, 1, 2, 3]
    np.testing.assert_allclose(result["task_returns"], expected.task_returns, rtol=1e-4)
    np.testing.assert_allclose(result["mean_return"], np.mean(result["task_returns"], axis=0))
    known = known_task_return(POEMSAC.load(model[1]), vec_env, tasks, n_episodes=2, seed=5, selection_episodes=2)
    assert result["known_task_return"] == pytest.approx(known.mean_return, rel=1e-4)
    assert result["limit"] == pytest.approx([information_limit(known.candidate_returns, k) for k in range(4)], rel=1e-4)
    assert result["limit"] == sorted(result["limit"])
    assert result["seed"] == 5
    assert result["versions"]["mujoco"] == "3.3.0"
    assert {result["oracle"], result["inference"], result["env_id"]} == {"mistake", inference, ENV_ID}


def test_table_plot_and_video(model: tuple[POEMSAC, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    imageio = pytest.importorskip("imageio.v3")
    plot, video = tmp_path / "plot.png", tmp_path / "video.gif"
    flags = ["--env", ENV_ID, "--queries", 2, "--tasks", 2, "--episodes", 1, "--record", 0, 2]
    assert adapt(model[1], *flags, "--plot", plot, "--video", video) == 0
    shown = capsys.readouterr().out
    for words in ("answers", "limit", "std. error", "task known", str(plot), str(video)):
        assert words in shown
    assert plot.read_bytes().startswith(b"\x89PNG")
    frames = imageio.imread(video, index=None)
    assert len(frames) == model[0].horizon
    assert frames.shape[2] > frames.shape[1], "two clips beside each other"


def test_the_environment_is_made_as_in_training(tmp_path: Path) -> None:
    env = TaskVecEnv.from_id(ENV_ID, 12, step_length=0.09)
    trained = POEMSAC("MlpPolicy", env, policy_kwargs={"net_arch": [16, 16]}, **SMALL).learn(300)
    trained.save(tmp_path / "model.zip")
    trained.save_pretrained(tmp_path / "folder")
    for given, expected in (([], 0.09), (["--env-kwargs", "step_length:0.02"], 0.02)):
        for name in ("model.zip", "folder"):
            file = tmp_path / "result.json"
            flags = ["--queries", 1, "--tasks", 2, "--episodes", 2, "--record", 0, "--seed", 5, "--json", file, *given]
            assert adapt(str(tmp_path / name), *flags) == 0
            result = json.loads(file.read_text())
            assert result["env_kwargs"] == {"step_length": expected}
            vec_env = TaskVecEnv.from_id(ENV_ID, 4, step_length=expected)
            evaluation = evaluate_adaptation(trained, vec_env, np.array(result["tasks"]), record_at=[0], n_episodes=2, seed=5)
            assert result["mean_return"] == pytest.approx(evaluation.mean_returns.tolist(), rel=1e-4)


def test_same_seed_same_result_and_fresh_tasks(model: tuple[POEMSAC, str], tmp_path: Path) -> None:
    results = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        file = tmp_path / f"{name}.json"
        assert adapt(model[1], "--queries", 1, "--tasks", 3, "--episodes", 1, "--seed", seed, "--json", file) == 0
        results.append(json.loads(file.read_text()))
    assert results[0]["task_returns"] == results[1]["task_returns"]
    assert results[0]["tasks"] != results[2]["tasks"]
    assert model[0].seed == 3
    assert not np.isin(np.array(results[0]["tasks"]), model[0].train_tasks).any()


def test_pretrained_folder_and_the_other_algorithm(model: tuple[POEMSAC, str], tmp_path: Path) -> None:
    flags = ["--queries", 1, "--tasks", 2, "--episodes", 1, "--json", tmp_path / "result.json"]
    model[0].save_pretrained(tmp_path / "folder")
    assert adapt(str(tmp_path / "folder"), *flags) == 0
    pearl = PEARLSAC("MlpPolicy", ENV_ID, policy_kwargs={"net_arch": [16, 16]}, **SMALL).learn(300)
    pearl.save(tmp_path / "pearl.zip")
    assert adapt(str(tmp_path / "pearl"), *flags, "--query-rule", "random") == 0


def test_a_model_with_a_schedule_of_rl_zoo3_in_a_process_of_its_own(tmp_path: Path) -> None:
    """Such a model brings rl_zoo3 with it, which replaces one of Gymnasium's wrappers."""
    model = POEMSAC("MlpPolicy", ENV_ID, SimpleLinearSchedule(1e-3), policy_kwargs={"net_arch": [16, 16]}, **SMALL)
    model.learn(300).save(tmp_path / "model.zip")
    flags = ["--model", str(tmp_path / "model"), "--queries", "1", "--tasks", "1", "--episodes", "1"]
    command = [sys.executable, "-m", "sb3_poem.cli", "adapt", *flags]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "task known" in done.stdout


def test_a_person_answers_with_a_task(model: tuple[POEMSAC, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO("what?\nr\n"))
    flags = ["--oracle", "human", "--queries", 1, "--task", 1.25, "--episodes", 1, "--json", tmp_path / "result.json"]
    assert adapt(model[1], *flags) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["answers"] == [["right"]]
    assert result["tasks"] == [[1.25]]
    assert np.shape(result["task_returns"]) == (1, 2)


def test_a_person_answers_by_their_own_wish(
    model: tuple[POEMSAC, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO("l\n"))
    state, video = tmp_path / "state.json", tmp_path / "video.gif"
    assert adapt(model[1], "--oracle", "human", "--queries", 1, "--json", state, "--video", video) == 0
    assert video.is_file()
    adapter = PreferenceAdapter.load(state, model[0], ENV_ID)
    assert adapter.done
    assert [answer.preference.value for answer in adapter.answers] == ["left"]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--env", "poem/HalfCheetahVel-v0"], "PointGoal"),
        (["--env", "Pendulum-v1"], "no task family"),
        (["--env", "poem/Nothing-v0"], "Nothing"),
        (["--task", 1.0, 2.0], "--task needs 1 numbers"),
        (["--task", 99.0, "--episodes", 1], "99"),
        (["--task", 1.0, "--tasks", 3], "--task is one task"),
        (["--oracle", "human", "--tasks", 3], "one task"),
        (["--queries", 5, "--record", 0, 6], "--record 6 is more than --queries 5"),
        (["--oracle", "human", "--plot", "a.png"], "--plot needs returns"),
        (["--oracle", "mistake", "--mistake-rate", 1.5], "1.5"),
        (["--oracle", "boltzmann", "--beta", -1.0], "-1.0"),
        (["--json", "a.txt"], "must end in .json"),
        (["--plot", "a.gif"], "must end in .png or"),
        (["--video", "a.avi"], "must end in .mp4 or .gif"),
        (["--env-kwargs", "nonsense"], "KEY:VALUE"),
        (["--env-kwargs", "colour:3"], "colour"),
    ],
)
def test_what_does_not_fit_is_refused(
    model: tuple[POEMSAC, str], flags: list, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert adapt(model[1], *flags) == 1
    assert words in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_refused(
    model: tuple[POEMSAC, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    assert adapt(model[1], "--json", tmp_path / "file" / "a.json") == 1
    assert f"cannot write to the folder '{tmp_path / 'file'}'" in capsys.readouterr().err


def test_environment_arguments_are_literals_or_text() -> None:
    assert parse_env_kwargs(["a:1.5", "b:True", "c:human", "d:a:b", "e:(1, 2)"]) == {
        "a": 1.5,
        "b": True,
        "c": "human",
        "d": "a:b",
        "e": (1, 2),
    }
