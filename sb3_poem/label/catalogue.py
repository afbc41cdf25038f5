"""Which trained models a person may choose from. The browser names one of them; it never names a
file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sb3_poem.common.foreign import environment_of
from sb3_poem.label.families import Description, describe
from sb3_poem.pearl_sac.saving import CONFIG, read_config
from sb3_poem.resources import find_folder, shipped_folder


@dataclass(frozen=True)
class Choice:
    """A trained model.

    :param name: What it is called; unique in a catalogue.
    :param folder: Where it is.
    :param algorithm: The class's name.
    :param env_id: The environment in which it is shown.
    :param env_kwargs: Arguments of the environment.
    """

    name: str
    folder: Path
    algorithm: str
    env_id: str
    env_kwargs: tuple[tuple[str, Any], ...] = ()

    @property
    def description(self) -> Description:
        """The family in words."""
        return describe(self.env_id)


def read_catalogue(
    model: str | None = None, env_id: str | None = None, env_kwargs: dict[str, Any] | None = None
) -> list[Choice]:
    """The models of a folder.

    :param model: A pretrained model's folder, a folder of such folders, or the name of a shipped
        model; None takes all that are shipped.
    :param env_id: The environment in which they are shown; None takes each model's own.
    :param env_kwargs: Arguments of the environment, over those that each model was trained with.
    :return: The models, by name.
    :raises FileNotFoundError: If there is none.
    :raises ValueError: If a model is broken, or does not say its environment.
    """
    folder = shipped_folder("pretrained") if model is None else find_folder(model)
    folders = (
        [folder]
        if (folder / CONFIG).is_file()
        else sorted(file.parent for file in folder.glob(f"*/{CONFIG}"))
    )
    if not folders:
        raise FileNotFoundError(
            f"--model {model}: {folder} holds no pretrained model (a folder with {CONFIG})"
        )
    choices = []
    for one in folders:
        config = read_config(one)
        own = config["env_id"], config["env_kwargs"]
        chosen, arguments = environment_of(str(one), *own, env_id, env_kwargs)
        choices.append(
            Choice(
                one.resolve().name,
                one.resolve(),
                config["algorithm"],
                chosen,
                tuple(sorted(arguments.items())),
            )
        )
    return choices
