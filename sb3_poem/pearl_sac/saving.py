"""How models and training runs are written and read: SB3's zip, checkpoints, and pretrained
folders.

A checkpoint holds all of a training run, so that it continues bit for bit. A pretrained folder
holds safetensors, JSON and a model card: nothing in it can run code.
"""

import inspect
import io
import itertools
import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as tensors_to_bytes
from stable_baselines3.common.save_util import load_from_zip_file
from torch import nn

from sb3_poem.common.buffers import ContextStore, TaskReplayBuffer
from sb3_poem.common.checks import check_whole
from sb3_poem.common.files import write_atomically
from sb3_poem.common.foreign import check_env_id
from sb3_poem.pearl_sac.policies import LatentPolicy
from sb3_poem.pearl_sac.train_tasks import TrainTasks
from sb3_poem.pearl_sac.updater import EntropyCoefficient
from sb3_poem.resources import find_folder, pretrained_names

CHECKPOINT_FORMAT = "sb3_poem checkpoint 2"
FORMAT = "sb3_poem pretrained 2"
WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "README.md"
SPACES = ("observation_space", "action_space", "task_space")
ARRAYS = {
    "train_tasks": "tasks",
    "latent_means": "latent_means",
    "latent_variances": "latent_variances",
}
# rebuilt from the critics: half of their size for nothing otherwise
DERIVED = "critic_target."
#: Arguments that decide what the networks are; a trained model has them for good
FIXED = ("latent_dim", "similarity", "context")
#: Arguments that are kept as training left them
LEARNED = ("target_entropy", "ent_coef", "learning_rate")
#: Arguments that are of one run only, or that the policy tells
NOT_KEPT = {
    *("policy", "env", "learning_starts", "stats_window_size", "tensorboard_log", "policy_kwargs"),
    *("verbose", "device", "_init_setup_model", "unsupported"),
}
#: The most that a file may ask for, of whole numbers
LARGEST = {
    "n_envs": 10_000,
    "horizon": 100_000,
    "reward_feature_dim": 10_000,
    "buffer_size": 100_000_000,
}
LARGEST_OF_OTHERS = 1_000_000


class SavedModel(Protocol):
    """What is saved of a model."""

    policy: LatentPolicy
    train_tasks: TrainTasks
    observation_space: spaces.Box
    action_space: spaces.Box
    task_space: spaces.Box
    algorithm: str
    env_id: str | None
    env_kwargs: Mapping[str, Any]
    reward_feature_dim: int
    predicted_rewards_error: float
    context_reward_statistics: tuple[float, float] | None
    num_timesteps: int
    n_envs: int
    latent_dim: int
    learning_rate: Any
    ent_coef: Any
    target_entropy: Any
    policy_class: Any
    policy_kwargs: dict[str, Any]
    _n_updates: int

    @property
    def entropy_coefficient(self) -> EntropyCoefficient: ...

    def _complete_policy_kwargs(self) -> None: ...

    def _setup_model(self) -> None: ...


Model = TypeVar("Model", bound=SavedModel)


def kept_arguments(algorithm: type) -> list[str]:
    """Arguments of the constructor that a pretrained folder holds, beside :data:`LEARNED`."""
    parameters = inspect.signature(algorithm).parameters
    return [name for name in parameters if name not in NOT_KEPT and name not in LEARNED]


# ---------------------------------------------------------------------- SB3's zip


