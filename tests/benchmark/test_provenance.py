"""Where a record says that it comes from."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from sb3_poem.benchmark import provenance


@pytest.mark.parametrize("folder", [".", ".venv/lib/site-packages"])
def test_only_the_checkouts_own_commit_is_named(
    folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not that of a project in which the package is installed."""
    who = ["-c", "user.name=n", "-c", "user.email=e"]
    for arguments in (["init"], [*who, "commit", "--allow-empty", "-m", "m"]):
        subprocess.run(["git", *arguments], cwd=tmp_path, check=True, capture_output=True)
    head = subprocess.check_output(["git", "rev-parse", "HEAD"], cwd=tmp_path, text=True).strip()
    file = tmp_path / folder / "sb3_poem/benchmark/provenance.py"
    file.parent.mkdir(parents=True)
    monkeypatch.setattr(provenance, "__file__", str(file))
    monkeypatch.delenv(provenance.COMMIT_VARIABLE, raising=False)
    found = provenance.commit()
    assert found is None if folder != "." else found and head.startswith(found)
