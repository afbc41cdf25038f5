"""How models and training runs are written and read: SB3's zip, checkpoints, and pretrained folders."""

import contextlib
import inspect
import io
import pathlib
import zipfile
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar, cast

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from poem_envs.registration import plain_id
from sb3_poem.common.checkpoint import is_checkpoint, read_checkpoint, restore_stores, save_checkpoint
from sb3_poem.common.files import write_atomically
from sb3_poem.common.pretrained import from_pretrained, save_pretrained
from sb3_poem.common.vec_env import as_task_vec_env, make_task_vec_env
from sb3_poem.pearl_sac.unsupported import refuse_unknown
from sb3_poem.resources import pretrained_names

#: Arguments of SB3's ``load`` beside the constructor's
LOADING = {"custom_objects", "print_system_info", "force_reset"}

SelfPersistent = TypeVar("SelfPersistent", bound="PersistentSAC")

DEFAULT_TRAIN_TASKS = 120


def default_train_tasks(all_tasks: np.ndarray | None) -> int:
    """How many tasks to train on unless told: 120, or all of a smaller finite family."""
    return DEFAULT_TRAIN_TASKS if all_tasks is None else min(DEFAULT_TRAIN_TASKS, len(all_tasks))


class PersistentSAC(SAC):
    """SAC whose files are written atomically and refuse what is not theirs; the base of :class:`PEARLSAC`."""

    #: Constructor argument -> attribute, for what :meth:`save_pretrained` keeps
    saved_arguments: ClassVar[dict[str, str]] = {
        name: name
        for name in (
            "batch_size",
            "buffer_size",
            "tau",
            "gamma",
            "gradient_steps",
            "target_update_interval",
            "n_train_tasks",
            "meta_batch_size",
            "context_size",
            "trajectories_per_task",
            "latent_dim",
            "kl_coef",
            "reward_coef",
            "policy_coef",
            "relabel_fraction",
            "reward_scale",
            "noise_color",
            "shaping_coef",
            "mirror_fraction",
            "policy_delay",
            "horizon",
            "precision",
            "seed",
        )
    }

    #: Arguments that decide what the networks are; a trained model has them for good
    fixed_arguments: ClassVar[tuple[str, ...]] = ("latent_dim", "similarity", "context")

    @staticmethod
    def _default_copies(n_train_tasks: int, trajectories_per_task: int) -> int:
        """One copy for each trajectory of an epoch, up to one per task or :data:`DEFAULT_TRAIN_TASKS`, whichever is more."""
        return min(n_train_tasks * trajectories_per_task, max(n_train_tasks, DEFAULT_TRAIN_TASKS))

    @classmethod
    def _vectorise(
        cls,
        env: GymEnv | gym.vector.VectorEnv | str | None,
        n_train_tasks: int | None,
        trajectories_per_task: int,
        n_copies: int | None = None,
    ) -> GymEnv | None:
        """What a model is given as its environment, as SB3 takes it. A registered id becomes
        ``n_copies``: unless given, :meth:`_default_copies` of a family that has a vectorised version,
        and of any other as many as :func:`make_task_vec_env` steps in turn.

        :raises TypeError: if it is something else
        :raises ValueError: if it is Gymnasium's vectorised environment of no task family
        """
        if isinstance(env, gym.vector.VectorEnv):
            return as_task_vec_env(env)
        if env is None or isinstance(env, gym.Env | VecEnv):
            return env
        if not isinstance(env, str):
            what = f"the class {env.__name__}" if isinstance(env, type) else f"a {type(env).__name__}"
            raise TypeError(
                f"env is {what}, but must be an environment, a vectorised one (DummyVecEnv, "
                "SubprocVecEnv, TaskVecEnv), or a registered id"
            )
        env = plain_id(env)
        if n_copies is not None:
            return make_task_vec_env(env, n_copies, max_sequential=n_copies)
        if n_train_tasks is None:
            with contextlib.closing(gym.make(env)) as probe:
                n_train_tasks = default_train_tasks(getattr(probe.unwrapped, "all_tasks", None))
        return make_task_vec_env(env, cls._default_copies(n_train_tasks, trajectories_per_task))

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """As SB3's, but a file is written completely or not at all."""
        if isinstance(path, io.BufferedIOBase):
            super().save(path, exclude, include)
            return
        archive = io.BytesIO()
        super().save(archive, exclude, include)  # type: ignore[arg-type]
        path = pathlib.Path(path)
        write_atomically(path if path.suffix else path.with_suffix(".zip"), archive.getbuffer())

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfPersistent], path: str | pathlib.Path | io.BufferedIOBase, env: GymEnv | str | None = None, **kwargs: Any
    ) -> SelfPersistent:
        """As SB3's. ``env`` may be a registered id too: it becomes as many copies as the model was trained with. Further
        arguments are the constructor's; a ``seed`` begins new random streams.

        :raises ValueError: if it is a folder, the file is truncated or holds another algorithm's model, env is of another
            family, or an argument would change what the networks are
        """
        if not isinstance(path, io.BufferedIOBase):
            cls._check_is_file(pathlib.Path(path))
        refuse_unknown(kwargs.keys() - inspect.signature(cls).parameters.keys() - LOADING, cls)
        try:
            data, _, _ = load_from_zip_file(path, device="cpu", load_data=True)
        except (zipfile.BadZipFile, RuntimeError, EOFError, ValueError) as error:
            raise ValueError(f"{path} is truncated, or no model saved by {cls.__name__}: {error}") from error
        if data is None:
            raise ValueError(f"{path} is truncated, or no model saved by {cls.__name__}: it holds no data of a model")
        if "train_tasks" not in data or ("preference_coef" in data) != hasattr(cls, "similarity"):
            raise ValueError(f"{path} holds a model of another algorithm, not of {cls.__name__}")
        if isinstance(path, io.BufferedIOBase):
            path.seek(0)
        changed = {cls.saved_arguments.get(name, name): value for name, value in kwargs.items()}
        for name in cls.fixed_arguments:
            attribute = cls.saved_arguments.get(name, name)
            if name in kwargs and data.get(attribute) != changed[attribute]:
                raise ValueError(f"{name} is {data.get(attribute)!r} in {path}, and cannot become {kwargs[name]!r}")
        learns = str(data["ent_coef"]).startswith("auto")
        if "ent_coef" in kwargs and str(kwargs["ent_coef"]).startswith("auto") != learns:
            raise ValueError(
                f"ent_coef is {data['ent_coef']!r} in {path}, and cannot become {kwargs['ent_coef']!r}: a coefficient that is "
                "learned stays one, as does a fixed one"
            )
        if kwargs.get("n_train_tasks") not in (None, len(data["train_tasks"])):
            raise ValueError(
                f"n_train_tasks is {len(data['train_tasks'])} in {path}, and cannot become {kwargs['n_train_tasks']}"
            )
        if env is not None:
            env = cls._vectorise(env, len(data["train_tasks"]), data["trajectories_per_task"], data["n_envs"])
        model = super().load(path, env=env, **changed)  # type: ignore[arg-type]
        if changed.get("seed") is not None:
            model.set_random_seed(changed["seed"])
        return model

    @classmethod
    def _check_is_file(cls, path: pathlib.Path) -> None:
        """
        :raises ValueError: if it is a folder or a shipped model's name, for ``from_pretrained``
        """
        if path.is_file():
            if is_checkpoint(path):
                raise ValueError(f"{path} is a checkpoint: use {cls.__name__}.load_checkpoint({str(path)!r})")
            return
        if not path.is_dir() and path.with_name(f"{path.name}.zip").is_file():
            return
        is_shipped = not path.exists() and str(path) in pretrained_names()
        if path.is_dir() or is_shipped:
            what = "the name of a model that ships" if is_shipped else "a folder"
            raise ValueError(f"{path} is {what}: use {cls.__name__}.from_pretrained({str(path)!r})")

    def save_checkpoint(self, path: str | pathlib.Path) -> None:
        """Write everything to one file, from which :meth:`load_checkpoint` continues bit for bit. Between two epochs only.

        :raises OSError: if it cannot be written; a previous checkpoint stays whole
        """
        save_checkpoint(cast(Any, self), path)

    @classmethod
    def load_checkpoint(
        cls: type[SelfPersistent], path: str | pathlib.Path, env: GymEnv | str | None = None, device: th.device | str = "auto"
    ) -> SelfPersistent:
        """Read a checkpoint; :meth:`resume` then continues the run.

        :param path: A file that :meth:`save_checkpoint` or :class:`TrainingCheckpointCallback` wrote
        :param env: An environment like the run's own: the same family and number of copies
        :param device: "auto", "cpu", "cuda"
        :raises ValueError: if the file is truncated or holds another algorithm's run, or env is of another family
        """
        state = read_checkpoint(path, cls.__name__)
        model = cls.load(io.BytesIO(state["model"].numpy().tobytes()), env, device=device)
        restore_stores(cast(Any, model), state)
        return model

    def save_pretrained(self, folder: str | pathlib.Path, card: dict[str, Any] | None = None) -> None:
        """Write safetensors, JSON and a model card; see :func:`sb3_poem.common.pretrained.save_pretrained`."""
        save_pretrained(cast(Any, self), folder, card)

    @classmethod
    def from_pretrained(
        cls: type[SelfPersistent],
        folder: str | pathlib.Path,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
    ) -> SelfPersistent:
        """Read what :meth:`save_pretrained` wrote, or a shipped model by its name; see
        :func:`sb3_poem.common.pretrained.from_pretrained`.
        """
        return from_pretrained(cast(Any, cls), folder, env, device)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_family", "context", "_logs_pending"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        kept = [name for name in state_dicts if name not in ("actor.optimizer", "critic.optimizer")]
        return [*kept, "policy.optimizer"], variables
