"""Tables against values computed by hand, and figures that can be read back."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmark_records import finished
from scipy.stats import mannwhitneyu

from sb3_poem.adaptation import AnswerLimits
from sb3_poem.benchmark.figures import suite_figures
from sb3_poem.benchmark.results import Selection, compare, summarise
from sb3_poem.benchmark.store import Record, Store
from sb3_poem.benchmark.suites import (
    BOLTZMANN,
    SUITES,
    TABLE_METHODS,
    TABLE_REFERENCES,
    Budget,
    Cell,
    OracleSpec,
    Training,
)
from sb3_poem.benchmark.tables import make_report, suite_rows, suite_tables

VEL = "poem/HalfCheetahVel-v0"
FOUR = Budget(tasks=4, episodes=2)


@pytest.fixture(autouse=True)
def few_bootstrap_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_poem.benchmark.results.BOOTSTRAP_SAMPLES", 20)


def ladder(cell: Cell, k: int) -> np.ndarray:
    """Four tasks at 10 apart, 1 higher with each answer, 5 higher with each seed."""
    return np.array([-40.0, -30.0, -20.0, -10.0]) + k + 5.0 * cell.seed


def matrix(cell: Cell) -> dict:
    """Limits of four tasks and four policies, each the best of one: 0 on the diagonal, -1 beside
    it, and so on.
    """
    places = np.arange(4)
    returns = -np.abs(places[:, None] - places[None, :]).astype(float)
    limits = AnswerLimits.measure(returns, returns, returns)
    return {"limits": {name: np.array(value).tolist() for name, value in vars(limits).items()}}


def records_of(suite: str = "table3", seeds: int = 3, **arguments: object) -> list[Record]:
    cells = SUITES[suite].cells([VEL], range(seeds), budget=FOUR, **arguments)
    yardsticks = [matrix(cell) if cell.definition.rule is None else {} for cell in cells]
    return [finished(cell, ladder, **more) for cell, more in zip(cells, yardsticks, strict=True)]


def selection_of(suite: str = "table3", seeds: int = 3, **arguments: object) -> Selection:
    return Selection(SUITES[suite], records_of(suite, seeds, **arguments))


def fill(path: Path, suite: str = "table3", seeds: int = 3, **arguments: object) -> Store:
    store = Store(path)
    for record in records_of(suite, seeds, **arguments):
        store.add(record)
    return store


def test_means_deviations_and_interquartile_means() -> None:
    returns = np.array([[0.0, 10.0, 20.0, 30.0], [4.0, 14.0, 24.0, 34.0]])  # two seeds, four tasks
    one, shifted = summarise(returns), summarise(returns + 100.0)
    assert (one.n_seeds, one.mean) == (2, 17.0)
    assert one.deviation == pytest.approx(np.sqrt(8.0))  # seeds 15 and 19
    assert one.iqm == 17.0  # of 0 4 10 14 20 24 30 34 the middle four
    # Tasks of the lowest draw may all be the first, and of the highest all the last.
    assert 0.0 <= one.iqm_low < one.iqm < one.iqm_high <= 34.0
    assert shifted.mean == one.mean + 100.0
    assert summarise(returns) == summarise(returns)  # a report is the same twice
    same_tasks = summarise(np.array([[15.0] * 4, [19.0] * 4]))
    assert (same_tasks.iqm_low, same_tasks.iqm_high) == (15.0, 19.0)
    single = summarise(returns[:1])
    assert (single.deviation, single.iqm_low, single.iqm_high) == (None, None, None)
    for bad in (returns[0], np.full((2, 2), np.nan), np.empty((0, 3))):
        with pytest.raises(ValueError, match="`returns` must be finite"):
            summarise(bad)


def test_the_probability_of_improvement_is_mann_and_whitneys() -> None:
    rng = np.random.default_rng(0)
    one, other = np.round(rng.normal(size=(2, 3, 8)), 1)  # with ties
    statistics = [
        mannwhitneyu(one[:, task], other[:, task]).statistic / 9 for task in range(one.shape[1])
    ]
    found = compare(one, other)
    assert found.probability == pytest.approx(np.mean(statistics))
    assert found.mean == pytest.approx((one - other).mean())
    assert found.low < found.mean < found.high
    assert found.probability_low < found.probability < found.probability_high


def test_a_claim_needs_mean_interquartile_mean_and_interval() -> None:
    rng = np.random.default_rng(1)
    tasks = 100.0 * rng.normal(size=10)  # far apart: only pairing shows a difference of one
    other = tasks + 0.1 * rng.normal(size=(3, 10))
    assert compare(other + 1.0, other).claim == "ahead"
    assert compare(other - 1.0, other).claim == "behind"
    assert compare(other[:1] + 1.0, other[:1]).claim == ""  # of one seed
    assert compare(other + rng.normal(size=10), other).claim == "not distinguishable"
    # One task of ten is much better, and all others a little worse.
    lucky = other + np.where(np.arange(10) == 0, 1000.0, -0.5)
    found = compare(lucky, other)
    assert (found.mean > 0, found.iqm < 0, found.claim) == (True, True, "not distinguishable")
    assert found.probability == pytest.approx(0.1, abs=0.05)


def test_kinds_of_questions_are_compared_by_films() -> None:
    """A best of four shows twice as many films as a pair, graded or not."""
    tables = suite_tables(selection_of("answers"))
    tables = {table.title.partition("; ")[2]: table for table in tables}
    for oracle in (
        "exact answers",
        "Boltzmann answers",
        "10 % of the answers flipped",
        "20 % of the answers flipped",
    ):
        table = tables[f"kinds of questions, {oracle}"]
        after = {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}
        assert len(after) == 6  # and no limit, which is of pairs
        for label in ("", ", graded", ", best of four"):
            for untold in ("", ", not told the noise"):
                row = after[f"POEM (Bayes){label}{untold}"]
                films = 4 if "four" in label else 2
                assert row["4 films"] == f"{-20 + 4 / films:.1f} ± 5.0"
                assert row["20 films"] == f"{-20 + 20 / films:.1f} ± 5.0"
    about = "exact answers, graded from 0.3 and 1.6 of the spread on"
    assert len(tables[f"other thresholds, {about}"].rows) == 2
    for oracle in ("Boltzmann answers, told as exact answers", "20 % of the answers flipped"):
        told = ", told as 10 % of the answers flipped" * oracle.startswith("20")
        assert len(tables[f"rules told wrongly, {oracle}{told}"].rows) == 2


def test_differences_are_paired_by_seed(tmp_path: Path) -> None:
    def returns(cell: Cell, k: int) -> np.ndarray:
        return ladder(cell, k) + (1.0 if cell.method == "poem-bayes" else 0.0)

    with Store(tmp_path / "store.sqlite") as store:
        cells = SUITES["table3"].cells([VEL], range(3), None, FOUR, snapshots=1)
        for cell in cells:
            if cell.definition.rule and (cell.method, cell.seed) != ("anole", 0):
                store.add(finished(cell, returns))
        text, _ = make_report(store, ["table3"])
        rows = json.loads(make_report(store, ["table3"], kind="json")[0])
    paired = [r for r in rows if (r["kind"], r["entry"]) == ("difference", "methods")]
    pairs = {(row["method"], row["against"]) for row in paired}
    assert len(pairs) == 6 + 5
    assert ("poem-bayes", "poem-paper") in pairs
    assert ("poem-paper", "poem-bayes") not in pairs
    [row] = [
        row
        for row in paired
        if (row["method"], row["against"], row["queries"]) == ("poem-bayes", "anole", 5)
    ]
    # Unpaired the means would differ by 1 - 2.5, as ANOLE lacks the worst seed.
    assert (row["n_seeds"], row["mean"], row["low"], row["high"]) == (2, 1.0, 1.0, 1.0)
    assert row["claim"] == "ahead"
    [line] = [line for line in text.splitlines() if line.startswith("| POEM (Bayes) | ANOLE | 2 |")]
    assert line.split(" | ")[3:5] == ["1.0 [1.0, 1.0]", "1.0"]
    assert line.count("ahead") == 3
    assert "| POEM (paper) | ANOLE | 2 | 0.0 [0.0, 0.0] |" in text


def test_rows_of_table_3() -> None:
    methods = ["poem-paper", "known-task"]
    rows = [row for row in suite_rows(selection_of(methods=methods)) if row.entry == "methods"]
    wanted = ("method", "poem-paper", 5, None)
    [row] = [r for r in rows if (r.kind, r.method, r.queries, r.snapshot) == wanted]
    # Seeds' means are -20, -15, -10.
    assert (row.n_seeds, row.mean, row.deviation) == (3, -15.0, 5.0)
    # The middle six of twelve values -35 -30 -25 -25 -20 -15 -15 -10 -5 -5 0 5.
    assert row.iqm == pytest.approx(-15.0)
    assert (row.paper_mean, row.paper_deviation) == (-50.0, 8.0)
    [early] = [r for r in rows if (r.method, r.queries, r.snapshot) == ("poem-paper", 10, 0.4)]
    assert (early.samples, early.paper_mean) == (400.0, None)
    # One policy for all four tasks loses 1 on average, two (tasks 0, 1 and 2, 3) 1/2, four nothing.
    limits = {r.queries: r.mean for r in rows if r.kind == "limit" and r.method == "known-task"}
    assert (limits[0], limits[1], limits[2], limits[10]) == (-1.0, -0.5, 0.0, 0.0)
    known = [r for r in rows if r.kind == "known" and r.method == "known-task"]
    assert [(r.mean, r.deviation, r.queries) for r in known] == [(-20.0, 5.0, None)]


def test_an_unfinished_method_shows_the_seeds_that_there_are() -> None:
    some = [*records_of(methods=["poem-paper"]), *records_of(seeds=1, methods=["anole"])]
    rows = [r for r in suite_rows(Selection(SUITES["table3"], some)) if r.entry == "methods"]
    final = {r.method: r.n_seeds for r in rows if r.kind == "method" and r.snapshot is None}
    assert final == {"poem-paper": 3, "anole": 1}
    [row] = [r for r in rows if (r.method, r.queries, r.snapshot) == ("anole", 10, None)]
    assert (row.n_seeds, row.mean, row.deviation, row.iqm_low) == (1, -15.0, None, None)


def test_noisy_answers_have_a_lower_limit() -> None:
    selection = selection_of("noise", seeds=1, snapshots=1, methods=["poem-bayes", "known-task"])
    rows = [r for r in suite_rows(selection) if r.kind == "limit" and r.queries == 10]
    by_oracle = {r.oracle: r.mean for r in rows if r.method == "known-task"}
    assert set(by_oracle) == {
        o.label for o in (BOLTZMANN, OracleSpec("mistake", 0.1), OracleSpec("mistake", 0.2))
    }
    assert all(-1.0 <= value <= 0.0 for value in by_oracle.values())
    assert by_oracle[BOLTZMANN.label] < by_oracle["10 % of the answers flipped"]


def test_other_budgets_stand_in_other_tables() -> None:
    suite = replace(SUITES["table3"], entries=SUITES["table3"].entries[:1])
    more = suite.cells([VEL], [0], ["anole"], replace(FOUR, episodes=3), snapshots=1)
    records = records_of(seeds=1, snapshots=1) + [finished(cell, ladder) for cell in more]
    tables = suite_tables(Selection(suite, records))
    assert [table.title for table in tables] == [
        "HalfCheetahVel: 4 test tasks, 2 episodes each; methods, exact answers",
        "HalfCheetahVel: 4 test tasks, 2 episodes each; differences of methods, exact answers",
        "HalfCheetahVel: the models",
        "HalfCheetahVel: 4 test tasks, 3 episodes each; methods, exact answers",
    ]


def test_one_table_never_mixes_versions(tmp_path: Path) -> None:
    """Older revisions have tables of their own; of models trained with other hyperparameters the
    newest are shown, and such as were handed over.
    """
    versions = (
        ([0, 1, 2], {"revision": 0}, -100.0),
        ([0, 1, 2], {"model": "hyperparameters 1"}, -50.0),
        ([0], {"model": "hyperparameters 2"}, 0.0),
        ([1], {"model": "file 1"}, 10.0),
    )
    cells = SUITES["shipped"].cells([VEL], range(3), ["poem-bayes"], FOUR)
    with Store(tmp_path / "store.sqlite") as store:
        for year, (seeds, changes, shift) in enumerate(versions, start=2001):
            for cell in cells:
                if cell.seed in seeds:
                    record = finished(
                        replace(cell, **changes), lambda cell, k, by=shift: ladder(cell, k) + by
                    )
                    store.add(replace(record, created=f"{year}-01-01"))
        tables = suite_tables(Selection(SUITES["shipped"], store.records()))
    old, new = sorted(tables, key=lambda table: "revision" not in table.title)
    assert old.title.split(";")[0].endswith("2 episodes each, revision 0 of the code")
    assert (old.rows[0][1:3], new.rows[0][1:3]) == (("3", "-120.0 ± 5.0"), ("2", "-17.5 ± 10.6"))


def test_one_table_shows_one_model_of_a_seed(tmp_path: Path) -> None:
    """Of two that were handed over for the same seed the one that was measured last, whatever the
    methods.
    """
    with Store(tmp_path / "store.sqlite") as store:
        for year, (method, model) in enumerate(
            [("poem-bayes", "file 1"), ("poem-paper", "file 1"), ("poem-bayes", "file 2")], 2001
        ):
            [cell] = SUITES["shipped"].cells([VEL], [0], [method], FOUR)
            record = finished(replace(cell, model=model), ladder)
            store.add(replace(record, created=f"{year}-01-01"))
        [selection] = [Selection(SUITES["shipped"], store.records())]
    assert {row.method for row in suite_rows(selection)} == {"poem-bayes"}
    assert [one.identity["model"] for one in selection.records.values()] == ["file 2"]


def test_the_table_of_what_ships(tmp_path: Path) -> None:
    """Seeds' means and standard errors over tasks, with success rates and times."""
    facts = {"training_cpu_seconds": 1234.0}
    with Store(tmp_path / "store.sqlite") as store:
        for cell in SUITES["shipped"].cells([VEL], range(2), budget=FOUR):
            known = cell.definition.rule is None
            rates = [0.5] * 4 if known else [[0.25] * 7] * 4
            extra = {**facts, "task_success_rates": rates, **(matrix(cell) if known else {})}
            store.add(finished(cell, ladder, **extra))
        text, _ = make_report(store, ["shipped"])
    # Seeds' means are -25 and -20; tasks are 10 apart, so their error is 12.9 / 2.
    row = next(line for line in text.splitlines() if line.startswith("| POEM (Bayes) | 2 |"))
    assert row.split(" | ")[2:6] == ["-22.5 ± 3.5", "6.5", "-21.5 ± 3.5", "6.5"]
    assert "| POEM (Bayes) | 0.25 | 0.25 | 0.25 | 0.25 | 0.25 |" in text
    assert "task known (POEM's policies): 0.50" in text
    assert "CPU seconds" in text
    assert "1,234" in text


