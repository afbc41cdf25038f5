"""What a store holds of a suite: finished cells, gathered over seeds and summarised."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from rliable import library, metrics
from scipy.stats import sem, trim_mean

from sb3_poem.adaptation.known_task import repertoire_limit
from sb3_poem.benchmark.cells import make_oracle_factory
from sb3_poem.benchmark.methods import METHODS
from sb3_poem.benchmark.store import Record
from sb3_poem.benchmark.suites import (
    FILE,
    REVISION,
    Budget,
    Cell,
    Entry,
    OracleSpec,
    Suite,
    Training,
    digest,
    family_label,
    family_name,
)

BOOTSTRAP_SAMPLES = 2000


@dataclass(frozen=True)
class Condition:
    """What must be equal for cells to stand in one table (of the budget all but the numbers of
    answers).
    """

    env_id: str
    budget: Budget
    training: Training
    revision: int

    @classmethod
    def of(cls, record: Record) -> Condition:
        identity, trained = record.identity, Training.from_dict(record.identity["training"])
        sizes = {name: identity[name] for name in ("tasks", "episodes", "task_seed")}
        return cls(identity["env_id"], Budget(**sizes), trained, identity["revision"])

    @property
    def family(self) -> str:
        return family_name(self.env_id)

    @property
    def version(self) -> str:
        """What titles add to results of other code than this."""
        return "" if self.revision == REVISION else f", revision {self.revision} of the code"

    def __str__(self) -> str:
        budget = self.budget
        words = [f"{family_label(self.env_id)}: {budget.tasks} test tasks"]
        words.append(f"{budget.episodes} episodes each")
        if self.training.timesteps is not None:
            words.append(f"trained for {self.training.timesteps:,} steps")
        words += [f"{name} = {value}" for name, value in self.training.hyperparameters]
        return ", ".join(words) + self.version


def _success_rates(records: Sequence[Record]) -> np.ndarray | None:
    """(n_seeds, n_tasks[, n_queries]); None for a family without successes."""
    if any("task_success_rates" not in record.result for record in records):
        return None
    return np.array([record.result["task_success_rates"] for record in records])


@dataclass(frozen=True, eq=False)
class _Measured:
    """A method's records, one a seed."""

    method: str
    records: tuple[Record, ...]

    @property
    def label(self) -> str:
        return METHODS[self.method].label


@dataclass(frozen=True, eq=False)
class Series(_Measured):
    """One method under one condition and one oracle, over seeds.

    :param snapshot: The share of the training after which; None: all.
    """

    oracle: OracleSpec
    snapshot: float | None

    @property
    def queries(self) -> tuple[int, ...]:
        return tuple(self.records[0].result["queries"])

    @cached_property
    def returns(self) -> np.ndarray:
        """(n_seeds, n_tasks, n_queries)."""
        return np.stack([np.array(record.result["task_returns"]) for record in self.records])

    @property
    def samples(self) -> float:
        return float(np.mean([record.result["training_samples"] for record in self.records]))

    @property
    def success_rates(self) -> list[float] | None:
        """(n_queries,) means over seeds and tasks, where the family has successes."""
        rates = _success_rates(self.records)
        return None if rates is None else rates.mean(axis=(0, 1)).tolist()

    def at(self, queries: int) -> np.ndarray | None:
        """(n_seeds, n_tasks) after so many answers; None if that was not measured."""
        return self.returns[:, :, self.queries.index(queries)] if queries in self.queries else None


@dataclass(frozen=True, eq=False)
class Reference(_Measured):
    """What the policies of one kind of model could earn."""

    @property
    def known(self) -> np.ndarray:
        """(n_seeds,) mean returns if the task were known."""
        return np.array([np.mean(record.result["task_returns"]) for record in self.records])

    @property
    def success_rate(self) -> float | None:
        """Mean over seeds and tasks if the task were known, where the family has successes."""
        rates = _success_rates(self.records)
        return None if rates is None else float(rates.mean())

    def limits(self, queries: int, oracle: OracleSpec) -> np.ndarray:
        """(n_seeds,): the most that so many answers of this oracle allow with these policies."""
        return np.array(_limits(self, queries, oracle))


@cache
def _limits(reference: Reference, queries: int, oracle: OracleSpec) -> tuple[float, ...]:
    """Tables and figures ask for the same ones."""
    noise, limits = make_oracle_factory(oracle)().noise_model, []
    for result in (record.result for record in reference.records):
        tasks, candidates = np.array(result["tasks"]), np.array(result["candidate_returns"])
        limits.append(repertoire_limit(tasks, candidates, queries, noise))
    return tuple(limits)


