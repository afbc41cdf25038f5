"""``make run``: the whole of it once, with the commands that do it.

Meta-trains an agent for PointGoal from nothing and adapts it to 30 unseen tasks by ten preference
queries each, then does the same adaptation with the HalfCheetahVel model that ships with the
package.
"""

import argparse
import shlex
import subprocess
import sys
import time
from pathlib import Path

from poem_envs.headless import can_draw
from sb3_poem.cli.outputs import check_writable

ADAPTATION = [
    "--oracle",
    "return",
    "--queries",
    "10",
    "--tasks",
    "30",
    "--record",
    "0",
    "1",
    "2",
    "5",
    "10",
]
NEXT = """\
Next:
  watch what ten answers change        {video}
  answer yourself                      sb3-poem adapt --model HalfCheetahVel --oracle human
  an oracle that errs                  sb3-poem adapt --model HalfCheetahVel --oracle mistake --mistake-rate 0.2
  meta-train another family            sb3-poem train --env poem/HalfCheetahFwdBack-v0 -P
  from Python, and your own family     README.md
(The program is {program}; activate its environment, or call it by this path.)
"""


def run(*arguments: str) -> None:
    """Show a command of ``sb3-poem``, and run it; stops the demonstration if it fails."""
    print(f"\n$ sb3-poem {shlex.join(arguments)}", flush=True)
    status = subprocess.run(
        [sys.executable, "-m", "sb3_poem.cli", *arguments], check=False
    ).returncode
    if status != 0:
        sys.exit(status)


def latest(pattern: str, folder: Path) -> Path:
    """The newest file of that name below a folder."""
    return max(folder.rglob(pattern), key=lambda path: path.stat().st_mtime)


def main() -> None:
    """Run the demonstration."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out"),
        help="folder for what is written (default: %(default)s)",
    )
    out: Path = parser.parse_args().out
    check_writable(out)
    started = time.perf_counter()

    print(
        "1. Meta-train a point that walks to goals on a half-circle. It sees some goals and their rewards."
    )
    run(
        "train",
        "--env",
        "poem/PointGoal-v0",
        "-f",
        str(out / "logs"),
        "--seed",
        "0",
        "--eval-freq",
        "-1",
        "--verbose",
        "0",
        "--num-threads",
        "1",  # as the time in the README was measured
        "-P",
    )
    model = latest("poem-PointGoal-v0.zip", out / "logs")

    print(
        "\n2. Thirty new goals, hidden: each is found by ten answers to `which of these is better?`, without reward."
    )
    files = ["--json", str(out / "PointGoal.json"), "--plot", str(out / "PointGoal.png")]
    run("adapt", "--model", str(model), *ADAPTATION, *files)

    print(
        "\n3. The same with a model that ships with the package: a robot that runs at a speed nobody tells it."
    )
    files = ["--json", str(out / "HalfCheetahVel.json"), "--plot", str(out / "HalfCheetahVel.png")]
    video = out / "HalfCheetahVel.mp4"
    if can_draw():
        files += ["--video", str(video)]
    else:
        print(
            "(No video: there is neither a display nor off-screen OpenGL here; apt-get install libegl1 libgl1.)"
        )
    run("adapt", "--model", "HalfCheetahVel", *ADAPTATION, *files)

    print(
        f"\nDone in {time.perf_counter() - started:.0f} s. The model is {model}; tables and plots are in {out}/.\n"
    )
    program = Path(sys.executable).with_name("sb3-poem")
    print(NEXT.format(video=video if can_draw() else "(needs off-screen OpenGL)", program=program))


if __name__ == "__main__":
    main()
