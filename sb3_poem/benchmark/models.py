"""Trained models: found among those that were handed over or left by earlier runs, or trained."""

import contextlib
import hashlib
import re
import shlex
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# A model that rl_zoo3 trained may hold its schedules. Importing it replaces Gymnasium's TimeLimit,
# so it comes first.
import rl_zoo3  # noqa: F401
from filelock import lock_descriptor
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.baselines import MAMLRewardModel, MetaReward, meta_train_reward
from sb3_poem.baselines.fragments import default_fragment_length
from sb3_poem.benchmark.methods import META_ITERATIONS, META_ITERATIONS_OF, VARIANTS
from sb3_poem.benchmark.provenance import provenance
from sb3_poem.benchmark.suites import FILE, REVISION, ModelKey, digest, family_id, family_label
from sb3_poem.benchmark.training import (
    LOG,
    SESSIONS,
    TrainingError,
    overrides,
    run_training,
    train_arguments,
    training_plan,
)
from sb3_poem.common.files import read_json, write_json_atomically
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.loading import ALGORITHMS, load_model
from sb3_poem.pearl_sac.saving import CHECKPOINT, CONFIG, WEIGHTS, read_config
from sb3_poem.resources import config_file, zoo_entry

MODEL, BEGUN, FINISHED, REWARD = "model.zip", "begun.json", "trained.json", "reward"
RECORD = "a record of a training"

Say = Callable[[str], None]


@contextlib.contextmanager
def locked(path: Path, on_wait: Callable[[], object] = lambda: None) -> Iterator[int]:
    """Hold a lock, at the latest until this process dies; ``on_wait`` is called if it is another's.
    The value is the file's descriptor: a child process that inherits it holds the lock as well.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        if not lock_descriptor(file.fileno(), blocking=False):
            on_wait()
            lock_descriptor(file.fileno())
        yield file.fileno()


@contextlib.contextmanager
def try_lock(path: Path) -> Iterator[bool]:
    """Hold a lock if nobody else does; the context's value is whether it is held here."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        yield lock_descriptor(file.fileno(), blocking=False)


@dataclass(frozen=True)
class Workplace:
    """Where models are kept, and how they are trained and run. Paths should be absolute where other
    processes take part.

    :param runs: Folder of the trainings
    :param models: Folders with models that were handed over, see :meth:`ModelLibrary.given`
    :param named: Models that were handed over one by one: family, variant, seed, path
    :param packages: Modules that register environments
    """

    runs: str
    models: tuple[str, ...] = ()
    named: tuple[tuple[str, str, int, str], ...] = ()
    device: str = "cpu"
    num_threads: int = 1
    packages: tuple[str, ...] = ()


