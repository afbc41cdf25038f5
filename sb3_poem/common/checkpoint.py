"""Checkpoints that hold all of a training run, so that it continues bit for bit."""

import io
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import torch as th

from sb3_poem.common.buffers import ContextStore
from sb3_poem.common.files import write_atomically

if TYPE_CHECKING:
    from sb3_poem.pearl_sac.pearl_sac import PEARLSAC

FORMAT = "sb3_poem checkpoint 1"


def save_checkpoint(model: "PEARLSAC", path: str | Path) -> None:
    """Write networks, optimisers, buffers, context, tasks, generators and counters to one file, atomically.

    :param model: The model, between two epochs
    :param path: The file
    :raises OSError: if it cannot be written; a previous checkpoint stays whole
    """
    archive = io.BytesIO()
    model.save(archive)
    context = model.context
    state: dict[str, Any] = {
        "format": FORMAT,
        "algorithm": type(model).__name__,
        "model": th.frombuffer(bytearray(archive.getvalue()), dtype=th.uint8),
        "replay_buffer": {name: th.as_tensor(value).cpu() for name, value in model.replay_buffer.state().items()},
        "context": None if context is None else _tensors(context),
    }

    def write(file: BinaryIO) -> None:
        try:
            th.save(state, file)
        except RuntimeError as error:
            # torch raises its own over what stopped its writing
            if isinstance(error.__context__, (OSError, KeyboardInterrupt)):
                raise error.__context__ from None
            raise

    write_atomically(path, write)


def _tensors(context: ContextStore) -> dict[str, th.Tensor]:
    return {name: value.cpu() for name, value in vars(context).items() if value is not None}


def read_checkpoint(path: str | Path, algorithm: str | None = None) -> dict[str, Any]:
    """Read what :func:`save_checkpoint` wrote.

    :param algorithm: Name of the class whose run it must hold; None takes any
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is truncated, of another program, or of another algorithm
    """
    try:
        state = th.load(path, map_location="cpu", weights_only=True)
    except OSError:
        raise
    except Exception as error:  # what unpickling foreign bytes may raise is no closed list
        raise ValueError(f"{path} is truncated, or no checkpoint of sb3_poem: {error}") from error
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise ValueError(f"{path} is no checkpoint of this version of sb3_poem (expected {FORMAT!r})")
    if algorithm not in (None, state["algorithm"]):
        raise ValueError(f"{path} holds a {state['algorithm']}; load it with {state['algorithm']}.load_checkpoint")
    return state


def restore_stores(model: "PEARLSAC", state: dict[str, Any]) -> None:
    """Put a checkpoint's replay buffer and context into a model that was loaded from its archive."""
    model.replay_buffer.load_state(state["replay_buffer"])
    if state["context"] is not None:
        model.context = ContextStore(**{name: value.to(model.device) for name, value in state["context"].items()})


def is_checkpoint(path: str | Path) -> bool:
    """Whether a file is a checkpoint of a training run, rather than a model that ``save`` wrote."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    # a model's file that is cut short may end with one of its parts, which looks the same
    return any(Path(entry.filename).name == "data.pkl" for entry in entries) and entries[0].header_offset == 0
