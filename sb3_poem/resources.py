"""Where the files that ship with the package are: hyperparameters and trained models."""

import difflib
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parent


def shipped_folder(name: str) -> Path:
    """The folder of shipped files of that name: inside the package when it was installed from a
    wheel, beside it in a checkout.

    :param name: ``"zoo_configs"`` or ``"pretrained"``
    :raises FileNotFoundError: if neither place has it, which means a broken installation
    """
    for root in (_PACKAGE, _PACKAGE.parent):
        if (root / name).is_dir():
            return root / name
    raise FileNotFoundError(
        f"sb3_poem was installed without its folder {name!r}; please install it again"
    )


def config_file(algorithm: str) -> Path:
    """The shipped hyperparameters of an algorithm.

    :param algorithm: its name on the command line, such as ``"poem_sac"``
    :raises FileNotFoundError: if there is none; the message lists those that there are
    """
    folder = shipped_folder("zoo_configs")
    path = folder / f"{algorithm}.yml"
    if not path.is_file():
        names = ", ".join(sorted(file.stem for file in folder.glob("*.yml"))) or "none"
        raise FileNotFoundError(
            f"No hyperparameters are shipped for {algorithm!r}; there are: {names}"
        )
    return path


def zoo_entry(file: Path, env_id: str, **changes: Any) -> dict[str, Any]:
    """An environment's entry of a file of hyperparameters.

    :param file: YAML in rl_zoo3's syntax; as there, Python in ``policy_kwargs`` is evaluated
    :param env_id: the environment's id
    :param changes: what shall differ
    :raises ValueError: if the file has no entry for it; the message lists those that there are
    """
    import yaml
    from torch import nn

    entries = yaml.safe_load(file.read_text())
    if env_id not in entries:
        raise ValueError(f"{file.name} has no entry {env_id!r}; there are: {', '.join(entries)}")
    entry = {**entries[env_id], **changes}
    if isinstance(entry.get("policy_kwargs"), str):
        entry["policy_kwargs"] = eval(entry["policy_kwargs"], {"nn": nn})
    return entry


def pretrained_names() -> list[str]:
    """The names of the trained models that are shipped."""
    return sorted(
        folder.name
        for folder in shipped_folder("pretrained").iterdir()
        if any(folder.glob("*.safetensors"))
    )


def pretrained_folder(name: str) -> Path:
    """The folder of a shipped model.

    :param name: as :func:`pretrained_names` lists it
    :raises FileNotFoundError: if there is none of that name; the message lists those that there are
    """
    names = pretrained_names()
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise FileNotFoundError(
            f"No model {name!r} is shipped; there are: {', '.join(names) or 'none'}.{hint}"
        )
    return shipped_folder("pretrained") / name


def find_folder(name: str | Path) -> Path:
    """The folder of a model.

    :param name: a folder's path, or the name of a shipped model
    :raises FileNotFoundError: if it is neither; the message lists the shipped models
    """
    path = Path(name)
    if path.is_dir():
        return path
    if path.exists():
        raise FileNotFoundError(
            f"{name} is a file, but must be the folder of a model; POEMSAC.load reads a model's file"
        )
    if path.suffix == ".zip" or len(path.parts) > 1:
        raise FileNotFoundError(f"{name}: there is no such file or folder of a model")
    return pretrained_folder(str(name))
