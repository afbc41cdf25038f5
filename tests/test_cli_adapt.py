"""``sb3-poem adapt``, against what the library gives when it is called directly."""

import io
import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
from filelock import lock_descriptor
from rl_zoo3.utils import SimpleLinearSchedule
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_poem import (
    PEARLSAC,
    POEMSAC,
    Bayes,
    MistakeOracle,
    Preference,
    PreferenceAdapter,
    ReturnOracle,
    cli,
)
from sb3_poem.adaptation import (
    AdaptedPolicy,
    evaluate_adaptation,
    known_task_return,
    named_rule,
)
from sb3_poem.cli.needs import parse_pairs
from sb3_poem.common.family_view import FamilyView
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.label import Store

SMALL = {
    "gradient_steps": 5,
    "meta_batch_size": 4,
    "batch_size": 16,
    "context_size": 16,
    "n_train_tasks": 12,
    "seed": 3,
}
ENV_ID = "poem/PointGoal-v0"
TINY = ["--env-kwargs", "width:48", "height:48"]  # videos that are made quickly


@pytest.fixture(autouse=True)
def few_other_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits that are chosen on five hundred other tasks take seconds each."""
    monkeypatch.setattr("sb3_poem.adaptation.known_task.OTHER_TASKS", 40)


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
    flags = [
        "--oracle",
        "mistake",
        "--mistake-rate",
        0.0,
        "--queries",
        3,
        "--tasks",
        4,
        "--episodes",
        2,
        "--seed",
        3,
    ]
    flags += [
        flag for name, value in options.items() for flag in (f"--{name.replace('_', '-')}", value)
    ]
    assert adapt(model[1], *flags, "--inference", inference, "--json", file) == 0
    result = json.loads(file.read_text())

    vec_env = make_task_vec_env(ENV_ID, 8)
    tasks = FamilyView(vec_env).test_tasks(4, 3)
    np.testing.assert_array_equal(result["tasks"], tasks)
    assert model[0].seed == 3  # and yet these are other tasks than those of its training
    assert not np.isin(tasks, model[0].train_tasks.tasks).any()
    expected = evaluate_adaptation(
        POEMSAC.load(model[1]),
        vec_env,
        tasks,
        lambda **kwargs: MistakeOracle(0.0, **kwargs),
        record_at=range(4),
        n_episodes=2,
        seed=3,
        rule=named_rule(inference, **options),
    )
    assert options.items() <= result.items()
    assert result["queries"] == [0, 1, 2, 3]
    np.testing.assert_allclose(result["task_returns"], expected.task_returns, rtol=1e-4)
    np.testing.assert_allclose(result["mean_return"], np.mean(result["task_returns"], axis=0))
    known = known_task_return(
        POEMSAC.load(model[1]), vec_env, tasks, n_episodes=2, seed=3, selection_episodes=2
    )
    assert result["known_task_return"] == pytest.approx(known.mean_return, rel=1e-4)
    assert result["limit"] == pytest.approx([known.limit(k) for k in range(4)], rel=1e-4)
    assert result["seed"] == 3
    assert result["versions"]["mujoco"] == "3.3.0"
    assert {result["oracle"], result["inference"], result["env_id"]} == {
        "mistake",
        inference,
        ENV_ID,
    }


def test_table_plot_video_and_the_policy_of_one_task(
    model: tuple[POEMSAC, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plot, video, policy = (tmp_path / name for name in ("a.png", "a.gif", "a.safetensors"))
    flags = ["--env", ENV_ID, "--queries", 2, "--task", 1.0, "--episodes", 1, "--record", 0, 2]
    files = ["--plot", plot, "--video", video, "--save", policy]
    assert adapt(model[1], *flags, *files, *TINY) == 0
    shown = capsys.readouterr().out
    for words in ("answers", "limit", "std. error", "task known", str(plot), str(video)):
        assert words in shown
    prose = " ".join(shown.split())
    assert "the best of 300 policies for each task, refined, and measured anew on 1 episo" in prose
    assert "limit: the best 2^answers of those 300, chosen on other tasks where dynamics" in prose
    assert (
        shown.index("after 0 answers: return")
        < shown.index("after 2 answers: return")
        < shown.index("task known")
    )
    assert plot.read_bytes().startswith(b"\x89PNG")
    frames = imageio.imread(video, index=None)
    assert len(frames) == model[0].horizon
    assert frames.shape[2] > frames.shape[1], "two clips beside each other"
    expected = evaluate_adaptation(
        model[0], make_task_vec_env(ENV_ID, 2), np.array([[1.0]]), record_at=[2], n_episodes=1
    )
    np.testing.assert_allclose(
        AdaptedPolicy.load(policy).latent, expected.latents[0, -1], rtol=1e-4
    )


def test_the_environment_is_made_as_in_training(tmp_path: Path) -> None:
    env = make_task_vec_env(ENV_ID, 12, step_length=0.09)
    trained = POEMSAC("MlpPolicy", env, policy_kwargs={"net_arch": [16, 16]}, **SMALL).learn(300)
    trained.save(tmp_path / "model.zip")
    trained.save_pretrained(tmp_path / "folder")
    file, other = tmp_path / "result.json", ["--env-kwargs", "step_length:0.02"]
    flags = ["--queries", 1, "--tasks", 2, "--episodes", 2, "--record", 0, "--json", file]
    for name, given, expected in (
        ("model.zip", [], 0.09),
        ("folder", [], 0.09),
        ("folder", other, 0.02),
    ):
        assert adapt(str(tmp_path / name), *flags, *given) == 0
        result = json.loads(file.read_text())
        assert result["env_kwargs"] == {"step_length": expected}
        vec_env = make_task_vec_env(ENV_ID, 4, step_length=expected)
        evaluation = evaluate_adaptation(
            trained, vec_env, np.array(result["tasks"]), record_at=[0, 1], n_episodes=2
        )
        assert result["mean_return"] == pytest.approx(evaluation.mean_returns.tolist(), rel=1e-4)


def test_the_other_algorithm(tmp_path: Path) -> None:
    pearl = PEARLSAC("MlpPolicy", ENV_ID, policy_kwargs={"net_arch": [16, 16]}, **SMALL).learn(300)
    pearl.save(tmp_path / "pearl.zip")
    flags = ["--queries", 1, "--tasks", 2, "--episodes", 1, "--query-rule", "random"]
    file = tmp_path / "result.json"
    assert adapt(str(tmp_path / "pearl"), *flags, "--json", file) == 0
    result = json.loads(file.read_text())
    vec_env, rule = make_task_vec_env(ENV_ID, 4), Bayes(query_rule="random")
    expected = evaluate_adaptation(pearl, vec_env, 2, record_at=(0, 1), n_episodes=1, rule=rule)
    np.testing.assert_allclose(result["task_returns"], expected.task_returns, rtol=1e-4)


def test_all_questions_are_asked_whatever_is_measured(
    model: tuple[POEMSAC, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, policy = tmp_path / "result[a].json", tmp_path / "a.safetensors"
    flags = ["--queries", 3, "--record", 1, "--tasks", 1, "--episodes", 1, "--n-candidates", 20]
    film = ["--video", tmp_path / "a.gif", *TINY]  # of the policies before and after
    assert adapt(model[1], *flags, *film, "--json", file, "--save", policy) == 0
    result = json.loads(file.read_text())
    assert f"Wrote {file}\n" in capsys.readouterr().out  # as it is, brackets and all
    assert result["queries"] == [0, 1, 3]
    assert len(result["answers"][0]) == AdaptedPolicy.load(policy).n_answers == 3


def test_a_model_with_a_schedule_of_rl_zoo3_in_a_process_of_its_own(tmp_path: Path) -> None:
    """Such a model brings rl_zoo3 with it, which replaces one of Gymnasium's wrappers."""
    model = POEMSAC(
        "MlpPolicy",
        ENV_ID,
        SimpleLinearSchedule(1e-3),
        policy_kwargs={"net_arch": [16, 16]},
        **SMALL,
    )
    model.learn(300).save(tmp_path / "model.zip")
    flags = [
        "--model",
        str(tmp_path / "model"),
        "--queries",
        "1",
        "--tasks",
        "1",
        "--episodes",
        "1",
    ]
    command = [sys.executable, "-m", "sb3_poem", "adapt", *flags]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "task known" in done.stdout


