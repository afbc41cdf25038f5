"""SB3's face of a vectorised task family: infos are as with ``DummyVecEnv`` and ``Monitor``."""

import copy
import dataclasses
import functools
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from poem_envs.family import TaskFamily, task_option
from poem_envs.registration import plain_id
from poem_envs.vector import TaskFamilyVector
from sb3_poem.common.checks import check_whole
from sb3_poem.common.family_view import no_family

# What these do, the vectorised environment or TaskVecEnv does itself.
ABSORBED_WRAPPERS = (TimeLimit, OrderEnforcing, PassiveEnvChecker, Monitor)
MAKE_VEC_ARGUMENTS = frozenset({"max_episode_steps", "nthread", "num_envs", "vectorization_mode"})
#: What TaskVecEnv reads of a vectorised environment's infos by itself
READ_INFOS = {"reward_features", "final_obs", "_final_obs"}
#: What every copy has one of, and where the vectorised environment holds all of them
OF_EACH_COPY = {"task": "tasks", "np_random": "np_random", "np_random_seed": "np_random_seed"}


class TaskVecEnv(VecEnv):
    """Vectorised environment for task families that have a vectorised version
    (``vector_entry_point``), in place of ``DummyVecEnv`` where a class can be given:
    ``make_vec_env(id, n, vec_env_cls=TaskVecEnv)``, rl_zoo3.

    It steps all copies at once, and gives the same observations, rewards and infos, those of
    ``Monitor`` and ``DummyVecEnv`` included, and ``"reward_features"``. ``get_attr`` and
    ``env_method`` see each copy as a single :class:`poem_envs.TaskFamily`.

    >>> from stable_baselines3.common.env_util import make_vec_env
    >>> env = make_vec_env("poem/PointGoal-v0", 4, vec_env_cls=TaskVecEnv)
    >>> env.reset().shape
    (4, 2)

    :param env_fns: One function a copy that returns an environment. Only the first is called: all
        copies are made alike, from its registration and arguments. If its ``Monitor`` has a file,
        the episodes of all copies are written to that file. Or a vectorised family.
    :param nthread: Threads (or processes, as the family has it) to step with; None for all cores
    :raises ValueError: If the environment is no task family, has no vectorised version, was not
        made by ``gym.make``, was given a task already, or is inside a wrapper other than
        ``TimeLimit``, ``OrderEnforcing``, ``PassiveEnvChecker`` and ``Monitor``.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]] | TaskFamilyVector,
        nthread: int | None = None,
    ) -> None:
        wrappers: list[gym.Wrapper] = []
        if isinstance(env_fns, TaskFamilyVector):
            vector_env = env_fns
        elif len(env_fns) < 1:
            raise ValueError("env_fns is empty; pass one function for each copy")
        elif not callable(env_fns[0]):
            raise TypeError(f"env_fns must hold functions that make one, but holds {env_fns[0]!r}")
        else:
            env = env_fns[0]()
            while isinstance(env, gym.Wrapper):  # outermost first
                wrappers.append(env)
                env = env.env
            vector_env = _vectorised(env, wrappers, len(env_fns), nthread)
            env.close()  # not the wrapper's: the monitor's file stays in use
        if (spec := vector_env.spec) is not None:
            # a single environment's: make_vec's own adds what gym.make does not take
            kwargs = {key: spec.kwargs[key] for key in spec.kwargs.keys() - MAKE_VEC_ARGUMENTS}
            limit = vector_env.max_episode_steps
            vector_env.spec = dataclasses.replace(spec, kwargs=kwargs, max_episode_steps=limit)
        self.vector_env = vector_env
        self._wrapper_types = (Monitor, *map(type, wrappers))
        self._monitor = next((each for each in wrappers if isinstance(each, Monitor)), None)
        self._views = [_Copy(vector_env, index) for index in range(vector_env.num_envs)]
        observation_space = vector_env.single_observation_space
        super().__init__(vector_env.num_envs, observation_space, vector_env.single_action_space)
        self.metadata = vector_env.metadata
        #: (num_envs, reward_feature_dim), those of the last step; None before the first
        self.last_reward_features: np.ndarray | None = None
        self._returns = np.zeros(self.num_envs)
        self._lengths = np.zeros(self.num_envs, dtype=np.int64)
        self._start_time = time.time() if self._monitor is None else self._monitor.t_start

    @property
    def tasks(self) -> np.ndarray | None:
        """The tasks in effect, ``(num_envs, task_dim)``; None before the first reset."""
        return self.vector_env.tasks

    def set_tasks(self, tasks: npt.ArrayLike) -> None:
        """See :meth:`poem_envs.TaskFamilyVector.set_tasks`."""
        self.vector_env.set_tasks(tasks)

    def keep_tasks(self) -> None:
        """See :meth:`poem_envs.TaskFamilyVector.keep_tasks`."""
        self.vector_env.keep_tasks()

    def reset(self) -> np.ndarray:
        for index, options in enumerate(self._options):
            if (task := task_option(options, "task")) is not None:
                self.vector_env.set_tasks([task], copies=[index])
        observations, _ = self.vector_env.reset(seed=self._seeds)
        self._reset_seeds()
        self._reset_options()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions  # of the step under way

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        stepped = self.vector_env.step(self._actions)
        observations, rewards, terminations, truncations, given = stepped
        self.last_reward_features = features = given["reward_features"]
        self._returns += rewards
        self._lengths += 1
        cut_short = truncations & ~terminations
        infos: list[dict[str, Any]] = [
            {"reward_features": row, "TimeLimit.truncated": cut}
            for row, cut in zip(features, cut_short.tolist(), strict=True)
        ]
        for key in given.keys() - READ_INFOS:  # "success" and the like
            for info, value in zip(infos, given[key], strict=True):
                info[key] = value
        dones = terminations | truncations
        for index in np.flatnonzero(dones).tolist():
            infos[index]["terminal_observation"] = given["final_obs"][index]
            infos[index]["episode"] = self._episode_info(index, infos[index])
        self._returns[dones] = 0.0
        self._lengths[dones] = 0
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        self.vector_env.close()
        if self._monitor is not None and self._monitor.results_writer is not None:
            self._monitor.results_writer.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        if self.render_mode != "rgb_array":
            what = "but this method assumes it is `rgb_array` to obtain images."
            warnings.warn(f"The render mode is {self.render_mode}, {what}", stacklevel=2)
            return [None] * self.num_envs
        images = self.vector_env.render()
        assert images is not None
        return images

    def __repr__(self) -> str:
        spec = self.vector_env.spec
        family = "an unregistered family" if spec is None else spec.id
        return f"TaskVecEnv({family}, {self.num_envs} copies)"

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return [getattr(self._views[index], attr_name) for index in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        if sorted(self._get_indices(indices)) != list(range(self.num_envs)):
            raise ValueError(
                f"indices={indices!r}: copies share their attributes, so {attr_name!r} can only be "
                "set for all of them"
            )
        if attr_name in ("task", "tasks"):
            raise AttributeError(
                f"{attr_name!r} cannot be set; use set_tasks(tasks), which takes effect at the "
                "next reset"
            )
        self.vector_env.set_attribute(attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        methods = self.get_attr(method_name, indices)
        return [method(*method_args, **kwargs) for method in methods]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Whether the copies do what a wrapper does: the first environment's, and ``Monitor``."""
        wrapped = any(issubclass(kind, wrapper_class) for kind in self._wrapper_types)
        return [wrapped for _ in self._get_indices(indices)]

    def _episode_info(self, index: int, info: dict[str, Any]) -> dict[str, Any]:
        episode = {
            "r": round(float(self._returns[index]), 6),
            "l": int(self._lengths[index]),
            "t": round(time.time() - self._start_time, 6),
        }
        if self._monitor is not None:
            episode.update({key: info[key] for key in self._monitor.info_keywords})
            if self._monitor.results_writer is not None:
                self._monitor.results_writer.write_row(episode)
        return episode


