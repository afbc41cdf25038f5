"""What README and guides show is what runs: their Python blocks and commands, on little."""

import doctest
import importlib
import re
import runpy
import shlex
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from sybil import Document
from sybil.evaluators.python import PythonEvaluator
from sybil.parsers.markdown import CodeBlockParser

from poem_envs.testing import check_task_family
from sb3_poem import PEARLSAC, POEMSAC, PreferenceAdapter, cli
from sb3_poem.cli import experiment

TOP = Path(__file__).parents[1]
PAGES = (
    "README.md",
    *(
        str(page.relative_to(TOP))
        for pattern in ("*.md", "[!_]*/*.md")
        for page in sorted((TOP / "docs").glob(pattern))
    ),
)
LEARN = PEARLSAC.learn

TINY = "--env-kwargs width:48 height:48"
#: Further words by subcommand, of which the last counts: as little as can be done
SMALL = {
    "train": "-n 1500 --verbose 0",
    "enjoy": "--no-render --queries 1",
    "record-video": f"--queries 1 {TINY}",
    "adapt": f"--tasks 1 --episodes 1 --queries 2 {TINY}",
    "benchmark": "--list",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def learn_quickly(model: PEARLSAC, *arguments: Any, **options: Any) -> PEARLSAC:
    """With two gradient steps an epoch."""
    model.gradient_steps = 2
    return LEARN(model, *arguments, **options)


def learn_little(model: PEARLSAC, *arguments: Any, **options: Any) -> PEARLSAC:
    """One epoch with two gradient steps."""
    return learn_quickly(model, 1, **options)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```python" in (TOP / page).read_text()]
)
def test_python_blocks_run(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(PEARLSAC, "learn", learn_little)
    env = gym.make("poem/HalfCheetahVel-v0", render_mode="rgb_array")
    env.reset(seed=0)
    registered = dict(gym.registry)
    document = Document.parse(str(TOP / page), CodeBlockParser("python", PythonEvaluator()))
    document.namespace.update(
        __name__="__main__",
        env=env,
        model=POEMSAC.from_pretrained("HalfCheetahVel"),
        your_answer=lambda left, right: "left",
    )
    example_policy = PreferenceAdapter("PointGoal", "poem/PointGoal-v0", seed=0).policy()
    example_policy.save(folder / "adapted_policy.safetensors")
    try:
        for example in document.examples():
            example.evaluate()
    finally:
        gym.registry.clear()
        gym.registry.update(registered)


EXAMPLES = [
    ".".join(file.relative_to(root).with_suffix("").parts)
    for root, package in ((TOP, "sb3_poem"), (TOP / "envs", "poem_envs"))
    for file in sorted((root / package).rglob("*.py"))
    if ">>> " in file.read_text()
]


@pytest.mark.parametrize("module", EXAMPLES)
def test_examples_in_docstrings_run(
    module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    failed, run = doctest.testmod(importlib.import_module(module))
    assert not failed, "an example fails: see the output"
    assert run


def test_every_public_class_has_an_example() -> None:
    ours = ("", ".adaptation", ".baselines", ".label", ".pearl_sac", ".poem_sac")
    modules = ("poem_envs", *(f"sb3_poem{package}" for package in ours))
    found = dict(each for module in modules for each in public_classes(module))
    assert len(found) > 40
    assert [name for name, public in found.items() if ">>> " not in (public.__doc__ or "")] == []


def public_classes(module: str) -> Iterator[tuple[str, type]]:
    """What a module exports; without ``__all__`` what it imports."""
    package = importlib.import_module(module)
    for name in getattr(package, "__all__", vars(package)):
        value = getattr(package, name)
        if isinstance(value, type) and not name.startswith("_"):
            yield f"{module}.{name}", value


def commands(page: str) -> Iterator[str]:
    """The lines of ``sb3-poem`` in a page, without their comments."""
    for block in re.findall(
        r"^```\w*\n(.*?)^```", (TOP / page).read_text(), flags=re.DOTALL | re.MULTILINE
    ):
        for line in block.splitlines():
            if line.startswith("sb3-poem "):
                yield line.split(" #")[0].strip()


@pytest.mark.parametrize("page", [page for page in PAGES if list(commands(page))])
def test_commands_are_understood(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    for command in commands(page):
        words = shlex.split(command)[1:]
        given, others = cli.build_parser().parse_known_args(words)
        assert not others or given.command == "train", command


def test_readme_s_commands_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(PEARLSAC, "learn", learn_quickly)
    few = partial(experiment.AdaptationEvalCallback, n_tasks=2)
    monkeypatch.setattr(experiment, "AdaptationEvalCallback", few)
    ran = []
    for command in commands("README.md"):
        words = shlex.split(re.sub("HalfCheetahVel|AntGoal", "PointGoal", command))[1:]
        if words[0] == "label":  # which serves a page
            continue
        ran.append(words[0])
        status = cli.main([*words, *SMALL[words[0]].split()])
        assert status == 0, (command, capsys.readouterr().err[-2000:])
    assert set(ran) == set(SMALL)


def test_every_kind_of_command_is_shown() -> None:
    shown = {command.split()[1] for page in PAGES for command in commands(page)}
    assert {"train", "enjoy", "adapt", "label", "benchmark", "record-video", "models"} <= shown


LINKED = (
    "README.md",
    "docs/*.md",
    "docs/[!_]*/*.md",
    "pretrained/*/README.md",
    "benchmarks/results/**/*.md",
)


def anchors(page: Path) -> set[str]:
    """What GitHub and MyST name a page's headings by."""
    text = page.read_text()
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {
        re.sub(r"[^\w -]", "", heading.strip().lower()).replace(" ", "-") for heading in headings
    }


def test_every_relative_link_leads_somewhere() -> None:
    pages = [page for pattern in LINKED for page in TOP.glob(pattern)]
    assert len(pages) > 60
    for page in pages:
        text, name = page.read_text(), page.relative_to(TOP)
        for target, anchor in re.findall(r"\]\(([^)#\s]*)#?([^)\s]*)[^)]*\)", text):
            if "://" in target or target.startswith("mailto:"):
                continue
            linked = page.parent / target if target else page
            assert linked.exists(), f"{name}: {target}"
            assert not anchor or anchor in anchors(linked), f"{name}: {target}#{anchor}"
        for target in re.findall(r"benchmarks/results/[\w*/.-]*[\w/]", text):
            assert list(TOP.glob(target)), f"{name}: {target}"


def test_results_are_small_and_listed() -> None:
    """Each folder has a manifest that names its files: with the command, and the commit that it ran
    at.
    """
    results = TOP / "benchmarks/results"
    files = [file for file in results.rglob("*") if file.is_file() and file.suffix != ".pdf"]
    assert 0 < sum(file.stat().st_size for file in files) < 4e6
    for file in files:
        manifest = (file.parent / "manifest.md").read_text()
        assert file.name == "manifest.md" or f"({file.name})" in manifest, file.relative_to(TOP)


COMMIT = re.compile(r"\b(?=[0-9a-f]*[a-f])(?=[0-9a-f]*[0-9])[0-9a-f]{7,40}\b")


def test_only_manifests_name_commits() -> None:
    pages = [TOP / "CHANGELOG.md", *(page for pattern in LINKED for page in TOP.glob(pattern))]
    found = [
        f"{page.relative_to(TOP)}: {commit}"
        for page in pages
        if page.name != "manifest.md"
        for commit in COMMIT.findall(page.read_text())
    ]
    assert not found


def test_figures_come_from_records() -> None:
    for page, content in runpy.run_path(str(TOP / "docs/tables.py"))["WRITTEN"].items():
        assert page.read_text() == content(), f"{page.name} is not what docs/tables.py writes"


def test_readme_is_two_screens() -> None:
    assert len((TOP / "README.md").read_text().splitlines()) <= 130


@pytest.mark.parametrize("page", [*PAGES, "CHANGELOG.md"])
def test_lines_fit_a_screen(page: str) -> None:
    assert max(map(len, (TOP / page).read_text().splitlines())) <= 120


def test_families_around_gymnasium_s_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOP / "docs" / "examples"))
    importlib.import_module("gymnasium_robots")
    for name in ("example/Walker2dVel-v0", "example/ReacherGoal-v0"):
        check_task_family(name)
