"""Trained models: found among those that were handed over or left by earlier runs, or trained."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

# A model that rl_zoo3 trained may hold its schedules. Importing it replaces Gymnasium's TimeLimit,
# so it comes first.
import rl_zoo3  # noqa: F401
from stable_baselines3.common.vec_env import VecEnv

from sb3_poem.adaptation.state import read_json, write_json_atomically
from sb3_poem.baselines import MAMLRewardModel, MetaReward, meta_train_reward
from sb3_poem.baselines.fragments import default_fragment_length
from sb3_poem.benchmark.hyperparameters import MissingEntryError, TrainingPlan, training_plan
from sb3_poem.benchmark.locks import locked, try_lock
from sb3_poem.benchmark.methods import META_ITERATIONS, META_ITERATIONS_OF, VARIANTS
from sb3_poem.benchmark.provenance import provenance
from sb3_poem.benchmark.suites import (
    FILE,
    REVISION,
    ModelKey,
    digest,
    family_id,
    family_label,
)
from sb3_poem.common.vec_env import make_task_vec_env
from sb3_poem.loading import ALGORITHMS
from sb3_poem.pearl_sac import PEARLSAC
from sb3_poem.pearl_sac.saving import CONFIG, WEIGHTS, is_checkpoint, read_config

CHECKPOINT, MODEL, BEGUN, FINISHED, SESSIONS, LOG, REWARD = (
    "checkpoint.zip",
    "model.zip",
    "begun.json",
    "trained.json",
    "sessions",
    "train.log",
    "reward",
)
LOG_LINES = 15

Say = Callable[[str], None]


class TrainingError(RuntimeError):
    """A training that did not end well; the message has the end of its log."""


@dataclass(frozen=True)
class Workplace:
    """Where models are kept, and how they are trained and run.

    :param runs: Folder of the trainings, and of locks.
    :param models: Folders with models that were handed over, see :meth:`ModelLibrary.given`.
    :param named: Models that were handed over one by one: family, variant, seed, path.
    :param device: As PyTorch names it.
    :param num_threads: Of PyTorch.
    """

    runs: str
    models: tuple[str, ...] = ()
    named: tuple[tuple[str, str, int, str], ...] = ()
    device: str = "cpu"
    num_threads: int = 1

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return asdict(self)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Workplace:
        """Read what :meth:`to_dict` wrote.

        :param data: The dictionary.
        :return: The workplace.
        """
        named = tuple((str(f), str(v), int(s), str(p)) for f, v, s, p in data["named"])
        return cls(**{**data, "models": tuple(data["models"]), "named": named})


class ModelLibrary:
    """The models of a workplace."""

    def __init__(self, workplace: Workplace) -> None:
        self.workplace = workplace
        self.runs = Path(workplace.runs)

    def folder(self, key: ModelKey) -> Path:
        """Where a model's training is kept."""
        variant = key.variant
        if not key.training.is_default:
            text = json.dumps(key.training.to_dict(), sort_keys=True)
            variant += "-" + hashlib.sha256(text.encode()).hexdigest()[:8]
        return self.runs / model_folder(key.env_id) / variant / f"seed{key.seed}"

    def given(self, key: ModelKey) -> Path | None:
        """The file or folder of a model that was handed over: one that was named;
        ``<Family>/<variant>/seed<seed>`` (a folder, or with ``.zip`` a file) in a folder of models;
        or ``<Family>`` there, a pretrained model of that variant and seed.

        :param key: The model.
        :return: Its place; None if it was not handed over.
        :raises ValueError: If a model that was named does not exist, or is a folder without one.
        """
        if not key.training.is_default:
            return None
        for family, variant, seed, path in self.workplace.named:
            if (family_id(family), variant, seed) == (key.env_id, key.variant, key.seed):
                named = Path(path)
                if not named.exists():
                    raise ValueError(
                        f"--model {family}:{variant}:{seed}={path}: there is no such file or folder"
                    )
                if named.is_dir():
                    _find_content(named)
                return named
        for folder in map(Path, self.workplace.models):
            place = folder / model_folder(key.env_id) / key.variant / f"seed{key.seed}"
            for candidate in (place, place.with_suffix(".zip")):
                if candidate.is_file() or (candidate.is_dir() and _content(candidate) is not None):
                    return candidate
            pretrained = folder / model_folder(key.env_id)
            if (pretrained / CONFIG).is_file() and _is_variant(read_config(pretrained), key):
                return pretrained
        return None

    def state(self, key: ModelKey) -> str:
        """ "handed over", "trained", "interrupted" or "missing".

        :param key: The model.
        """
        if self.given(key) is not None:
            return "handed over"
        folder = self.folder(key)
        if (folder / FINISHED).exists():
            return "trained"
        return "interrupted" if any(folder.glob(f"*/*/{CHECKPOINT}")) else "missing"

    def origin(self, key: ModelKey) -> str:
        """What a model is, or will be, made of, as part of a cell's identity: the file that was
        handed over; or the hyperparameters, and the revision of the code that trained with them.

        :param key: The model.
        :raises ValueError: If there are no hyperparameters for it, or what there is of it was
            trained with others.
        """
        path = self.given(key)
        if path is not None:
            return FILE + _describe_given(path)["sha256"][:24]
        base = VARIANTS[key.variant].base
        if base is not None:
            return self.origin(_other(key, base))
        made = {"hyperparameters": _as_json(training_plan(key).hyperparameters)}
        begun = self.folder(key) / BEGUN
        if begun.exists():
            found = read_json(begun)
        elif self.state(key) == "missing":
            found = {**made, "revision": REVISION}
        else:
            found = {"hyperparameters": None}
        if found["hyperparameters"] != made["hyperparameters"]:
            raise ValueError(
                f"{begun.parent} was trained with other hyperparameters than zoo_configs/ has for {key} now: take "
                "another folder for --runs, or remove it"
            )
        return f"hyperparameters {digest(found)}"

    def has_snapshots(self, key: ModelKey) -> bool:
        """Whether the model is, or will be, saved along its training."""
        return self.given(key) is None

    def lock_file(self, key: ModelKey) -> Path:
        """Held by whoever trains the model."""
        return self.folder(key) / ".lock"

    def is_taken(self, key: ModelKey) -> bool:
        """Whether the model, or one that it is made from, is missing and another process is
        training it.
        """
        if self.given(key) is not None or (self.folder(key) / FINISHED).exists():
            return False
        base = VARIANTS[key.variant].base
        if base is not None and self.is_taken(_other(key, base)):
            return True
        with try_lock(self.lock_file(key)) as free:
            return not free

    def ensure(self, key: ModelKey, say: Say = print) -> dict[str, Any]:
        """Train the model if it is missing, or finish its training; another process that is at it
        is waited for.

        :param key: The model.
        :param say: Takes a line of progress.
        :return: How it was trained, JSON-ready.
        :raises TrainingError: If the training fails.
        """
        path = self.given(key)
        if path is not None:
            return _describe_given(path)
        folder = self.folder(key)
        if not (folder / FINISHED).exists():
            base = VARIANTS[key.variant].base
            if base is not None:
                self.ensure(_other(key, base), say)
            with locked(
                self.lock_file(key), lambda: say(f"waiting for another process that trains {key}")
            ) as lock:
                if not (folder / FINISHED).exists():
                    self._derive(key, base) if base is not None else self._train(key, lock, say)
        return read_json(folder / FINISHED)

    def load(self, key: ModelKey, env: VecEnv, snapshot: float | None = None) -> Any:
        """A model that :meth:`ensure` has made sure of.

        :param key: The model.
        :param env: An environment of its family, which it gets.
        :param snapshot: The share of the training after which to take it; None: all.
        :return: The model, or a :class:`MAMLRewardModel`; with its replay buffer where that was
            kept.
        :raises ValueError: If a model that was handed over is another, or was not saved along its
            training.
        """
        base = VARIANTS[key.variant].base
        path = self.given(key)
        if base is not None and path is None:
            model = self.load(_other(key, base), env)
            return MAMLRewardModel(MetaReward.load(self.folder(key) / REWARD, model.policy), model)
        algorithm = ALGORITHMS[VARIANTS[key.variant].algorithm]
        device = self.workplace.device
        if path is not None:
            if snapshot is not None:
                raise ValueError(f"{key} was handed over, and so has no models along its training")
            model = _load_given(algorithm, path, env, device)
            _check_variant(model, key, path)
            return model
        if snapshot is not None:
            return algorithm.load(self.snapshot_file(key, snapshot), env, device=device)
        if algorithm is PEARLSAC:  # whose replay buffer is asked about
            return algorithm.load_checkpoint(self._run(key) / CHECKPOINT, env, device=device)
        return algorithm.load(self._run(key) / f"{_file_name(key.env_id)}.zip", env, device=device)

    def snapshot_file(self, key: ModelKey, snapshot: float) -> Path:
        """The model that was saved nearest to a share of the training.

        :param key: The model.
        :param snapshot: The share.
        :return: The file.
        :raises ValueError: If none was saved within one interval of it.
        """
        plan = training_plan(key)
        wanted = snapshot * plan.timesteps
        files = {
            int(re.findall(r"\d+", file.stem)[-1]): file
            for file in self.folder(key).glob("*/*/rl_model_*_steps.zip")
        }
        files = {
            steps: file for steps, file in files.items() if steps > plan.epoch_steps
        }  # the first epoch is not learnt from
        nearest = min(files, key=lambda steps: abs(steps - wanted), default=None)
        if nearest is None or abs(nearest - wanted) > plan.save_steps:
            raise ValueError(
                f"{key} has no model that was saved near {wanted:,.0f} steps; there are: {sorted(files)}"
            )
        return files[nearest]

    def _run(self, key: ModelKey) -> Path:
        """The folder that rl_zoo3 made for the run that finished."""
        return self.folder(key) / read_json(self.folder(key) / FINISHED)["run"]

    def _train(self, key: ModelKey, lock: int, say: Say) -> None:
        plan, folder = training_plan(key), self.folder(key)
        if not (folder / BEGUN).exists():
            made = {"hyperparameters": _as_json(plan.hyperparameters), "revision": REVISION}
            write_json_atomically(folder / BEGUN, made)
        before = len(list(folder.glob(f"{SESSIONS}/*.json")))
        arguments = _train_arguments(key, plan)
        state = "resuming" if before else "training"
        say(
            f"{state} {key}: {plan.timesteps:,} steps, {plan.updates:,} updates; log in {folder / LOG}"
        )
        others = [
            "-f",
            str(folder),
            "--resume",
            "--save-freq",
            str(plan.save_steps),
            "--device",
            self.workplace.device,
        ]
        others += ["--num-threads", str(self.workplace.num_threads)]
        module = [sys.executable, "-m", "sb3_poem.benchmark.training_process", str(os.getpid())]
        module += [str(folder / SESSIONS / f"{before + 1}.json")]
        threads = {
            name: str(self.workplace.num_threads) for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
        }
        with (folder / LOG).open("a") as log:
            # In a session of its own an interrupt from the keyboard does not reach it: rl_zoo3
            # would save half a training as if it were whole. It inherits the lock, so that nobody
            # else trains while it still ends.
            child = subprocess.Popen(
                [*module, *arguments, *others],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **threads},
                pass_fds=(lock,),
                start_new_session=True,
            )
            try:
                status = child.wait()
            finally:
                if child.poll() is None:
                    child.kill()
                    child.wait()
        finished = sorted(
            folder.glob(f"*/*/{_file_name(key.env_id)}.zip"), key=lambda file: file.stat().st_mtime
        )
        if status != 0 or not finished:
            tail = "\n".join((folder / LOG).read_text(errors="replace").splitlines()[-LOG_LINES:])
            raise TrainingError(
                f"the training of {key} ended with status {status}; the end of {folder / LOG}:\n{tail}"
            )
        model = ALGORITHMS[plan.algorithm].load(finished[-1], device="cpu")
        if model.num_timesteps < plan.timesteps:
            raise TrainingError(
                f"{finished[-1]} stopped after {model.num_timesteps:,} of {plan.timesteps:,} steps; remove it"
            )
        sessions = [read_json(file) for file in folder.glob(f"{SESSIONS}/*.json")]
        info = {
            "source": "trained",
            "run": str(finished[-1].parent.relative_to(folder)),
            "command": "sb3-poem " + " ".join(arguments),
            "revision": read_json(folder / BEGUN)["revision"],
            "hyperparameters": plan.hyperparameters,
            "overrides": plan.overrides,
            "env_steps": int(model.num_timesteps),
            "updates": int(model._n_updates),
            "seconds": round(sum(session["seconds"] for session in sessions), 1),
            "cpu_seconds": round(sum(session["cpu_seconds"] for session in sessions), 1),
            "sessions": len(sessions),
            **provenance(),
        }
        write_json_atomically(folder / FINISHED, info)
        say(f"trained {key} in {info['seconds']:.0f} s")

    def _derive(self, key: ModelKey, base: str) -> None:
        """MAML's reward, from PEARL's experience."""
        base_key = _other(key, base)
        env = make_task_vec_env(key.env_id, 1)
        try:
            model = self.load(base_key, env)
            if not model.replay_buffer.counts.any():
                raise ValueError(
                    f"{key} learns from the replay buffer of {base_key}, which the model that was handed over does not have; "
                    f"hand over its {CHECKPOINT} instead"
                )
            started = time.time()
            iterations = META_ITERATIONS_OF.get(key.family, META_ITERATIONS)
            length = default_fragment_length(model.horizon)
            reward = meta_train_reward(model, iterations, fragment_length=length, seed=key.seed)
        finally:
            env.close()
        folder = self.folder(key)
        reward.save(folder / REWARD)
        base_info = self.ensure(base_key)
        info = {
            "source": "derived",
            "base": base_info,
            "hyperparameters": {"n_iterations": iterations, "fragment_length": length},
            "env_steps": base_info["env_steps"],
            "updates": base_info["updates"],
            "seconds": round(time.time() - started, 1),
            **provenance(),
        }
        write_json_atomically(folder / FINISHED, info)


