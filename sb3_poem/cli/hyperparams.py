"""Hyperparameters: checks before anything starts, and what ``train -optimize`` searches."""

import contextlib
import importlib.util
import inspect
import math
import os
from collections.abc import Mapping
from functools import partial
from typing import Any

import optuna
from rl_zoo3.utils import SimpleLinearSchedule

from poem_envs.registration import did_you_mean
from sb3_poem.loading import ALGORITHMS
from sb3_poem.pearl_sac.arguments import UNSUPPORTED
from sb3_poem.resources import shipped_folder

# What rl_zoo3 takes out of an entry for itself before the rest goes to the algorithm.
ZOO_KEYS = frozenset({"callback", "env_kwargs", "monitor_kwargs", "n_envs", "n_timesteps"})
# What rl_zoo3 gives to the algorithm itself; the same in an entry would be given twice.
FLAGS = {"device": "--device", "env": "--env", "seed": "--seed", "verbose": "--verbose"}
FLAGS |= {"tensorboard_log": "-tb"}
#: Searched from a fourth to four times the entry's value
COEFFICIENTS = ("kl_coef", "reward_coef", "policy_coef", "preference_coef")
SCALES = ("one_minus_gamma", "learning_rate", "tau", *COEFFICIENTS)
#: Searched from a half to twice the entry's value
COUNTS = ("gradient_steps", "batch_size", "context_size", "meta_batch_size", "latent_dim")
#: Searched up to so far from the entry's value
FRACTIONS = {"relabel_fraction": 0.3}
#: The name of a learning rate that falls to zero (rl_zoo3's ``lin_1e-3``), and stays one
LINEAR = "lin_learning_rate"


def check_entry(entry: Mapping[str, Any], algorithm: str, source: str) -> None:
    """Refuse keys of an entry (of what ``source`` names) that neither rl_zoo3 nor the algorithm
    takes, and numbers that are none, or were read as text, as YAML reads 1e-3 (but not 1.0e-3).
    """
    parameters = inspect.signature(ALGORITHMS[algorithm]).parameters
    known = {name for name in parameters if not name.startswith("_")} - {"unsupported"} | ZOO_KEYS
    for key in sorted(entry):
        if key in FLAGS:
            raise ValueError(f"{key!r} in {source} belongs on the command line: {FLAGS[key]}")
        if key in UNSUPPORTED:
            raise ValueError(f"{key!r} in {source} is not for {algorithm}: {UNSUPPORTED[key]}")
        if key not in known:
            alike = did_you_mean(key, known - set(FLAGS), n=3) or ", nor anything like it."
            what = f"{algorithm} has no such hyperparameter{alike}"
            raise ValueError(f"Unknown key {key!r} in {source}: {what}")
        kind = parameters[key].annotation if key in parameters else None
        _check_value(f"{key} in {source}", key, entry[key], kind)


def _check_value(what: str, key: str, value: Any, kind: Any) -> None:
    if isinstance(value, str) and (number := _number(value)) is not None:
        raise ValueError(f"{what} is the text {value!r}; write {number!r}")
    if key == "n_timesteps":
        fits, wanted = isinstance(value, (int, float)) and value >= 1, "a positive number"
    elif key == "n_envs":
        fits, wanted = isinstance(value, int) and value >= 1, "a positive whole number"
    elif key == "learning_rate":
        fits = not isinstance(value, str) or _number(value.partition("_")[2]) is not None
        wanted = "a number, or 'lin_' and a number"
    else:
        fits = kind not in (int, float) or isinstance(value, (int, kind))
        wanted = "a whole number" if kind is int else "a number"
    if not fits:
        raise ValueError(f"{what} must be {wanted}, got {value!r}")


def _number(text: str) -> float | None:
    with contextlib.suppress(ValueError):
        return float(text)
    return None


def find_config(config: str) -> str:
    """A file that ``-c`` names, its own or one that ships, or as rl_zoo3 takes it a Python module;
    anything else is refused.
    """
    if config.endswith((".yml", ".yaml", ".py")):
        if os.path.isfile(config):
            return config
        shipped = {file.name: str(file) for file in shipped_folder("zoo_configs").glob("*.yml")}
        if config not in shipped:
            names = ", ".join(sorted(shipped))
            raise ValueError(f"-c {config}: there is no such file; those that ship are {names}")
        return shipped[config]
    found = None
    with contextlib.suppress(ImportError, ValueError):
        found = importlib.util.find_spec(config)
    if found is None:
        raise ValueError(f"-c {config}: there is no such module; a file ends in .yml, .yaml or .py")
    return config


def entry_params(algorithm: str, entry: dict[str, Any]) -> dict[str, Any]:
    """The trial that is an entry itself, by Optuna's names, without what cannot be searched around
    it: None, 0, and gradient steps of -1.
    """
    parameters = inspect.signature(ALGORITHMS[algorithm]).parameters
    values = {name: parameter.default for name, parameter in parameters.items()} | entry
    values["one_minus_gamma"] = 1.0 - values["gamma"]
    rate = values["learning_rate"]
    if callable(rate):  # a schedule
        values["learning_rate"] = rate(1.0)
    params = {name: float(values[name]) for name in (*SCALES, *FRACTIONS) if values.get(name)}
    params |= {name: int(values[name]) for name in COUNTS if values[name] > 0}
    if isinstance(rate, SimpleLinearSchedule):
        params[LINEAR] = params.pop("learning_rate")
    return params


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """A trial's parameters, under Optuna's names, as hyperparameters of an entry."""
    hyperparams = dict(sampled_params)
    if "one_minus_gamma" in hyperparams:
        hyperparams["gamma"] = 1.0 - hyperparams.pop("one_minus_gamma")
    if LINEAR in hyperparams:
        hyperparams["learning_rate"] = f"lin_{hyperparams.pop(LINEAR)}"
    return hyperparams


def _sample(
    algorithm: str, trial: optuna.Trial, n_actions: int, n_envs: int, more: dict[str, Any]
) -> dict[str, Any]:
    params: dict[str, Any] = {}
    for name, value in entry_params(algorithm, more.get("entry", {})).items():
        if name in COUNTS:
            low = max(1, math.ceil(value / 2))
            params[name] = trial.suggest_int(name, low, 2 * value, log=True)
        elif name in FRACTIONS:
            low, high = max(0.0, value - FRACTIONS[name]), min(1.0, value + FRACTIONS[name])
            params[name] = trial.suggest_float(name, low, high)
        else:
            high = 4 * value if name in COEFFICIENTS else min(1.0, 4 * value)
            params[name] = trial.suggest_float(name, value / 4, high, log=True)
    return convert_params(params)


#: By the algorithm's name, called with (trial, n_actions, n_envs, additional arguments)
SAMPLERS: dict[str, Any] = {name: partial(_sample, name) for name in ALGORITHMS}
