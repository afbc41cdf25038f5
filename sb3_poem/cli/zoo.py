"""rl_zoo3's train and enjoy with this package's algorithms, environments and hyperparameters."""

import difflib
import inspect
import sys
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import yaml
from rl_zoo3 import ALGOS
from rl_zoo3 import enjoy as zoo_enjoy
from rl_zoo3 import train as zoo_train
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from poem_envs import TaskFamily
from sb3_poem.cli import has_display
from sb3_poem.cli.models import ALGORITHMS
from sb3_poem.cli.outputs import check_writable
from sb3_poem.resources import config_file

# What rl_zoo3 takes out of an entry for itself before the rest goes to the algorithm.
ZOO_KEYS = frozenset(
    {"callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "n_timesteps"}
    | {"normalize", "vec_env_wrapper"}
)
# What rl_zoo3 gives to the algorithm itself; the same in an entry would be given twice.
FLAG_OF_KEY = {
    "device": "--device",
    "env": "--env",
    "seed": "--seed",
    "tensorboard_log": "-tb",
    "verbose": "--verbose",
}


def check_keys(keys: Sequence[str], algorithm: str, source: str) -> None:
    """
    Compare the keys of an entry of hyperparameters with what rl_zoo3 and the algorithm take.

    :param keys: the entry's keys
    :param algorithm: name of the algorithm
    :param source: where the keys were read, for the message
    :raises ValueError: at the first key that neither takes; the message names it and what resembles it
    """
    known = ZOO_KEYS | {name for name in inspect.signature(ALGOS[algorithm]).parameters if not name.startswith("_")}
    for key in keys:
        if key in FLAG_OF_KEY:
            raise ValueError(f"{key!r} in {source} belongs on the command line: {FLAG_OF_KEY[key]}")
        if key not in known:
            close = difflib.get_close_matches(key, known - set(FLAG_OF_KEY), n=3)
            hint = f"did you mean {' or '.join(map(repr, close))}?" if close else "nor anything like it."
            raise ValueError(f"Unknown key {key!r} in {source}: {algorithm} has no such hyperparameter, {hint}")


def check_numbers(entry: dict[str, Any], source: str) -> None:
    """
    :param entry: hyperparameters
    :param source: where they were read, for the message
    :raises ValueError: if a number was read as text, as YAML reads 1e-3 (but 1.0e-3 as a number)
    """
    for key, value in entry.items():
        if isinstance(value, str):
            try:
                number = float(value)
            except ValueError:
                continue
            raise ValueError(f"{key} in {source} is the text {value!r} to YAML; write {number!r}")


def is_task_family(env_id: str) -> bool | None:
    """Whether an environment is a task family; None if its entry point is a function, which does not tell."""
    entry_point = gym.spec(env_id).entry_point
    creator = gym.envs.registration.load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
    return issubclass(creator, TaskFamily) if inspect.isclass(creator) else None


class PoemExperimentManager(ExperimentManager):
    """rl_zoo3's experiment with our hyperparameter files, our vectorised environment, and checks before anything starts."""

    def __init__(
        self, args: Any, algo: str, env_id: str, log_folder: str, tensorboard_log: str = "", *rest: Any, **kwargs: Any
    ):
        if algo in ALGORITHMS:
            if is_task_family(env_id) is False:
                raise ValueError(f"--env {env_id} is no task family (a poem_envs.TaskFamily), and {algo} needs one")
            kwargs["config"] = kwargs.get("config") or str(config_file(algo))
        for folder in filter(None, (log_folder, tensorboard_log)):
            check_writable(folder)
        super().__init__(args, algo, env_id, log_folder, tensorboard_log, *rest, **kwargs)
        if is_task_family(env_id) and gym.spec(env_id).vector_entry_point and kwargs.get("vec_env_type", "dummy") == "dummy":
            from sb3_poem.common.vec_env import TaskVecEnv

            self.vec_env_class = TaskVecEnv

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        try:
            hyperparams, saved = super().read_hyperparameters()
        except yaml.YAMLError as error:
            raise ValueError(f"{self.config} is not valid YAML: {error}") from error
        if self.algo in ALGORITHMS:
            custom = set(self.custom_hyperparams or ())
            source = f"{self.config}, entry {self.env_name.gym_id!r}"
            check_keys(sorted(custom), self.algo, "-params")
            check_keys(sorted(set(hyperparams) - custom), self.algo, source)
            check_numbers({key: value for key, value in hyperparams.items() if key not in custom}, source)
        return hyperparams, saved


def register_algorithms() -> None:
    """Make our algorithms known to rl_zoo3, in this process."""
    from sb3_poem.cli.hyperparams_opt import CONVERTERS, SAMPLERS

    ALGOS.update(ALGORITHMS)
    HYPERPARAMS_SAMPLER.update(SAMPLERS)
    HYPERPARAMS_CONVERTER.update(CONVERTERS)


def run_zoo(command: str, arguments: Sequence[str]) -> None:
    """
    Run rl_zoo3's program with our algorithms registered; ``poem_sac`` and the folder ``logs`` are the defaults.

    :param command: ``"train"`` or ``"enjoy"``
    :param arguments: its own arguments, as its ``--help`` lists them
    """
    register_algorithms()
    defaults = ["--algo", "poem_sac"]
    if command == "enjoy":
        defaults += ["--folder", "logs"]
        if not has_display() and not {"--no-render", "-h", "--help"} & set(arguments):
            raise OSError("there is no display to draw on: add --no-render, or see `sb3-poem adapt --video FILE`")

    # rl_zoo3's programs read the process's own arguments.
    own_arguments = sys.argv
    sys.argv = [f"sb3-poem {command}", *defaults, *arguments]
    zoo_train.ExperimentManager = PoemExperimentManager  # type: ignore[misc]
    try:
        zoo_train.train() if command == "train" else zoo_enjoy.enjoy()
    except AssertionError as error:
        # rl_zoo3 asserts on what the user gave; an assertion without words is a defect.
        if not str(error):
            raise
        raise ValueError(str(error)) from error
    finally:
        sys.argv = own_arguments
        zoo_train.ExperimentManager = ExperimentManager  # type: ignore[misc]