def _other(key: ModelKey, variant: str) -> ModelKey:
    return ModelKey(key.env_id, variant, key.seed, key.training)


def model_folder(env_id: str) -> str:
    """The folder of an environment's models: two families of one name, from other packages or of
    other versions, have two.
    """
    return _file_name(family_label(env_id))


def _file_name(env_id: str) -> str:
    return env_id.replace("/", "-")


def _train_arguments(key: ModelKey, plan: TrainingPlan) -> list[str]:
    """Those of ``sb3-poem`` that decide what comes out."""
    arguments = [
        "train",
        "--algo",
        plan.algorithm,
        "--env",
        key.env_id,
        "--seed",
        str(key.seed),
        "--eval-freq",
        "-1",
    ]
    if key.training.timesteps is not None:
        arguments += ["-n", str(plan.timesteps)]
    if plan.overrides:
        arguments += ["-params", *(f"{name}:{value!r}" for name, value in plan.overrides.items())]
    return arguments


def _as_json(data: Any) -> Any:
    return json.loads(json.dumps(data))


def _content(folder: Path) -> Path | None:
    """What a folder holds that can be loaded: the checkpoint first, for its replay buffer."""
    names = (folder / CHECKPOINT, folder / MODEL, folder / CONFIG)
    return next((path for path in names if path.is_file()), None)