def read_archive(
    path: str | Path | io.BufferedIOBase, algorithm: type, changes: Mapping[str, Any]
) -> dict[str, Any]:
    """The attributes in a zip that ``save`` wrote.

    :param algorithm: Whose zip it must be
    :param changes: Arguments of the constructor that shall differ
    :raises ValueError: if it is a folder, the file is truncated or holds another algorithm's model,
        or a change is of what the networks are
    """
    if not isinstance(path, io.BufferedIOBase):
        _check_is_file(Path(path), algorithm)
    try:
        data, _, _ = load_from_zip_file(path, device="cpu", load_data=True)
    except (zipfile.BadZipFile, RuntimeError, EOFError, ValueError) as error:
        raise ValueError(
            f"{path} is truncated, or no model saved by {algorithm.__name__}: {error}"
        ) from error
    if data is None:
        raise ValueError(
            f"{path} is truncated, or no model saved by {algorithm.__name__}: it holds no data of a model"
        )
    if data.get("algorithm") != algorithm.__name__:
        raise ValueError(f"{path} holds a model of another algorithm, not of {algorithm.__name__}")
    if isinstance(path, io.BufferedIOBase):
        path.seek(0)
    found = {**data, "n_train_tasks": len(data["train_tasks"])}
    for name, value in changes.items():
        fixed = name in FIXED or (name == "n_train_tasks" and value is not None)
        if fixed and value != found.get(name):
            raise ValueError(
                f"{name} is {found.get(name)!r} in {path}, and cannot become {value!r}"
            )
    learns = str(data["ent_coef"]).startswith("auto")
    if "ent_coef" in changes and str(changes["ent_coef"]).startswith("auto") != learns:
        raise ValueError(
            f"ent_coef is {data['ent_coef']!r} in {path}, and cannot become {changes['ent_coef']!r}: a "
            "coefficient that is learned stays one, as does a fixed one"
        )
    return data


def algorithm_of(archive: Path) -> str:
    """Name of the class whose model a zip holds; empty where that cannot be told."""
    try:
        with zipfile.ZipFile(archive) as file:
            name = json.loads(file.read("data")).get("algorithm")
    except (zipfile.BadZipFile, KeyError, ValueError, AttributeError):
        return ""
    return str(name)


def _check_is_file(path: Path, algorithm: type) -> None:
    """:raises ValueError: if it is a checkpoint, a folder or a shipped model's name, for which there
    are other methods
    """
    if path.is_file():
        if is_checkpoint(path):
            raise ValueError(
                f"{path} is a checkpoint: use {algorithm.__name__}.load_checkpoint({str(path)!r})"
            )
        return
    if not path.is_dir() and path.with_name(f"{path.name}.zip").is_file():
        return
    is_shipped = not path.exists() and str(path) in pretrained_names()
    if path.is_dir() or is_shipped:
        what = "the name of a model that ships" if is_shipped else "a folder"
        raise ValueError(
            f"{path} is {what}: use {algorithm.__name__}.from_pretrained({str(path)!r})"
        )


# ---------------------------------------------------------------------- checkpoints


