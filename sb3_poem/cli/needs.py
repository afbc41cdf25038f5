"""What commands share: a word to the user, and checks before a command spends its time."""

import ast
import importlib
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

#: Print a line at once, also into a file
say = partial(print, flush=True)


def check_writable(folder: str | Path) -> None:
    """Make a folder and a file in it: a run should not find out at its end that it cannot save."""
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        why = error.strerror or error
        raise OSError(f"cannot write to the folder {str(folder)!r}: {why}") from error


def check_output(flag: str, path: Path | None, suffixes: Sequence[str]) -> None:
    """Refuse a file that a flag named, if it did, for its suffix or for where it lies."""
    if path is None:
        return
    if path.suffix not in suffixes:
        raise ValueError(f"{flag} {path}: the name must end in {' or '.join(suffixes)}")
    check_writable(path.parent)


def parse_pairs(flag: str, pairs: Sequence[str]) -> dict[str, Any]:
    """Read a flag's ``KEY:VALUE`` arguments; a value is a Python literal, or else a string."""
    values: dict[str, Any] = {}
    for pair in pairs:
        key, colon, text = pair.partition(":")
        if not colon or not key.isidentifier():
            raise ValueError(f"{flag} {pair}: must have the form KEY:VALUE")
        try:
            values[key] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            values[key] = text
    return values


def check_device(name: str) -> None:
    """Refuse a ``--device`` that PyTorch does not know."""
    from sb3_poem.common import precision

    precision.check_device(name, "--device")


def import_packages(names: Sequence[str]) -> None:
    """Import the modules of ``--gym-packages``, which may lie in the working folder."""
    folder = os.getcwd()
    if names and folder not in sys.path:
        # last, so that no file there takes the place of an installed package
        sys.path.append(folder)
    for name in names:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if not f"{name}.".startswith(f"{error.name}."):
                raise  # the module is there, and imports what is not
            raise ValueError(
                f"--gym-packages {name}: there is no such module, neither installed nor in "
                f"{folder}; name a module as in Python's import, without .py"
            ) from error