def _find_content(folder: Path) -> Path:
    file = _content(folder)
    if file is None:
        raise ValueError(
            f"{folder} holds no model: neither {CHECKPOINT}, nor {MODEL}, nor {CONFIG}"
        )
    return file


def _load_given(algorithm: type[PEARLSAC], path: Path, env: VecEnv, device: str) -> PEARLSAC:
    file = _find_content(path) if path.is_dir() else path
    if file.name == CONFIG:
        return algorithm.from_pretrained(path, env, device=device)
    if is_checkpoint(file):
        return algorithm.load_checkpoint(file, env, device=device)
    return algorithm.load(file, env, device=device)


def _is_variant(config: dict[str, Any], key: ModelKey) -> bool:
    """Whether a pretrained folder's configuration is that of a model."""
    variant, arguments = VARIANTS[key.variant], config["arguments"]
    if variant.base is not None or config["algorithm"] != ALGORITHMS[variant.algorithm].__name__:
        return False
    facts = _distinguishing(
        arguments.get("similarity"), arguments.get("context"), arguments["latent_dim"]
    )
    return (config["env_id"], arguments.get("seed"), facts) == (
        key.env_id,
        key.seed,
        _expected(key),
    )


def _check_variant(model: Any, key: ModelKey, path: Path) -> None:
    """Refuse a model that is not the one as which it was handed over."""
    facts = _distinguishing(
        getattr(model, "similarity", None), getattr(model, "context", None), int(model.latent_dim)
    )
    found, expected = (model.env_id, model.seed, facts), (key.env_id, key.seed, _expected(key))
    if found != expected:
        names = ("env_id", "seed", "(similarity, context, latent_dim)")
        wrong = [
            f"{n} {f!r} instead of {e!r}"
            for n, f, e in zip(names, found, expected, strict=True)
            if f != e
        ]
        raise ValueError(f"{path} was handed over as {key}, but has {', '.join(wrong)}")


