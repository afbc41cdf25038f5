"""A model from its name: a file, a folder, or one that ships with the package."""

from pathlib import Path
from typing import Any

import torch as th

from sb3_poem.pearl_sac import PEARLSAC
from sb3_poem.pearl_sac.saving import facts_of, read_config
from sb3_poem.poem_sac import POEMSAC
from sb3_poem.resources import find_folder, pretrained_names

ALGORITHMS: dict[str, type[PEARLSAC]] = {"poem_sac": POEMSAC, "pearl_sac": PEARLSAC}
BY_CLASS_NAME = {algorithm.__name__: algorithm for algorithm in ALGORITHMS.values()}


def as_model(model: Any) -> Any:
    """A model as it is, or the one that a name stands for.

    :param model: A model with latents, of whichever class, or what :func:`load_model` takes
    :raises TypeError: If it is neither
    """
    if isinstance(model, (str, Path)):
        return load_model(model)
    if hasattr(model, "latent_dim") and not isinstance(model, type):
        return model
    is_class = isinstance(model, type)
    what = f"the class {model.__name__}" if is_class else f"of type {type(model).__name__}"
    raise TypeError(
        f"`model` is {what}, but must be a trained POEMSAC or PEARLSAC, a file or folder of one, "
        f"or the name of a model that ships: {', '.join(pretrained_names())}"
    )


def load_model(name: str | Path, device: th.device | str = "auto") -> PEARLSAC:
    """Load a model of either algorithm.

    >>> load_model("PointGoal").env_id
    'poem/PointGoal-v0'

    :param name: A file that ``save`` wrote (``.zip`` may be left out), a checkpoint, a folder that
        ``save_pretrained`` wrote, the name of a shipped model, or ``"user/name"`` on the Hugging
        Face Hub
    :param device: As PyTorch names it
    :raises FileNotFoundError: If it is none of these; the message lists the shipped models
    :raises ValueError: If a file is truncated, or of another program
    """
    path = Path(name)
    archive = path if path.is_file() else Path(f"{path}.zip")
    if archive.suffix == ".safetensors":
        instead = "AdaptedPolicy.load reads a policy, and of a model name the folder"
        raise ValueError(f"{name} holds no whole model: {instead}")
    if archive.is_file():
        # where that cannot be told, POEMSAC.load says what is wrong with the file
        facts = facts_of(archive)
        kind = BY_CLASS_NAME.get(str(facts.get("algorithm")), POEMSAC)
        read = kind.load_checkpoint if facts.get("keeps_experience") else kind.load
        return read(archive, device=device)
    path = find_folder(name)
    found = read_config(path)["algorithm"]
    if found not in BY_CLASS_NAME:
        raise ValueError(f"{path} holds a {found}, known are {', '.join(BY_CLASS_NAME)}")
    return BY_CLASS_NAME[found].from_pretrained(path, device=device)