def test_families_of_one_name_and_curves_of_different_parts_stay_apart(tmp_path: Path) -> None:
    with Store(tmp_path / "store.sqlite") as store:
        for env_id, parts in ((VEL, 5), ("mine/HalfCheetahVel-v0", 2)):
            for cell in SUITES["table3"].cells([env_id], [0], ["anole"], FOUR, snapshots=parts):
                store.add(
                    finished(
                        cell,
                        lambda cell, k: ladder(cell, k) - 100.0 * cell.env_id.startswith("mine"),
                    )
                )
        selection = Selection(SUITES["table3"], store.records())
    measured: dict[str, set[float | None]] = {}
    for row in suite_rows(selection):
        measured.setdefault(row.condition.split(":")[0], set()).add(row.snapshot)
        assert row.paper_mean is None or not row.condition.startswith("mine")
    with Store(tmp_path / "store.sqlite") as store:
        for family, conditions in (("mine/HalfCheetahVel-v0", 1), ("HalfCheetahVel", 1), (None, 2)):
            rows = json.loads(make_report(store, ["table3"], family and [family], "json")[0])
            assert len({row["condition"] for row in rows}) == conditions
            assert family is None or rows[0]["condition"].startswith(f"{family}:")
    assert measured == {
        "HalfCheetahVel": {None, 0.2, 0.4, 0.6, 0.8},
        "mine/HalfCheetahVel-v0": {None, 0.5},
    }
    panels = suite_figures(selection)["table3-methods-queries"].axes
    titles = {panel.get_title().partition(":")[0] for panel in panels}
    assert titles == {"HalfCheetahVel", "mine/HalfCheetahVel-v0"}
    tables = [
        table for table in suite_tables(selection) if table.title.endswith("methods, exact answers")
    ]
    assert sorted((table.title.split(":")[0], table.rows[0][2]) for table in tables) == [
        ("HalfCheetahVel", "-24.0"),
        ("mine/HalfCheetahVel-v0", "-124.0"),
    ]


