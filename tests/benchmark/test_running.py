"""Running for real, in a small form: all methods, interruption, and two processes at once."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from meta_toys import small
from worlds import SpeedEnv

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.adaptation import MistakeNoise, Preference
from sb3_poem.benchmark.cells import make_oracle_factory
from sb3_poem.benchmark.models import ModelLibrary, Workplace, locked
from sb3_poem.benchmark.results import Selection
from sb3_poem.benchmark.running import make_plan, run_cells
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import (
    BOLTZMANN,
    EXACT,
    SUITES,
    TABLE_METHODS,
    TABLE_REFERENCES,
    Budget,
    Cell,
    Entry,
    ModelKey,
    OracleSpec,
    Suite,
    Training,
)
from sb3_poem.benchmark.tables import suite_rows
from sb3_poem.cli import main
from sb3_poem.common.files import write_json_atomically
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.pearl_sac.callbacks import EpochCallback, TrainingCheckpointCallback

TINY_MODEL = {
    "n_train_tasks": 12,
    "n_envs": 12,
    "gradient_steps": 3,
    "batch_size": 8,
    "meta_batch_size": 6,
}
TINY = Suite(
    "tiny",
    "A suite of two questions",
    ("PointGoal",),
    (Entry("methods", "Methods", TABLE_METHODS, record_at=(0, 1, 2), curves=(EXACT,)),),
    TABLE_REFERENCES,
    snapshots=2,
    overrides={"MAMLReward": (("batch_size", 8), ("gradient_steps", 1))},
)
BUDGET = Budget(tasks=2, episodes=1)
TRAINING = Training(1800, tuple(sorted(TINY_MODEL.items())))


POINT = "poem/PointGoal-v0"


@pytest.fixture(autouse=True)
def few_other_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits that are chosen on five hundred other tasks take seconds each."""
    monkeypatch.setattr("sb3_poem.adaptation.known_task.OTHER_TASKS", 40)


