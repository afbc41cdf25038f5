"""What a store holds of a suite: finished cells, gathered over seeds and summarised."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from scipy.stats import sem, trim_mean

from poem_envs.registration import family_name
from sb3_poem.adaptation.limits import AnswerLimits, check_returns
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
    family_id,
    family_label,
)

BOOTSTRAP_SAMPLES = 10_000


@dataclass(frozen=True)
class Condition:
    """What must be equal for cells to stand in one table."""

    env_id: str
    budget: Budget
    training: Training
    revision: int

    @classmethod
    def of(cls, record: Record) -> Self:
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


@dataclass(frozen=True, eq=False)
class Series:
    """One method's records, one a seed, under one condition and oracle, after a share of the
    training (None: all).
    """

    method: str
    records: list[Record]
    oracle: OracleSpec
    snapshot: float | None

    @property
    def label(self) -> str:
        return METHODS[self.method].label

    @cached_property
    def returns(self) -> np.ndarray:
        """(n_seeds, n_tasks[, n_queries])."""
        return np.array([record.result["task_returns"] for record in self.records])

    @property
    def success_rates(self) -> Any:
        """([n_queries,]) means over seeds and tasks; None for a family without successes."""
        if any("task_success_rates" not in record.result for record in self.records):
            return None
        rates = np.array([record.result["task_success_rates"] for record in self.records])
        return rates.mean(axis=(0, 1))

    @property
    def queries(self) -> tuple[int, ...]:
        return tuple(self.records[0].result["queries"])

    @property
    def samples(self) -> float:
        return float(np.mean([record.result["training_samples"] for record in self.records]))

    def at(self, queries: int) -> np.ndarray:
        """(n_seeds, n_tasks) after so many answers."""
        return self.returns[:, :, self.queries.index(queries)]

    def against(self, other: Self, queries: int) -> "Comparison | None":
        """After so many answers, on the seeds that both have; None if there are none."""
        mine, theirs = ([record.seed for record in each.records] for each in (self, other))
        common, one, two = np.intersect1d(mine, theirs, return_indices=True)
        return compare(self.at(queries)[one], other.at(queries)[two]) if len(common) else None

    def limits(self, queries: int, oracle: OracleSpec) -> np.ndarray | None:
        """(n_seeds,): the most that so many answers of an oracle allow; None if not measured."""
        found: list[Any] = [record.result.get("limits") for record in self.records]
        if None in found:
            return None
        noise = make_oracle_factory(oracle)().noise_model
        return np.array([AnswerLimits(**one).after(queries, noise) for one in found])


class Selection:
    """What there is of a suite, of some families (None: all), by their names or ids. Of models of
    one seed the newest counts, and of those that were trained here only such as have the
    hyperparameters of the newest of all seeds.
    """

    def __init__(
        self, suite: Suite, records: Iterable[Record], families: Sequence[str] | None = None
    ) -> None:
        self.suite = suite
        ids = None if families is None else {family_id(name) for name in families}
        wanted = [one for one in records if ids is None or one.identity["env_id"] in ids]
        in_order = sorted(wanted, key=lambda record: record.created)
        newest = {kind: one.identity["model"] for one in in_order for kind in _kinds(one)}
        #: By the key of a cell whose model is not told
        self.records = {
            digest({**one.identity, "model": None}): one
            for one in in_order
            if all(one.identity["model"] == newest[kind] for kind in _kinds(one))
        }
        found: dict[Condition, list[Record]] = {}
        for one in self.records.values():
            found.setdefault(Condition.of(one), []).append(one)
        order = (*suite.families, *sorted(one.family for one in found))
        self._found = found
        self.conditions = sorted(found, key=lambda one: (order.index(one.family), str(one)))

    def series(self, entry: Entry, condition: Condition) -> list[Series]:
        """The finished cells of an entry under a condition, those along the training too."""
        found: dict[tuple[str, OracleSpec, float | None], list[Record]] = {}
        for cell, record in self._cells(entry, condition):
            found.setdefault((cell.method, cell.oracle, cell.snapshot), []).append(record)
        series = [
            Series(method, some, oracle, snapshot)
            for (method, oracle, snapshot), some in found.items()
        ]
        return sorted(series, key=lambda one: entry.methods.index(one.method))

    def references(self, condition: Condition) -> list[Series]:
        """What the models' policies could earn under a condition, in the order of the suite."""
        return self.series(Entry("references", "", self.suite.references), condition)

    def _cells(self, entry: Entry, condition: Condition) -> Iterator[tuple[Cell, Record]]:
        records = self._found[condition]
        shares = sorted({record.identity["snapshot"] for record in records} - {None})
        what: dict[str, Any] = {"budget": condition.budget, "training": condition.training}
        for seed in sorted({record.seed for record in records}):
            base = Cell(condition.env_id, "", seed, **what, revision=condition.revision)
            for cell in self.suite.entry_cells(entry, base, shares):
                if cell.key in self.records:
                    yield cell, self.records[cell.key]


