"""What ``sb3-poem train -optimize`` searches: a range around each value of an entry."""

import inspect
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import optuna
from rl_zoo3.utils import SimpleLinearSchedule

from sb3_poem.loading import ALGORITHMS

#: Searched from a fourth to four times the entry's value
COEFFICIENTS = ("kl_coef", "reward_coef", "policy_coef", "preference_coef")
SCALES = ("one_minus_gamma", "learning_rate", "tau", *COEFFICIENTS)
#: Searched from a half to twice the entry's value
COUNTS = ("gradient_steps", "batch_size", "context_size", "meta_batch_size", "latent_dim")
#: Searched up to so far from the entry's value
FRACTIONS = {"relabel_fraction": 0.3}
#: A learning rate that falls to zero, which rl_zoo3 writes ``lin_1e-3``, is searched under this
#: name, and stays one
LINEAR = "lin_learning_rate"


def entry_params(algorithm: str, entry: dict[str, Any]) -> dict[str, Any]:
    """The trial that is an entry itself, by Optuna's names and with schedules of learning rates,
    without what cannot be searched around it: None, 0, and gradient steps of -1.
    """
    parameters = inspect.signature(ALGORITHMS[algorithm]).parameters
    values = {name: parameter.default for name, parameter in parameters.items()} | entry
    values["one_minus_gamma"] = 1.0 - values["gamma"]
    rate = values["learning_rate"]
    if callable(rate):
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
SAMPLERS: dict[str, Callable[..., dict[str, Any]]] = {
    name: partial(_sample, name) for name in ALGORITHMS
}