@pytest.fixture(scope="module")
def handed_over(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of models of one epoch; of PEARL's with and without its replay buffer."""
    folder = tmp_path_factory.mktemp("models")
    for name in ("all", "without"):
        (folder / name / "PointGoal/pearl/seed0").mkdir(parents=True)
        (folder / name / "PointGoal/poem").mkdir()
    poem, pearl = small(POEMSAC).learn(300), small(PEARLSAC).learn(300)
    poem.save(folder / "all/PointGoal/poem/seed0.zip")
    pearl.save_checkpoint(folder / "all/PointGoal/pearl/seed0/checkpoint.zip")
    pearl.save(folder / "without/PointGoal/pearl/seed0/model.zip")
    return folder


def library_of(tmp_path: Path, *models: Path) -> tuple[ModelLibrary, Store]:
    place = Workplace(str(tmp_path / "runs"), models=tuple(map(str, models)))
    return ModelLibrary(place), Store(tmp_path / "store.sqlite")


def test_every_method_runs_and_is_recorded(
    tmp_path: Path, handed_over: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_poem.benchmark.models.META_ITERATIONS_OF", {"PointGoal": 2})
    library, store = library_of(tmp_path, handed_over / "all")
    arguments = (TINY, library, store, None, None, range(1), BUDGET, Training(), 1)
    plan = make_plan(*arguments)
    assert run_cells(plan.todo, library, store) == []
    records = {record.method: record for record in store.records()}
    assert records.keys() == {*TABLE_METHODS, *TABLE_REFERENCES}
    for record in records.values():
        returns = np.array(record.result["task_returns"])
        assert np.isfinite(returns).all()
        assert returns.shape == ((2, 3) if "queries" in record.result else (2,))
        assert record.provenance["versions"]["torch"]
        assert record.result["training_samples"] == 300
        assert record.identity["model"].startswith("file ")
        assert str(tmp_path) not in json.dumps([record.result, record.provenance, record.identity])
    assert records["anole"].result["fragments"] == "replay buffer"
    rows = suite_rows(Selection(TINY, records.values()))
    assert {row.method for row in rows} == {*TABLE_METHODS, *TABLE_REFERENCES}
    again = make_plan(*arguments)
    assert (len(again.done), again.todo) == (len(plan.todo), [])


def test_methods_that_know_more_run_and_are_recorded(tmp_path: Path, handed_over: Path) -> None:
    """Candidates from the training tasks, and questions about rollouts on the new task, which are
    as many as others make.
    """
    library, store = library_of(tmp_path, handed_over / "all")
    methods = ("anole-rollouts-aggregate", "pearl-bayes", "reward-oracle-aggregate")
    informed = (*methods, "poem-bayes-aggregate-decoder")
    suite = replace(TINY, entries=(Entry("informed", "", informed, record_at=(0, 2)),))
    plan = make_plan(suite, library, store, None, informed, range(1), BUDGET, Training(), 1)
    assert run_cells(plan.todo, library, store) == []
    records = {record.method: record for record in store.records()}
    assert records.keys() == set(informed)
    for method, record in records.items():
        assert np.isfinite(record.result["task_returns"]).all()
        assert record.result["adaptation_trajectories"] == 2 * 2 * 2  # tasks, answers, two each
        asked = "rollouts of the new task" if method in methods[:2] else None
        assert record.result.get("fragments") == asked
        assert record.identity.get("library") == (None if asked is None else "rollouts")


def test_every_kind_of_question_is_asked_and_recorded(tmp_path: Path, handed_over: Path) -> None:
    questions, *others = (replace(one, record_at=(0, 2)) for one in SUITES["answers"].entries)
    entries = (replace(questions, oracles=(BOLTZMANN,)), *others)
    library, store = library_of(tmp_path, handed_over / "all")
    few = {"Bayes": (("n_particles", 20),)}
    suite = replace(SUITES["answers"], entries=entries, references=(), overrides=few)
    given = (["PointGoal"], None, range(1), BUDGET, Training(), 1)
    plan = make_plan(suite, library, store, *given)
    assert run_cells(plan.todo, library, store) == []
    records = list(store.records())
    assert len(records) == 6 + 2 + 2 * 2
    for record in records:
        kind, graded = record.identity["options"].get("question", "pair"), {"thresholds"}
        films = 2 + 2 * (kind == "best-of-four")
        letters = {"pair": "ler", "graded": "LlerR", "best-of-four": "1234e"}[kind]
        assert record.result["adaptation_trajectories"] == 2 * 2 * films  # of tasks and questions
        assert set("".join(record.result["answers"])) <= set(letters)
        other = record.identity["oracle"].keys() - {"kind", "value", "told"}
        assert other == (graded if kind == "graded" else set())
        assert Cell.of_identity(record.method, record.identity).key == record.key


def test_who_answers_may_err_otherwise_than_rules_are_told() -> None:
    ten, twenty = OracleSpec("mistake", 0.1), OracleSpec("mistake", 0.2)
    better, worse = (
        Trajectory(np.zeros((2, 2)), np.zeros((1, 1)), np.zeros(5), np.array([[speed]]))
        for speed in (2.0, 1.0)
    )
    rates = []
    for spec in (ten, twenty, replace(twenty, told=ten)):
        oracle = make_oracle_factory(spec)(SpeedEnv(), np.array([2.0]), 0)
        flips = sum(oracle(better, worse) is Preference.RIGHT for _ in range(99))
        rates.append((oracle.noise_model, flips))
    assert [noise for noise, _ in rates] == [
        MistakeNoise(0.1),
        MistakeNoise(0.2),
        MistakeNoise(0.1),
    ]
    assert 0 < rates[0][1] < rates[1][1] == rates[2][1]


def test_a_finished_cell_is_verified(
    tmp_path: Path, handed_over: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Run again it is the same; a record that was changed is found out, figure or identity."""
    words = ["--models", str(handed_over / "all"), "--runs", str(tmp_path)]
    words += ["--store", str(tmp_path / "s.sqlite")]
    run = ["benchmark", "run", "--suite", "smoke", "--seeds", "1", "--tasks", "2"]
    assert main([*run, "--episodes", "1", "--methods", "poem-paper", "known-task", *words]) == 0
    verify = ["benchmark", "verify", *words]
    assert main(verify) == 0
    listed = capsys.readouterr().out.splitlines()[-3:]
    named = [line.partition("PointGoal, ")[2] for line in listed]
    assert sorted(named)[1:] == ["poem-paper, seed 0", "poem-paper, seed 0, Boltzmann answers"]
    for line in listed:
        assert main([*verify, "--cell", line[:10]]) == 0
        assert capsys.readouterr().out.endswith("the same, bit for bit\n")
    key = next(line.split()[0] for line in listed if line.endswith("poem-paper, seed 0"))
    with Store(tmp_path / "s.sqlite") as store:
        [record] = [one for one in store.records() if one.key == key]
    false = json.loads(json.dumps(record.result))
    false["task_returns"][1][0] += 0.0001
    other = {**record.identity, "tasks": 3}
    for name, change in (("figure", {"result": false}), ("identity", {"identity": other})):
        words[-1] = str(tmp_path / f"{name}.sqlite")
        with Store(words[-1]) as store:
            store.add(replace(record, **change))
    assert main(["benchmark", "verify", *words, "--cell", key]) != 0
    assert f"the identity of cell {key} has the key" in capsys.readouterr().err
    words[-1] = str(tmp_path / "figure.sqlite")
    assert main(["benchmark", "verify", *words, "--cell", key]) == 1
    n = len(false["queries"]) * 2
    assert f"task_returns: 1 of {n} numbers differ, the most at [1, 0]" in capsys.readouterr().out
    assert main(["benchmark", "verify", *words, "--cell", "x"]) != 0
    assert "--cell x is no cell's key" in capsys.readouterr().err
    trained = ModelLibrary(Workplace(str(tmp_path))).origin(ModelKey(POINT, "poem", 0))
    with Store(words[-1]) as store:
        missing = Cell.of_identity("poem-paper", {**record.identity, "model": trained})
        store.add(replace(record, key=missing.key, identity=missing.identity()))
    assert main(["benchmark", "verify", *words, "--cell", missing.key]) == 0  # of equal weights
    assert capsys.readouterr().out.endswith("the same, bit for bit\n")
    nowhere = ["--runs", str(tmp_path / "nowhere"), "--store", words[-1], "--cell", missing.key]
    assert main(["benchmark", "verify", *nowhere]) != 0  # and nothing is trained
    assert "missing: say where it is by --runs" in capsys.readouterr().err
    early = replace(missing, snapshot=0.5)  # which no model that was handed over is
    with Store(words[-1]) as store:
        store.add(replace(record, key=early.key, identity=early.identity()))
    assert main(["benchmark", "verify", *words, "--cell", early.key]) != 0
    assert "handed over: say where it is by --runs" in capsys.readouterr().err
    words[1] = str(handed_over / "without")
    assert main(["benchmark", "verify", *words, "--cell", key]) != 0
    assert "say where it is by --runs, --models or --model" in capsys.readouterr().err


def test_a_model_without_experience(
    tmp_path: Path, handed_over: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    library, store = library_of(tmp_path, handed_over / "without")
    methods = ["anole-random", "maml-reward"]
    suite = replace(TINY, entries=(replace(TINY.entries[0], oracles=(EXACT, BOLTZMANN)),))
    plan = make_plan(suite, library, store, None, methods, range(1), BUDGET, Training(), 1)
    failures = run_cells(plan.todo, library, store)
    assert len(failures) == 2
    assert capsys.readouterr().err.count("Traceback") == 1  # not tried twice
    for failure in failures:
        assert "which the model that was handed over does not have; hand over its" in failure
    for record in store.records():
        assert record.result["fragments"] == "rollouts of the training tasks"


def test_what_is_made_from_a_model_is_made_anew_of_another(
    tmp_path: Path, handed_over: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_poem.benchmark.models.META_ITERATIONS_OF", {"PointGoal": 2})
    checkpoint = tmp_path / "later/PointGoal/pearl/seed0/checkpoint.zip"
    small(PEARLSAC).learn(600).save_checkpoint(checkpoint)
    key, env = ModelKey(POINT, "maml-reward", 0), make_task_vec_env(POINT, 2)
    made = []
    for models in (handed_over / "all", tmp_path / "later"):
        library, _ = library_of(tmp_path, models)
        made.append(library.ensure(key))
        assert library.load(key, env).reward.digest
    assert [info["env_steps"] for info in made] == [300, 600]


def test_what_ships_is_exported_with_what_it_earns(
    tmp_path: Path, handed_over: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["benchmark", "run", "--seeds", "1", "--families", "PointGoal", "--tasks", "2"]
    words += ["--episodes", "1", "--models", str(tmp_path / "given"), "--runs", str(tmp_path)]
    words += ["--store", str(tmp_path / "s.sqlite"), "--export", str(tmp_path / "out")]
    known = {"command": "sb3-poem train", "commit": "abc", "note": "of a test", "license": "gpl"}
    trained = POEMSAC.load(handed_over / "all/PointGoal/poem/seed0.zip")
    trained.save_pretrained(tmp_path / "given/PointGoal", {**known, "wall_seconds": 60.0})
    assert main([*words, "--suite", "shipped"]) == 0
    model = POEMSAC.from_pretrained(tmp_path / "out" / "PointGoal")
    assert model.num_timesteps == 300
    card = json.loads((tmp_path / "out/PointGoal/config.json").read_text())["card"]
    assert {**known, "wall_seconds": 60.0}.items() <= card.items()  # what its folder told of it
    results = card["results"]
    earned = results["adaptation to 2 unseen tasks"]
    assert [one["inference"] for one in earned] == ["bayes", "paper"]
    with Store(tmp_path / "s.sqlite") as store:
        records = {record.method: record.result for record in store.records()}
    known = np.mean(records["known-task"]["task_returns"])
    for one, method in zip(earned, ("poem-bayes", "poem-paper"), strict=True):
        assert one["queries"] == [0, 1, 2, 3, 5, 7, 10]
        np.testing.assert_allclose(
            one["mean_return"], np.mean(records[method]["task_returns"], axis=0)
        )
        assert one["known_task_return"] == pytest.approx(known)
        assert one["limit"][:2] == records["known-task"]["limits"]["codebooks"][:2]
    assert results["property 1"]["env_steps"] == 300
    shown = (tmp_path / "out/PointGoal/README.md").read_text()
    assert "adaptation to 2 test tasks" in shown
    assert f"| `Bayes()` | default | {earned[0]['mean_return'][0]:.1f} |" in shown
    assert main([*words, "--suite", "smoke"]) != 0
    assert "--export is for --suite shipped" in capsys.readouterr().err


@pytest.mark.slow
def test_every_method_is_trained_and_measured_along_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sb3_poem.benchmark.models.META_ITERATIONS_OF", {"PointGoal": 2})
    library, store = library_of(tmp_path)
    arguments = (TINY, library, store, None, None, range(1), BUDGET, TRAINING)
    plan = make_plan(*arguments)
    assert run_cells(plan.todo, library, store) == []
    records = list(store.records())
    assert {record.method for record in records} == {*TABLE_METHODS, *TABLE_REFERENCES}
    assert (
        len(records) == len(plan.todo) == 9 + 5
    )  # MAML-reward, greedy search and what is known have no curve
    for record in records:
        model = record.provenance["model"]
        returns = np.array(record.result["task_returns"])
        assert np.isfinite(returns).all()
        assert len(returns) == 2
        assert record.provenance["versions"]["torch"]
        assert record.result["training_samples"] > 0
        assert str(tmp_path) not in json.dumps([record.result, record.provenance, record.identity])
        assert (model.get("base") or model)["hyperparameters"]["gradient_steps"] == 3
        if record.identity["snapshot"] is None:
            assert record.result["training_samples"] == 1800
            assert "queries" not in record.result or returns.shape == (2, 3)
        else:
            assert 300 < record.result["training_samples"] < 1800
            assert returns.shape == (2, 1)
    fragments = {record.result.get("fragments") for record in records if record.method == "anole"}
    assert fragments == {"replay buffer", "rollouts of the training tasks"}
    assert {row.method for row in suite_rows(Selection(TINY, records))} == {
        *TABLE_METHODS,
        *TABLE_REFERENCES,
    }

    again = make_plan(*arguments)
    assert (len(again.done), again.todo) == (len(plan.todo), [])
    assert len(list((tmp_path / "runs").rglob("sessions/*.json"))) == 2


def test_a_family_of_ones_own_is_trained_by_the_module_that_registers_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_family.py").write_text(
        "import gymnasium\nfrom poem_envs.point_goal import PointGoalEnv\n"
        "gymnasium.register('own/Point-v0', PointGoalEnv, max_episode_steps=25)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path])
    words = "benchmark run --suite smoke --families own/Point-v0 --methods poem-bayes --seeds 1"
    little = "--timesteps 100 --params n_train_tasks:4 gradient_steps:1 learning_rate:lin_1e-3"
    own = "--gym-packages own_family --snapshots 1 --tasks 2 --episodes 1"
    try:
        assert main(f"{words} {little} {own}".split()) == 0
    finally:
        gym.registry.pop("own/Point-v0", None)
        sys.modules.pop("own_family", None)
    (record, _) = Store(Path("benchmark.sqlite"), create=False).records()
    command = shlex.split(record.provenance["model"]["command"])  # as a shell takes it back
    assert {"own_family", "learning_rate:'lin_1e-3'"} < set(command)


def test_a_training_that_fails_is_reported_and_the_rest_is_run(tmp_path: Path) -> None:
    library, store = library_of(tmp_path)
    methods = ["anole", "reward-oracle", "maml-reward"]  # of one model, and one made from it
    broken = Training(600, (("gradient_stebs", 3),))
    plan = make_plan(TINY, library, store, None, methods, range(1), BUDGET, broken, 1)
    lines: list[str] = []
    failures = run_cells(plan.todo, library, store, lines.append)
    assert len(failures) == 3
    assert all(
        "Unknown key 'gradient_stebs'" in failure and "did you mean" in failure
        for failure in failures
    )
    assert sum(line.startswith(("training", "resuming")) for line in lines) == 1  # not tried twice
    assert store.keys() == set()


def test_cells_whose_model_another_process_trains_come_last(
    tmp_path: Path, handed_over: Path
) -> None:
    (tmp_path / "pearl/PointGoal").mkdir(parents=True)
    pearl = handed_over / "all/PointGoal/pearl"
    shutil.copytree(pearl, tmp_path / "pearl/PointGoal/pearl")
    library, store = library_of(tmp_path, tmp_path / "pearl")
    methods = ["poem-paper", "reward-oracle"]
    plan = make_plan(TINY, library, store, None, methods, range(1), BUDGET, Training(), 1)
    assert [cell.method for cell in plan.todo] == methods
    key = plan.todo[0].model_key
    lines: list[str] = []
    with contextlib.ExitStack() as other_process:
        other_process.enter_context(locked(library.lock_file(key)))

        def say(line: str) -> None:
            lines.append(line)
            assert "waiting" not in line  # this process would wait for ever
            if "reward-oracle" in line:  # the other one ends its training
                run = library.folder(key) / "poem_sac/poem-PointGoal-v0_1"
                run.mkdir(parents=True)
                model = handed_over / "all/PointGoal/poem/seed0.zip"
                shutil.copy(model, run / "poem-PointGoal-v0.zip")
                made = {"run": str(run.relative_to(library.folder(key))), "seconds": 1.0}
                (library.folder(key) / "trained.json").write_text(json.dumps(made))
                other_process.close()

        assert run_cells(plan.todo, library, store, say) == []
    shown = [line.split(", ")[1] for line in lines if line.startswith("[")]
    assert shown == ["reward-oracle", "poem-paper"]
    assert len(store.keys()) == 2


def test_cells_that_failed_are_not_counted_as_run(
    tmp_path: Path,
    handed_over: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With Ray a model that cannot be trained fails by itself, and then with each cell."""
    failures = ["poem", "poem-paper, return", "poem-paper, Boltzmann"]
    monkeypatch.setattr("sb3_poem.cli.benchmark.run_with_ray", lambda *_: failures)
    words = ["--models", str(handed_over / "all"), "--store", str(tmp_path / "s.sqlite")]
    words += ["--runs", str(tmp_path), "--seeds", "1", "--methods", "poem-paper"]
    assert main(["benchmark", "run", "--suite", "smoke", *words, "--backend", "ray"]) == 1
    assert "\n0 cells run, 3 failed" in capsys.readouterr().out


def test_processes_that_keep_models_apart_share_the_cells_of_a_store(
    tmp_path: Path, handed_over: Path
) -> None:
    """One finds a cell taken, waits, and has nothing to do."""
    workplaces = [Workplace(str(tmp_path / name), (str(handed_over / "all"),)) for name in "ab"]
    first, second = map(ModelLibrary, workplaces)
    path, lines = tmp_path / "store.sqlite", []
    how = (None, None, ["poem-paper"], range(1), BUDGET, Training(), 1)
    cells = make_plan(TINY, first, *how).todo

    def other_process() -> None:
        with Store(path) as store:
            lines.append(run_cells(cells, second, store, lines.append))

    other = threading.Thread(target=other_process)

    def say(line: str) -> None:
        if line.startswith("[1/1]"):
            other.start()
            while not lines:
                time.sleep(0.01)

    with Store(path) as store:
        assert run_cells(cells, first, store, say) == []
        other.join()
        assert len(store.keys()) == 1
    assert lines == [f"waiting for another process: {cells[0]}", []]


def test_an_interrupted_training_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    """Time after the last checkpoint of the session before counts for nothing."""
    library, _ = library_of(tmp_path)
    key = ModelKey(POINT, "poem", 0, Training(600, tuple(sorted(TINY_MODEL.items()))))
    folder = library.folder(key)
    run = folder / "poem_sac" / "poem-PointGoal-v0_1"
    callback = TrainingCheckpointCallback(run / "checkpoint.zip")

    class Stop(EpochCallback):
        def _on_epoch(self) -> None:
            callback.stop()

    with pytest.raises(KeyboardInterrupt):
        small(POEMSAC).learn(600, [Stop(), callback])
    (run / "poem-PointGoal-v0").mkdir()
    (run / "poem-PointGoal-v0/args.yml").write_text("seed: 0")
    write_json_atomically(folder / "sessions/1.json", {"seconds": 100.0, "cpu_seconds": 50.0})
    write_json_atomically(folder / "begun.json", {"hyperparameters": {}, "revision": 7})
    assert library.state(key) == "interrupted"
    lines: list[str] = []
    info = library.ensure(key, lines.append)
    assert lines[0].startswith("resuming PointGoal poem seed 0")
    assert "Resuming" in (folder / "train.log").read_text()
    assert (info["env_steps"], info["sessions"], info["revision"]) == (600, 2, 7)
    own = json.loads((folder / "sessions/2.json").read_text())
    assert own["cpu_seconds"] > 0
    assert info["seconds"] == pytest.approx(100.0 + own["seconds"], abs=0.1)
    assert info["cpu_seconds"] == pytest.approx(50.0 + own["cpu_seconds"], abs=0.1)
    assert library.state(key) == "trained"


def start(folder: Path) -> subprocess.Popen[str]:
    parameters = [f"{name}:{value}" for name, value in {**TINY_MODEL, "gradient_steps": 20}.items()]
    command = [
        sys.executable,
        "-m",
        "sb3_poem",
        "benchmark",
        "run",
        "--suite",
        "smoke",
        "--seeds",
        "1",
    ]
    command += ["--methods", "poem-paper", "--snapshots", "1", "--tasks", "2", "--episodes", "1"]
    command += ["--timesteps", "9000", "--params", *parameters]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def wait_for(pattern: str, folder: Path, process: subprocess.Popen[str]) -> Path:
    while process.poll() is None:
        found = list(folder.rglob(pattern))
        if found:
            return found[0]
        time.sleep(0.02)
    raise AssertionError(f"no {pattern} before the end: {process.communicate()[0]}")


@pytest.mark.slow
def test_a_killed_run_is_continued_by_two_processes_and_nothing_is_done_twice(
    tmp_path: Path,
) -> None:
    first = start(tmp_path)
    checkpoint = wait_for("checkpoint.zip", tmp_path, first)
    children = [
        int(pid)
        for pid in subprocess.run(
            ["pgrep", "-P", str(first.pid)], capture_output=True, text=True
        ).stdout.split()
    ]
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    assert children
    deadline = time.time() + 10
    while (
        any(Path(f"/proc/{child}/stat").exists() and not is_zombie(child) for child in children)
        and time.time() < deadline
    ):
        time.sleep(0.02)
    assert not any(
        Path(f"/proc/{child}/stat").exists() and not is_zombie(child) for child in children
    )
    assert not list(tmp_path.rglob("trained.json"))
    saved = checkpoint.read_bytes()

    both = [start(tmp_path) for _ in range(2)]
    outputs = [process.communicate()[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], outputs
    [trained] = tmp_path.rglob("trained.json")
    info = json.loads(trained.read_text())
    assert (info["env_steps"], info["sessions"]) == (9000, 2)
    assert info["cpu_seconds"] > 0
    log = trained.with_name("train.log").read_text()
    assert log.count("Resuming") == 1
    assert (
        checkpoint.read_bytes() == saved
    )  # the first run's own; the second went on in a folder of its own
    text = "".join(outputs)
    assert text.count("resuming PointGoal poem seed 0") == 1
    assert text.count("    0: -") == 2  # both oracles' cells, each once
    with Store(tmp_path / "benchmark.sqlite", create=False) as store:
        assert len(list(store.records())) == 2


def is_zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True