def test_hyperparameters_that_are_lists(tmp_path: Path) -> None:
    training = Training(None, (("net_arch", (64, 64)),))
    with Store(tmp_path / "store.sqlite") as store:
        [cell] = SUITES["table3"].cells([VEL], [0], ["anole"], FOUR, training, 1)
        store.add(finished(cell, ladder))
        [condition] = Selection(SUITES["table3"], store.records()).conditions
    assert condition.training == training
    assert str(condition).endswith("net_arch = (64, 64)")


def test_every_format(tmp_path: Path) -> None:
    methods = [*TABLE_METHODS, *TABLE_REFERENCES]
    methods.remove("maml-reward")  # which stands in another table too
    store = fill(tmp_path / "store.sqlite", snapshots=1, methods=methods)
    markdown, _ = make_report(store, ["table3"])
    assert "abc" not in markdown  # the commit: it is the store's and the manifest's
    line, *_ = (one for one in markdown.splitlines() if one.startswith("| POEM (paper) | 3 "))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[:3] == ["POEM (paper)", "3", "-19.0 ± 5.0"]
    assert cells[3].startswith("-19.0 [-")
    assert cells[4] == "-65.0 ± 10.0"
    latex, _ = make_report(store, ["table3"], kind="latex")
    assert r"POEM (paper) & 3 & -19.0 $\pm$ 5.0 & " in latex
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 7
    assert r"\par task known (POEM's policies): -20.0 $\pm$ 5.0" in latex
    assert "95 %" not in latex.replace(r"95 \%", "")
    table = list(csv.DictReader(io.StringIO(make_report(store, ["table3"], kind="csv")[0])))
    data = json.loads(make_report(store, ["table3"], kind="json")[0])
    assert len(table) == len(data)
    assert [float(row["mean"]) for row in table] == [row["mean"] for row in data]
    both = json.loads(make_report(store, ["table3", "shipped"], kind="json")[0])  # of one list
    assert both[: len(data)] == data
    assert {row["suite"] for row in both} == {"table3", "shipped"}