class ModelLibrary:
    def __init__(self, workplace: Workplace) -> None:
        self.workplace = workplace
        self.runs = Path(workplace.runs)

    def folder(self, key: ModelKey) -> Path:
        variant = key.variant
        if not key.training.is_default:
            variant += "-" + digest(key.training.to_dict())[:8]
        if key.base is not None and self.given(key.base) is not None:
            variant += "-" + digest(self.origin(key.base))[:8]  # another is made of another one
        return self.runs / model_folder(key.env_id) / variant / f"seed{key.seed}"

    def given(self, key: ModelKey) -> Path | None:
        """The file or folder of a model that was handed over: one that was named;
        ``<Family>/<variant>/seed<seed>`` (a folder, or with ``.zip`` a file) in a folder of models;
        or ``<Family>`` there, a pretrained model of that variant and seed. None if there is none,
        or the variant is made from another one's model.
        """
        if not key.training.is_default or key.base is not None:
            return None
        for family, variant, seed, path in self.workplace.named:
            if (family_id(family), variant, seed) == (key.env_id, key.variant, key.seed):
                if _content(Path(path)) is None:
                    files = f"neither {CHECKPOINT}, nor {MODEL}, nor {CONFIG}"
                    raise ValueError(f"{path} holds no model: {files}")
                return Path(path)
        for folder in map(Path, self.workplace.models):
            pretrained = folder / model_folder(key.env_id)
            place = pretrained / key.variant / f"seed{key.seed}"
            for candidate in (place, place.with_suffix(".zip")):
                if _content(candidate) is not None:
                    return candidate
            if (pretrained / CONFIG).is_file():
                config = read_config(pretrained)
                if not _departures({"seed": None, **config["arguments"], **config}, key):
                    return pretrained
        return None

    def state(self, key: ModelKey) -> str:
        """ "handed over", "trained", "interrupted" or "missing"."""
        if self.given(key) is not None:
            return "handed over"
        folder = self.folder(key)
        if (folder / FINISHED).exists():
            return "trained"
        return "interrupted" if any(folder.glob(f"*/*/{CHECKPOINT}")) else "missing"

    def origin(self, key: ModelKey) -> str:
        """What a model is, or will be, made of, as part of a cell's identity: the file that was
        handed over; or the hyperparameters, and the revision of the code that trained with them.

        :raises ValueError: If what there is of it was trained with other hyperparameters
        """
        path = self.given(key)
        if path is not None:
            return FILE + _describe_given(path)["sha256"][:24]
        if key.base is not None:
            return self.origin(key.base)
        hyperparameters, begun = training_plan(key).hyperparameters, self.folder(key) / BEGUN
        found = {"hyperparameters": hyperparameters, "revision": REVISION}
        if self.state(key) != "missing":
            found = read_json(begun, RECORD) if begun.exists() else {"hyperparameters": None}
        if found["hyperparameters"] != hyperparameters:
            raise ValueError(
                f"{begun.parent} was trained with other hyperparameters than zoo_configs/ has for "
                f"{key} now: take another folder for --runs, or remove it"
            )
        return f"hyperparameters {digest(found)}"

    def lock_file(self, key: ModelKey) -> Path:
        return self.folder(key) / ".lock"

    def is_taken(self, key: ModelKey) -> bool:
        """Whether another process is training the model, or one that it is made from."""
        if self.state(key) in ("handed over", "trained"):
            return False
        if key.base is not None and self.is_taken(key.base):
            return True
        with try_lock(self.lock_file(key)) as free:
            return not free

    def ensure(self, key: ModelKey, say: Say = print) -> dict[str, Any]:
        """Train the model if it is missing, or finish its training (another process that is at it
        is waited for); how it was trained, JSON-ready.

        :raises TrainingError: If that fails
        """
        path = self.given(key)
        if path is not None:
            return _describe_given(path)
        finished = self.folder(key) / FINISHED
        if not finished.exists():
            if key.base is not None:
                self.ensure(key.base, say)
            wait = f"waiting for another process that trains {key}"
            with locked(self.lock_file(key), lambda: say(wait)) as lock:
                if not finished.exists():
                    made = self._train(key, lock, say) if key.base is None else self._derive(key)
                    write_json_atomically(finished, {**made, **provenance()})
        return read_json(finished, RECORD)

    def load(self, key: ModelKey, env: VecEnv, snapshot: float | None = None) -> Any:
        """A model that :meth:`ensure` has made sure of, or a :class:`MAMLRewardModel`; with its
        replay buffer where that was kept.

        :param env: An environment of its family, which it gets
        :param snapshot: The share of the training after which to take it; None: all, as of one
            that was handed over
        :raises ValueError: If one that was handed over is another
        """
        if key.base is not None:
            model = self.load(key.base, env)
            return MAMLRewardModel(MetaReward.load(self.folder(key) / REWARD, model.policy), model)
        path = self.given(key)
        if path is not None:
            file = _content(path) or path
        elif snapshot is not None:
            file = self.snapshot_file(key, snapshot)
        else:
            run = self.folder(key) / read_json(self.folder(key) / FINISHED, RECORD)["run"]
            # PEARL's replay buffer is asked about
            is_pearl = VARIANTS[key.variant].algorithm == "pearl_sac"
            file = run / (CHECKPOINT if is_pearl else _zip_name(key.env_id))
        model = load_model(file.parent if file.name == CONFIG else file, self.workplace.device)
        if path is not None and (wrong := _departures(vars(model), key)):
            raise ValueError(f"{path} was handed over as {key}, but has {', '.join(wrong)}")
        model.set_env(env)
        return model

    def snapshot_file(self, key: ModelKey, snapshot: float) -> Path:
        """The model that was saved within one interval of a share of the training."""
        plan = training_plan(key)
        wanted = snapshot * plan.timesteps
        files = {
            int(re.findall(r"\d+", file.stem)[-1]): file
            for file in self.folder(key).glob("*/*/rl_model_*_steps.zip")
        }
        # the first epoch is not learnt from
        usable = [steps for steps in files if steps > plan.epoch_steps]
        nearest = min(usable, key=lambda steps: abs(steps - wanted), default=None)
        if nearest is None or abs(nearest - wanted) > plan.save_steps:
            raise ValueError(
                f"{key} has no model that was saved near {wanted:,.0f} steps; there are: "
                f"{sorted(usable)}"
            )
        return files[nearest]

    def _train(self, key: ModelKey, lock: int, say: Say) -> dict[str, Any]:
        plan, folder = training_plan(key), self.folder(key)
        begun = folder / BEGUN
        state = "training" if self.state(key) == "missing" else "resuming"
        if state == "training":
            made = {"hyperparameters": plan.hyperparameters, "revision": REVISION}
            write_json_atomically(begun, made)
        say(
            f"{state} {key}: {plan.timesteps:,} steps, {plan.updates:,} updates; "
            f"log in {folder / LOG}"
        )
        place = self.workplace
        arguments = train_arguments(key, plan, place.packages)
        run_training(arguments, plan.save_steps, folder, lock, place.device, place.num_threads)
        files = folder.glob(f"*/*/{_zip_name(key.env_id)}")
        file = max(files, key=lambda file: file.stat().st_mtime, default=None)
        if file is None:
            raise TrainingError(f"the training of {key} left no model; see {folder / LOG}")
        model = ALGORITHMS[plan.algorithm].load(file, device="cpu")
        if model.num_timesteps < plan.timesteps:
            raise TrainingError(
                f"{file} stopped after {model.num_timesteps:,} of {plan.timesteps:,} steps; "
                "remove it"
            )
        sessions = [read_json(each, RECORD) for each in folder.glob(f"{SESSIONS}/*.json")]
        names = ("seconds", "cpu_seconds")
        took = {name: round(sum(session[name] for session in sessions), 1) for name in names}
        say(f"trained {key} in {took['seconds']:.0f} s")
        return {
            "source": "trained",
            "run": str(file.parent.relative_to(folder)),
            "command": shlex.join(["sb3-poem", *arguments]),
            "revision": read_json(begun, RECORD)["revision"],
            "hyperparameters": plan.hyperparameters,
            "overrides": plan.overrides,
            "env_steps": int(model.num_timesteps),
            "updates": int(model._n_updates),
            **took,
            "sessions": len(sessions),
        }

    def _derive(self, key: ModelKey) -> dict[str, Any]:
        """MAML's reward, from PEARL's experience."""
        assert key.base is not None
        iterations = META_ITERATIONS_OF.get(key.family, META_ITERATIONS)
        with contextlib.closing(make_task_vec_env(key.env_id, 1)) as env:
            model = self.load(key.base, env)
            if not model.replay_buffer.counts.any():
                raise ValueError(
                    f"{key} learns from the replay buffer of {key.base}, which the model that was "
                    f"handed over does not have; hand over its {CHECKPOINT} instead"
                )
            started = time.time()
            length = default_fragment_length(model.horizon)
            reward = meta_train_reward(model, iterations, fragment_length=length, seed=key.seed)
        reward.save(self.folder(key) / REWARD)
        return {
            "source": "derived",
            "base": self.ensure(key.base),
            "hyperparameters": {"n_iterations": iterations, "fragment_length": length},
            "env_steps": int(model.num_timesteps),
            "updates": int(model._n_updates),
            "seconds": round(time.time() - started, 1),
        }


