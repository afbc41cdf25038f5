"""``sb3-poem models``: what ships, a line each."""

import json
from pathlib import Path
from typing import Any

from sb3_poem.resources import pretrained_folder, pretrained_names

HEADER = ("name", "environment", "algorithm", "steps", "return after 0 and 10 answers")


def run_models(_: Any) -> None:
    """Print the models that ship. Nothing heavy is imported: their configurations are JSON."""
    rows = [HEADER, *(_row(name, pretrained_folder(name)) for name in pretrained_names())]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print(
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        )
    print(
        "\nReturns are means over 30 unseen tasks, by the rule `bayes`; each model's card has all figures."
    )


def _row(name: str, folder: Path) -> tuple[str, ...]:
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    return (
        name,
        config["env_id"],
        config["algorithm"],
        f"{config['num_timesteps']:,}",
        _returns(config["card"]),
    )


def _returns(card: dict[str, Any]) -> str:
    """The returns in a card, if it has any by the default rule."""
    for result in card.get("results", {}).get("adaptation to 30 unseen tasks", ()):
        earned = dict(zip(result["queries"], result["mean_return"], strict=True))
        if result["inference"] == "bayes" and {0, 10} <= set(earned):
            return f"{earned[0]:.1f} -> {earned[10]:.1f} (task known: {result['known_task_return']:.1f})"
    return ""
