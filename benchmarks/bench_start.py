"""Seconds of imports, of the command line's help, and until the first environment step of
``learn``, in fresh processes.
"""

import statistics
import subprocess
import sys
from functools import partial

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
    "sb3-poem --help": ["-m", "sb3_poem", "--help"],
    "import stable_baselines3": ["-c", "import stable_baselines3"],
    "from sb3_poem import POEMSAC": ["-c", "from sb3_poem import POEMSAC"],
    "first step of learn": ["-c", FIRST_STEP],
}


def main() -> None:
    given = common.arguments(__doc__, repeats=5)
    contenders = {
        name: partial(subprocess.run, [sys.executable, *words], check=True, capture_output=True)
        for name, words in COMMANDS.items()
    }
    seconds = common.seconds_in_turns(contenders, given.repeats)
    rows = [[name, statistics.median(values), min(values)] for name, values in seconds.items()]
    sections = [common.table(["what", "seconds, median", "fastest"], rows)]
    settings = {"turns": given.repeats, "caches": "warm"}
    common.write("start", "Import and start", sections, seconds, given.out, settings)


if __name__ == "__main__":
    main()
