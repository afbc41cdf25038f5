"""Writes what README, the pages of results and performance, and the cards of the models that ship
show from the stores: ``python docs/tables.py``.

A test compares, so that no figure stands there that no store has.
"""

import contextlib
import json
import re
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import Any

import gymnasium as gym
import numpy as np

import poem_envs  # noqa: F401
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.tables import TABLE_3, make_report
from sb3_poem.pearl_sac.model_card import model_card

TOP = Path(__file__).resolve().parents[1]
RESULTS = TOP / "benchmarks/results"
FAMILIES = (*TABLE_3, "FetchReach", "PointGoal")
ANSWERS = (0, 1, 2, 5, 10)
#: The store of a family's part of Table 3, of the models that the suite ``shipped`` made
TABLE3_STORE = "table3.sqlite"
#: Which row of each part of Table 3 the others are compared with
OWN = {"methods": "poem-bayes", "informed": "poem-bayes-aggregate"}
METHODS = """All methods, by the same test tasks and seeds, each with as many updates; "training
tasks": with candidates from their posteriors; `Bayes()` chooses. The last columns say where it
stands against the row, with candidates of the row's kind: ahead or behind if mean, interquartile
mean and the whole 95 % interval of the paired difference say so, else open: not
distinguishable."""
#: What else is to be known of a family's figures
REMARKS = {
    "MetaWorldML10": "The likelihood that `Bayes` has by default here was chosen by what another "
    "model earned on these test tasks.",
}
MANIPULATIONS = """By manipulation, three test tasks each. An episode succeeds by Meta-World's own
criterion if one of its 200 steps does; rewards are version 2."""
CAPTIONS = {
    "table3-methods-queries": "Methods, against the number of exact answers",
    "table3-methods-samples": "Methods, against the samples that training had",
    "table3-informed-queries": "Methods with candidates from the training tasks",
    "table3-parts-queries": "What the rows of POEM owe to what",
    "noise": "Methods under answers with errors",
    "ablation": "Ablations",
    "smoke": "Methods, against the number of exact answers",
}
PAGES = {
    "table3": "all methods under exact answers, with intervals",
    "noise": "under answers with errors",
    "ablation": "ablations",
    "epsilon": "tolerances of eq. 9",
    "smoke": "all methods",
    "adaptation": "a record by `sb3-poem adapt`",
    "metaworld-evaluation-test": "Meta-World's own evaluation, held-out manipulations",
    "metaworld-evaluation-train": "the ten to train on",
}


SHIPPED = Store(RESULTS / "shipped/benchmark.sqlite", create=False)
#: Those of the suite ``shipped``, one a method and number of answers
ROWS: list[dict[str, Any]] = json.loads(make_report(SHIPPED, ["shipped"], kind="json")[0])


def row(family: str, method: str, queries: int | None = None, kind: str = "method") -> Any:
    """The one of a family and a method, if it was measured."""
    for one in ROWS:
        if (one["family"], one["method"], one["kind"]) == (family, method, kind) and (
            queries in (None, one["queries"])
        ):
            return one
    return None


def digits(value: float) -> int:
    """Decimals with which a return is shown."""
    return 0 if abs(value) >= 100 else 1


def cell(found: Any, error: bool = False) -> str:
    """A return, with its deviation over training seeds, or the standard error over tasks of one."""
    if found is None:
        return ""
    n = digits(found["mean"])
    text = f"{found['mean']:,.{n}f}"
    spread = found["task_error" if found["n_seeds"] == 1 else "deviation"]
    if error and spread is not None:
        text += f"\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{spread:.{n}f}"
    return text


def rate(found: Any) -> str:
    """The share of successes, where the family knows of success."""
    if found is None or found["success_rate"] is None:
        return ""
    return f"{100 * found['success_rate']:.0f} %"


def training(family: str) -> str:
    """How the family's model came about."""
    steps = f"{int(row(family, 'poem-bayes')['samples']):,} environment steps"
    return " ".join(
        [f"Trained as its entry says, for {steps}.", *filter(None, [REMARKS.get(family)])]
    )


def table(head: list[str], rows: list[list[str]]) -> list[str]:
    """Markdown."""
    return [f"| {' | '.join(one)} |" for one in (head, ["---"] * len(head), *rows)]


def summary() -> str:
    """README's table: a row a family."""
    rows = []
    for family in FAMILIES:
        paper = dict(TABLE_3.get(family, {}))
        poem = paper.pop("POEM", None)
        quoted = []
        if poem is not None:
            best = [max(figures[i][0] for figures in paper.values()) for i in (0, 2)]
            quoted = [f"{figure:,}" for figure in (*best, poem[0][0], poem[2][0])]
        ours = [cell(row(family, "poem-bayes", k), error=True) for k in (1, 10)]
        limits = [cell(row(family, "known-task", k, "limit")) for k in (1, 10)]
        known = cell(row(family, "known-task", kind="known"))
        seeds = str(row(family, "poem-bayes", 10)["n_seeds"])
        rows.append([family, *(quoted or [""] * 4), seeds, *ours, *limits, known])
    head = ["family", "paper: baseline, 1", "10", "paper: POEM, 1", "10", "seeds"]
    return "\n".join(table([*head, "ours: 1", "10", "limit: 1", "10", "task known"], rows))


