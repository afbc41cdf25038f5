"""Where the files that ship with the package are: hyperparameters and trained models."""

from pathlib import Path
from typing import Any

from poem_envs.registration import did_you_mean, family_name
from sb3_poem.hub import download, is_repository

_PACKAGE = Path(__file__).resolve().parent


def shipped_folder(name: str) -> Path:
    """The folder of shipped files of that name, ``"zoo_configs"`` or ``"pretrained"``: inside the
    package when it was installed from a wheel, beside it in a checkout.
    """
    inside = _PACKAGE / name
    return inside if inside.is_dir() else _PACKAGE.parent / name


def config_file(algorithm: str) -> Path:
    """The shipped hyperparameters of an algorithm.

    :param algorithm: Its name on the command line, such as ``"poem_sac"``
    :raises FileNotFoundError: If there is none; the message lists those that there are
    """
    files = {file.stem: file for file in sorted(shipped_folder("zoo_configs").glob("*.yml"))}
    if algorithm not in files:
        names = ", ".join(files)
        raise FileNotFoundError(f"No hyperparameters ship for {algorithm!r}; there are: {names}")
    return files[algorithm]


def zoo_entry(file: Path, env_id: str, **changes: Any) -> dict[str, Any]:
    """An environment's entry of a file of hyperparameters, or its ``default`` entry.

    :param file: YAML in rl_zoo3's syntax; as there, Python in ``policy_kwargs`` is evaluated
    :param changes: What shall differ
    :raises ValueError: If the file has neither; the message lists those that there are
    """
    import yaml
    from torch import nn

    entries = yaml.safe_load(file.read_text())
    if env_id not in entries and "default" not in entries:
        raise ValueError(f"{file.name} has no entry {env_id!r}; there are: {', '.join(entries)}")
    entry = {**entries.get(env_id, entries.get("default")), **changes}
    if isinstance(entry.get("policy_kwargs"), str):
        entry["policy_kwargs"] = eval(entry["policy_kwargs"], {"nn": nn})
    return entry


def pretrained_names() -> list[str]:
    """The names of the trained models that are shipped."""
    weights = shipped_folder("pretrained").glob("*/*.safetensors")
    return sorted({file.parent.name for file in weights})


def pretrained_folder(name: str) -> Path:
    """The folder of a shipped model.

    :raises FileNotFoundError: If there is none of that name; the message lists those that there are
    """
    names = pretrained_names()
    if name not in names:
        known = f"those shipped are: {', '.join(names)}{did_you_mean(name, names)}"
        raise FileNotFoundError(f"There is no model {name!r} here, and none is shipped; {known}")
    return shipped_folder("pretrained") / name


def find_folder(name: str | Path) -> Path:
    """The folder of a model, fetched if it is on the Hub; see :meth:`PEARLSAC.from_pretrained`."""
    path = Path(name)
    if path.is_dir():
        return path
    if path.exists():
        written = "as POEMSAC.load(file).save_pretrained(folder) writes it"
        raise FileNotFoundError(f"{name} is a file, but must be the folder of a model, {written}")
    family = family_name(str(name))
    if name == f"poem/{family}-v0" and family in pretrained_names():
        raise FileNotFoundError(f"{name} is an environment; the model that ships is {family!r}")
    if is_repository(name):
        return download(str(name))
    if path.suffix == ".zip" or len(path.parts) > 1:
        raise FileNotFoundError(f"{name}: there is no such file or folder of a model")
    return pretrained_folder(str(name))
