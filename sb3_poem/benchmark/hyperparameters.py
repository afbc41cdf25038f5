"""What a model of the benchmark is trained with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import yaml

from sb3_poem.benchmark.families import FamilyFacts, family_facts
from sb3_poem.benchmark.methods import VARIANTS
from sb3_poem.benchmark.suites import ModelKey
from sb3_poem.resources import config_file

#: Models are saved, for curves and against interruptions, this many times in a training.
SAVES = 20


@dataclass(frozen=True)
class TrainingPlan:
    """A training, in figures.

    :param algorithm: "poem_sac" or "pearl_sac".
    :param hyperparameters: All that differs from the algorithm's defaults.
    :param overrides: The part of them that differs from the hyperparameter file.
    :param timesteps: Environment steps asked for.
    :param epoch_steps: Environment steps of an epoch.
    :param updates: Gradient steps.
    """

    algorithm: str
    hyperparameters: dict[str, Any]
    overrides: dict[str, Any]
    timesteps: int
    epoch_steps: int
    updates: int

    @property
    def save_steps(self) -> int:
        """Environment steps between two saved models, a whole number of epochs."""
        return max(1, round(self.timesteps / SAVES / self.epoch_steps)) * self.epoch_steps


class MissingEntryError(ValueError):
    """There are no hyperparameters for a family."""


def training_plan(key: ModelKey) -> TrainingPlan:
    """How a model is trained.

    :param key: The model.
    :return: The plan.
    :raises MissingEntryError: If there are no hyperparameters for the family.
    """
    variant = VARIANTS[key.variant]
    file = config_file(variant.algorithm)
    entries = yaml.safe_load(file.read_text())
    entry = entries.get(key.env_id, entries.get("default"))
    if entry is None:
        raise MissingEntryError(
            f"{file} has no entry for {key.env_id}, which says how to train {variant.name} on it: add one, or hand over a "
            "model by --models or --model"
        )
    overrides = {**variant.hyperparameters, **dict(key.training.hyperparameters)}
    hyperparameters = {**entry, **overrides}
    timesteps = int(
        hyperparameters["n_timesteps"] if key.training.timesteps is None else key.training.timesteps
    )
    hyperparameters["n_timesteps"] = timesteps
    epoch_steps = _epoch_steps(family_facts(key.env_id), hyperparameters)
    per_epoch = int(hyperparameters.get("gradient_steps", 1000))
    epochs = -(-timesteps // epoch_steps)
    updates = epochs * (epoch_steps if per_epoch < 0 else per_epoch)
    return TrainingPlan(
        variant.algorithm, hyperparameters, overrides, timesteps, epoch_steps, updates
    )


def _epoch_steps(facts: FamilyFacts, hyperparameters: dict[str, Any]) -> int:
    from sb3_poem.pearl_sac.train_tasks import DEFAULT_TRAIN_TASKS

    tasks = hyperparameters.get("n_train_tasks")
    if tasks is None:
        tasks = (
            DEFAULT_TRAIN_TASKS
            if facts.n_tasks is None
            else min(DEFAULT_TRAIN_TASKS, facts.n_tasks)
        )
    return int(tasks) * int(hyperparameters.get("trajectories_per_task", 1)) * facts.horizon
