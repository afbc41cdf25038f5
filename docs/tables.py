"""Writes what README and the results page show from the records: ``python docs/tables.py``.

A test compares, so that no figure stands there that no record has.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from sb3_poem.benchmark.tables import TABLE_3

TOP = Path(__file__).resolve().parents[1]
RESULTS = TOP / "benchmarks/results"
FAMILIES = (*TABLE_3, "FetchReach", "PointGoal")
RULES = {"bayes": "`Bayes()`", "paper": "`Paper()`"}
FIGURES = {
    "table3-methods-queries": "Methods, against the number of exact answers",
    "table3-methods-samples": "Methods, against the samples that training had",
    "noise": "Methods under answers with errors",
    "ablation": "Ablations",
    "smoke": "Methods, against the number of exact answers",
}
PAGES = {
    "table3": "all methods under exact answers",
    "noise": "under answers with errors",
    "ablation": "ablations",
    "epsilon": "tolerances of eq. 9",
    "smoke": "all methods",
}


def runs_of(family: str) -> list[dict[str, Any]]:
    """A family's recorded trainings, each with its adaptations; none where nothing was recorded."""
    record = RESULTS / family / "adaptation.json"
    return json.loads(record.read_text())["runs"] if record.exists() else []


def adaptations(family: str, rule: str) -> list[dict[str, Any]]:
    """One a seed: the first of its records is that of the default options."""
    ours = [
        [one for one in run["adaptations"] if one["inference"] == rule] for run in runs_of(family)
    ]
    return [found[0] for found in ours if found]


def number(values: list[float]) -> str:
    """Mean, and the deviation over seeds where there are several."""
    mean = np.mean(values)
    digits = 0 if abs(mean) >= 100 else 1
    spread = f" ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else ""
    return f"{mean:.{digits}f}{spread}"


def after(found: list[dict[str, Any]], k: int, what: str = "mean_return") -> str:
    """What was earned after k answers."""
    return number([one[what][one["queries"].index(k)] for one in found]) if found else ""


def summary() -> str:
    """README's table: a row a family."""
    lines = [
        "| family | paper: best baseline, 10 | POEM, 1 | POEM, 10 | ours: 1 | 10 | task known "
        "| seeds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for family in FAMILIES:
        paper = TABLE_3.get(family, {})
        others = [row[2][0] for name, row in paper.items() if name != "POEM"]
        theirs = [f"{paper['POEM'][column][0]:,}" for column in (0, 2)] if paper else ["", ""]
        best = f"{max(others):,}" if others else ""
        found = adaptations(family, "bayes")
        known = number([one["known_task_return"] for one in found]) if found else ""
        ours = [after(found, k) for k in (1, 10)]
        cells = (family, best, *theirs, *ours, known, str(len(found)))
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def family_section(family: str) -> str:
    """A family's part of the results page."""
    folder = RESULTS / family
    lines = [f"## {family}", ""]
    found = {rule: adaptations(family, rule) for rule in RULES}
    if any(found.values()):
        ks = [
            k
            for k in (0, 1, 2, 5, 10)
            if all(k in one["queries"] for ones in found.values() for one in ones)
        ]
        lines.append(f"| rule | {' | '.join(f'{k} answers' for k in ks)} | task known | seeds |")
        lines.append("|---|" + "---|" * (len(ks) + 2))
        for rule, name in RULES.items():
            if not found[rule]:
                continue
            known = number([one["known_task_return"] for one in found[rule]])
            cells = [name, *(after(found[rule], k) for k in ks), known, str(len(found[rule]))]
            lines.append(f"| {' | '.join(cells)} |")
        limits = [one["limit"] for one in found["bayes"] or found["paper"] if one.get("limit")]
        if limits:
            queries = (found["bayes"] or found["paper"])[0]["queries"]
            cells = [number([limit[queries.index(k)] for limit in limits]) for k in ks]
            lines.append(f"| *limit* | {' | '.join(cells)} |  |  |")
        lines.append("")
    pages = [(page, text) for page, text in PAGES.items() if (folder / f"{page}.md").exists()]
    where = f"../benchmarks/results/{family}"
    links = [f"[{text}]({where}/{page}.md)" for page, text in pages]
    lines += [f"Tables: {', '.join([*links, f'[the record]({where}/adaptation.md)'])}.", ""]
    for picture in sorted(folder.glob("*.png")):
        caption = next(
            (text for start, text in FIGURES.items() if picture.stem.startswith(start)), ""
        )
        lines += [f"![{caption}]({where}/{picture.name})", "", f"*{caption}.*", ""]
    return "\n".join(lines)


def results_page() -> str:
    """The page docs/results.md."""
    head = f"""# Results

Made from the records in `benchmarks/results/` by `python docs/tables.py`; each folder's manifest
has the commands. Mean return over 30 test tasks that no training saw (10 of `PointGoal`), after
exact answers; ± is the standard deviation over training seeds. *Task known*: what the model's own
policies earn when the task need not be found out. *Limit*: the best choice of 2^k of these
policies, chosen with the test tasks in sight: an optimistic bound for k exact answers. What is not
listed was not measured.

{summary()}
"""
    return "\n".join([head, *(family_section(family) for family in FAMILIES)])


def readme() -> str:
    """README with its table."""
    text = (TOP / "README.md").read_text()
    return re.sub(
        r"(<!-- results:.*?-->\n).*?(<!-- end -->)",
        rf"\g<1>{summary()}\n\g<2>",
        text,
        flags=re.DOTALL,
    )


WRITTEN = {TOP / "README.md": readme, TOP / "docs/results.md": results_page}

if __name__ == "__main__":
    for page, content in WRITTEN.items():
        page.write_text(content())
