"""Which models are taken, and what is refused before any training."""

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from meta_toys import small, walks

from sb3_poem import PEARLSAC, POEMSAC
from sb3_poem.benchmark.estimate import Pace
from sb3_poem.benchmark.models import ModelLibrary, Workplace
from sb3_poem.benchmark.running import describe, make_plan
from sb3_poem.benchmark.suites import REVISION, SUITES, Budget, ModelKey, Training, family_id
from sb3_poem.benchmark.training import FamilyFacts, family_facts, training_plan
from sb3_poem.cli import main
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.resources import shipped_folder

POINT = "poem/PointGoal-v0"
ML10 = FamilyFacts("poem/MetaWorldML10-v0", 200, 120, False)  # which takes seconds to make


def plan_for(
    library: ModelLibrary,
    suite: str,
    families: list[str] | None,
    methods: list[str] | None = None,
    seeds: int = 1,
):
    return make_plan(
        SUITES[suite], library, None, families, methods, range(seeds), Budget(), Training()
    )


def test_the_training_plan_follows_the_hyperparameter_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = training_plan(ModelKey("poem/HalfCheetahVel-v0", "poem-d2", 0))
    assert (plan.timesteps, plan.epoch_steps, plan.updates) == (720_000, 24_000, 30_000)
    assert plan.save_steps == 48_000
    assert plan.hyperparameters["latent_dim"] == 2
    assert plan.overrides == {"latent_dim": 2}
    two_tasks = training_plan(ModelKey("poem/HalfCheetahFwdBack-v0", "poem", 0))
    assert (two_tasks.epoch_steps, two_tasks.updates) == (24_000, 120_000)
    monkeypatch.setattr("sb3_poem.benchmark.training.family_facts", lambda name: ML10)
    # 120 tasks, and each policy on the three other tasks of its group, or four times on its own
    ml10 = [training_plan(ModelKey(ML10.env_id, name, 0)) for name in ("poem", "pearl")]
    assert [(plan.epoch_steps, plan.updates) for plan in ml10] == [(4 * 24_000, 63_000)] * 2
    monkeypatch.undo()
    shorter = training_plan(ModelKey(POINT, "pearl", 0, Training(3000, (("gradient_steps", 7),))))
    assert (shorter.timesteps, shorter.updates) == (3000, 7)
    assert shorter.overrides == {"gradient_steps": 7}
    # 150 rollouts by 120 copies, which are as many as training takes: all make two
    how = Training(8000, (("n_train_tasks", 50), ("trajectories_per_task", 3)))
    assert training_plan(ModelKey(POINT, "poem", 0, how)).epoch_steps == 240 * 25
    few = Training(8000, (*how.hyperparameters, ("n_envs", 40)))
    assert training_plan(ModelKey(POINT, "poem", 0, few)).epoch_steps == 160 * 25


def test_shipped_models_are_taken_for_their_own_seed_alone() -> None:
    folder = shipped_folder("pretrained")
    library = ModelLibrary(Workplace("nowhere", models=(str(folder),)))
    for family in ("PointGoal", "HalfCheetahVel", "HalfCheetahFwdBack"):
        own = json.loads((folder / family / "config.json").read_text())["arguments"]["seed"]
        keys = [ModelKey(f"poem/{family}-v0", "poem", seed) for seed in range(3)]
        assert [library.given(key) is not None for key in keys] == [
            seed == own for seed in range(3)
        ]
        for variant in (
            "poem-inner",
            "poem-pearl-context",
            "poem-d2",
            "poem-d10",
            "pearl",
            "maml-reward",
        ):
            assert library.given(ModelKey(f"poem/{family}-v0", variant, own)) is None
    altered = ModelKey("poem/HalfCheetahVel-v0", "poem", 0, Training(timesteps=1000))
    assert library.given(altered) is None