def write_checkpoint(
    path: str | Path,
    algorithm: str,
    archive: bytes,
    replay_buffer: TaskReplayBuffer,
    context: ContextStore | None,
) -> None:
    """Write a training run to one file, atomically.

    :param algorithm: Name of the model's class
    :param archive: What the model's ``save`` writes
    :raises OSError: if it cannot be written; a previous checkpoint stays whole
    """
    state: dict[str, Any] = {
        "format": CHECKPOINT_FORMAT,
        "algorithm": algorithm,
        "model": th.frombuffer(bytearray(archive), dtype=th.uint8),
        "replay_buffer": {
            name: th.as_tensor(value).cpu() for name, value in replay_buffer.state().items()
        },
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
    """Read what :func:`write_checkpoint` wrote.

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
    if not isinstance(state, dict) or state.get("format") != CHECKPOINT_FORMAT:
        raise ValueError(
            f"{path} is no checkpoint of this version of sb3_poem (expected {CHECKPOINT_FORMAT!r})"
        )
    if algorithm not in (None, state["algorithm"]):
        raise ValueError(
            f"{path} holds a {state['algorithm']}; load it with {state['algorithm']}.load_checkpoint"
        )
    return state


def is_checkpoint(path: str | Path) -> bool:
    """Whether a file is a checkpoint of a training run, rather than a model that ``save`` wrote."""
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    # a model's file that is cut short may end with one of its parts, which looks the same
    return (
        any(Path(entry.filename).name == "data.pkl" for entry in entries)
        and entries[0].header_offset == 0
    )


# ---------------------------------------------------------------------- pretrained folders


def save_pretrained(
    model: SavedModel, folder: str | Path, card: dict[str, Any] | None = None
) -> None:
    """Write a model so that :func:`from_pretrained` can read it.

    :param model: A trained model
    :param folder: Where; made if missing
    :param card: What the card should say: ``command``, ``seed``, ``commit``, ``machine``, ``note``,
        ``results``: any JSON
    :raises OSError: if the folder cannot be written
    :raises ValueError: if the policy's activation is none of torch.nn's or its optimiser none of
        torch.optim's, which JSON could not name
    """
    folder = Path(folder)
    config, tensors = model_contents(model, card)
    contents = {  # all made before the first is written
        WEIGHTS: tensors_to_bytes(tensors),
        CONFIG: (config_text(config) + "\n").encode(),
        CARD: _card_text(config).encode(),
    }
    for name, content in contents.items():
        write_atomically(folder / name, content)


def model_contents(
    model: SavedModel, card: dict[str, Any] | None = None
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """What a model is made of, from which :func:`build_model` makes it again.

    :param model: A trained model
    :param card: See :func:`save_pretrained`
    :return: Its configuration, which :func:`config_text` writes, and its tensors by name
    :raises ValueError: see :func:`save_pretrained`
    """
    activation, optimizer = model.policy.activation_fn, model.policy.optimizer_class
    for argument, value, module in (
        ("activation_fn", activation, nn),
        ("optimizer_class", optimizer, th.optim),
    ):
        if getattr(module, value.__name__, None) is not value:
            raise ValueError(
                f"{argument} must be one of {module.__name__} to be saved by its name, got {value}"
            )
    error = model.predicted_rewards_error
    tensors = {
        f"policy.{name}": value
        for name, value in model.policy.state_dict().items()
        if not name.startswith(DERIVED)
    }
    tensors |= {
        name: th.as_tensor(getattr(model.train_tasks, field)) for name, field in ARRAYS.items()
    }
    config: dict[str, Any] = {
        "format": FORMAT,
        "algorithm": model.algorithm,
        "env_id": model.env_id,
        "env_kwargs": dict(model.env_kwargs),
        "arguments": _arguments(model),
        "net_arch": model.policy.net_arch,
        "activation_fn": activation.__name__,
        "optimizer_class": optimizer.__name__,
        "optimizer_kwargs": model.policy.optimizer_kwargs,
        "layer_norm": model.policy.layer_norm,
        "n_critics": model.policy.n_critics,
        "reward_feature_dim": model.reward_feature_dim,
        "predicted_rewards_error": None if np.isnan(error) else error,  # NaN is no JSON
        "context_reward_statistics": model.context_reward_statistics,
        "num_timesteps": model.num_timesteps,
        "n_updates": model._n_updates,
        "n_envs": model.n_envs,
        "card": card or {},
    }
    for name in SPACES:
        space = getattr(model, name)
        tensors[f"{name}.low"], tensors[f"{name}.high"] = (
            th.as_tensor(space.low),
            th.as_tensor(space.high),
        )
        config[name] = {"dtype": str(space.dtype)}
    return config, {name: value.detach().cpu().contiguous() for name, value in tensors.items()}


def config_text(config: dict[str, Any]) -> str:
    """A configuration as JSON.

    :param config: What :func:`model_contents` gave
    """
    return json.dumps(config, indent=2, default=_to_json)


def _arguments(model: SavedModel) -> dict[str, Any]:
    """Arguments of the constructor with which training goes on as it stopped; a schedule's place
    takes its default.
    """
    arguments = {name: getattr(model, name) for name in kept_arguments(type(model))}
    arguments["target_entropy"] = model.target_entropy
    arguments["ent_coef"] = model.ent_coef
    coefficient = model.entropy_coefficient
    if coefficient.optimizer is not None:
        arguments["ent_coef"] = f"auto_{coefficient.value.item():.9g}"
    if isinstance(model.learning_rate, (int, float)):
        arguments["learning_rate"] = model.learning_rate
    return arguments


def _to_json(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{value!r} of type {type(value).__name__} cannot be written as JSON")


def _card_text(config: dict[str, Any]) -> str:
    card = config["card"]
    lines = [
        f"# {config['algorithm']} on `{config['env_id']}`",
        "",
        f"Trained with sb3_poem for {config['num_timesteps']:,} environment steps and {config['n_updates']:,} gradient steps.",
        "",
        "```python",
        f"model = sb3_poem.{config['algorithm']}.from_pretrained(<this folder>)",
        "```",
        "",
    ]
    for key in ("command", "seed", "commit", "machine"):
        if key in card:
            lines.append(f"- {key}: `{card[key]}`")
    if "note" in card:
        lines.append(f"- {card['note']}")
    if "results" in card:
        lines += [
            "",
            "Results:",
            "",
            "```json",
            json.dumps(card["results"], indent=2, default=_to_json),
            "```",
        ]
    return "\n".join(lines) + "\n"


def read_config(folder: str | Path) -> dict[str, Any]:
    """The ``config.json`` of a pretrained folder.

    :raises FileNotFoundError: if the folder or its configuration does not exist
    :raises ValueError: if it is truncated or of another program
    """
    path = Path(folder) / CONFIG
    if not path.is_file():
        raise FileNotFoundError(f"{folder} is no folder of a pretrained model: it has no {CONFIG}")
    return parse_config(path.read_bytes(), str(path))


def parse_config(text: str | bytes, source: str) -> dict[str, Any]:
    """The configuration of a model.

    :param text: What :func:`config_text` wrote
    :param source: Where it comes from, for the message
    :raises ValueError: if it is truncated, of another program or version, or its ``env_id`` would
        import a module
    """
    try:
        config = json.loads(text)
    except (ValueError, RecursionError) as error:  # of thousands of brackets
        raise ValueError(
            f"{source} is truncated, or no configuration of sb3_poem: {error}"
        ) from error
    found = config.get("format") if isinstance(config, dict) else None
    if found != FORMAT:
        raise ValueError(
            f"{source} is not of this version of sb3_poem: its format is {found!r}, expected {FORMAT!r}"
        )
    check_env_id(config.get("env_id"), source)
    for name in ("env_kwargs", "arguments", "card"):
        if not isinstance(config.get(name), dict):
            raise ValueError(
                f"{source}: {name} must be an object, but is a {type(config.get(name)).__name__}"
            )
    if not isinstance(config.get("algorithm"), str):
        raise ValueError(f"{source} names no algorithm")
    return config


def from_pretrained(algorithm: type[Model], folder: str | Path, device: th.device | str) -> Model:
    """Read a model that :func:`save_pretrained` wrote.

    :param algorithm: Class of the model
    :param folder: The folder, or the name of a model that ships
    :param device: "auto", "cpu", "cuda"
    :raises FileNotFoundError: if the folder does not hold a model
    :raises ValueError: if a file is truncated or foreign, or the model is of another algorithm
    """
    folder = find_folder(folder)
    config = read_config(folder)
    if config["algorithm"] != algorithm.__name__:
        raise ValueError(
            f"{folder} holds a {config['algorithm']}; load it with {config['algorithm']}.from_pretrained"
        )
    weights = folder / WEIGHTS
    try:
        tensors = load_tensors(weights.read_bytes())
    except SafetensorError as error:
        raise ValueError(f"{weights} is truncated, or no safetensors file: {error}") from error
    return build_model(algorithm, config, tensors, str(folder), device)


def build_model(
    algorithm: type[Model],
    config: dict[str, Any],
    tensors: dict[str, th.Tensor],
    source: str,
    device: th.device | str = "auto",
) -> Model:
    """Make a model from what :func:`model_contents` took it apart into.

    No memory is taken for networks before the configuration has been found to agree with the
    tensors.

    :param algorithm: Class of the model
    :param config: Its configuration
    :param source: Where they come from, for the message
    :param device: "auto", "cpu", "cuda"
    :raises ValueError: if something is missing, does not fit, or is out of all proportion
    """
    try:
        _check_numbers(algorithm, config, tensors)
        make: Any = algorithm  # without an environment
        model: Model = make(
            "MlpPolicy", None, device=device, _init_setup_model=False, **config["arguments"]
        )
        for name in SPACES:
            low, high = tensors[f"{name}.low"].numpy(), tensors[f"{name}.high"].numpy()
            setattr(model, name, spaces.Box(low, high, dtype=np.dtype(config[name]["dtype"]).type))
        model.train_tasks = TrainTasks(
            **{field: tensors[name].numpy() for name, field in ARRAYS.items()}
        )
        for name in ("env_id", "env_kwargs", "reward_feature_dim", "num_timesteps", "n_envs"):
            setattr(model, name, config[name])
        error = config["predicted_rewards_error"]
        model.predicted_rewards_error = float("nan") if error is None else error
        if config["context_reward_statistics"] is not None:
            model.context_reward_statistics = tuple(config["context_reward_statistics"])
        model._n_updates = config["n_updates"]
        if model.target_entropy == "auto":  # which SAC would look up in the environment
            model.target_entropy = -float(np.prod(model.action_space.shape))
        model.policy_kwargs |= {
            name: config[name] for name in ("net_arch", "layer_norm", "n_critics")
        }
        model.policy_kwargs["activation_fn"] = _named(nn, config["activation_fn"], nn.Module)
        model.policy_kwargs["optimizer_class"] = _named(
            th.optim, config["optimizer_class"], th.optim.Optimizer
        )
        model.policy_kwargs["optimizer_kwargs"] = config["optimizer_kwargs"]
        _check_shapes(model, tensors)
        model._setup_model()
        state = {
            name.removeprefix("policy."): value
            for name, value in tensors.items()
            if name.startswith("policy.")
        }
        state |= {
            f"{DERIVED}{name.removeprefix('critic.')}": v
            for name, v in state.items()
            if name.startswith("critic.")
        }
        model.policy.load_state_dict(state)
    except Exception as error:  # what foreign data may raise is no closed list
        raise ValueError(
            f"{source} does not hold a complete {algorithm.__name__}: {error}"
        ) from error
    return model


def _named(module: Any, name: str, base: type) -> Any:
    found = getattr(module, name, None)
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ValueError(f"{name!r} is no {base.__name__} of {module.__name__}")
    return found


def _check_numbers(algorithm: type, config: dict[str, Any], tensors: dict[str, th.Tensor]) -> None:
    """Refuse arguments that no model is saved with, and numbers of another size than a model's."""
    parameters = inspect.signature(algorithm).parameters
    for name, value in config["arguments"].items():
        if name not in (*kept_arguments(algorithm), *LEARNED):
            raise ValueError(f"`{name}` is no argument that a model is saved with")
        if type(parameters[name].default) is int or (name in LARGEST and value is not None):
            check_whole(name, value, -1, LARGEST.get(name, LARGEST_OF_OTHERS))
        elif isinstance(value, float) and not math.isfinite(value):
            raise ValueError(f"`{name}` must be finite, but is {value}")
    n_tasks = len(tensors["train_tasks"])
    if config["arguments"].get("n_train_tasks") not in (None, n_tasks):
        raise ValueError(
            f"`n_train_tasks` is {config['arguments']['n_train_tasks']}, but there are {n_tasks} train_tasks"
        )
    for name, least in (
        ("n_envs", 1),
        ("reward_feature_dim", 1),
        ("num_timesteps", 0),
        ("n_updates", 0),
        ("n_critics", 1),
    ):
        check_whole(name, config[name], least, LARGEST.get(name))
    arch = config["net_arch"]
    if (
        not isinstance(arch, dict)
        or not {"pi", "qf", "encoder", "decoder", "embedding"} <= arch.keys()
    ):
        raise ValueError(
            f"net_arch must have the widths of pi, qf, encoder, decoder and embedding, but is {str(arch)[:60]}"
        )
    for width in itertools.chain(*arch.values()):
        check_whole("net_arch", width, 1)
    n_layers = sum(map(len, arch.values())) + config["n_critics"] * (len(arch["qf"]) + 1)
    if n_layers > len(tensors):
        raise ValueError(
            f"net_arch and n_critics ask for {n_layers} layers, but there are {len(tensors)} tensors"
        )


def _check_shapes(model: SavedModel, tensors: dict[str, th.Tensor]) -> None:
    """Refuse tensors of other shapes than the configured networks', of which an outline is made."""
    model._complete_policy_kwargs()
    arguments = {
        **model.policy_kwargs,
        "optimizer_kwargs": {},
    }  # a fused one does not take outlines
    with th.device("meta"):
        outline = model.policy_class(
            model.observation_space, model.action_space, lambda _: 0.0, **arguments
        )
    latents = (len(tensors["train_tasks"]), model.latent_dim)
    expected = {
        "train_tasks": (latents[0], *model.task_space.shape),
        "latent_means": latents,
        "latent_variances": latents,
    }
    state = outline.state_dict().items()
    expected |= {
        f"policy.{name}": tuple(value.shape)
        for name, value in state
        if not name.startswith(DERIVED)
    }
    for name, shape in expected.items():
        found = tuple(tensors[name].shape) if name in tensors else "missing"
        if found != shape:
            raise ValueError(
                f"net_arch, latent_dim and the spaces make the tensor {name} {shape}, but it is {found}"
            )
