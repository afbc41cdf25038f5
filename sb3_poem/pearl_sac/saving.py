"""How models are written and read: SB3's zip; checkpoints, which are such zips with the experience;
and pretrained folders, in which nothing can run code.
"""

import contextlib
import inspect
import io
import json
import pickle
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from safetensors.torch import save as tensors_to_bytes
from stable_baselines3 import SAC
from stable_baselines3.common.save_util import json_to_data
from torch import nn

from sb3_poem.common.buffers import ContextStore
from sb3_poem.common.checks import check_whole
from sb3_poem.common.files import parse_json
from sb3_poem.common.foreign import check_env_id
from sb3_poem.common.networks import parse_tensors
from sb3_poem.common.precision import check_device
from sb3_poem.hub import FILES
from sb3_poem.pearl_sac.model_card import model_card
from sb3_poem.pearl_sac.policies import DEFAULT_NET_ARCH
from sb3_poem.pearl_sac.train_tasks import TrainTasks
from sb3_poem.resources import find_folder, pretrained_names

FORMAT = "sb3_poem pretrained 2"
WEIGHTS, CONFIG, CARD = FILES
#: The name of a training's checkpoint
CHECKPOINT = "checkpoint.zip"
#: What a configuration holds of a model, as it is, and of its policy
FACTS = ("env_id", "env_kwargs", "reward_feature_dim", "num_timesteps", "n_envs")
POLICY_FACTS = ("net_arch", "layer_norm", "n_critics", "optimizer_kwargs")
#: Classes that it names: where they are, and their base class
CLASSES = {"activation_fn": (nn, nn.Module), "optimizer_class": (th.optim, th.optim.Optimizer)}
SPACES = ("observation_space", "action_space", "task_space")
#: The fields of TrainTasks, by the names of their tensors
ARRAYS = {
    "train_tasks": "tasks",
    "latent_means": "latent_means",
    "latent_variances": "latent_variances",
}
# rebuilt from the critics: half of their size for nothing otherwise
DERIVED = "critic_target."
#: Arguments that decide what the networks are; a trained model has them for good
FIXED = ("latent_dim", "similarity", "similarity_temperature", "context")
#: Arguments that are kept as training left them
LEARNED = ("target_entropy", "ent_coef", "learning_rate")
#: Arguments that are of one run only, or that the policy tells
NOT_KEPT = {
    *("policy", "env", "learning_starts", "stats_window_size", "tensorboard_log", "policy_kwargs"),
    *("verbose", "device", "_init_setup_model", "unsupported"),
}
#: The most that a file may ask for, of whole numbers
LARGEST = {"n_envs": 10**4, "horizon": 10**5, "reward_feature_dim": 10**4, "buffer_size": 10**8}
LARGEST_OF_OTHERS = 10**6

Model = TypeVar("Model", bound=SAC)


def kept_arguments(algorithm: type) -> list[str]:
    """Arguments of the constructor that a pretrained folder holds, beside :data:`LEARNED`."""
    parameters = inspect.signature(algorithm).parameters
    return [name for name in parameters if name not in NOT_KEPT and name not in LEARNED]


# ---------------------------------------------------------------------- SB3's zip


#: What reading a damaged file raises
BROKEN = (
    *(zipfile.BadZipFile, EOFError, RuntimeError, pickle.UnpicklingError),
    *(UnicodeDecodeError, json.JSONDecodeError),
)


@contextlib.contextmanager
def reading(path: str | Path | io.BufferedIOBase, algorithm: type) -> Iterator[None]:
    """Say which file it is that cannot be read."""
    try:
        yield
    except Exception as error:
        # SB3 raises a ValueError from that of a zip
        broken = isinstance(error, BROKEN) or isinstance(error.__cause__, BROKEN)
        if not broken or isinstance(error, th.OutOfMemoryError):
            raise
        file = path.name if isinstance(path, io.BufferedReader) else path
        what = f"{file} is truncated, or no model saved by {algorithm.__name__}"
        raise ValueError(f"{what}: {error}") from error