@pytest.mark.parametrize("suite", ["table3", "noise", "ablation"])
def test_figures(suite: str) -> None:
    expected = {
        "table3": {f"{entry}-queries" for entry in ("methods", "prior", "informed", "parts")}
        | {"methods-samples"},
        "noise": {f"methods-{o}-queries" for o in ("boltzmann", "mistake-0.1", "mistake-0.2")}
        | {f"untold-{o}-queries" for o in ("boltzmann", "mistake-0.1", "mistake-0.2")}
        | {"methods-boltzmann-samples"},
        "ablation": {"design-queries", "design-samples", "rules-queries", "queries-queries"},
    }[suite]
    figures = suite_figures(selection_of(suite, seeds=1))
    assert figures.keys() == {f"{suite}-{name}" for name in expected}
    assert all(figure.axes[0].get_lines() for figure in figures.values())


def test_figures_are_written_beside_the_report(tmp_path: Path) -> None:
    store = fill(tmp_path / "store.sqlite", "epsilon", seeds=1)
    _, files = make_report(store, ["epsilon"], out=tmp_path)
    figures = ("epsilon-tolerance", "epsilon-tolerance-cosine")
    names = {f"{name}{suffix}" for name in figures for suffix in (".png", ".pdf")}
    assert {file.name for file in files} == {*names, "epsilon.md"}
    assert all(file.stat().st_size > 500 for file in files)
    assert all(file.read_bytes()[:4] == b"\x89PNG" for file in files if file.suffix == ".png")


