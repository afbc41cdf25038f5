"""Turn a benchmarked run into a shipped model: ``python benchmarks/ship.py HalfCheetahVel --seed 0
--runs logs/benchmark``.
"""

import argparse
import json
from pathlib import Path

from sb3_poem.loading import load_model

REPOSITORY = Path(__file__).parents[1]


def main() -> None:
    """Write ``pretrained/<family>`` from the model and the recorded results of one seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("family")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=Path, default=Path("logs/benchmark"))
    arguments = parser.parse_args()
    results = json.loads(
        (REPOSITORY / f"benchmarks/results/{arguments.family}/adaptation.json").read_text()
    )
    run = next(run for run in results["runs"] if run["training"]["seed"] == arguments.seed)
    folder = arguments.runs / arguments.family / f"seed{arguments.seed}"
    model = load_model(str(sorted(folder.glob(f"*/*/poem-{arguments.family}-v0.zip"))[-1]))
    returns = [
        {
            name: result[name]
            for name in (
                "inference",
                "candidates",
                "queries",
                "mean_return",
                "limit",
                "known_task_return",
            )
        }
        for result in run["adaptations"]
    ]
    card = {
        **run["training"],
        "results": {"adaptation to 30 unseen tasks": returns, "property 1": run["order"]},
    }
    model.save_pretrained(REPOSITORY / "pretrained" / arguments.family, card)


if __name__ == "__main__":
    main()
