"""Writes what README, the pages of results and performance, and the cards of the models that ship
show from the stores: ``python docs/tables.py``.

A test compares, so that no figure stands there that no store has.
"""

import contextlib
import json
import re
from functools import cache, partial
from pathlib import Path
from textwrap import fill
from typing import Any

import gymnasium as gym
import numpy as np

import poem_envs  # noqa: F401
from sb3_poem.benchmark.methods import METHODS
from sb3_poem.benchmark.results import compare, summarise
from sb3_poem.benchmark.store import Store
from sb3_poem.benchmark.suites import OracleSpec
from sb3_poem.benchmark.tables import TABLE_3, make_report
from sb3_poem.pearl_sac.model_card import model_card

TOP = Path(__file__).resolve().parents[1]
RESULTS = TOP / "benchmarks/results"
FAMILIES = (*TABLE_3, "FetchReach", "PointGoal")
ANSWERS = (0, 1, 2, 5, 10)
#: The store of a family's part of Table 3, of the models that the suite ``shipped`` made
TABLE3_STORE = "table3.sqlite"
#: The same of the suite ``noise``
NOISE_STORE = "noise.sqlite"
#: The same of the suite ``answers``
ANSWERS_STORE = "answers.sqlite"
#: Which row of each part of Table 3 the others are compared with, the first that there is
OWN = {
    "prior": ("poem-bayes-prior-decoder", "poem-bayes-prior-similarity"),
    "informed": ("poem-bayes-aggregate",),
}
PAPERS = {"prior": "poem-paper", "informed": "poem-paper-aggregate"}
SOURCES = {"prior": "prior", "informed": "training tasks"}
PARTS = """What `Bayes()` owes to its parts: rule, candidates, likelihood (S or decoder), POEM's
model, its preference loss. The last columns say how `Bayes()` as it is stands against the row."""
TABLE = """All methods, by the same test tasks and seeds, each with as many updates, with
candidates from the prior or from the training tasks' posteriors. `Bayes()` takes the latter where
they are far from the prior. The last columns say how `Bayes` and `Paper` with candidates of the
same kind stand against the row: ahead (+) or behind (-) if mean, interquartile mean and the whole
95 % interval of the paired difference say so, else not distinguishable (?)."""
UNTOLD = """Answers with errors: `Bayes()` that is told how they err, and that is not
(`noise_model="infer"`). The last columns say by how much of the range from no answer to the task
known the latter is behind (negative: ahead). A difference is distinguishable if mean, interquartile
mean and the whole 95 % interval of the paired difference agree: {claim}."""
KINDS = """Kinds of questions: a pair, a graded pair (much better, too), and the best of four, which
shows twice as many films as either. `Bayes()` is told how answers err, or not
(`noise_model="infer"`). The last column says whether five answers are ahead (+) or behind (-) of
ten to pairs, by the same rule and on the same tasks, or not distinguishable (?)."""
#: How tables write a claim
SIGNS = {"ahead": "+", "behind": "-", "not distinguishable": "?", "": ""}
#: What else is to be known of a family's figures
REMARKS = {
    "AntDir2D": "Of kinds of questions, seeds 1 and 2 were trained anew on another processor, "
    "which rounds differently.",
    "MetaWorldML10": "The likelihood that `Bayes` has by default here was chosen by what another "
    "model earned on these test tasks.",
}
MANIPULATIONS = """Seed 0 by manipulation, three test tasks each. An episode succeeds by
Meta-World's own criterion if one of its 200 steps does; rewards are version 2."""
CAPTIONS = {
    "table3-prior-queries": "Return against answers, the prior's candidates",
    "table3-informed-queries": "Return against answers, training tasks' candidates",
    "smoke": "Return against the number of exact answers",
}
PAGES = {
    "table3": "all methods, with intervals",
    "noise": "under answers with errors",
    "answers": "kinds of questions",
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


def cell(found: Any, spread: str = "") -> str:
    """A return, with a spread of this name if there is one."""
    if found is None:
        return ""
    n = digits(found["mean"])
    text = f"{found['mean']:,.{n}f}"
    if spread and found[spread] is not None:
        text += f"\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{found[spread]:,.{n}f}"
    return text


def spread_of(family: str) -> tuple[str, str]:
    """What ± is in a family's table, in words and by its name."""
    seeds, tasks = row(family, "poem-bayes", 10)["n_seeds"], effort(family)["tasks"]
    if seeds > 1:
        return f"{seeds} seeds; ± is the deviation over them.", "deviation"
    if len(np.unique(tasks, axis=0)) < len(tasks):
        return "One seed.", ""  # of the same two tasks, again and again
    return "One seed; ± is the standard error over tasks.", "task_error"


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
        ours = [cell(row(family, "poem-bayes", k)) for k in (1, 10)]
        limits = [cell(row(family, "known-task", k, "limit")) for k in (1, 10)]
        known = cell(row(family, "known-task", kind="known"))
        seeds = str(row(family, "poem-bayes", 10)["n_seeds"])
        rows.append([family, *(quoted or [""] * 4), seeds, *ours, *limits, known])
    head = ["family", "paper: baseline, 1", "10", "paper: POEM, 1", "10", "seeds"]
    return "\n".join(table([*head, "ours: 1", "10", "limit: 1", "10", "task known"], rows))


def spreads() -> str:
    """What stands behind the summary's figures after ten answers, a row a family."""
    rows = []
    for family in FAMILIES:
        found, trained = row(family, "poem-bayes", 10), effort(family)
        n = digits(found["mean"])
        deviation, error = (
            "" if value is None else f"{value:,.{n}f}"
            for value in (found["deviation"], found["task_error"])
        )
        if len(np.unique(trained["tasks"], axis=0)) < len(trained["tasks"]):
            error = ""
        shares = [share(family, k) for k in (1, 5, 10)]
        rows.append([family, str(found["n_seeds"]), f"{trained['updates']:,}", deviation, error])
        rows[-1] += [f"{trained['training_cpu_seconds'] / 60:.0f}", *shares]
    head = ["family", "seeds", "updates", "± over seeds", "± over tasks", "minutes of a core"]
    return "\n".join(table([*head, "share of the limit's range, 1", "5", "10"], rows))


def effort(family: str) -> dict[str, Any]:
    """The result of seed 0's cell of the task known, which says what its training took."""
    [found] = [
        one.result
        for one in SHIPPED.records()
        if (one.family, one.method, one.seed) == (family, "known-task", 0)
    ]
    return found


def share(family: str, queries: int) -> str:
    """How much `Bayes()` earns of what the limit gains by so many answers."""
    nothing, limit = (row(family, "known-task", k, "limit")["mean"] for k in (0, queries))
    return (
        f"{100 * (row(family, 'poem-bayes', queries)['mean'] - nothing) / (limit - nothing):.0f} %"
    )


@cache
def returns_by_seed(store: Store) -> dict[tuple[str, str, str, int], np.ndarray]:
    """(n_seeds, n_tasks) of each family, oracle, method of POEM and number of answers."""
    found: dict[tuple[str, str, str, int], list[np.ndarray]] = {}
    for one in sorted(store.records(), key=lambda one: one.seed):
        if one.method.startswith("poem"):
            oracle = OracleSpec.of_identity(one.identity["oracle"]).label
            for k, returns in zip(
                one.result["queries"], np.array(one.result["task_returns"]).T, strict=True
            ):
                found.setdefault((one.family, oracle, one.method, k), []).append(returns)
    return {key: np.stack(returns) for key, returns in found.items()}


def paper_rule() -> str:
    """What `Paper()` earns with the models that ship, a row a family."""
    rows = []
    for family in FAMILIES:
        if poem := TABLE_3.get(family, {}).get("POEM"):
            ours = [row(family, "poem-paper", k) for k in (1, 5, 10)]
            figures = [*(f"{mean:,}" for mean, _ in poem), *map(cell, ours)]
            returns, claims = returns_by_seed(SHIPPED), []
            for k in (1, 5, 10):
                about = [(family, "exact answers", f"poem-{one}", k) for one in ("bayes", "paper")]
                claims.append(compare(*map(returns.__getitem__, about)))
            signs = [SIGNS[one.claim] for one in claims]
            rows.append([family, str(ours[0]["n_seeds"]), *figures, *signs])
    head = ["family", "seeds", "the paper: 1", "5", "10", "`Paper()`: 1", "5", "10"]
    head += ["`Bayes()`: 1", "5", "10"]
    return "\n".join(table(head, rows))


@cache
def table3(family: str) -> list[dict[str, Any]]:
    """What is known of a family's part of Table 3 after 1, 5 and 10 answers."""
    store = Store(RESULTS / family / TABLE3_STORE, create=False)
    found = json.loads(make_report(store, ["table3"], kind="json")[0])
    return [one for one in found if one["queries"] in (1, 5, 10)]


def methods(family: str) -> list[str]:
    """A family's part of Table 3: what every method earns, and whether `Bayes` is ahead of it; of
    nothing while baselines were not run.
    """
    found = table3(family)
    of_paper = {
        (one["method"], one["queries"]): one["paper_mean"]
        for one in found
        if one["entry"] == "methods" and one["kind"] == "method"
    }
    if not any(one["method"] == "anole" for one in found):
        return []  # POEM's own rows alone
    rows = []
    for entry, source in SOURCES.items():
        here = [one for one in found if one["entry"] == entry]
        earned = {(one["method"], one["queries"]): one for one in here if one["kind"] == "method"}
        names = list(dict.fromkeys(name for name, _ in earned))
        own = next(name for name in OWN[entry] if name in names)
        claims = {
            (one["method"], one["against"], one["queries"]): SIGNS[one["claim"]]
            for one in here
            if one["kind"] == "difference"
        }
        for name in names:
            if name in OWN["prior"] and name != own:
                continue
            label = "POEM (Bayes)" if name == own else earned[name, 1]["label"]
            label = label.removesuffix(f", {source}")
            paper = [of_paper.get((name, k)) for k in (1, 5, 10)]
            rows.append([label, "" if name == "maml-reward" else source])
            rows[-1] += ["" if one is None else f"{one:,.0f}" for one in paper]
            rows[-1] += [cell(earned[name, k], "deviation") for k in (1, 5, 10)]
            for subject in (own, PAPERS[entry]):
                rows[-1] += [claims.get((subject, name, k), "") for k in (1, 5, 10)]
            if name == own:
                rows[-1][0] = "**POEM (Bayes)**"
    rows = list(map(list, dict.fromkeys(map(tuple, rows))))  # MAML-reward stands in both
    head = ["method", "candidates", "paper: 1", "5", "10", "ours: 1", "5", "10"]
    return [*table([*head, "Bayes: 1", "5", "10", "Paper: 1", "5", "10"], rows), ""]


def parts(family: str) -> list[str]:
    """What `Bayes()` owes to what: other candidates, likelihoods, models."""
    found = [one for one in table3(family) if one["entry"] == "parts"]
    earned = {(one["method"], one["queries"]): one for one in found if one["kind"] == "method"}
    claims = {
        (one["against"], one["queries"]): SIGNS[one["claim"]]
        for one in found
        if one["kind"] == "difference" and one["method"] == "poem-bayes"
    }
    rows = [
        [
            earned[name, 1]["label"],
            *(cell(earned[name, k], "deviation") for k in (1, 5, 10)),
            *(claims.get((name, k), "") for k in (1, 5, 10)),
        ]
        for name in dict.fromkeys(name for name, _ in earned)
    ]
    return [*table(["method", "1", "5", "10", "`Bayes()`, 1", "5", "10"], rows), ""]


def untold(family: str) -> list[str]:
    """What it costs not to know how answers err."""
    store = Store(RESULTS / family / NOISE_STORE, create=False)
    returns = returns_by_seed(store)
    found = {
        (one["oracle"], one["method"], one["queries"]): one
        for one in json.loads(make_report(store, ["noise"], kind="json")[0])
        if one["kind"] == "method"
    }
    known = row(family, "known-task", kind="known")["mean"]
    rows, claims = [], []
    for oracle in dict.fromkeys(oracle for oracle, _, _ in found):
        told, inferred = (
            [found[oracle, f"poem-bayes{name}", k] for k in (0, 1, 5, 10)]
            for name in ("", "-untold")
        )
        label = oracle.removesuffix(" answers").replace(" of the answers", "")
        rows.append([label, *(cell(one, "deviation") for one in (*told[1:], *inferred[1:]))])
        for one, other in zip(told[1:], inferred[1:], strict=True):
            lost = (one["mean"] - other["mean"]) / (known - told[0]["mean"])
            rows[-1].append(f"{100 * lost:.0f} %")
        claims += [
            compare(
                *(returns[family, oracle, f"poem-bayes{name}", k] for name in ("-untold", ""))
            ).claim
            for k in (1, 5, 10)
        ]
    told_apart = sum(claim in ("ahead", "behind") for claim in claims)
    claim = f"{told_apart or 'none'} of these {len(claims)}"
    head = ["answers", "told: 1", "5", "10", "not told: 1", "5", "10", "behind: 1", "5", "10"]
    return [fill(UNTOLD.format(claim=claim), 120), "", *table(head, rows), ""]


def questions(family: str) -> list[str]:
    """What is earned by kinds of questions and by who answers."""
    store = Store(RESULTS / family / ANSWERS_STORE, create=False)
    returns, rows = returns_by_seed(store), []
    for one in json.loads(make_report(store, ["answers"], [family], kind="json")[0]):
        if one["kind"] != "method" or one["queries"] != 1:
            continue
        oracle, method = one["oracle"], METHODS[one["method"]]
        told = "no" if "noise_model" in method.options else "yes"
        if ", told as " in oracle:
            oracle, _, told = oracle.partition(", told as ")
            told = f"as {told}"
        oracle = oracle.replace(" answers, graded from", ", from").removesuffix(" of the spread on")
        about = [
            oracle.removesuffix(" answers").replace(" of the answers", ""),
            method.question.replace("-", " "),
            told,
        ]
        mine = {k: returns[family, one["oracle"], method.name, k] for k in ANSWERS}
        earned = [summarise(mine[k]) for k in ANSWERS[1:]]
        sign, pairs = "", method.name.replace(f"-{method.question}", "")
        if pairs != method.name:
            usual = one["oracle"].partition(", graded from ")[0]
            versus = compare(mine[5], returns[family, usual, pairs, 10])
            sign = SIGNS[versus.claim]
        rows.append([*about, *(cell(vars(each), "deviation") for each in earned), sign])
    head = ["answers", "question", "told", *(f"k = {k}" for k in ANSWERS[1:])]
    return [fill(KINDS, 120), "", *table([*head, "five against ten pairs"], rows), ""]


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
    rows, (about, spread) = [], spread_of(family)
    for name, method, kind in (
        ("`Bayes()`", "poem-bayes", "method"),
        ("`Paper()`", "poem-paper", "method"),
        ("*limit*", "known-task", "limit"),
    ):
        figures = [row(family, method, k, kind) for k in ANSWERS]
        if not any(figures):
            continue
        known = row(family, "known-task", kind="known") if kind == "method" else None
        rows.append([name, *(cell(one, spread) for one in figures), cell(known)])
        rates = [rate(one) for one in (*figures, known)]
        if any(rates):
            rows.append([f"{name}, success", *rates])
    lines = [f"## {family}", "", fill(f"{training(family)} {about}", 120), ""]
    lines += [*table(["rule", *(f"k = {k}" for k in ANSWERS), "task known"], rows), ""]
    if family == "MetaWorldML10":
        lines += [fill(MANIPULATIONS, 120), "", *by_manipulation(family), ""]
    if (folder / TABLE3_STORE).exists():
        if rows := methods(family):
            lines += [fill(TABLE, 120), "", *rows]
        lines += [fill(PARTS, 120), "", *parts(family)]
    if (folder / NOISE_STORE).exists():
        lines += untold(family)
    if (folder / ANSWERS_STORE).exists():
        lines += questions(family)
    links = []
    for page, text in PAGES.items():
        if (folder / f"{page}.md").exists():
            old = "revision 0 of the code" in (folder / f"{page}.md").read_text()
            links.append(f"[{text}]({where}/{page}.md)" + " (revision 0)" * old)
    if links:
        lines += ["More: " + ",\n".join(links) + ".", ""]
    for picture in sorted(folder.glob("*.png")):
        caption = next(text for start, text in CAPTIONS.items() if picture.stem.startswith(start))
        lines += [f"![{caption}]({where}/{picture.name})", "", f"*{caption}.*", ""]
    return "\n".join(lines)


def results_page() -> str:
    """The page docs/results.md."""
    head = f"""# Results

**The paper's claim.** The paper has POEM 20 to 50 % ahead of the best baseline. With models by the
entries of `zoo_configs/` all methods were compared on HalfCheetahVel, on AntVel and on PointGoal,
which is small. There the paper's own rule, `Paper()`, with candidates from the prior, does not show
that. On AntVel it is not distinguishable from any of the three ANOLEs after any number of answers.
On HalfCheetahVel it is not distinguishable from ANOLE and ANOLE-greedy after one answer; after ten
it is ahead of ANOLE and not distinguishable from ANOLE-greedy. With candidates from the training
tasks for all methods it is behind these two after one answer, and ahead of both after five and ten;
on AntVel it is behind both after one, ahead of ANOLE alone after five, and distinguishable from
neither after ten. On PointGoal it is 12 to 15 % ahead of all three ANOLEs after one answer, and not
distinguishable from them after five and ten. With earlier, shorter trainings (three seeds) it is
ahead of every baseline on HalfCheetahFwdBack after one answer, and behind ANOLE and ANOLE-greedy
after ten.

**The models that ship.** Mean return over 30 test tasks, 10 episodes each, after exact answers. No
training saw the test tasks, but those of the two FwdBack families: these have two tasks, forward
and backward, and training has both. The column *seeds* counts trainings; the model of seed 0 ships.

- *paper*: Table 3 of [Xu & Zhu 2025](https://proceedings.mlr.press/v267/); *baseline* is the best
  of its baselines after so many answers.
- *ours*: the rule `Bayes()`. [`Paper()`](algorithms/paper.md#results) stands below, by family.
- *limit*: the best choice of 2^k of the model's policies, all that k answers can tell apart, of 300
  (MetaWorldML10: 30). It is chosen by three episodes a policy, on other tasks where dynamics are
  shared, and measured by one other episode a policy, so that it is an estimate: it may lie above
  the task known, and a rule that acts on other policies may pass it.
- *task known*: the best of the model's policies for each task, found by trying.

Each model is what the family's entry in `zoo_configs/` makes, in one run from nothing.

{summary()}

What stands behind the figures after ten answers: the deviation over seeds, the standard error over
tasks, and how much of what the limit gains over no answer `Bayes()` has after 1, 5 and 10:

{spreads()}

`sb3-poem benchmark run --suite shipped --families FAMILY --seeds N` trains and measures (with
`--models pretrained --seeds 1` it measures what ships), `python docs/tables.py` writes this page
from [its stores](../benchmarks/results/shipped/manifest.md). Pages of *revision 0*
of the [code](guides/benchmark.md#suites) are of earlier and shorter trainings, and their figures
are not comparable with those here.

**What was not measured.** With the models that ship: all methods on seven of the paper's nine
families; answers with errors, but for `Bayes()` where a table says so; ablations and tolerances;
kinds of questions, but on HalfCheetahVel and AntDir2D.
`sb3-poem benchmark run --suite table3 --seeds 3 --snapshots 1 --list` says what each would take.
"""
    return "\n".join([head, *(family_section(family) for family in FAMILIES)])


def trainings() -> str:
    """What the models that ship cost."""
    known = {family: effort(family) for family in FAMILIES}
    rows = [
        [
            family,
            f"{found['training_samples']:,}",
            f"{found['updates']:,}",
            f"{found['training_cpu_seconds'] / 60:.1f}",
        ]
        for family, found in known.items()
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


PAPER = TOP / "docs/algorithms/paper.md"
README, PERFORMANCE = TOP / "README.md", TOP / "docs/performance.md"
PRETRAINED = TOP / "pretrained/README.md"
WRITTEN = {
    PRETRAINED: lambda: with_table(PRETRAINED, "models", models()),
    README: lambda: with_table(README, "results", summary()),
    PERFORMANCE: lambda: with_table(PERFORMANCE, "trainings", trainings()),
    PAPER: lambda: with_table(PAPER, "paper-rule", paper_rule()),
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
