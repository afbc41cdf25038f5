"""What the suites declare."""

import json
import subprocess
import sys
from dataclasses import replace

import pytest
import yaml
from benchmark_records import cells_of

from poem_envs.registration import family_name
from sb3_poem.benchmark.cells import _episode_seed
from sb3_poem.benchmark.methods import METHODS, VARIANTS
from sb3_poem.benchmark.suites import (
    BOLTZMANN,
    EXACT,
    PAPER_FAMILIES,
    RECORD_AT,
    SUITES,
    Budget,
    Training,
    family_id,
    hashable,
)
from sb3_poem.benchmark.tables import TABLE_3, paper_figure
from sb3_poem.resources import config_file


def test_suites_hold_what_the_issue_asks_for() -> None:
    table = SUITES["table3"].cells(["poem/AntVel-v0"], [0])
    final = {cell.method for cell in table if cell.snapshot is None}
    assert final == {*SUITES["table3"].methods}
    assert {
        "anole",
        "anole-greedy",
        "anole-random",
        "maml-reward",
        "reward-oracle",
        "poem-paper",
        "poem-bayes",
    } < final
    assert all(
        cell.oracle == EXACT and cell.budget.tasks == 30 and cell.budget.episodes == 10
        for cell in table
    )
    assert sorted({cell.snapshot for cell in table if cell.method == "anole"} - {None}) == [
        0.2,
        0.4,
        0.6,
        0.8,
    ]
    assert {cell.snapshot for cell in table if cell.method in ("maml-reward", "anole-greedy")} == {
        None
    }

    ablation = SUITES["ablation"].cells(["poem/HalfCheetahVel-v0"], [0])
    hyperparameters = {
        json.dumps(dict(VARIANTS[cell.definition.variant].hyperparameters)) for cell in ablation
    }
    assert hyperparameters == {
        json.dumps(dict(changes))
        for changes in (
            {},
            {"similarity": "inner"},
            {"similarity": "cosine"},
            {"context": "pearl"},
            {"latent_dim": 2},
            {"latent_dim": 10},
        )
    }
    assert {cell.definition.rule for cell in ablation if cell.definition.rule is not None} == {
        "Paper",
        "Bayes",
    }
    assert {cell.definition.options.get("query_rule") for cell in ablation} == {
        None,
        "worst-case",
        "information-gain",
        "random",
    }
    assert tuple(range(21)) in {cell.budget.record_at for cell in ablation}

    epsilon = SUITES["epsilon"].cells(
        ["poem/HalfCheetahVel-v0"], [0], ["poem-paper-epsilon-0", "poem-paper-epsilon-0.4"]
    )
    assert {(cell.definition.options["epsilon"], cell.oracle) for cell in epsilon} == {
        (value, oracle) for value in (0.0, 0.4) for oracle in (EXACT, BOLTZMANN)
    }
    assert len([name for name in SUITES["epsilon"].methods if "epsilon" in name]) == 2 * 6
    noise = {cell.oracle for cell in cells_of(SUITES["noise"]) if cell.definition.rule is not None}
    assert {(oracle.kind, oracle.value) for oracle in noise} == {
        ("boltzmann", None),
        ("mistake", 0.1),
        ("mistake", 0.2),
    }


def test_every_method_has_a_form_with_the_training_tasks_latents() -> None:
    """But MAML-reward, which has no candidates. No method of the last table is told the noise."""
    for name in {*SUITES["table3"].entries[0].methods} - {"maml-reward"}:
        plain, informed = METHODS[name], METHODS[f"{name}-aggregate"]
        assert informed.name in SUITES["table3"].methods
        assert dict(informed.options) == {**plain.options, "candidates": "aggregate"}
        assert (informed.variant, informed.rule) == (plain.variant, plain.rule)
    parts = [METHODS[name] for name in SUITES["table3"].entries[-1].methods]
    tried = {(one.options.get("candidates"), one.options.get("likelihood")) for one in parts}
    assert {(c, s) for c in ("prior", "aggregate") for s in ("similarity", "decoder")} < tried
    assert {"pearl", "poem", "poem-no-preferences"} == {one.variant for one in parts}
    for name in SUITES["noise"].entries[-1].methods:
        method = METHODS[name]
        assert method.rule != "Bayes" or method.options["noise_model"] == "infer"