def check_archive(
    path: str | Path | io.BufferedIOBase,
    algorithm: type,
    changes: Mapping[str, Any],
    custom_objects: dict[str, Any] | None = None,
) -> str | Path | io.BufferedIOBase:
    """Refuse a zip of which ``load`` cannot make the model with these changes of arguments, from
    all that it holds but tensors; where it is.
    """
    file = path
    if not isinstance(path, io.BufferedIOBase):
        file = Path(path) if Path(path).is_file() else Path(f"{path}.zip")
        _check_is_model(file, Path(path), algorithm.__name__)
    with reading(path, algorithm), zipfile.ZipFile(file) as archive:
        if "data" not in archive.namelist():
            raise zipfile.BadZipFile("it holds no data of a model")
        data = json_to_data(archive.read("data").decode(), custom_objects)
    if (found := data.get("algorithm")) != algorithm.__name__:
        what = f"{path} holds a {found or 'model of another algorithm'}"
        raise ValueError(f"{what}, not a {algorithm.__name__}")
    found = {**data, "n_train_tasks": len(data["train_tasks"])}
    for name, value in changes.items():
        fixed, why = name in FIXED or (name == "n_train_tasks" and value is not None), ""
        if name == "ent_coef":
            fixed = str(value).startswith("auto") != str(found[name]).startswith("auto")
            why = ": a coefficient that is learned stays one, as does a fixed one"
        if fixed and value != (kept := found.get(name)):
            raise ValueError(f"{name} is {kept!r} in {path}, and cannot become {value!r}{why}")
    return file


def facts_of(path: str | Path) -> dict[str, Any]:
    """What a zip says of its model in plain JSON; nothing where it is none of ours. A checkpoint of
    a training run, unlike a model that ``save`` wrote, ``keeps_experience``.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return dict(json.loads(archive.read("data")))
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError):
        return {}


def _check_is_model(file: Path, path: Path, algorithm: str) -> None:
    """Refuse what another method reads, and a file that is not there; ``path`` is as given."""
    what, method = "the name of a model that ships", "from_pretrained"
    if file.is_file():
        if not facts_of(file).get("keeps_experience"):
            return
        path, what, method = file, "a checkpoint", "load_checkpoint"
    elif path.is_dir():
        what = "a folder"
    elif str(path) not in pretrained_names():
        also = "" if path.suffix == ".zip" else f", nor {file}"
        raise FileNotFoundError(f"there is no file {path}{also}")
    raise ValueError(f"{path} is {what}: use {algorithm}.{method}({str(path)!r})")


# ---------------------------------------------------------------------- checkpoints


class Experience:
    """A model's replay buffer and contexts, as SB3 writes and reads what has a ``state_dict``."""

    def __init__(self, model: Any) -> None:
        self.model = model

    def state_dict(self) -> dict[str, dict[str, th.Tensor]]:
        context = self.model.epoch_context
        kept = {} if context is None else vars(context)
        tensors = {name: value for name, value in kept.items() if value is not None}
        return {"replay_buffer": self.model.replay_buffer.state(), "context": tensors}

    def load_state_dict(self, state: dict[str, dict[str, th.Tensor]], strict: bool = True) -> None:
        self.model.replay_buffer.load_state(state["replay_buffer"])
        if state["context"]:
            self.model.epoch_context = ContextStore(**state["context"])


# ---------------------------------------------------------------------- pretrained folders


def pretrained_files(
    model: Any, card: dict[str, Any] | None, name: str | None = None
) -> dict[str, bytes]:
    """What :func:`from_pretrained` reads, by the names of its files; the card says to load the
    model by ``name``, None is its family's.
    """
    config, tensors = model_contents(model, card)
    text = config_text(config)
    return {
        WEIGHTS: tensors_to_bytes(tensors),
        CONFIG: (text + "\n").encode(),
        CARD: model_card(json.loads(text), name).encode(),
    }