def methods(family: str) -> list[str]:
    """A family's part of Table 3: what every method earns, and whether `Bayes()` is ahead of it."""
    store = Store(RESULTS / family / TABLE3_STORE, create=False)
    found = json.loads(make_report(store, ["table3"], kind="json")[0])
    groups = ("methods", "informed")
    found = [one for one in found if one["entry"] in groups and one["queries"] in (1, 5, 10)]
    earned: dict[tuple[str, int], Any] = {}
    for one in found:
        if one["kind"] == "method":  # some stand in both groups, with the paper's figures in one
            earned.setdefault((one["label"], one["queries"]), one)
    ahead = {
        (one["against"], one["queries"]): one["claim"].replace("not distinguishable", "open")
        for one in found
        if one["kind"] == "difference" and one["method"] == OWN[one["entry"]]
    }
    rows = []
    for label in dict.fromkeys(label for label, _ in earned):
        own = [earned[label, k] for k in (1, 5, 10)]
        paper = ["" if one["paper_mean"] is None else f"{one['paper_mean']:,.0f}" for one in own]
        claims = [ahead.get((one["method"], one["queries"]), "") for one in own]
        rows.append([label, *paper, *(cell(one, error=True) for one in own), *claims])
    head = ["method", "paper: 1", "5", "10", "ours: 1", "5", "10", "Bayes, 1", "5", "10"]
    return [*table(head, rows), ""]


def by_manipulation(family: str) -> list[str]:
    """What seed 0 earns in each of a family's manipulations."""
    results = {
        one.method: one.result for one in SHIPPED.records() if (one.family, one.seed) == (family, 0)
    }
    ours, known = results["poem-bayes"], results["known-task"]
    with contextlib.closing(gym.make(f"poem/{family}-v0")) as env:
        names = env.get_wrapper_attr("manipulations")
    numbers = np.array(ours["tasks"])[:, 0].astype(int)
    last = ours["queries"].index(max(ANSWERS))
    rows = []
    for number in sorted(set(numbers.tolist())):
        found = [names[number]]
        for result, column in ((ours, (..., last)), (known, ...)):
            returns, rates = (
                np.array(result[what])[column][numbers == number].mean()
                for what in ("task_returns", "task_success_rates")
            )
            found += [f"{returns:,.0f}", f"{100 * rates:.0f} %"]
        rows.append(found)
    return table(["manipulation", "ten answers", "success", "task known", "success"], rows)


def family_section(family: str) -> str:
    """A family's part of the results page."""
    folder, where = RESULTS / family, f"../benchmarks/results/{family}"
    rows = []
    for name, method, kind in (
        ("`Bayes()`", "poem-bayes", "method"),
        ("`Paper()`", "poem-paper", "method"),
        ("*limit*", "known-task", "limit"),
    ):
        figures = [row(family, method, k, kind) for k in ANSWERS]
        if not any(figures):
            continue
        known = row(family, "known-task", kind="known") if kind == "method" else None
        rows.append([name, *(cell(one, error=True) for one in figures), cell(known)])
        rates = [rate(one) for one in (*figures, known)]
        if any(rates):
            rows.append([f"{name}, success", *rates])
    lines = [f"## {family}", "", fill(training(family), 120), ""]
    lines += [*table(["rule", *(f"k = {k}" for k in ANSWERS), "task known"], rows), ""]
    if family == "MetaWorldML10":
        lines += [fill(MANIPULATIONS, 120), "", *by_manipulation(family), ""]
    if (folder / TABLE3_STORE).exists():
        lines += [fill(METHODS, 120), "", *methods(family)]
    links = [
        f"[{text}]({where}/{page}.md)"
        for page, text in PAGES.items()
        if (folder / f"{page}.md").exists()
    ]
    if links:
        lines += ["More: " + ",\n".join(links) + ".", ""]
    for picture in sorted(folder.glob("*.png")):
        caption = next(text for start, text in CAPTIONS.items() if picture.stem.startswith(start))
        lines += [f"![{caption}]({where}/{picture.name})", "", f"*{caption}.*", ""]
    return "\n".join(lines)