def test_a_cell_is_the_same_in_every_suite() -> None:
    keys = {
        name: {cell.key for cell in cells_of(suite, env_ids=["poem/AntVel-v0"])}
        for name, suite in SUITES.items()
    }
    one = {
        cell.method: cell
        for cell in SUITES["table3"].cells(["poem/AntVel-v0"], [0])
        if cell.snapshot is None
    }
    assert one["poem-paper"].key in keys["table3"] & keys["ablation"] & keys["epsilon"]
    assert (
        one["known-task"].key in keys["table3"] & keys["noise"] & keys["ablation"] & keys["epsilon"]
    )
    assert keys["shipped"] < keys["table3"]
    for name, suite in SUITES.items():
        cells = cells_of(suite, env_ids=["poem/AntVel-v0"])
        assert len(keys[name]) == len(cells)


def test_whatever_changes_a_result_changes_the_key() -> None:
    suite = SUITES["smoke"]
    [cell] = [
        c
        for c in suite.cells(["poem/PointGoal-v0"], [0], ["anole"], snapshots=1)
        if c.oracle == EXACT
    ]
    others = [
        suite.cells(["poem/PointGoal-v0"], [0], ["anole"], budget, training, 1)
        for budget, training in (
            (Budget(tasks=9, episodes=5), None),
            (Budget(tasks=10, episodes=6), None),
            (None, Training(timesteps=100)),
            (None, Training(hyperparameters=(("gamma", 0.5),))),
        )
    ]
    keys = [cell.key, *(c.key for cells in others for c in cells if c.oracle == EXACT)]
    keys += [
        c.key
        for c in suite.cells(["poem/PointGoal-v0"], [1], ["anole"], snapshots=1)
        if c.oracle == EXACT
    ]
    keys += [
        c.key
        for c in suite.cells(["poem/AntVel-v0"], [0], ["anole"], snapshots=1)
        if c.oracle == EXACT
    ]
    keys += [replace(cell, revision=0).key, replace(cell, model="file 123").key]
    assert len(set(keys)) == 9


def test_unknown_methods_are_refused() -> None:
    with pytest.raises(ValueError, match="--methods anole: it is not in the suite 'epsilon'"):
        SUITES["epsilon"].cells(["poem/AntVel-v0"], [0], ["anole"])


def test_methods_that_need_shared_dynamics_say_why() -> None:
    assert METHODS["poem-bayes"].objection(shared_dynamics=False) is None
    assert METHODS["anole"].objection(shared_dynamics=True) is None
    assert METHODS["anole-rollouts"].objection(shared_dynamics=False) is None
    for name in ("anole", "anole-greedy", "anole-random", "maml-reward", "pearl-bayes"):
        assert "do not share their dynamics" in (
            METHODS[name].objection(shared_dynamics=False) or ""
        )


def test_family_names() -> None:
    assert family_id("AntGoal") == "poem/AntGoal-v0"
    assert family_id("Walk1D-v0") == "Walk1D-v0"
    assert family_name("poem/AntGoal-v0") == "AntGoal"


def test_baselines_are_trained_on_as_many_samples() -> None:
    poem, pearl = (
        yaml.safe_load(config_file(name).read_text()) for name in ("poem_sac", "pearl_sac")
    )
    assert poem.keys() == pearl.keys()
    assert all(poem[name]["n_timesteps"] == pearl[name]["n_timesteps"] for name in poem)


def test_the_papers_table() -> None:
    assert set(TABLE_3) == set(PAPER_FAMILIES)
    assert all(
        len(rows) == 5 and all(len(row) == 3 for row in rows.values()) for rows in TABLE_3.values()
    )
    assert paper_figure("HalfCheetahVel", "POEM", 10) == (-46.0, 6.0)
    assert paper_figure("MetaWorldML1", "ANOLE-greedy", 1) == (1091.0, 47.0)
    assert paper_figure("HumanoidDir2D", "MAML-reward", 5) == (529.0, 56.0)
    assert paper_figure("HalfCheetahVel", "POEM", 3) == (None, None)
    assert paper_figure("PointGoal", "POEM", 10) == (None, None)
    assert set(RECORD_AT) >= {1, 5, 10}


def test_the_declarations_are_light() -> None:
    """The command line reads them for its help."""
    code = "import sys, sb3_poem.benchmark.suites; print({'torch', 'mujoco'} & set(sys.modules))"
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout.strip()
        == "set()"
    )


def test_seeds_share_no_episodes_or_answers() -> None:
    cells = SUITES["noise"].cells(["poem/PointGoal-v0"], range(3), ["anole"], snapshots=1)
    seeds = {
        cell.seed: {_episode_seed(cell) + i for i in range(cell.budget.tasks)} for cell in cells
    }
    assert len(set.union(*seeds.values())) == 3 * 30


def test_hyperparameters_can_be_looked_up() -> None:
    assert hashable([64, [1, 2]]) == (64, (1, 2))
    with pytest.raises(ValueError, match="is a dictionary; write it as text"):
        hashable({"pi": [64]})
