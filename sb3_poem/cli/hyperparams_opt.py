"""What ``sb3-poem train -optimize`` searches, in the form of rl_zoo3's samplers: a range around
each value of an entry.
"""

import inspect
import math
from collections.abc import Callable
from typing import Any

import optuna
from rl_zoo3.utils import SimpleLinearSchedule

from sb3_poem.loading import ALGORITHMS

#: Searched from a fourth to four times the entry's value
SCALES = (
    "one_minus_gamma",
    "learning_rate",
    "tau",
    "kl_coef",
    "reward_coef",
    "policy_coef",
    "preference_coef",
)
#: Searched from a half to twice the entry's value
COUNTS = ("gradient_steps", "batch_size", "context_size", "meta_batch_size", "latent_dim")
#: Searched up to so far from the entry's value
FRACTIONS = {"relabel_fraction": 0.3}
#: A learning rate that falls to zero, which rl_zoo3 writes ``lin_1e-3``, is searched under this
#: name, and stays one
LINEAR = "lin_learning_rate"

Sampler = Callable[[optuna.Trial, int, int, dict[str, Any]], dict[str, Any]]


def entry_params(algorithm: str, entry: dict[str, Any]) -> dict[str, Any]:
    """The trial that is an entry itself, without what cannot be searched around it: 0, and as many
    gradient steps as are taken in the environment (-1).

    :param algorithm: name of the algorithm
    :param entry: hyperparameters, learning rates as schedules
    :return: values by the names of Optuna's parameters
    """
    values = {
        name: parameter.default
        for name, parameter in inspect.signature(ALGORITHMS[algorithm]).parameters.items()
    }
    values |= entry
    values["one_minus_gamma"] = 1.0 - values["gamma"]
    rate = values["learning_rate"]
    if callable(rate):
        values["learning_rate"] = rate(1.0)
    params = {name: float(values[name]) for name in (*SCALES, *FRACTIONS) if name in values}
    params |= {name: int(values[name]) for name in COUNTS}
    if isinstance(rate, SimpleLinearSchedule):
        params[LINEAR] = params.pop("learning_rate")
    return {name: value for name, value in params.items() if value > 0 or name in FRACTIONS}


def convert_params(params: dict[str, Any]) -> dict[str, Any]:
    """Turn a trial's parameters into hyperparameters as an entry has them.

    :param params: under Optuna's names
    """
    hyperparams = dict(params)
    if "one_minus_gamma" in hyperparams:
        hyperparams["gamma"] = 1.0 - hyperparams.pop("one_minus_gamma")
    if LINEAR in hyperparams:
        hyperparams["learning_rate"] = f"lin_{hyperparams.pop(LINEAR)}"
    return hyperparams


def _sampler(algorithm: str) -> Sampler:
    def sample(
        trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
    ) -> dict[str, Any]:
        params: dict[str, Any] = {}
        for name, value in entry_params(algorithm, additional_args.get("entry", {})).items():
            if name in COUNTS:
                params[name] = trial.suggest_int(
                    name, max(1, math.ceil(value / 2)), 2 * value, log=True
                )
            elif name in FRACTIONS:
                reach = FRACTIONS[name]
                params[name] = trial.suggest_float(
                    name, max(0.0, value - reach), min(1.0, value + reach)
                )
            else:
                high = 4 * value if name.endswith("_coef") else min(1.0, 4 * value)
                params[name] = trial.suggest_float(name, value / 4, high, log=True)
        return convert_params(params)

    return sample


SAMPLERS: dict[str, Sampler] = {name: _sampler(name) for name in ALGORITHMS}
CONVERTERS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = dict.fromkeys(
    ALGORITHMS, convert_params
)