def vectorised(env: gym.Env | gym.vector.VectorEnv | VecEnv) -> VecEnv:
    """The same environment as a vectorised one of SB3, of one copy if it is not one."""
    if isinstance(env, gym.Env):
        return DummyVecEnv([lambda: env])
    if isinstance(env, TaskFamilyVector):
        return TaskVecEnv(env)
    if isinstance(env, gym.vector.SyncVectorEnv):
        return DummyVecEnv([functools.partial(Monitor, single) for single in env.envs])
    if isinstance(env, gym.vector.VectorEnv):
        raise ValueError(
            f"env is a {type(env).__name__}, but must be gym.make_vec(id, n) of a task family "
            "(poem_envs.TaskFamily) without wrappers, or SB3's make_vec_env(id, n, "
            "vec_env_cls=...) with TaskVecEnv, DummyVecEnv or SubprocVecEnv"
        )
    return env


def make_task_vec_env(
    env_id: str, n_envs: int, max_sequential: int = 8, nthread: int | None = None, **env_kwargs: Any
) -> VecEnv:
    """Copies of a registered family: a :class:`TaskVecEnv`, or a ``DummyVecEnv`` of a family
    without a vectorised version.

    :param max_sequential: The most copies that a ``DummyVecEnv`` steps one after another
    :param nthread: As of :class:`TaskVecEnv`
    :param env_kwargs: Arguments of the environment
    """
    check_whole("n_envs", n_envs, 1)
    env_id = plain_id(env_id)
    make = functools.partial(gym.make, env_id, **env_kwargs)
    if gym.spec(env_id).vector_entry_point is not None:
        return TaskVecEnv([make] * n_envs, nthread)
    return DummyVecEnv([lambda: Monitor(make())] * min(n_envs, max_sequential))


