"""What a store holds of a suite: finished cells, gathered over seeds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from sb3_poem.adaptation.evaluation import KnownTaskReturn
from sb3_poem.benchmark.cells import make_oracle_factory
from sb3_poem.benchmark.methods import METHODS
from sb3_poem.benchmark.store import Record
from sb3_poem.benchmark.suites import (
    FILE,
    REVISION,
    Budget,
    Entry,
    OracleSpec,
    Suite,
    Training,
    digest,
    family_label,
    family_name,
    hashable,
)


@dataclass(frozen=True)
class Condition:
    """What must be equal for cells to stand in one table.

    :param env_id: The family.
    :param tasks: Number of test tasks.
    :param episodes: Per task and measurement.
    :param task_seed: Of the test tasks.
    :param training: What differs from the hyperparameter files.
    :param revision: See :data:`REVISION`.
    """

    env_id: str
    tasks: int
    episodes: int
    task_seed: int
    training: Training
    revision: int

    @property
    def family(self) -> str:
        """The family's name."""
        return family_name(self.env_id)

    @property
    def budget(self) -> Budget:
        """As cells have it."""
        return Budget(self.tasks, self.episodes, task_seed=self.task_seed)

    def __str__(self) -> str:
        words = [
            f"{family_label(self.env_id)}: {self.tasks} test tasks, {self.episodes} episodes each"
        ]
        if self.training.timesteps is not None:
            words.append(f"trained for {self.training.timesteps:,} steps")
        words += [f"{name} = {value}" for name, value in self.training.hyperparameters]
        if self.revision != REVISION:
            words.append(f"revision {self.revision} of the code")
        return ", ".join(words)


@dataclass(frozen=True, eq=False)
class Series:
    """One method under one condition and one oracle, over seeds.

    :param method: Its name.
    :param oracle: Who answered.
    :param snapshot: The share of the training after which; None: all.
    :param queries: After how many answers.
    :param seeds: Which seeds there are.
    :param returns: (n_seeds, n_tasks, n_queries).
    :param records: Of the seeds.
    """

    method: str
    oracle: OracleSpec
    snapshot: float | None
    queries: tuple[int, ...]
    seeds: tuple[int, ...]
    returns: np.ndarray
    records: tuple[Record, ...]

    @property
    def label(self) -> str:
        """As in tables and figures."""
        return METHODS[self.method].label

    @property
    def samples(self) -> float:
        """Environment steps of the training, mean over seeds."""
        return float(np.mean([record.result["training_samples"] for record in self.records]))

    @property
    def success_rates(self) -> list[float] | None:
        """(n_queries,) means over seeds and tasks; None for a family without successes."""
        rates = [record.result.get("task_success_rates") for record in self.records]
        return None if None in rates else np.mean(rates, axis=(0, 1)).tolist()

    def at(self, queries: int) -> np.ndarray | None:
        """(n_seeds, n_tasks) after so many answers; None if that was not measured."""
        return self.returns[:, :, self.queries.index(queries)] if queries in self.queries else None


@dataclass(frozen=True, eq=False)
class Reference:
    """What the policies of one kind of model could earn.

    :param method: Its name.
    :param records: Of the seeds.
    """

    method: str
    records: tuple[Record, ...]

    @property
    def label(self) -> str:
        """As in tables."""
        return METHODS[self.method].label

    @property
    def known(self) -> np.ndarray:
        """(n_seeds,) mean returns if the task were known."""
        return np.array([np.mean(record.result["task_returns"]) for record in self.records])

    @property
    def success_rate(self) -> float | None:
        """Mean over seeds and tasks if the task were known; None for a family without successes."""
        rates = [record.result.get("task_success_rates") for record in self.records]
        return None if None in rates else float(np.mean(rates))

    def limits(self, queries: int, oracle: OracleSpec) -> np.ndarray:
        """The information limit, (n_seeds,).

        :param queries: How many answers.
        :param oracle: Who answers.
        :return: The most that so many answers allow with these policies, for each seed.
        """
        return np.array(_limits(self, queries, oracle))