def test_a_model_is_told_by_its_hyperparameters_or_its_file(tmp_path: Path) -> None:
    library, key = ModelLibrary(Workplace(str(tmp_path))), ModelKey(POINT, "poem", 0)
    made = library.origin(key)
    assert made == library.origin(replace(key, seed=1))
    assert made != library.origin(ModelKey(POINT, "poem-inner", 0))
    pearl, reward = (library.origin(ModelKey(POINT, name, 0)) for name in ("pearl", "maml-reward"))
    assert pearl == reward
    shipped = ModelLibrary(Workplace(str(tmp_path), models=(str(shipped_folder("pretrained")),)))
    folder = shipped_folder("pretrained") / "PointGoal"
    own = replace(key, seed=json.loads((folder / "config.json").read_text())["arguments"]["seed"])
    sha256 = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    assert sha256.startswith(shipped.origin(own).removeprefix("file "))
    begun = library.folder(key) / "begun.json"
    begun.parent.mkdir(parents=True)
    hyperparameters = json.loads(json.dumps(training_plan(key).hyperparameters))
    begun.write_text(json.dumps({"hyperparameters": hyperparameters, "revision": REVISION}))
    (begun.parent / "trained.json").touch()
    assert library.origin(key) == made
    begun.write_text(json.dumps({"hyperparameters": hyperparameters, "revision": REVISION + 1}))
    assert library.origin(key) != made
    hyperparameters["gamma"] = 0.5
    begun.write_text(json.dumps({"hyperparameters": hyperparameters, "revision": REVISION}))
    with pytest.raises(
        ValueError, match="was trained with other hyperparameters than zoo_configs/"
    ):
        library.origin(key)


def test_families_of_one_name_have_folders_of_their_own(tmp_path: Path) -> None:
    library = ModelLibrary(Workplace(str(tmp_path)))
    ids = ("poem/PointGoal-v0", "mine/PointGoal-v0", "poem/PointGoal-v1")
    folders = [
        library.folder(ModelKey(env_id, "poem", 0)).relative_to(tmp_path).as_posix()
        for env_id in ids
    ]
    assert folders == [
        "PointGoal/poem/seed0",
        "mine-PointGoal-v0/poem/seed0",
        "poem-PointGoal-v1/poem/seed0",
    ]


def test_models_are_found_in_a_folder_or_by_name_and_checked(tmp_path: Path) -> None:
    poem = small(POEMSAC, latent_dim=2).learn(300)
    pearl = small(PEARLSAC).learn(300)
    poem.save(tmp_path / "models/PointGoal/poem-d2/seed0.zip")
    (tmp_path / "models/PointGoal/pearl/seed0").mkdir(parents=True)
    pearl.save_checkpoint(tmp_path / "models/PointGoal/pearl/seed0/checkpoint.zip")
    poem.save_pretrained(tmp_path / "elsewhere")
    named = (("PointGoal", "poem-inner", 0, str(tmp_path / "elsewhere")),)
    library = ModelLibrary(
        Workplace(str(tmp_path / "runs"), models=(str(tmp_path / "models"),), named=named)
    )
    env = make_task_vec_env(POINT, 4)
    loaded = library.load(ModelKey(POINT, "poem-d2", 0), env)
    assert loaded.num_timesteps == poem.num_timesteps
    with_buffer = library.load(ModelKey(POINT, "pearl", 0), env)
    np.testing.assert_array_equal(with_buffer.replay_buffer.counts, pearl.replay_buffer.counts)
    info = library.ensure(ModelKey(POINT, "poem-d2", 0))
    assert info["source"] == "handed over"
    assert len(info["sha256"]) == 64
    assert str(tmp_path) not in json.dumps(info)
    with pytest.raises(
        ValueError,
        match=r"handed over as PointGoal poem-inner seed 0, but has \(similarity, context, latent",
    ):
        library.load(ModelKey(POINT, "poem-inner", 0), env)
    env.close()
    # made from another one's model, and of another environment than the cells'
    pearl.save(tmp_path / "models/PointGoal/maml-reward/seed0.zip")
    assert library.given(ModelKey(POINT, "maml-reward", 0)) is None
    short = small(POEMSAC, make_task_vec_env(POINT, 4, step_length=0.1)).learn(300)
    short.save(tmp_path / "models/PointGoal/poem/seed0.zip")
    with pytest.raises(ValueError, match=r"env_kwargs {'step_length': 0.1} instead of {}"):
        library.load(ModelKey(POINT, "poem", 0), make_task_vec_env(POINT, 4))


