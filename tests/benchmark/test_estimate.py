"""The estimate of ``sb3-poem benchmark run --list``, against what was recorded."""

from __future__ import annotations

import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from sb3_poem import cli
from sb3_poem.benchmark.estimate import Pace, cell_seconds, training_seconds
from sb3_poem.benchmark.store import Record, Store
from sb3_poem.benchmark.suites import SUITES, Budget, ModelKey, digest

FOUR = "poem-bayes-best-of-four"
RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"


def pace_of(records: list[Record]) -> Pace:
    """How fast the machine was that wrote the records: of random questions, which are evaluation
    alone, and of PEARL.
    """
    random = [r for r in records if r.method == "anole-random" and r.identity["snapshot"] is None]
    budget = random[0].identity
    steps = budget["tasks"] * budget["episodes"] * len(budget["record_at"]) * 25
    trained = [r.provenance["model"] for r in random]
    return Pace(
        float(np.mean([r.result["seconds"] for r in random])) / steps,
        float(np.mean([model["seconds"] / model["updates"] for model in trained])),
    )


def test_the_estimate_of_the_smoke_suite_is_within_a_factor_of_two() -> None:
    with Store(RESULTS / "PointGoal" / "benchmark.sqlite", create=False) as store:
        records = {digest({**one.identity, "model": None}): one for one in store.records()}
    pace = pace_of(list(records.values()))
    cells = SUITES["smoke"].cells(["poem/PointGoal-v0"], range(3), snapshots=1)
    assert {cell.key for cell in cells} == set(records)
    estimated: dict[str, float] = defaultdict(float)
    recorded: dict[str, float] = defaultdict(float)
    for cell in cells:
        estimated[cell.method] += cell_seconds(cell, pace)
        recorded[cell.method] += records[cell.key].result["seconds"]
        model = records[cell.key].provenance["model"]
        key = f"training of {cell.model_key}"
        estimated[key], recorded[key] = training_seconds(cell.model_key, pace), model["seconds"]
    for name, seconds in recorded.items():
        if seconds > 6:  # less than that is all overhead
            assert 0.5 < estimated[name] / seconds < 2, name
    assert 0.8 < sum(estimated.values()) / sum(recorded.values()) < 1.25


def test_the_estimate_grows_with_what_is_asked_for() -> None:
    pace = Pace(1e-4, 1e-2)

    def seconds(**budget: int) -> float:
        cells = SUITES["table3"].cells(
            ["poem/AntVel-v0"], [0], budget=Budget(**budget), snapshots=1
        )
        return sum(cell_seconds(cell, pace) for cell in cells)

    assert seconds(tasks=60, episodes=10) == pytest.approx(
        2 * seconds(tasks=30, episodes=10), rel=0.1
    )
    assert seconds(tasks=30, episodes=20) > seconds(tasks=30, episodes=10)
    alone, both = (
        training_seconds(ModelKey("poem/AntVel-v0", name, 0), pace)
        for name in ("pearl", "maml-reward")
    )
    assert both < alone
    cells = SUITES["answers"].cells(["poem/AntVel-v0"], [0], ["poem-bayes", FOUR], snapshots=1)
    pair, four = (
        cell_seconds(next(cell for cell in cells if cell.method == name), Pace(1e-4, 0.0))
        for name in ("poem-bayes", FOUR)
    )
    assert four - pair == pytest.approx(30 * 10 * 2 * 200 * 1e-4)  # tasks, questions, films, steps


def test_the_list_estimates_each_training_and_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def minutes(*flags: str) -> float:
        assert (
            cli.main(["benchmark", "run", "--suite", "smoke", "--seeds", "1", "--list", *flags])
            == 0
        )
        shown = capsys.readouterr().out
        assert (
            len(
                re.findall(
                    r"PointGoal (?:poem|pearl|maml-reward) seed 0: missing, .*, about \d+ min",
                    shown,
                )
            )
            == 3
        )
        number, unit = re.findall(r"\nabout ([\d.]+) (min|h) in one process", shown)[0]
        return float(number) * (60 if unit == "h" else 1)

    assert minutes("--snapshots", "1", "--timesteps", "3000") < minutes(
        "--episodes", "500", "--tasks", "50"
    )
    assert not list(tmp_path.iterdir())