def test_a_store_without_final_cells_has_figures_along_the_training(tmp_path: Path) -> None:
    cells = SUITES["table3"].cells([VEL], range(1), ["anole"], FOUR)
    with Store(tmp_path / "store.sqlite") as store:
        for cell in cells:
            if cell.snapshot is not None:
                store.add(finished(cell, ladder))
        _, files = make_report(store, ["table3"], out=tmp_path)
    names = [file.name for file in files]
    assert names == ["table3.md", "table3-methods-samples.png", "table3-methods-samples.pdf"]


def test_lines_show_the_values_of_the_store() -> None:
    figures = suite_figures(selection_of(methods=["poem-bayes", "anole", "known-task"]))
    [axes] = figures["table3-methods-queries"].axes
    line = next(line for line in axes.get_lines() if line.get_label() == "ANOLE")
    np.testing.assert_allclose(line.get_xydata(), [[k, -20.0 + k] for k in (0, 1, 2, 3, 5, 7, 10)])
    limit = next(line for line in axes.get_lines() if line.get_label().startswith("limit"))
    np.testing.assert_allclose(limit.get_ydata()[:3], [-1.0, -0.5, 0.0])
    [axes] = figures["table3-methods-samples"].axes
    line = next(line for line in axes.get_lines() if line.get_label() == "ANOLE")
    np.testing.assert_allclose(line.get_xydata(), [[s, -10.0] for s in (200, 400, 600, 800, 1000)])