def _kinds(record: Record) -> list[tuple[Any, ...]]:
    """Of what the record's model must be the newest."""
    kind = Condition.of(record), record.identity["variant"]
    is_file = str(record.identity["model"]).startswith(FILE)
    return [(*kind, record.seed)] + [kind] * (not is_file)


@dataclass(frozen=True)
class Summary:
    """What several seeds earned: mean and deviation (n - 1) of their mean returns, and the
    interquartile mean over seeds and tasks with its :func:`interval` (None for one seed); and the
    standard error over tasks of their means over seeds (None for one task).
    """

    n_seeds: int
    mean: float
    deviation: float | None
    iqm: float
    iqm_low: float | None
    iqm_high: float | None
    task_error: float | None


def summarise(returns: np.ndarray) -> Summary:
    """Summarise returns (n_seeds, n_tasks), column j the same test task for all seeds."""
    returns = check_returns(returns, "(n_seeds, n_tasks)")
    seeds, tasks = returns.mean(axis=1), returns.mean(axis=0)
    deviation = float(seeds.std(ddof=1)) if len(seeds) > 1 else None
    error = float(sem(tasks)) if len(tasks) > 1 else None
    figures = (float(_iqm(returns)), *interval(_iqm, returns), error)
    return Summary(len(seeds), float(seeds.mean()), deviation, *figures)


@dataclass(frozen=True)
class Comparison:
    """What a method earns more than another on the same seeds and tasks: the mean and the
    interquartile mean of the paired differences; and the probability of improvement, that it earns
    more on a task when both take any seed (Mann & Whitney's, averaged over tasks; a tie counts one
    half). ``low`` and ``high`` are the :func:`interval` of the mean.
    """

    n_seeds: int
    mean: float
    low: float | None
    high: float | None
    iqm: float
    probability: float
    probability_low: float | None
    probability_high: float | None

    @property
    def claim(self) -> str:
        """ "ahead" or "behind" if the mean, the interquartile mean and the whole interval agree;
        empty for one seed.
        """
        ends = [end for end in (self.mean, self.iqm, self.low, self.high) if end is not None]
        if len(ends) < 4:
            return ""
        return "ahead" if min(ends) > 0 else "behind" if max(ends) < 0 else "not distinguishable"


def compare(one: np.ndarray, other: np.ndarray) -> Comparison:
    """Compare returns (n_seeds, n_tasks) of two methods, of the same seeds and tasks."""
    gaps = one - other
    mean, iqm, probability = map(float, (gaps.mean(), _iqm(gaps), _probability(one, other)))
    low, high = interval(lambda drawn: drawn.mean(axis=(-2, -1)), gaps)
    ends = interval(_probability, one, other)
    return Comparison(len(gaps), mean, low, high, iqm, probability, *ends)


def interval(
    statistic: Callable[..., np.ndarray], *samples: np.ndarray
) -> tuple[float, float] | tuple[None, None]:
    """The 95 % percentile bootstrap interval of a statistic of samples (n_seeds, n_tasks): seeds
    and tasks are drawn anew, the same ones for all samples (Owen 2007). None for one seed, which
    says nothing of another.

    :param statistic: Of arrays (..., n_seeds, n_tasks), giving (...).
    """
    n_seeds, n_tasks = samples[0].shape
    if n_seeds < 2:
        return None, None
    rng = np.random.default_rng(0)  # a report is the same twice
    seeds = rng.integers(n_seeds, size=(BOOTSTRAP_SAMPLES, n_seeds, 1))
    tasks = rng.integers(n_tasks, size=(BOOTSTRAP_SAMPLES, 1, n_tasks))
    low, high = np.quantile(statistic(*(each[seeds, tasks] for each in samples)), (0.025, 0.975))
    return float(low), float(high)


def _iqm(scores: np.ndarray) -> np.ndarray:
    """(..., n_seeds, n_tasks) -> (...)."""
    return trim_mean(scores.reshape(*scores.shape[:-2], -1), proportiontocut=0.25, axis=-1)


def _probability(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(..., n_seeds, n_tasks), twice -> (...)."""
    order = np.sign(one[..., :, None, :] - other[..., None, :, :])
    return 0.5 + 0.5 * order.mean(axis=(-3, -2, -1))
