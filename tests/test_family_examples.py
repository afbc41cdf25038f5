"""The examples of docs/families.md run as they are printed, and their families keep the contract."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "families.md"
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)


@pytest.mark.parametrize(("number", "family"), [(0, "class Walk1D(TaskFamily)"), (1, "class Reach1DFamily(GoalFamily)")])
def test_the_example_runs(number, family, tmp_path):
    assert family in EXAMPLES[number]
    assert "check_task_family(" in EXAMPLES[number]
    script = tmp_path / "example.py"
    script.write_text(EXAMPLES[number])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    result = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_every_example_is_run():
    assert len(EXAMPLES) == 2
