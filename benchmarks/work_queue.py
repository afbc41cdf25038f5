"""Work through `queue.yml`: train, adapt and record every seed of every family that has no record
yet.

python benchmarks/work_queue.py [--device cuda --conf zoo_configs/poem_sac_paper.yml] [--runs
logs/benchmark]

A seed is done when `results/<Family>/adaptation.json` holds it. What was interrupted goes on from
its last checkpoint in `--runs`; an entry that fails is reported at the end, after the others.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml
from adaptation import RESULTS, family_of

HERE = Path(__file__).parent


def missing_seeds(entry: dict[str, Any]) -> list[int]:
    """Seeds of an entry that have no record."""
    file = RESULTS / family_of(entry["env"]) / "adaptation.json"
    recorded = (
        {run["training"]["seed"] for run in json.loads(file.read_text())["runs"]}
        if file.exists()
        else set()
    )
    return [seed for seed in entry["seeds"] if seed not in recorded]


def main() -> None:
    """Run what is missing, one after another."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--queue", type=Path, default=HERE / "queue.yml")
    parser.add_argument(
        "--runs", default="logs/benchmark", help="where models and checkpoints are kept"
    )
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--conf", help="hyperparameters other than zoo_configs/poem_sac.yml")
    parser.add_argument("--list", action="store_true", help="only show what is missing")
    given = parser.parse_args()
    failed = []
    for entry in yaml.safe_load(given.queue.read_text()):
        seeds = missing_seeds(entry)
        print(
            f"{entry['env']}: {'seeds ' + ', '.join(map(str, seeds)) + ' missing' if seeds else 'done'}",
            flush=True,
        )
        for seed in [] if given.list else seeds:
            train = [
                "--device",
                given.device,
                *(["-c", given.conf] if given.conf else []),
                *entry.get("train", []),
            ]
            command = [
                sys.executable,
                str(HERE / "adaptation.py"),
                entry["env"],
                "--seeds",
                str(seed),
                "--runs",
                given.runs,
            ]
            command += ["--algo", entry.get("algo", "poem_sac"), "--train-args", *train]
            if subprocess.run(command).returncode != 0:
                failed.append(f"{entry['env']}, seed {seed}")
    if failed:
        sys.exit("Failed: " + "; ".join(failed))


if __name__ == "__main__":
    main()