def model_contents(
    model: Any, card: dict[str, Any] | None = None
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """What :func:`build_model` makes a model of again: its configuration, which
    :func:`config_text` writes, and its tensors by name; raises as :meth:`PEARLSAC.save_pretrained`.
    """
    policy, error = model.policy, model.predicted_rewards_error
    for argument, (module, _) in CLASSES.items():
        value = getattr(policy, argument)
        if getattr(module, value.__name__, None) is not value:
            raise ValueError(f"{argument} must be in {module.__name__} to be saved, but is {value}")
    state, boxes = policy.state_dict(), {name: getattr(model, name) for name in SPACES}
    tensors = {f"policy.{name}": state[name] for name in state if not name.startswith(DERIVED)}
    for name, field in ARRAYS.items():
        tensors[name] = th.as_tensor(getattr(model.train_tasks, field))
    for name, box in boxes.items():
        tensors[f"{name}.low"], tensors[f"{name}.high"] = map(th.as_tensor, (box.low, box.high))
    # those with which training goes on; a schedule's place takes its default
    names = [*kept_arguments(type(model)), "target_entropy", "ent_coef"]
    arguments = {name: getattr(model, name) for name in names}
    coefficient = model.entropy_coefficient
    if coefficient.optimizer is not None:
        arguments["ent_coef"] = f"auto_{coefficient.value.item():.9g}"
    if not callable(model.learning_rate):
        arguments["learning_rate"] = model.learning_rate
    config: dict[str, Any] = {
        "format": FORMAT,
        "algorithm": model.algorithm,
        **{name: getattr(model, name) for name in FACTS},
        "n_updates": model._n_updates,
        "arguments": arguments,
        **{name: getattr(policy, name) for name in POLICY_FACTS},
        **{name: getattr(policy, name).__name__ for name in CLASSES},
        "predicted_rewards_error": None if np.isnan(error) else error,  # NaN is no JSON
        "context_reward_statistics": model.context_reward_statistics,
        "card": card or {},
        **{name: {"dtype": str(box.dtype)} for name, box in boxes.items()},
    }
    return config, {name: value.detach().cpu().contiguous() for name, value in tensors.items()}


def config_text(config: dict[str, Any]) -> str:
    """A configuration as JSON; refuses what cannot be written so."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"{value!r} of type {type(value).__name__} cannot be written as JSON")

    return json.dumps(config, indent=2, default=plain)


def read_config(folder: str | Path) -> dict[str, Any]:
    """The ``config.json`` of a pretrained folder; raises FileNotFoundError if there is none, and as
    :func:`parse_config`.
    """
    path = Path(folder) / CONFIG
    if not path.is_file():
        raise FileNotFoundError(f"{folder} is no folder of a pretrained model: it has no {CONFIG}")
    return parse_config(path.read_bytes(), str(path))


def parse_config(text: str | bytes, source: str) -> dict[str, Any]:
    """What :func:`config_text` wrote; ``source`` is where it comes from, for the message.

    :raises ValueError: If it is truncated, of another program or version, or its ``env_id`` would
        import a module
    """
    config = parse_json(text, f"{source} is truncated, or no configuration of sb3_poem")
    if (found := config.get("format")) != FORMAT:
        what = f"its format is {found!r}, expected {FORMAT!r}"
        raise ValueError(f"{source} is not of this version of sb3_poem: {what}")
    check_env_id(config.get("env_id"), source)
    for name in ("env_kwargs", "arguments", "card"):
        if not isinstance(config.get(name), dict):
            kind = type(config.get(name)).__name__
            raise ValueError(f"{source}: {name} must be an object, but is a {kind}")
    if not isinstance(config.get("algorithm"), str):
        raise ValueError(f"{source} names no algorithm")
    return config


def from_pretrained(algorithm: type[Model], folder: str | Path, device: th.device | str) -> Model:
    """See :meth:`PEARLSAC.from_pretrained`."""
    folder = find_folder(folder)
    config, weights = read_config(folder), folder / WEIGHTS
    found = config["algorithm"]
    if found != algorithm.__name__:
        raise ValueError(f"{folder} holds a {found}; load it with {found}.from_pretrained")
    tensors = parse_tensors(weights.read_bytes(), weights)
    return build_model(algorithm, config, tensors, str(folder), device)


def build_model(
    algorithm: type[Model],
    config: dict[str, Any],
    tensors: dict[str, th.Tensor],
    source: str,
    device: th.device | str = "auto",
) -> Model:
    """Make a model from what :func:`model_contents` took it apart into. No memory is taken for
    networks before the configuration has been found to agree with the tensors.

    :raises ValueError: If something is missing or does not fit; the message names ``source``
    """
    check_device(device)
    try:
        _check_numbers(algorithm, config, tensors)
        arguments = {**config["arguments"], "device": device, "_init_setup_model": False}
        make: Any = algorithm  # without an environment
        model = make("MlpPolicy", None, **arguments)
        for name in SPACES:
            low, high = tensors[f"{name}.low"].numpy(), tensors[f"{name}.high"].numpy()
            setattr(model, name, spaces.Box(low, high, dtype=np.dtype(config[name]["dtype"]).type))
        model.train_tasks = TrainTasks(*(tensors[name].numpy() for name in ARRAYS))
        for name in FACTS:
            setattr(model, name, config[name])
        model._n_updates = config["n_updates"]
        error, statistics = config["predicted_rewards_error"], config["context_reward_statistics"]
        model.predicted_rewards_error = float("nan") if error is None else error
        model.context_reward_statistics = None if statistics is None else tuple(statistics)
        model.policy_kwargs |= {name: config[name] for name in POLICY_FACTS}
        for name, (module, base) in CLASSES.items():
            kind = getattr(module, config[name], None)
            if not (isinstance(kind, type) and issubclass(kind, base)):
                raise ValueError(f"{config[name]!r} is no {base.__name__} of {module.__name__}")
            model.policy_kwargs[name] = kind
        _check_shapes(model, tensors)
        model._setup_model()
        state = {}
        for name, value in tensors.items():
            if name.startswith("policy."):
                state[name.removeprefix("policy.")] = value
            if name.startswith("policy.critic."):
                state[DERIVED + name.removeprefix("policy.critic.")] = value
        model.policy.load_state_dict(state)
    except Exception as error:  # what foreign data may raise is no closed list
        what = f"does not hold a complete {algorithm.__name__}: {error}"
        raise ValueError(f"{source} {what}") from error
    return model


def _check_numbers(algorithm: type, config: dict[str, Any], tensors: dict[str, th.Tensor]) -> None:
    """Refuse arguments that no model is saved with, and numbers of another size than a model's."""
    parameters, arguments = inspect.signature(algorithm).parameters, config["arguments"]
    for name, value in arguments.items():
        if name not in (*kept_arguments(algorithm), *LEARNED):
            raise ValueError(f"`{name}` is no argument that a model is saved with")
        if type(parameters[name].default) is int or (name in LARGEST and value is not None):
            check_whole(name, value, -1, LARGEST.get(name, LARGEST_OF_OTHERS))
    expected, n_tasks = arguments.get("n_train_tasks"), len(tensors["train_tasks"])
    if expected not in (None, n_tasks):
        raise ValueError(f"`n_train_tasks` is {expected}, but there are {n_tasks} train_tasks")
    least = {"n_envs": 1, "reward_feature_dim": 1, "n_critics": 1}
    for name in (*least, "num_timesteps", "n_updates"):
        check_whole(name, config[name], least.get(name, 0), LARGEST.get(name))
    arch = config["net_arch"]
    if not isinstance(arch, dict) or not DEFAULT_NET_ARCH.keys() <= arch.keys():
        names = ", ".join(DEFAULT_NET_ARCH)
        raise ValueError(f"net_arch must have the widths of {names}, but is {str(arch)[:60]}")
    n_layers = sum(map(len, arch.values())) + config["n_critics"] * (len(arch["qf"]) + 1)
    if n_layers > len(tensors):
        asked = f"net_arch and n_critics ask for {n_layers} layers"
        raise ValueError(f"{asked}, but there are {len(tensors)} tensors")


def _check_shapes(model: Any, tensors: dict[str, th.Tensor]) -> None:
    """Refuse tensors of other shapes than the configured networks', of which an outline is made."""
    model._complete_policy_kwargs()
    # a fused optimiser does not take outlines
    arguments = {**model.policy_kwargs, "optimizer_class": th.optim.SGD, "optimizer_kwargs": {}}
    policy_class, action_space = model.policy_class, model.action_space
    with th.device("meta"):
        outline = policy_class(model.observation_space, action_space, lambda _: 0.0, **arguments)
    latents = (len(tensors["train_tasks"]), model.latent_dim)
    expected = {"train_tasks": (latents[0], *model.task_space.shape)}
    expected |= {"latent_means": latents, "latent_variances": latents}
    for name, value in outline.state_dict().items():
        if not name.startswith(DERIVED):
            expected[f"policy.{name}"] = tuple(value.shape)
    for name, shape in expected.items():
        found = tuple(tensors[name].shape) if name in tensors else "missing"
        if found != shape:
            raise ValueError(
                "net_arch, latent_dim and the spaces make the tensor "
                f"{name} {shape}, but it is {found}"
            )
