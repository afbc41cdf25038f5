"""The card of a pretrained folder: what the model is, how to use it, what it earned."""

from textwrap import fill
from typing import Any

from poem_envs.registration import family_name

RULES = {"bayes": "`Bayes()`", "paper": "`Paper()`"}


def model_card(config: dict[str, Any], name: str | None = None) -> str:
    """Markdown with YAML front matter as the Hugging Face Hub takes it.

    :param config: Of a pretrained folder; what ``card`` in it leaves out is left out here.
    :param name: By which the model is loaded; None is its family's, as of a shipped one
    """
    card, algorithm, env_id = config["card"], config["algorithm"], config["env_id"]
    ships = str(env_id).startswith("poem/") or name is not None
    name = name or (family_name(str(env_id)) if ships else "path/of/this/folder")
    registered = "" if ships else "  # after an import of the module that registers it"
    return f"""---
library_name: sb3_poem
license: {card.get("license", "mit")}
tags: [reinforcement-learning, meta-reinforcement-learning, preferences, stable-baselines3]
---

# {algorithm} on `{env_id}`

One policy for each task of the family `{env_id}`; at most ten answers to "which of these did you
like better?" find the one for a new task.

## Use

```python
import gymnasium as gym

import sb3_poem

model = sb3_poem.{algorithm}.from_pretrained("{name}"){"  # or the path of this folder" * ships}
env = gym.make("{env_id}"){registered}
adapter = sb3_poem.PreferenceAdapter(model, env, oracle=sb3_poem.ReturnOracle())
policy = adapter.adapt()
```

## Training

{_training(config)}{_results(card)}
## Limits

Made for this family alone, in simulation. What it earns on tasks outside of the family's
distribution, or from people, is not on this card. `config.json` holds all arguments and the whole
record.
"""


def _training(config: dict[str, Any]) -> str:
    card = config["card"]
    rows = [
        ("environment steps", f"{config['num_timesteps']:,}"),
        ("gradient steps", f"{config['n_updates']:,}"),
        *((key, str(card[key])) for key in ("seed", "machine") if key in card),
    ]
    if card.get("wall_seconds"):
        rows.append(("wall time", f"{card['wall_seconds'] / 60:.0f} minutes"))
    text = "| | |\n|---|---|\n" + "".join(f"| {key} | {value} |\n" for key, value in rows)
    if "command" in card:
        text += f"\nTrained with:\n\n```\n{card['command']}\n```\n"
    if "note" in card:
        note = f"`config.json` notes: {card['note']}"
        text += f"\n{fill(note, 100, break_on_hyphens=False)}\n"
    return text


def _results(card: dict[str, Any]) -> str:
    results = card.get("results", {})
    what = next((name for name in results if name.startswith("adaptation to ")), "")
    measured = [one for one in results.get(what, ()) if one["inference"] in RULES]
    if not measured:
        return ""
    ks = [k for k in measured[0]["queries"] if all(k in one["queries"] for one in measured)]
    head = ["rule", "candidates", *(f"k = {k}" for k in ks), "task known"]
    rows = [head, ["---"] * len(head)]
    for one in measured:
        returns = [f"{one['mean_return'][one['queries'].index(k)]:.1f}" for k in ks]
        source, known = one.get("candidates", "default"), f"{one['known_task_return']:.1f}"
        rows.append([RULES[one["inference"]], source, *returns, known])
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return f"""
## Results

Mean return after k exact answers, {what.replace("unseen", "test")}.

{table}
"""
