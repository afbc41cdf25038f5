"""What ``sb3-poem train -optimize`` searches, in the form of rl_zoo3's samplers."""

from collections.abc import Callable
from typing import Any

import optuna

# Kept by Optuna as exponents of two, given to the algorithm as numbers.
POWERS_OF_TWO = ("batch_size", "context_size", "meta_batch_size")


def convert_params(sampled: dict[str, Any]) -> dict[str, Any]:
    """
    Turn a trial's parameters into arguments of the algorithm.

    :param sampled: as :func:`sample_pearl_sac_params` or :func:`sample_poem_sac_params` named them
    """
    hyperparams = dict(sampled)
    hyperparams["gamma"] = 1.0 - hyperparams.pop("one_minus_gamma")
    for name in POWERS_OF_TWO:
        hyperparams[name] = 2 ** hyperparams.pop(f"{name}_pow")
    return hyperparams


def _suggest(trial: optuna.Trial) -> dict[str, Any]:
    return {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.05, log=True),
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-3, log=True),
        "tau": trial.suggest_float("tau", 0.002, 0.02, log=True),
        "gradient_steps": trial.suggest_categorical("gradient_steps", [250, 500, 1000, 2000]),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 8),
        "context_size_pow": trial.suggest_int("context_size_pow", 5, 8),
        "meta_batch_size_pow": trial.suggest_int("meta_batch_size_pow", 3, 5),
        "latent_dim": trial.suggest_int("latent_dim", 2, 8),
        "kl_coef": trial.suggest_float("kl_coef", 0.01, 3.0, log=True),
        "reward_coef": trial.suggest_float("reward_coef", 0.05, 2.0, log=True),
        "policy_coef": trial.suggest_float("policy_coef", 0.1, 2.0, log=True),
        "relabel_fraction": trial.suggest_float("relabel_fraction", 0.0, 0.8),
    }


def sample_pearl_sac_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Arguments of :class:`~sb3_poem.PEARLSAC` for one trial.

    :param trial: draws the values
    :param n_actions: unused, as are the other two; rl_zoo3 gives them to every sampler
    """
    return convert_params(_suggest(trial))


def sample_poem_sac_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Arguments of :class:`~sb3_poem.POEMSAC` for one trial.

    :param trial: draws the values
    :param n_actions: unused, as are the other two; rl_zoo3 gives them to every sampler
    """
    return convert_params({**_suggest(trial), "preference_coef": trial.suggest_float("preference_coef", 0.5, 20.0, log=True)})


Sampler = Callable[[optuna.Trial, int, int, dict[str, Any]], dict[str, Any]]
SAMPLERS: dict[str, Sampler] = {"pearl_sac": sample_pearl_sac_params, "poem_sac": sample_poem_sac_params}
CONVERTERS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {"pearl_sac": convert_params, "poem_sac": convert_params}
