"""What the distribution holds, and that it works where the checkout is not."""

import configparser
import json
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE_ROOTS = {"poem_envs": ROOT / "envs", "sb3_poem": ROOT}


@pytest.fixture(scope="module")
def setup_cfg() -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read(ROOT / "setup.cfg")
    return parser


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of the tracked and untracked files of this tree, built where nothing earlier was
    built.
    """
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        check=True,
        capture_output=True,
    ).stdout.decode()
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    command = [
        sys.executable,
        "-m",
        "build",
        "--wheel",
        "--outdir",
        str(folder / "dist"),
        str(source),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if (
        "ConnectionError" in done.stdout
        or "No matching distribution found for setuptools" in done.stdout
    ):
        pytest.skip("the build backend cannot be fetched here")
    assert done.returncode == 0, done.stdout + done.stderr
    return next((folder / "dist").glob("*.whl"))


def test_every_package_of_the_tree_is_declared(setup_cfg: configparser.ConfigParser) -> None:
    declared = set(setup_cfg["options"]["packages"].split()) - {
        "sb3_poem.pretrained",
        "sb3_poem.zoo_configs",
    }
    present = {
        ".".join(init.parent.relative_to(root).parts)
        for package, root in PACKAGE_ROOTS.items()
        for init in (root / package).rglob("__init__.py")
    }
    assert declared == present


def test_every_path_in_the_makefile_exists() -> None:
    named = re.findall(
        r"\b(?:tests|benchmarks|envs|docs)/[\w*./]*\w", (ROOT / "Makefile").read_text()
    )
    assert len(named) > 5
    missing = [
        path for path in named if not path.startswith("docs/_build") and not any(ROOT.glob(path))
    ]
    assert not missing


def test_every_pattern_of_package_data_has_a_file(setup_cfg: configparser.ConfigParser) -> None:
    places = dict(line.split(" = ") for line in setup_cfg["options"]["package_dir"].split("\n")[2:])
    for package, patterns in setup_cfg["options.package_data"].items():
        folder = ROOT / places.get(package, package.replace(".", "/"))
        for pattern in patterns.split():
            assert any(folder.glob(pattern)), f"{package}: {pattern}"


def test_every_tested_version_is_within_the_declared_ranges(
    setup_cfg: configparser.ConfigParser,
) -> None:
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    tested = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            name, version = line.split("==")
            tested[canonicalize_name(name)] = version
    extras = setup_cfg["options.extras_require"]
    declared = setup_cfg["options"]["install_requires"] + extras["dev"] + extras["label"]
    declared += extras["metaworld"]
    requirements = [
        Requirement(line)
        for line in declared.splitlines()
        if line.strip() and not line.startswith("#")
    ]
    assert len(requirements) > 20
    for requirement in requirements:
        assert requirement.specifier.contains(tested[canonicalize_name(requirement.name)]), (
            requirement
        )


def test_the_tested_mujoco_is_the_one_that_meta_world_takes(
    setup_cfg: configparser.ConfigParser,
) -> None:
    pin = next(line for line in metadata.requires("metaworld") or [] if "mujoco" in line)
    assert pin.replace(" ", "") in (ROOT / "constraints.txt").read_text().split()
    assert "metaworld" not in setup_cfg["options"]["install_requires"]
    assert "-e '.[dev,label,metaworld]'" in (ROOT / "Makefile").read_text()


def test_the_supported_pythons_are_the_same_everywhere(
    setup_cfg: configparser.ConfigParser,
) -> None:
    prefix = "Programming Language :: Python :: 3."
    minors = [
        line.removeprefix(prefix)
        for line in setup_cfg["metadata"]["classifiers"].splitlines()
        if prefix in line
    ]
    first, last = f"3.{minors[0]}", f"3.{minors[-1]}"
    assert (first, last) == ("3.11", "3.13")
    assert setup_cfg["options"]["python_requires"] == f">={first}"
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    assert settings["ruff"]["target-version"] == f"py{first.replace('.', '')}"
    assert settings["mypy"]["python_version"] == first
    assert f"sys.version_info < ({first.replace('.', ', ')})" in (ROOT / "Makefile").read_text()
    assert f"Python {first} to {last}" in (ROOT / "README.md").read_text()


def test_changelog_and_citation_name_this_version() -> None:
    version = (ROOT / "sb3_poem/version.txt").read_text().strip()
    newest = re.search(r"^## (\S+) - (\d{4}-\d\d-\d\d)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert newest is not None
    assert newest[1] == version
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"version: {version}\ndate-released: {newest[2]}\n" in citation


def test_wheel_holds_all_that_is_needed_and_nothing_else(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {
        str(file.relative_to(root))
        for package, root in PACKAGE_ROOTS.items()
        for file in (root / package).rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }
    expected |= {
        f"sb3_poem/zoo_configs/{file.name}" for file in (ROOT / "zoo_configs").glob("*.yml")
    }
    expected |= {
        f"sb3_poem/{file.relative_to(ROOT)}"
        for pattern in ("*.safetensors", "*.json", "*.md")
        for file in (ROOT / "pretrained").rglob(pattern)
    }
    assert {name for name in names if ".dist-info/" not in name} == expected
    assert {Path(name).name for name in names if ".dist-info/" in name} >= {
        "METADATA",
        "LICENSE",
        "entry_points.txt",
    }


PROBE = """
import json, sys
import gymnasium as gym, poem_envs, sb3_poem
from sb3_poem import resources
from sb3_poem.cli import main
env = gym.make("poem/PointGoal-v0")
print(json.dumps({
    "files": [poem_envs.__file__, sb3_poem.__file__, str(resources.config_file("poem_sac"))],
    "ids": sorted(i for i in gym.registry if i.startswith("poem/")),
    "models": [str(resources.pretrained_folder(name)) for name in resources.pretrained_names()],
    "observation": env.reset(seed=0)[0].tolist(),
}))
"""


def test_wheel_works_installed_elsewhere(wheel: Path, tmp_path: Path) -> None:
    """In a fresh environment which finds the dependencies of this one behind its own packages, away
    from the checkout.
    """
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")]
    subprocess.run(command, check=True)
    python = tmp_path / "venv/bin/python"
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    install += ["--no-deps", "--no-index", str(wheel)]
    subprocess.run(install, check=True, cwd=tmp_path, env=environment)
    # A plain path line: the .pth files in that folder, and so the editable install of the checkout,
    # are not read.
    site_packages = next((tmp_path / "venv/lib").glob("python*/site-packages"))
    (site_packages / "dependencies.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")

    def run(*command: str) -> str:
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    found = json.loads(run(str(python), "-c", PROBE).splitlines()[-1])
    assert all(name.startswith(str(site_packages)) for name in found["files"] + found["models"])
    assert "poem/HalfCheetahVel-v0" in found["ids"]
    assert {Path(name).name for name in found["models"]} == {
        file.parent.name for file in (ROOT / "pretrained").rglob("*.safetensors")
    }

    assert "adapt" in run(str(tmp_path / "venv/bin/sb3-poem"), "--help")