def make_shown_env(env_id: str, render_mode: str | None, **env_kwargs: Any) -> gym.Env:
    """A single environment, to be looked at; refused if it cannot be drawn so."""
    env = gym.make(plain_id(env_id), render_mode=render_mode, **env_kwargs)
    if render_mode is not None and render_mode not in env.metadata.get("render_modes", ()):
        raise ValueError(f"{env_id} cannot be shown: it has no render mode {render_mode!r}")
    return env


class _Copy:
    """One copy of a vectorised task family, as a single environment is seen."""

    # what a step or a reset of one copy alone would put out of step with the others
    _HIDDEN = frozenset({"reset", "step", "close"})

    def __init__(self, vector_env: TaskFamilyVector, index: int) -> None:
        self._vector_env, self._index = vector_env, index
        self.spec, self.max_episode_steps = vector_env.spec, vector_env.max_episode_steps

    @property
    def unwrapped(self) -> "_Copy":
        return self

    def set_task(self, task: npt.ArrayLike) -> None:
        self._vector_env.set_tasks([np.asarray(task)], copies=[self._index])

    def render(self) -> Any:
        return self._vector_env.render_copy(self._index)

    def get_wrapper_attr(self, name: str) -> Any:
        return getattr(self, name)

    def __str__(self) -> str:
        return f"<{type(self._vector_env.family).__name__} instance>"

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name in self._HIDDEN:
            raise AttributeError(f"a copy of a vectorised task family has no attribute {name!r}")
        if name in OF_EACH_COPY:
            of_all = getattr(self._vector_env, OF_EACH_COPY[name])
            return None if of_all is None else of_all[self._index]
        return getattr(self._vector_env.family, name)


def _is_absorbed(wrapper: gym.Wrapper) -> bool:
    # An import of rl_zoo3 replaces Gymnasium's TimeLimit by a subclass.
    patched = isinstance(wrapper, TimeLimit) and type(wrapper).__module__ == "rl_zoo3.gym_patches"
    return patched or type(wrapper) in ABSORBED_WRAPPERS


def _vectorised(
    bare: gym.Env, wrappers: list[gym.Wrapper], num_envs: int, nthread: int | None
) -> TaskFamilyVector:
    """The vectorised version of a single environment, from its registration and arguments."""
    instead = "use DummyVecEnv instead of TaskVecEnv"
    if not isinstance(bare, TaskFamily):
        raise ValueError(no_family(str(bare)))
    foreign = [type(wrapper).__name__ for wrapper in wrappers if not _is_absorbed(wrapper)]
    if foreign:
        allowed = ", ".join(kind.__name__ for kind in ABSORBED_WRAPPERS)
        raise ValueError(
            f"the environment is wrapped in {', '.join(foreign)}, but only {allowed} can be "
            f"vectorised; {instead}"
        )
    monitors = [wrapper for wrapper in wrappers if isinstance(wrapper, Monitor)]
    if any(monitor.reset_keywords or not monitor.allow_early_resets for monitor in monitors):
        what = "Monitor's reset_keywords and allow_early_resets=False are not supported"
        raise ValueError(f"{what}; {instead}")
    if bare.spec is None:
        raise ValueError(f"{bare} was not made by gym.make; register it, or {instead}")
    if bare.spec.vector_entry_point is None:
        raise ValueError(f"{bare.spec.id} is registered without a vector_entry_point; {instead}")
    if bare._next_task is not None:
        raise ValueError(f"{bare} was given a task, which copies would not get; use set_tasks")
    limits = [wrapper._max_episode_steps for wrapper in wrappers if isinstance(wrapper, TimeLimit)]
    spec = copy.deepcopy(bare.spec)
    spec.max_episode_steps = min(limits, default=None)
    kwargs: dict[str, Any] = {} if nthread is None else {"nthread": nthread}
    vector_env = gym.make_vec(spec, num_envs, "vector_entry_point", **kwargs)
    if not isinstance(vector_env, TaskFamilyVector):
        raise ValueError(f"{spec.id}'s vector_entry_point is no TaskFamilyVector; {instead}")
    return vector_env
