"""``sb3-poem models``: what ships, a line each."""

import json
from typing import Any

from sb3_poem.resources import pretrained_folder, pretrained_names

HEADER = ("name", "environment", "algorithm", "steps", "return after 0 and 10 answers")
FOOTER = """Returns are means over 30 test tasks by the rule `bayes`; cards, in pretrained/, have
all figures. MetaWorld's models need the extra metaworld."""


def run_models(_: Any) -> None:
    """Print the models that ship. Nothing heavy is imported: their configurations are JSON."""
    rows = [HEADER]
    for name in pretrained_names():
        config = json.loads((pretrained_folder(name) / "config.json").read_text(encoding="utf-8"))
        steps, returns = f"{config['num_timesteps']:,}", _returns(config["card"])
        rows.append((name, config["env_id"], config["algorithm"], steps, returns))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        print("  ".join(cells).rstrip())
    print(f"\n{FOOTER}")


def _returns(card: dict[str, Any]) -> str:
    """The returns in a card, if it has any by the default rule."""
    for result in card.get("results", {}).get("adaptation to 30 unseen tasks", ()):
        earned = dict(zip(result["queries"], result["mean_return"], strict=True))
        if result["inference"] == "bayes" and {0, 10} <= set(earned):
            known = result["known_task_return"]
            return f"{earned[0]:.1f} -> {earned[10]:.1f} (task known: {known:.1f})"
    return ""