def results_page() -> str:
    """The page docs/results.md."""
    head = f"""# Results

Mean return of the families' models, over 30 test tasks that no training saw, 10 episodes each,
after exact answers. Of *seeds* trainings seed 0 ships.

- *paper*: Table 3 of [Xu & Zhu 2025](https://proceedings.mlr.press/v267/); *baseline* is the best
  of its baselines after so many answers.
- *ours*: the rule `Bayes()`; ± is the deviation over seeds, or of one seed the standard error over
  tasks. [`Paper()`](algorithms/paper.md) stands below, by family.
- *limit*: the best choice of 2^k of the model's policies, all that k answers can tell apart. They
  are chosen by one episode each, on other tasks where dynamics are shared, and measured by other
  episodes; so it is an estimate, and a rule that acts on policies outside of that choice may pass
  it.
- *task known*: the best of the model's policies for each task, found by trying.
- The paper has POEM ahead of all baselines by 20 to 50 %. With its own rule, `Paper()`, that does
  not appear where all methods were measured: on HalfCheetahVel it is behind ANOLE-greedy after one
  answer, level after five, and 15 % ahead after ten, which three seeds do not tell from chance.
- Each model is what the family's entry in `zoo_configs/` makes, in one run from nothing.

`sb3-poem benchmark run --suite shipped --families FAMILY --seeds N` trains and measures (with
`--models pretrained --seeds 1` it measures what ships), `python docs/tables.py` writes this page
from [its stores](../benchmarks/results/shipped/manifest.md). HalfCheetahVel's table of all methods,
with its figures, is of the models above and their seeds. The other figures below a family are of
models of their own, by the revision of the code that each record names. What is not listed was not
measured.

{summary()}
"""
    return "\n".join([head, *(family_section(family) for family in FAMILIES)])


def trainings() -> str:
    """What the models that ship cost."""
    records = [one for one in SHIPPED.records() if (one.method, one.seed) == ("known-task", 0)]
    known = {one.family: one.result for one in records}
    rows = [
        [
            family,
            f"{known[family]['training_samples']:,}",
            f"{known[family]['updates']:,}",
            f"{known[family]['training_cpu_seconds'] / 60:.1f}",
        ]
        for family in FAMILIES
        if family in known
    ]
    return "\n".join(table(["family", "environment steps", "updates", "minutes of a core"], rows))


def by_seed(family: str) -> list[list[str]]:
    """What each training's model earns: seed, after one answer, after ten, with the task known."""
    found = {
        (one.seed, one.method): one.result for one in SHIPPED.records() if one.family == family
    }
    rows = []
    for seed in sorted({seed for seed, _ in found}):
        ours, known = found[seed, "poem-bayes"], np.mean(found[seed, "known-task"]["task_returns"])
        earned = np.mean(ours["task_returns"], axis=0)
        figures = [*(earned[ours["queries"].index(k)] for k in (1, 10)), known]
        rows.append([str(seed), *(f"{one:,.{digits(one)}f}" for one in figures)])
    return rows


def models() -> str:
    """Which models ship, and what they earn."""
    rows = []
    for family in FAMILIES:
        ships, *others = (after_ten for _, _, after_ten, _ in by_seed(family))
        rows.append([f"[{family}]({family}/README.md)", ships, ", ".join(others)])
    head = ["model", "return after ten answers", "of seeds that do not ship"]
    return "\n".join(table(head, rows))


def with_table(page: Path, name: str, content: str) -> str:
    """A page with a table between its marks."""
    pattern = rf"(<!-- {name}:.*?-->\n).*?(<!-- end -->)"
    return re.sub(pattern, rf"\g<1>{content}\n\g<2>", page.read_text(), flags=re.DOTALL)


def card(folder: Path) -> str:
    """A shipped model's card, with a picture, as it stands in the tree."""
    text = model_card(json.loads((folder / "config.json").read_text()))
    picture = f"../../docs/_static/environments/{folder.name}.webp"
    shown = f"![The robot after ten answers]({picture})"
    text = text.replace("\n## Use\n", f"\n{shown}\n\n## Use\n", 1)
    seeds = table(["seed", "k = 1", "k = 10", "task known"], by_seed(folder.name))
    all_of_them = "\n".join(["By seed of the training, `Bayes()`; seed 0 ships:", "", *seeds])
    return text.replace("\n## Limits\n", f"\n{all_of_them}\n\n## Limits\n", 1)


README, PERFORMANCE = TOP / "README.md", TOP / "docs/performance.md"
PRETRAINED = TOP / "pretrained/README.md"
WRITTEN = {
    PRETRAINED: lambda: with_table(PRETRAINED, "models", models()),
    README: lambda: with_table(README, "results", summary()),
    PERFORMANCE: lambda: with_table(PERFORMANCE, "trainings", trainings()),
    TOP / "docs/results.md": results_page,
    **{
        folder / "README.md": partial(card, folder)
        for folder in sorted((TOP / "pretrained").iterdir())
        if folder.is_dir()
    },
}

if __name__ == "__main__":
    for page, content in WRITTEN.items():
        page.write_text(content())