def model_folder(env_id: str) -> str:
    """The folder of an environment's models, another for each package and version."""
    return family_label(env_id).replace("/", "-")


def _zip_name(env_id: str) -> str:
    return env_id.replace("/", "-") + ".zip"


def _content(path: Path) -> Path | None:
    """What of a file or folder can be loaded: the checkpoint first, for its replay buffer."""
    files = [path / name for name in (CHECKPOINT, MODEL, CONFIG)] if path.is_dir() else [path]
    return next(filter(Path.is_file, files), None)


def _departures(found: Mapping[str, Any], key: ModelKey) -> list[str]:
    """What a model has, by its arguments or attributes, that its family's entry does not make."""
    variant = VARIANTS[key.variant]
    made = zoo_entry(config_file(variant.algorithm), key.env_id, **overrides(key))
    if variant.algorithm == "poem_sac":
        made = {"similarity": "two-encoder", "context": "optimal", **made}
    expected: dict[str, Any] = {"algorithm": ALGORITHMS[variant.algorithm].__name__}
    expected |= {"env_id": key.env_id, "env_kwargs": {}, "seed": key.seed}
    both = [(name, found[name], value) for name, value in expected.items()]
    kinds = "(similarity, context, latent_dim, without preferences)"
    both.append((kinds, _kind(found), _kind(made)))
    return [f"{name} {one!r} instead of {other!r}" for name, one, other in both if one != other]


def _kind(values: Mapping[str, Any]) -> tuple[Any, ...]:
    """What tells variants apart."""
    kinds = values.get("similarity"), values.get("context"), int(values.get("latent_dim", 5))
    return (*kinds, values.get("preference_coef") == 0)


def _describe_given(path: Path) -> dict[str, Any]:
    """What is known of a model that was handed over."""
    file = _content(path) or path
    info: dict[str, Any] = {"source": "handed over", "name": "/".join(path.parts[-3:])}
    if file.name == CONFIG:
        config = read_config(file.parent)
        card = {name: value for name, value in config["card"].items() if name != "results"}
        info |= {
            "env_steps": config["num_timesteps"],
            "updates": config["n_updates"],
            "arguments": config["arguments"],
            "seconds": card.get("wall_seconds"),
            "cpu_seconds": card.get("cpu_seconds"),
            "card": card,
        }
        file = file.with_name(WEIGHTS)
    info["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    return info