def _distinguishing(
    similarity: str | None, context: str | None, latent_dim: int
) -> tuple[str | None, str | None, int]:
    return similarity, context, latent_dim


def _expected(key: ModelKey) -> tuple[str | None, str | None, int]:
    """What a model of this key is like: as its family's entry would make it, or as the algorithm's
    defaults do without one.
    """
    variant = VARIANTS[key.variant]
    hyperparameters = variant.hyperparameters
    with contextlib.suppress(MissingEntryError):  # a family that nothing is trained on here
        hyperparameters = training_plan(key).hyperparameters
    dim = int(hyperparameters.get("latent_dim", 5))
    if variant.algorithm == "pearl_sac":
        return None, None, dim
    return (
        hyperparameters.get("similarity", "two-encoder"),
        hyperparameters.get("context", "optimal"),
        dim,
    )


def _describe_given(path: Path) -> dict[str, Any]:
    """What is known of a model that was handed over; how it was trained if it says so."""
    file = _content(path) if path.is_dir() else path
    assert file is not None, "given() finds what can be loaded"
    info: dict[str, Any] = {"source": "handed over", "name": "/".join(path.parts[-3:])}
    if file.name == CONFIG:
        config = read_config(path)
        card = {name: value for name, value in config["card"].items() if name != "results"}
        info |= {
            "env_steps": config["num_timesteps"],
            "updates": config["n_updates"],
            "arguments": config["arguments"],
        }
        info |= {"seconds": card.get("wall_seconds"), "cpu_seconds": card.get("cpu_seconds")}
        info["card"] = card
        file = path / WEIGHTS
    info["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    return info