class Selection:
    """What there is of a suite. Models that were trained with other hyperparameters than the newest
    of their kind are left out.

    :param records: Of a store.
    :param families: Only these; None: all.
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
        self.conditions = sorted(
            {_condition(record.identity) for record in self.records.values()},
            key=lambda c: (_family_order(suite, c.family), c.env_id, str(c)),
        )
        self.seeds = sorted({record.seed for record in self.records.values()})
        self._shares: dict[Condition, set[float]] = {
            condition: set() for condition in self.conditions
        }
        for record in self.records.values():
            if record.identity["snapshot"] is not None:
                self._shares[_condition(record.identity)].add(record.identity["snapshot"])
        self._references: dict[Condition, list[Reference]] = {}

    def series(self, entry: Entry, condition: Condition) -> list[Series]:
        """The finished cells of an entry under a condition, final models and those along the
        training.

        :return: In the order of the entry.
        """
        found: dict[tuple[str, OracleSpec, float | None], list[Record]] = {}
        for seed in self.seeds:
            arguments = (condition.env_id, seed, condition.budget, condition.training)
            for cell in self.suite.entry_cells(entry, *arguments, sorted(self._shares[condition])):
                key = replace(cell, revision=condition.revision).key
                if key in self.records:
                    found.setdefault((cell.method, cell.oracle, cell.snapshot), []).append(
                        self.records[key]
                    )
        order = {name: position for position, name in enumerate(entry.methods)}
        result = []
        for (method, oracle, snapshot), records in sorted(
            found.items(), key=lambda item: order[item[0][0]]
        ):
            returns = np.stack([np.array(record.result["task_returns"]) for record in records])
            seeds = tuple(record.seed for record in records)
            queries = tuple(records[0].result["queries"])
            result.append(Series(method, oracle, snapshot, queries, seeds, returns, tuple(records)))
        return result

    def references(self, condition: Condition) -> list[Reference]:
        """What the models' policies could earn under a condition.

        :return: In the order of the suite.
        """
        if condition not in self._references:
            self._references[condition] = self._find_references(condition)
        return self._references[condition]

    def _find_references(self, condition: Condition) -> list[Reference]:
        entry = Entry("references", "", self.suite.references)
        found: dict[str, list[Record]] = {}
        for seed in self.seeds:
            for cell in self.suite.entry_cells(
                entry, condition.env_id, seed, condition.budget, condition.training
            ):
                key = replace(cell, revision=condition.revision).key
                if key in self.records:
                    found.setdefault(cell.method, []).append(self.records[key])
        return [
            Reference(method, tuple(found[method]))
            for method in self.suite.references
            if method in found
        ]


@cache
def _limits(reference: Reference, queries: int, oracle: OracleSpec) -> tuple[float, ...]:
    """Tables and figures ask for the same ones."""
    noise = make_oracle_factory(oracle)().noise_model
    limits = []
    for record in reference.records:
        returns = np.array(record.result["candidate_returns"])
        tasks, empty = np.array(record.result["tasks"]), np.empty((0, 0))
        known = KnownTaskReturn(
            tasks, np.array(record.result["task_returns"])[:, None], empty, empty, returns
        )
        limits.append(known.limit(queries, noise))
    return tuple(limits)


def _condition(identity: dict[str, Any]) -> Condition:
    training = identity["training"]
    hyperparameters = tuple(
        sorted((name, hashable(value)) for name, value in training["hyperparameters"].items())
    )
    return Condition(
        identity["env_id"],
        identity["tasks"],
        identity["episodes"],
        identity["task_seed"],
        Training(training["timesteps"], hyperparameters),
        identity["revision"],
    )


def _kind(record: Record) -> tuple[Condition, str]:
    return _condition(record.identity), record.identity["variant"]


def _handed_over(record: Record) -> bool:
    return str(record.identity["model"]).startswith(FILE)


def _family_order(suite: Suite, family: str) -> int:
    return suite.families.index(family) if family in suite.families else len(suite.families)