def test_a_person_answers_with_a_task(
    model: tuple[POEMSAC, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer_by(monkeypatch, tmp_path, "what?\nr\nl\n")
    flags = [
        "--oracle",
        "human",
        "--queries",
        2,
        "--record",
        0,
        "--task",
        1.25,
        "--episodes",
        1,
        "--json",
        tmp_path / "result.json",
    ]
    assert adapt(model[1], *flags, *TINY) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["answers"] == [["right", "left"]]
    assert result["queries"] == [0, 2]  # and the last one, which is what they got
    assert result["tasks"] == [[1.25]]
    assert np.shape(result["task_returns"]) == (1, 2)


def test_a_person_answers_by_their_own_wish(
    model: tuple[POEMSAC, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer_by(monkeypatch, tmp_path, "l\n")
    state, video = tmp_path / "state.json", tmp_path / "video.gif"
    assert (
        adapt(
            model[1], "--oracle", "human", "--queries", 1, "--json", state, "--video", video, *TINY
        )
        == 0
    )
    assert video.is_file()
    adapter = PreferenceAdapter.load(state, model[0], ENV_ID)
    assert adapter.done
    assert [answer.preference.value for answer in adapter.answers] == ["left"]


def test_a_person_says_how_much_better(
    model: tuple[POEMSAC, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    answer_by(monkeypatch, tmp_path, "1\n3\n4\n5\n")
    graded = ["--question", "graded", "--infer-noise", "--queries", 4, "--n-candidates", 20]
    assert adapt(model[1], "--oracle", "human", *graded, "--json", "state.json", *TINY) == 0
    words = ["much left", "equal", "right", "much right"]
    kept = PreferenceAdapter.load("state.json", model[0], ENV_ID)
    assert [answer.preference.value for answer in kept.answers] == words
    assert kept.rule == Bayes(20, question="graded", noise_model="infer")
    label = ["label", "--store", "label_data"]
    assert cli.main([*label, "export", "--out", "a.jsonl"]) == 0
    lines = [json.loads(line) for line in Path("a.jsonl").read_text().splitlines()]
    assert [line["preference"] for line in lines] == words
    assert {line["question"] for line in lines} == {"graded"}
    capsys.readouterr()
    for rule in ("bayes", "paper"):  # the latter reads "much better" as better
        assert cli.main([*label, "replay", "--model", model[1], "--inference", rule]) == 0
        assert " of 3" in capsys.readouterr().out  # those of "equal" are not foretold


def test_a_person_says_which_of_four_is_best_and_goes_on_later(
    model: tuple[POEMSAC, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    four = ["--question", "best-of-four", "--queries", 3, "--n-candidates", 20, *TINY]
    command = [model[1], "--oracle", "human", *four]
    answer_by(monkeypatch, tmp_path, "4\n1\n")  # and then standard input ends
    assert adapt(*command) == 0
    answer_by(monkeypatch, tmp_path, "left\n0\n")
    assert adapt(*command, "--resume", "--json", "state.json") == 0
    assert "'left' is no answer." in capsys.readouterr().out
    kept = PreferenceAdapter.load("state.json", model[0], ENV_ID)
    assert [answer.preference.value for answer in kept.answers] == ["fourth", "first", "equal"]
    assert kept.rule.question == "best-of-four"
    label = ["label", "--store", "label_data"]
    assert cli.main([*label, "replay", "--model", model[1]]) == 0
    assert " of 2" in capsys.readouterr().out
    assert cli.main([*label, "replay", "--model", model[1], "--inference", "paper"]) == 1
    assert "Session 1 asks which of four is best" in capsys.readouterr().out


def test_a_program_says_which_of_four_is_best(
    model: tuple[POEMSAC, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "result.json"
    flags = ["--oracle", "boltzmann", "--question", "best-of-four", "--queries", 2, "--tasks", 3]
    assert adapt(model[1], *flags, "--episodes", 1, "--n-candidates", 20, "--json", file) == 0
    result = json.loads(file.read_text())
    answers = {word for answers in result["answers"] for word in answers}
    assert answers <= {"first", "second", "third", "fourth", "equal"}
    assert len(answers) > 1
    assert result["thresholds"] is None
    assert "the best 4^answers of those" in capsys.readouterr().out


def test_a_program_says_how_much_better(model: tuple[POEMSAC, str], tmp_path: Path) -> None:
    file = tmp_path / "result.json"
    flags = ["--oracle", "mistake", "--question", "graded", "--infer-noise", "--queries", 3]
    flags += ["--thresholds", 0.0, 0.01, "--tasks", 3, "--episodes", 1, "--n-candidates", 20]
    assert adapt(model[1], *flags, "--seed", 5, "--json", file) == 0
    result = json.loads(file.read_text())
    answers = {word for answers in result["answers"] for word in answers}
    assert answers <= {"much left", "left", "right", "much right"}
    assert answers & {"much left", "much right"}
    assert result["thresholds"] == [0.0, 0.01]
    assert result["noise_model"] == "infer"
    assert result["limit"][1] == pytest.approx(result["limit"][3])  # five policies for three tasks


def answer_by(monkeypatch: pytest.MonkeyPatch, folder: Path, answers: str | None) -> None:
    """What a person types, in a working folder; None for a terminal without standard input."""
    folder.mkdir(exist_ok=True)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "stdin", None if answers is None else io.StringIO(answers))


def test_a_person_who_stops_goes_on_later_as_if_they_had_not(
    model: tuple[POEMSAC, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    flags = ["--oracle", "human", "--queries", 3, "--seed", 2, *TINY]
    answer_by(monkeypatch, tmp_path / "at once", "l\nr\nl\n")
    assert adapt(model[1], *flags, "--save", "policy.safetensors") == 0
    expected = AdaptedPolicy.load("policy.safetensors").latent
    film = f"record-video --model policy.safetensors {shlex.join(TINY)} --out policy.mp4"
    assert film in capsys.readouterr().out  # of the environment that was adapted in

    answer_by(monkeypatch, tmp_path / "twice", "l\n")  # then the input ends
    assert adapt(model[1], *flags) == 0
    shown = capsys.readouterr().out
    assert "Standard input ended after 1 of 3 answers" in shown
    assert "It believes that you mean a place" in shown
    words = f"--oracle human --queries 3 --seed 2 {shlex.join(TINY)} --resume"
    again = f"sb3-poem adapt --model {model[1]} {words}"
    assert f"answer the rest:  {again}\n" in shown
    monkeypatch.setattr(sys, "stdin", ThenInterrupt("r\n"))
    assert adapt(model[1], *flags, "--resume") == 130
    assert "Interrupted after 2 of 3 answers" in capsys.readouterr().out
    answer_by(monkeypatch, tmp_path / "twice", "l\n")
    with Path("label_data/session-1.lock").open() as other:
        assert lock_descriptor(other.fileno(), blocking=False)
        assert cli.main(shlex.split(again)[1:]) == 1
    assert "session 1 of label_data is in use at another" in capsys.readouterr().err
    assert cli.main(shlex.split(again)[1:]) == 0
    films = Path("preference_queries/session-1")  # no other session's
    assert f"Query 3: {films}/query-003.gif" in capsys.readouterr().out

    answer_by(monkeypatch, tmp_path / "twice", None)  # nothing is left to be asked
    assert adapt(model[1], *flags, "--resume", "--save", "policy.safetensors") == 0
    np.testing.assert_array_equal(AdaptedPolicy.load("policy.safetensors").latent, expected)
    (session,) = Store("label_data").sessions()
    assert [row["preference"] for row in Store("label_data").answers(session.id)] == [
        "left",
        "right",
        "left",
    ]


def test_no_policy_and_no_answer_of_another_is_passed_over(
    model: tuple[POEMSAC, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    flags = ["--oracle", "human", "--seed", 2, *TINY]
    answer_by(monkeypatch, tmp_path / "here", "l\n")
    assert adapt(model[1], *flags, "--queries", 2) == 0
    assert "--save policy-1.safetensors" in capsys.readouterr().out
    answer_by(monkeypatch, tmp_path / "here", "r\n")
    assert adapt(model[1], *flags, "--queries", 3, "--resume") == 1
    words = "session 1 has 1 of 2 answers, but was begun with n_queries 2, not 3"
    assert words in capsys.readouterr().err
    assert [session.id for session in Store("label_data").sessions()] == [1]
    Path("policy.safetensors").write_bytes(b"of somebody")
    assert adapt(model[1], *flags, "--queries", 2, "--save", "policy.safetensors") == 1
    assert "--save policy.safetensors: a policy is kept there already" in capsys.readouterr().err
    assert Path("policy.safetensors").read_bytes() == b"of somebody"


def interrupt(*_: object, **__: object) -> str:
    raise KeyboardInterrupt


class ThenInterrupt(io.StringIO):
    """Somebody who types this and then Ctrl-C."""

    def readline(self, *_: Any) -> str:
        return super().readline() or interrupt()


def test_a_session_of_another_model_of_that_name_is_not_gone_on_with(
    model: tuple[POEMSAC, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    flags = ["--oracle", "human", "--queries", 2, *TINY]
    answer_by(monkeypatch, tmp_path, "l\n")
    assert adapt(model[1], *flags, "--resume") == 0
    assert "There is nothing to go on with" in capsys.readouterr().out
    POEMSAC("MlpPolicy", ENV_ID, policy_kwargs={"net_arch": [16, 16]}, **{**SMALL, "seed": 4}).save(
        tmp_path / "model.zip"
    )
    answer_by(monkeypatch, tmp_path, "l\n")
    assert adapt("model.zip", *flags, "--candidates", "prior") == 0  # another session
    capsys.readouterr()
    assert adapt(model[1], *flags, "--resume", "--candidates", "prior") == 1
    assert "question 1 of session 2 was another one" in capsys.readouterr().err


def test_answers_are_replayed_to_the_model_that_a_link_led_to(
    model: tuple[POEMSAC, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model[0].save_pretrained(tmp_path / "run_7")
    (tmp_path / "latest").symlink_to("run_7")
    store = tmp_path / "label_data"
    for folder, name in ((tmp_path, "latest"), (tmp_path / "run_7", ".")):
        answer_by(monkeypatch, folder, "l\n")
        flags = ["--oracle", "human", "--queries", 1, "--store", store, *TINY]
        assert adapt(name, *flags) == 0
        replayed = ["replay", "--store", str(store), "--model", name, "--json", "replay.json"]
        assert cli.main(["label", *replayed]) == 0
        for session in json.loads(Path("replay.json").read_text())["sessions"]:
            assert session["action_error"] is None  # its own latents, not those most alike


@pytest.mark.parametrize("answers", ["", None])
def test_a_person_without_standard_input_is_told(
    model: tuple[POEMSAC, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answers: str | None,
) -> None:
    answer_by(monkeypatch, tmp_path, answers)
    assert adapt(model[1], "--oracle", "human", *TINY) == 1
    assert "error: no answer can be read: standard input is closed" in capsys.readouterr().err


@pytest.mark.parametrize(("after", "measured"), [(2, [0, 1, 2]), (None, [0, 1, 2, 3])])
def test_an_interrupt_keeps_what_was_measured(
    model: tuple[POEMSAC, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    after: int | None,
    measured: list[int],
) -> None:
    """While the third question's answer is awaited, or while the best policies are looked for."""
    if after is None:
        monkeypatch.setattr("sb3_poem.cli.subject.known_task_return", interrupt)
    else:
        answers = iter([Preference.LEFT] * after)
        monkeypatch.setattr(ReturnOracle, "__call__", lambda *_: next(answers, None) or interrupt())
    monkeypatch.chdir(tmp_path)
    files = ["--json", "a.json", "--plot", "a.png", "--save", "a.safetensors", "--video", "a.gif"]
    assert adapt(model[1], "--queries", 3, "--tasks", 1, "--episodes", 1, *files) == 130
    shown = capsys.readouterr().out
    assert f"Interrupted after {measured[-1]} of 3 answers" in shown
    assert "1 task, return oracle, incomplete" in shown
    result = json.loads(Path("a.json").read_text())
    assert result["queries"] == measured
    assert len(result["task_returns"][0]) == len(measured)
    assert result["complete"] is False
    assert Path("a.png").read_bytes().startswith(b"\x89PNG")
    assert AdaptedPolicy.load("a.safetensors").latent.shape == (model[0].latent_dim,)
    assert not Path("a.gif").exists()


def test_an_interrupt_before_anything_was_measured(
    model: tuple[POEMSAC, str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sb3_poem.adaptation.evaluation.rollout_episodes", interrupt)
    assert adapt(model[1]) == 130
    assert capsys.readouterr().err.endswith("Interrupted.\n")


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--env", "poem/HalfCheetahVel-v0"], "PointGoal"),
        (["--env", "Pendulum-v1"], "no task family"),
        (["--env", "poem/Nothing-v0"], "Nothing"),
        (["--task", 1.0, 2.0], "--task needs 1 number for"),
        (["--task", 99.0, "--episodes", 1], "--task 99 is outside of the tasks, Box(0"),
        (["--task", 1.0, "--tasks", 3], "--task is one task"),
        (["--oracle", "human", "--tasks", 3], "one task"),
        (["--queries", 5, "--record", 0, 6], "--record 6 is more than --queries 5"),
        (["--oracle", "human", "--plot", "a.png"], "--plot needs returns"),
        (
            ["--save", "a.safetensors"],
            "--save keeps the policy of one task, but 30 are adapted: add --tasks 1",
        ),
        (["--save", "a.zip", "--tasks", 1], "must end in .safetensors"),
        (["--store", "a"], "--store is for --oracle human, but that is return"),
        (["--resume"], "--resume is for --oracle human, but that is return"),
        (["--mistake-rate", 0.0], "--mistake-rate is for --oracle mistake, but that is return"),
        (["--beta", 2.0], "--beta is for --oracle boltzmann, but that is return"),
        (
            ["--question", "graded", "--thresholds", 0.7, 0.1],
            "--thresholds 0.7 0.1: must be two shares",
        ),
        (["--thresholds", 0.1, 0.7], "--thresholds is for --question graded, but that is pair"),
        (
            ["--infer-noise", "--inference", "paper"],
            "--infer-noise is for --inference bayes, but that is paper",
        ),
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


def test_a_model_of_a_part_of_its_training_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = POEMSAC("MlpPolicy", ENV_ID, **SMALL)
    stop = StopTrainingOnMaxEpisodes(1)
    model.learn(1200, callback=stop).save(tmp_path / "part.zip")
    assert 0 < model.num_timesteps < 1200
    enjoy = ["enjoy", "--no-render", "--queries", "1", "--episodes", "1"]
    assert cli.main([*enjoy, "--model", str(tmp_path / "part.zip")]) == 0
    part = f"part.zip is of {model.num_timesteps} of the 1,200 steps of its training"
    assert part in capsys.readouterr().out


def test_a_folder_that_cannot_be_written_is_refused(
    model: tuple[POEMSAC, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    assert adapt(model[1], "--json", tmp_path / "file" / "a.json") == 1
    assert f"cannot write to the folder '{tmp_path / 'file'}'" in capsys.readouterr().err


def test_environment_arguments_are_literals_or_text() -> None:
    assert parse_pairs("--env-kwargs", ["a:1.5", "b:True", "c:human", "d:a:b", "e:(1, 2)"]) == {
        "a": 1.5,
        "b": True,
        "c": "human",
        "d": "a:b",
        "e": (1, 2),
    }
