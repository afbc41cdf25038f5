"""Where a record comes from: commit, versions, machine."""

import os
import platform
import re
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

from poem_envs.vector import available_cores
from sb3_poem import __version__

CODE = ("sb3_poem", "envs", "zoo_configs", "benchmarks/*.py")
VERSIONED = ("stable_baselines3", "rl_zoo3", "torch", "gymnasium", "mujoco", "numpy")
COMMIT_VARIABLE = "SB3_POEM_COMMIT"
INSTRUCTION_SETS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16")


def provenance() -> dict[str, Any]:
    """Commit, versions and machine, JSON-ready."""
    return {"commit": commit(), "versions": versions(), "machine": machine()}


def commit() -> str | None:
    """The checkout's commit, with a plus sign if the code was changed since; None elsewhere. A copy
    of the tree without its repository may name it by the environment variable ``SB3_POEM_COMMIT``.
    """
    if COMMIT_VARIABLE in os.environ:
        return os.environ[COMMIT_VARIABLE]
    folder = Path(__file__).resolve().parents[2]
    # an installed package may lie inside another project's checkout
    head = _git(folder, "rev-parse", "--short", "HEAD") if (folder / ".git").exists() else None
    if head is None:
        return None
    changed = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", *CODE)
    return head + ("+" if changed else "")


def versions() -> dict[str, str]:
    """Of Python and of the packages that matter for a result."""
    own = {"python": platform.python_version(), "sb3_poem": __version__}
    return own | {name: version(name) for name in VERSIONED}


def machine() -> str:
    """What the processor can do: usable cores, architecture, vector instructions; and the GPU."""
    import torch as th

    cpuinfo = Path("/proc/cpuinfo")
    flags = re.search(r"^flags.*$", cpuinfo.read_text() if cpuinfo.exists() else "", re.MULTILINE)
    known = set(flags[0].split()) if flags else set()
    words = [f"{available_cores()} of {os.cpu_count()} cores", platform.machine()]
    words += [name for name in INSTRUCTION_SETS if name in known]
    return ", ".join(words + ([th.cuda.get_device_name()] if th.cuda.is_available() else []))


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        return subprocess.check_output(
            ["git", *arguments], cwd=folder, stderr=subprocess.DEVNULL, text=True
        ).strip()
    except (OSError, subprocess.CalledProcessError):
        return None