def test_the_model_saved_nearest_to_a_share_of_the_training(tmp_path: Path) -> None:
    library, key = ModelLibrary(Workplace(str(tmp_path))), ModelKey(POINT, "poem", 0)
    plan = training_plan(key)
    run = library.folder(key) / "poem_sac" / "poem-PointGoal-v0_1"
    run.mkdir(parents=True)
    for steps in (plan.epoch_steps, plan.timesteps // 2):
        (run / f"rl_model_{steps}_steps.zip").touch()
    half = library.snapshot_file(key, 0.5 + 0.4 * plan.save_steps / plan.timesteps)
    assert half.name == f"rl_model_{plan.timesteps // 2}_steps.zip"
    with pytest.raises(ValueError, match="has no model that was saved near 1,050 steps"):
        library.snapshot_file(key, 0.01)  # nothing was learnt from the first epoch


def test_a_method_that_cannot_run_on_a_family_says_so_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = family_facts("PointGoal")
    for module in ("running", "training", "estimate"):
        monkeypatch.setattr(
            f"sb3_poem.benchmark.{module}.family_facts",
            lambda name: ML10 if "ML10" in name else family_facts(name),
        )
    monkeypatch.setattr("sb3_poem.benchmark.running.measure_pace", lambda *where: Pace(1e-4, 1e-2))
    assert known.shared_dynamics
    library = ModelLibrary(Workplace(str(tmp_path)))
    with pytest.raises(
        ValueError,
        match="--methods anole cannot run on MetaWorldML10: its tasks do not share their dynamics",
    ):
        plan_for(library, "table3", ["MetaWorldML10"], ["anole"])
    plan = plan_for(library, "table3", ["MetaWorldML10"])
    skipped = {cell.method for cell, _ in plan.skipped}
    assert skipped >= {"anole", "anole-greedy-aggregate", "maml-reward"}
    assert not skipped & {"anole-rollouts", "poem-bayes-prior-similarity", "reward-oracle"}
    assert {cell.method for cell in plan.todo} >= {"poem-bayes", "poem-paper", "reward-oracle"}
    lines = "\n".join(describe(plan, library))
    assert "anole cannot run on MetaWorldML10" in lines
    assert re.search(r"MetaWorldML10 poem seed 0: missing, [\d,]+ steps", lines)
    for families, message in (
        (
            ["HalfCheetahFly"],
            "--families HalfCheetahFly: .* The package's own families are: AntDir2D",
        ),
        (["CartPole-v1"], "--families CartPole-v1: .* is no task family"),
    ):
        with pytest.raises(ValueError, match=message):
            plan_for(library, "table3", families)
    assert not any(tmp_path.iterdir())


def test_families_whose_extra_is_missing_are_left_out_unless_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def facts(name: str) -> FamilyFacts:
        if "MetaWorld" in name:
            raise ImportError("pip install '.[metaworld]'")
        return FamilyFacts(family_id(name), 200, 120, True)

    monkeypatch.setattr("sb3_poem.benchmark.running.family_facts", facts)
    library = ModelLibrary(Workplace(str(tmp_path)))
    plan = plan_for(library, "table3", None)
    assert "poem/AntVel-v0" in {cell.env_id for cell in plan.todo}
    assert {reason for cell, reason in plan.skipped if cell.family.startswith("MetaWorld")} == {
        f"MetaWorld{name}: pip install '.[metaworld]'" for name in ("ML1", "ML10")
    }
    with pytest.raises(ValueError, match=r"--families MetaWorldML1: pip install '.\[metaworld"):
        plan_for(library, "table3", ["MetaWorldML1"])


def test_the_plan_names_each_model_once_and_a_base_first(tmp_path: Path) -> None:
    plan = plan_for(ModelLibrary(Workplace(str(tmp_path))), "table3", ["PointGoal"], seeds=2)
    names = [(key.variant, key.seed) for key in plan.models]
    variants = ("poem", "pearl", "maml-reward", "poem-no-preferences")
    assert sorted(names) == sorted((v, s) for s in range(2) for v in variants)
    assert all(names.index(("pearl", s)) < names.index(("maml-reward", s)) for s in range(2))
    only = plan_for(
        ModelLibrary(Workplace(str(tmp_path))), "table3", ["PointGoal"], ["maml-reward"]
    )
    assert [key.variant for key in only.models] == ["pearl", "maml-reward"]


def test_named_models_of_two_families_of_one_name(tmp_path: Path) -> None:
    for name in ("mine", "theirs"):
        (tmp_path / name).write_bytes(b"")
    named = tuple(
        (f"{name}/PointGoal-v0", "poem", 0, str(tmp_path / file))
        for name, file in (("my", "mine"), ("poem", "theirs"))
    )
    library = ModelLibrary(Workplace(str(tmp_path), named=named))
    assert library.given(ModelKey("my/PointGoal-v0", "poem", 0)) == tmp_path / "mine"
    assert library.given(ModelKey(POINT, "poem", 0)) == tmp_path / "theirs"


def test_a_model_of_ones_own_family_needs_no_entry(tmp_path: Path) -> None:
    arguments = {"n_train_tasks": 4, "horizon": 10, "meta_batch_size": 4}
    model = small(POEMSAC, walks(2), latent_dim=2, **arguments)
    model.env_id = "my/Walk-v0"
    model.save_pretrained(tmp_path / "my-Walk-v0")
    library = ModelLibrary(Workplace(str(tmp_path / "runs"), models=(str(tmp_path),)))
    key = ModelKey("my/Walk-v0", "poem-d2", 0)
    assert library.given(key) == tmp_path / "my-Walk-v0"
    assert library.given(ModelKey("my/Walk-v0", "poem", 0)) is None  # which has five dimensions
    assert library.load(key, walks(2)).latent_dim == 2


def test_a_named_folder_without_a_model(tmp_path: Path) -> None:
    library = ModelLibrary(
        Workplace(str(tmp_path), named=(("PointGoal", "poem", 0, str(tmp_path)),))
    )
    with pytest.raises(ValueError, match=r"holds no model: neither checkpoint\.zip"):
        library.given(ModelKey(POINT, "poem", 0))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--models", "no_such_folder"], "--models no_such_folder: there is no such folder"),
        (
            ["--model", "PointGaol:poem:0=."],
            "PointGaol is none of the families of this run: PointGoal",
        ),
        (["--model", "PointGoal:poem:0=gone"], "0=gone: there is no such file or folder"),
        (["--model", "PointGoal:poem:5=."], "5 is none of the seeds of this run: 0, 1, 2"),
        (
            ["--model", "PointGoal:maml-reward:0=."],
            "maml-reward is none of the models of this run: pearl, poem",
        ),
        (["--device", "gpu"], "--device gpu: there is no such device"),
        (
            ["--params", "trajectories_per_task:0"],
            "`trajectories_per_task` must be at least 1, but is 0",
        ),
        (["--params", "n_train_tasks:few"], "`n_train_tasks` must be a whole number, but is 'few'"),
        (
            ["--params", "net_arch:{'pi': [64]}"],
            "--params net_arch:.*: .* is a dictionary; write it as text",
        ),
    ],
)
def test_what_would_quietly_train_something_else_is_refused(
    words: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["benchmark", "run", "--suite", "smoke", *words]) != 0
    assert re.search(message, capsys.readouterr().err)
    assert not any(tmp_path.iterdir())


def test_lists_are_taken_as_hyperparameters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sb3_poem.benchmark.running.measure_pace", lambda *where: Pace(1e-4, 1e-2))
    runs = ["--runs", str(tmp_path), "--store", str(tmp_path / "s.sqlite")]
    assert (
        main(
            [
                "benchmark",
                "run",
                "--suite",
                "smoke",
                "--list",
                "--params",
                "train_freq:[1, 'step']",
                *runs,
            ]
        )
        == 0
    )
    assert "PointGoal poem seed 0: missing" in capsys.readouterr().out
