"""The record of ``benchmarks/graded_answers.py``: cells of another model are done again."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


def test_cells_of_an_earlier_model_are_marked_and_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("common", "graded_answers"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    graded, told = importlib.import_module("graded_answers"), []

    def evaluate(model, env, tasks, oracle, *, rule, **settings):
        told.append(rule.noise_model)
        found = np.full((tasks, 5), len(told), dtype=float)
        return SimpleNamespace(mean_returns=found.mean(axis=0), task_returns=found)

    monkeypatch.setattr(graded, "evaluate_adaptation", evaluate)
    arguments = ["--models", "PointGoal", "--oracles", "20 % mistakes, told 10 %", "--tasks", "2"]
    monkeypatch.setattr(sys, "argv", ["x", *arguments, "--out", str(tmp_path)])
    graded.main()
    assert [getattr(noise, "rate", noise) for noise in told] == 2 * [None, "infer", 0.1]
    graded.main()
    assert len(told) == 6  # nothing is done twice
    file = tmp_path / "answers.json"
    file.write_text(file.read_text().replace('"model": "', '"model": "another', 1))
    graded.main()
    assert len(told) == 7
    assert "earlier" not in (tmp_path / "answers.md").read_text().partition("|")[2]
    file.write_text(file.read_text().replace('"model": "', '"model": "another', 1))
    monkeypatch.setattr(sys, "argv", ["x", "--out", str(tmp_path)])
    graded.main()
    assert (tmp_path / "answers.md").read_text().count("| earlier |") == 1
