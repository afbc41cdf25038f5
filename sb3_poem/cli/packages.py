"""``--gym-packages``: modules that register environments."""

import importlib
import os
import sys
from collections.abc import Sequence


def import_packages(names: Sequence[str]) -> None:
    """Import modules, which may lie in the working folder."""
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
