"""rl_zoo3's train and enjoy with this package's algorithms, environments and hyperparameters."""

import sys
from collections.abc import Sequence

from rl_zoo3 import ALGOS
from rl_zoo3 import enjoy as zoo_enjoy
from rl_zoo3 import train as zoo_train
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from poem_envs.headless import has_display
from sb3_poem.cli.experiment import make_experiment
from sb3_poem.cli.resume import resumed
from sb3_poem.loading import ALGORITHMS

# Those of our own that differ from rl_zoo3's; what the user gives comes later, and wins.
DEFAULTS = {
    "train": ["--algo", "poem_sac", "--eval-freq", "100000", "--eval-episodes", "2"],
    "enjoy": ["--algo", "poem_sac", "--folder", "logs"],
}


def register_algorithms() -> None:
    """Make our algorithms known to rl_zoo3, in this process."""
    from sb3_poem.cli.hyperparams_opt import CONVERTERS, SAMPLERS

    ALGOS.update(ALGORITHMS)
    HYPERPARAMS_SAMPLER.update(SAMPLERS)
    HYPERPARAMS_CONVERTER.update(CONVERTERS)


def run_zoo(command: str, arguments: Sequence[str]) -> None:
    """
    Run rl_zoo3's program with our algorithms registered; ``poem_sac`` and the folder ``logs`` are the defaults.
    Training evaluates by adaptation, which takes a while, and so less often and on fewer episodes than rl_zoo3's default.

    :param command: ``"train"`` or ``"enjoy"``
    :param arguments: its own arguments, as its ``--help`` lists them
    """
    register_algorithms()
    defaults = DEFAULTS[command]
    if command == "enjoy" and not has_display() and not {"--no-render", "-h", "--help"} & set(arguments):
        raise OSError("there is no display to draw on: add --no-render, or see `sb3-poem adapt --video FILE`")

    if {"-h", "--help"} & set(arguments):
        print(f"Defaults here: {' '.join(defaults)}")
        if command == "train":
            print("--resume: go on with the last run of the same algorithm, environment and seed, if it did not finish")
        print()

    given = [*defaults, *arguments]
    if command == "train" and "--resume" in arguments:
        continued = resumed(given)
        if continued is None:
            return
        given = continued
    # rl_zoo3's programs read the process's own arguments.
    own_arguments = sys.argv
    sys.argv = [f"sb3-poem {command}", *given]
    zoo_train.ExperimentManager = make_experiment  # type: ignore[assignment,misc]
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
