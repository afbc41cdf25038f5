"""Seconds of imports, of the command line's help, and until the first environment step of
``learn``, in fresh processes.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
from typing import Any

import common

FIRST_STEP = """
from sb3_poem import POEMSAC
from stable_baselines3.common.callbacks import BaseCallback
class Stop(BaseCallback):
    def _on_step(self):
        return False
POEMSAC("MlpPolicy", "poem/HalfCheetahVel-v0").learn(1, Stop())
"""
COMMANDS: dict[str, list[str]] = {
    "python, nothing": ["-c", ""],
    "import gymnasium": ["-c", "import gymnasium"],
    "import poem_envs": ["-c", "import poem_envs"],
    "import sb3_poem": ["-c", "import sb3_poem"],
    "sb3-poem --help": ["-m", "sb3_poem.cli", "--help"],
    "import stable_baselines3": ["-c", "import stable_baselines3"],
    "from sb3_poem import POEMSAC": ["-c", "from sb3_poem import POEMSAC"],
    "first step of learn": ["-c", FIRST_STEP],
}


def main() -> None:
    """Measure and write."""
    options = common.arguments(
        __doc__, lambda parser: parser.add_argument("--repeats", type=int, default=5)
    )

    def runner(arguments: list[str]) -> Any:
        return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)

    contenders = {name: runner(arguments) for name, arguments in COMMANDS.items()}
    seconds = common.seconds_in_turns(contenders, options.repeats)
    rows = [[name, statistics.median(values), min(values)] for name, values in seconds.items()]
    sections = [common.table(["what", "seconds, median", "fastest"], rows)]
    common.write(
        "start",
        "Import and start",
        sections,
        seconds,
        options.out,
        {"turns": options.repeats, "caches": "warm"},
    )


if __name__ == "__main__":
    main()