def test_a_method_looks_the_same_in_all_figures_and_like_no_other() -> None:
    looks: dict[str, dict[str, tuple[str, str]]] = {}
    for name, figure in suite_figures(selection_of(seeds=1, snapshots=1)).items():
        lines = [line for line in figure.axes[0].get_lines() if line.get_marker() != "None"]
        looks[name] = {line.get_label(): (line.get_color(), line.get_marker()) for line in lines}
        assert len(set(looks[name].values())) == len(lines)
    assert len(looks["table3-parts-queries"]) > 10
    for label in ("ANOLE", "reward oracle"):
        assert looks["table3-methods-queries"][label] == looks["table3-prior-queries"][label]
        informed = looks["table3-informed-queries"][f"{label}, training tasks"]
        assert informed == looks["table3-methods-queries"][label]


def test_a_store_without_the_suite_is_refused(tmp_path: Path) -> None:
    store = fill(tmp_path / "store.sqlite", "epsilon", seeds=1, methods=["poem-paper-epsilon-0.4"])
    with pytest.raises(ValueError, match=r"--suite smoke: .* holds no finished cell of it"):
        make_report(store, ["smoke"])
    with pytest.raises(ValueError, match=r"no finished cell of the suites' families \(name others"):
        make_report(Store(tmp_path / "empty.sqlite"))
    assert make_report(store)[0].count("# Tolerance of the paper's rule") == 1


def test_a_table_has_the_yardsticks_of_its_own_models_only() -> None:
    yardsticks: dict[str, set[str]] = {}
    for row in suite_rows(selection_of("ablation", seeds=1, snapshots=1)):
        if row.kind in ("limit", "known"):
            yardsticks.setdefault(row.entry, set()).add(row.method)
    assert yardsticks["rules"] == yardsticks["queries"] == {"known-task"}
    assert {"known-task", "known-task-poem-inner", "known-task-poem-d2"} <= yardsticks["design"]


def test_a_report_of_some_seeds(tmp_path: Path) -> None:
    store = fill(tmp_path / "store.sqlite", "epsilon")
    rows = json.loads(make_report(store, ["epsilon"], kind="json", seeds=[0, 2])[0])
    final = [row for row in rows if row["kind"] == "method" and row["queries"] == 0]
    assert {(row["n_seeds"], row["mean"]) for row in final} == {(2, -20.0)}  # of -25 and -15
    with pytest.raises(ValueError, match=r"holds no finished cell of it, AntVel, seed 0$"):
        make_report(store, ["epsilon"], ["AntVel"], seeds=[0])
    with pytest.raises(ValueError, match=r"holds no finished cell of HalfCheetahVel, seed 7"):
        make_report(store, families=["HalfCheetahVel"], seeds=[7])
