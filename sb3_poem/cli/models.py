"""Load a model that was named on the command line."""

import json
import zipfile
from pathlib import Path

from sb3_poem.common.pretrained import read_config
from sb3_poem.pearl_sac import PEARLSAC
from sb3_poem.poem_sac import POEMSAC
from sb3_poem.resources import pretrained_folder

ALGORITHMS: dict[str, type[PEARLSAC]] = {"poem_sac": POEMSAC, "pearl_sac": PEARLSAC}
_BY_CLASS_NAME = {algorithm.__name__: algorithm for algorithm in ALGORITHMS.values()}


def load_model(name: str, device: str = "cpu") -> PEARLSAC:
    """
    Load a model of either algorithm.

    :param name: a file that ``save`` wrote (``.zip`` may be left out), a folder that ``save_pretrained`` wrote, or the
        name of a shipped model
    :param device: as PyTorch names it
    :raises FileNotFoundError: if it is none of these; the message lists the shipped models
    :raises ValueError: if a file is truncated, or of another program
    """
    path = Path(name)
    archive = path if path.is_file() else path.with_name(f"{path.name}.zip")
    if archive.is_file():
        return _algorithm_of(archive).load(archive, device=device)
    if not path.is_dir():
        if path.suffix == ".zip" or len(path.parts) > 1:
            raise FileNotFoundError(f"--model {name}: there is no such file or folder")
        path = pretrained_folder(name)
    algorithm = read_config(path)["algorithm"]
    if algorithm not in _BY_CLASS_NAME:
        raise ValueError(f"{path} holds a {algorithm}, known are {', '.join(_BY_CLASS_NAME)}")
    return _BY_CLASS_NAME[algorithm].from_pretrained(path, device=device)


def _algorithm_of(archive: Path) -> type[PEARLSAC]:
    """Whose model a file holds; where that cannot be told, ``POEMSAC.load`` says what is wrong with the file."""
    try:
        with zipfile.ZipFile(archive) as file:
            data = json.loads(file.read("data"))
    except (zipfile.BadZipFile, KeyError, ValueError):
        return POEMSAC
    return POEMSAC if "preference_coef" in data else PEARLSAC
