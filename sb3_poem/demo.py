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
from sb3_poem.cli.needs import check_writable

ADAPTATION = "--oracle return --queries 10 --tasks 30 --record 0 1 2 5 10"
# one thread: networks this small gain nothing from more
TRAINING = "--env poem/PointGoal-v0 --seed 0 --eval-freq -1 --verbose 0 --num-threads 1 -P"
NEXT = """\
Next:
  watch what ten answers change        {video}
  answer yourself                      {adapt} --oracle human
  an oracle that errs                  {adapt} --oracle mistake --mistake-rate 0.2
  meta-train another family            sb3-poem train --env poem/HalfCheetahFwdBack-v0 -P
  from Python, and your own family     README.md
(The program is {program}; activate its environment, or call it by this path.)
"""


def run(words: str, *arguments: object) -> None:
    """Show a command of ``sb3-poem``, and run it; stops the demonstration if it fails."""
    command = [*shlex.split(words), *map(str, arguments)]
    print(f"\n$ sb3-poem {shlex.join(command)}", flush=True)
    if status := subprocess.run([sys.executable, "-m", "sb3_poem", *command]).returncode:
        sys.exit(status)


def adapt(model: str | Path, name: str, out: Path, *arguments: object) -> None:
    """Adapt a model, and write the table and the plot of what that earned."""
    files = ["--json", out / f"{name}.json", "--plot", out / f"{name}.png"]
    run(f"adapt {ADAPTATION}", "--model", model, *files, *arguments)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    what = "folder for what is written (default: %(default)s)"
    parser.add_argument("--out", type=Path, default=Path("out"), help=what)
    out: Path = parser.parse_args().out
    check_writable(out)
    started = time.perf_counter()

    print("1. Meta-train a point that walks to goals on a half-circle. It sees some goals and")
    print("   their rewards.")
    run(f"train {TRAINING}", "-f", out / "logs")
    models = (out / "logs").rglob("poem-PointGoal-v0.zip")
    model = max(models, key=lambda path: path.stat().st_mtime)

    print("\n2. Thirty new goals, hidden: each is found by ten answers to `which of these is")
    print("   better?`, without reward.")
    adapt(model, "PointGoal", out)

    print("\n3. The same with a model that ships with the package: a robot that runs at a speed")
    print("   nobody tells it.")
    draws, video = can_draw(), out / "HalfCheetahVel.mp4"
    if not draws:
        print("(No video: there is neither a display nor off-screen OpenGL here;")
        print("apt-get install libegl1 libgl1.)")
    adapt("HalfCheetahVel", "HalfCheetahVel", out, *(["--video", video] if draws else []))

    print(f"\nDone in {time.perf_counter() - started:.0f} s. The model is {model}; tables and")
    print(f"plots are in {out}/.\n")
    program = Path(sys.executable).with_name("sb3-poem")
    shown = video if draws else "(needs off-screen OpenGL)"
    adapts = "sb3-poem adapt --model HalfCheetahVel"
    print(NEXT.format(video=shown, adapt=adapts, program=program))


if __name__ == "__main__":
    main()