class Selection:
    """What there is of a suite, of some families (None: all). Models that were trained with other
    hyperparameters than the newest of their kind are left out.
    """

    def __init__(
        self, suite: Suite, records: Iterable[Record], families: Sequence[str] | None = None
    ) -> None:
        self.suite = suite
        of_families = [one for one in records if families is None or one.family in families]
        in_order = sorted(of_families, key=lambda record: record.created)
        newest = {_kind(one): one.identity["model"] for one in in_order if not _handed_over(one)}
        #: By the key of a cell whose model is not told
        self.records = {
            digest({**record.identity, "model": None}): record
            for record in in_order
            if _handed_over(record) or record.identity["model"] == newest[_kind(record)]
        }
        shares: dict[Condition, set[float]] = {}
        for record in self.records.values():
            some = shares.setdefault(Condition.of(record), set())
            if record.identity["snapshot"] is not None:
                some.add(record.identity["snapshot"])
        order = {name: position for position, name in enumerate(suite.families)}
        self._shares = dict(
            sorted(
                shares.items(),
                key=lambda item: (
                    order.get(item[0].family, len(order)),
                    item[0].env_id,
                    str(item[0]),
                ),
            )
        )
        self.conditions = list(self._shares)
        self.seeds = sorted({record.seed for record in self.records.values()})
        self._references: dict[Condition, list[Reference]] = {}

    def series(self, entry: Entry, condition: Condition) -> list[Series]:
        """The finished cells of an entry under a condition, those along the training too."""
        found: dict[tuple[str, OracleSpec, float | None], list[Record]] = {}
        for cell, record in self._cells(entry, condition):
            found.setdefault((cell.method, cell.oracle, cell.snapshot), []).append(record)
        series = [
            Series(name, tuple(records), oracle, snapshot)
            for (name, oracle, snapshot), records in found.items()
        ]
        return sorted(series, key=lambda one: entry.methods.index(one.method))

    def references(self, condition: Condition) -> list[Reference]:
        """What the models' policies could earn under a condition, in the order of the suite."""
        if condition not in self._references:
            found: dict[str, list[Record]] = {name: [] for name in self.suite.references}
            for cell, record in self._cells(Entry("", "", self.suite.references), condition):
                found[cell.method].append(record)
            # always the same objects, whose limits are kept
            self._references[condition] = [
                Reference(method, tuple(records)) for method, records in found.items() if records
            ]
        return self._references[condition]

    def _cells(self, entry: Entry, condition: Condition) -> Iterator[tuple[Cell, Record]]:
        shares = sorted(self._shares[condition])
        for seed in self.seeds:
            for cell in self.suite.entry_cells(
                entry, condition.env_id, seed, condition.budget, condition.training, shares
            ):
                key = replace(cell, revision=condition.revision).key
                if key in self.records:
                    yield cell, self.records[key]


def _kind(record: Record) -> tuple[Condition, str]:
    return Condition.of(record), record.identity["variant"]


def _handed_over(record: Record) -> bool:
    return str(record.identity["model"]).startswith(FILE)


@dataclass(frozen=True)
class Summary:
    """What several seeds earned: the mean of their mean returns, its deviation (n - 1), and the
    interquartile mean over seeds and tasks with its 95 % interval (both None for one seed); and the
    standard error over tasks of their means over seeds (None for one task).
    """

    n_seeds: int
    mean: float
    deviation: float | None
    iqm: float
    iqm_low: float | None
    iqm_high: float | None
    task_error: float | None


def summarise(returns: np.ndarray, intervals: bool = True) -> list[Summary]:
    """Summarise one method on one family after several numbers of answers.

    :param returns: (n_seeds, n_tasks, n_records); column j is the same test task for all seeds.
    :param intervals: Whether intervals are wanted, which take about a second: rliable's percentiles
        of stratified bootstrap samples, which draw the seeds anew for every task.
    """
    returns = np.asarray(returns, dtype=np.float64)
    if returns.ndim != 3 or 0 in returns.shape or not np.isfinite(returns).all():
        raise ValueError(
            "`returns` must be finite, (n_seeds, n_tasks, n_records), none 0, but has shape "
            f"{returns.shape}"
        )
    seeds, tasks = returns.mean(axis=1), returns.mean(axis=0)
    iqms = [float(metrics.aggregate_iqm(record)) for record in np.moveaxis(returns, 2, 0)]
    nothing: list[float | None] = [None] * len(iqms)
    low = high = nothing
    if intervals and len(seeds) > 1:
        with _seeded(0):
            _, bounds = library.get_interval_estimates(
                {"method": returns}, _iqms, reps=BOOTSTRAP_SAMPLES
            )
        low, high = bounds["method"].tolist()
    deviations = seeds.std(axis=0, ddof=1).tolist() if len(seeds) > 1 else nothing
    errors = sem(tasks).tolist() if len(tasks) > 1 else nothing
    figures = zip(seeds.mean(axis=0).tolist(), deviations, iqms, low, high, errors, strict=True)
    return [Summary(len(returns), *figure) for figure in figures]


def _iqms(scores: np.ndarray) -> np.ndarray:
    """(n_seeds, n_tasks, n_records) -> (n_records,): each record's interquartile mean."""
    return trim_mean(scores.reshape(-1, scores.shape[2]), proportiontocut=0.25, axis=0)


@contextlib.contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """rliable draws from the global generator: seed it, so that a report is the same twice, and
    hand it back as it was.
    """
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(state)  # noqa: NPY002
