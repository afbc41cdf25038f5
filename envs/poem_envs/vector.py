"""Many copies of a task family at once, the same as single ones bit for bit."""

import functools
import os
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from poem_envs.family import TaskFamily, checked, task_option
from poem_envs.processes import EpisodeStart, ProcessCopies

NO_RENDER_MODE = "without a render_mode; pass one to the constructor, say 'rgb_array'"
#: What a family has for its one copy, and a vectorised one has not.
OF_ONE_COPY = frozenset({"task", "set_task"})


@dataclass(kw_only=True, eq=False, repr=False)
class BatchFamily(TaskFamily):
    """A family whose simulator steps any number of copies at once. By itself it is an environment
    of one copy; :class:`TaskFamilyVector` makes room for more.

    A subclass defines ``_allocate(n)``, ``_begin_episodes(copies, rngs)``, ``_advance(actions)``
    (features ``(n, reward_feature_dim)`` and early ends ``(n,)``), ``_observations()``
    (``(n, obs_dim)``) and ``_reward``, and ``_render_copy(copy, render_mode, task)`` in place of
    ``render()`` if it can be drawn. It sets what :class:`TaskFamily` asks for in its class, in the
    constructor, which hands all that it does not know to ``super().__init__``, or, as a dataclass
    whose fields are its arguments, in ``__post_init__``.

    >>> class Drift(BatchFamily):
    ...     observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    ...     action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    ...     task_space = spaces.Box(-1.0, 1.0, (1,), np.float64)
    ...     reward_feature_dim = 1
    ...
    ...     def _allocate(self, n):
    ...         self.x = np.zeros((n, 1))
    ...
    ...     def _begin_episodes(self, copies, rngs):
    ...         self.x[copies] = 0.0
    ...
    ...     def _advance(self, actions):
    ...         self.x += 0.1 * actions
    ...         return self.x.copy(), np.zeros(len(actions), dtype=bool)
    ...
    ...     def _observations(self):
    ...         return self.x.copy()
    ...
    ...     def _reward(self, tasks, features):
    ...         return -np.abs(features[..., 0] - tasks[..., 0])
    >>> envs = TaskFamilyVector(Drift, num_envs=3)
    >>> envs.reset(seed=0)[0].shape
    (3, 1)
    """

    render_mode: str | None = None
    render_task: bool = False

    #: How many threads may step the copies.
    nthread = 1

    def __post_init__(self) -> None:
        super().__init__(render_mode=self.render_mode, render_task=self.render_task)
        self._allocate(1)

    @abstractmethod
    def _allocate(self, n: int) -> None:
        """Make room for the states of ``n`` copies, before the first episode."""

    @abstractmethod
    def _begin_episodes(self, copies: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        """Put some copies, given by number, into a start state, each with its own generator."""

    @abstractmethod
    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Step all copies by valid actions ``(n, action_dim)`` float64; return new arrays of reward
        features ``(n, reward_feature_dim)`` and of early ends ``(n,)``.
        """

    def _step_infos(self) -> dict[str, np.ndarray]:
        """Further entries of the infos of the step just taken, a row for each copy."""
        return {}

    @abstractmethod
    def _observations(self) -> np.ndarray:
        """The observations of all copies, ``(n, obs_dim)``, a new array."""

    def _render_copy(self, copy: int, render_mode: str, task: np.ndarray | None) -> Any:
        """Render one copy, in one of Gymnasium's modes, with its task unless that is None."""
        name = type(self).__name__
        raise NotImplementedError(f"{name} has no _render_copy(copy, render_mode, task)")

    def _begin_episode(self, rng: np.random.Generator) -> np.ndarray:
        self._begin_episodes(np.zeros(1, dtype=np.intp), [rng])
        return self._observations()[0]

    def _simulate(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        features, terminated = self._advance(action[None])
        return self._observations()[0], features[0], bool(terminated[0])

    def _step_info(self) -> dict[str, Any]:
        return {key: values[0] for key, values in self._step_infos().items()}

    def render(self) -> Any:
        """Render the current state as ``render_mode`` says."""
        if self.render_mode is None:
            gym.logger.warn(f"render() was called {NO_RENDER_MODE}")
            return None
        return self._render_copy(0, self.render_mode, self._task if self.render_task else None)


def available_cores() -> int:
    """The number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class TaskFamilyVector(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A vectorised task family, each copy with a task of its own.

    Copies of a :class:`BatchFamily` are stepped at once; those of any other family share the work
    of ``nthread`` processes, this one among them. Register a family with it::

        vector = functools.partial(TaskFamilyVector, Walk1D)
        gym.register("my/Walk-v0", Walk1D, vector_entry_point=vector, max_episode_steps=50)

    The families that ship are registered so:

    >>> envs = gym.make_vec("poem/PointGoal-v0", 4, vectorization_mode="vector_entry_point")
    >>> observations, _ = envs.reset(seed=0)
    >>> observations.shape, envs.tasks.shape
    ((4, 2), (4, 1))

    - A copy whose episode ends is reset in the same step (``AutoresetMode.SAME_STEP``). Then
      ``infos["final_obs"]`` holds ``(num_envs, obs_dim)`` that each copy's step led to, and
      ``infos["_final_obs"]`` which copies were reset.
    - ``infos["reward_features"]``, ``(num_envs, reward_feature_dim)``, and a family's ``"success"``
      and ``"is_success"``, ``(num_envs,)``, are always those of the step just taken.
    - ``reset(seed=s)`` seeds copy ``i`` with ``s + i``; results equal those of single environments
      bit for bit, whatever ``nthread``.
    - What else a family has, its attributes and methods, the vectorised one has too.

    :param family: A :class:`~poem_envs.TaskFamily` class, or a function that makes such an
        environment; ``family_kwargs`` are its arguments
    :param nthread: Number of threads, or processes; None for as many as this process may use cores
    :param max_episode_steps: Episodes are truncated after so many steps; None for as many as a
        :class:`GoalFamily`'s environment has, or no limit
    """

    single_action_space: spaces.Box

    def __init__(
        self,
        family: Callable[..., TaskFamily],
        *,
        num_envs: int = 1,
        nthread: int | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **family_kwargs: Any,
    ) -> None:
        super().__init__()
        self.closed = True  # until there is something to close
        numbers = {"num_envs": num_envs, "nthread": nthread, "max_episode_steps": max_episode_steps}
        for name, number in numbers.items():
            if number is not None and number < 1:
                raise ValueError(f"{name}={number!r} must be at least 1")
        nthread = nthread or available_cores()
        if render_mode is not None:
            family_kwargs["render_mode"] = render_mode
        make = functools.partial(family, **family_kwargs)
        #: A single environment of the family, of whose class and arguments the copies are.
        self.family = one = make()
        if not isinstance(one, TaskFamily):
            raise TypeError(
                f"family={family!r} makes a {type(one).__name__}, but it must make a "
                "poem_envs.TaskFamily"
            )
        if render_mode == "human" and num_envs > 1:
            raise ValueError(
                f"render_mode='human' shows one environment, but num_envs={num_envs}; use "
                "'rgb_array'"
            )
        self.metadata = {**one.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps or getattr(one, "max_episode_steps", None)
        self.render_mode = render_mode
        self.single_observation_space = one.observation_space
        self.single_action_space = one.action_space
        self.observation_space = batch_space(one.observation_space, num_envs)
        self.action_space = batch_space(one.action_space, num_envs)

        self._tasks: np.ndarray | None = None  # (num_envs, task_dim)
        self._next_tasks = np.full((num_envs, *one.task_space.shape), np.nan)
        self._task_chosen = np.zeros(num_envs, dtype=bool)
        self._tasks_kept = np.zeros(num_envs, dtype=bool)
        # Of each copy, None before the first reset: what np_random and np_random_seed give.
        self._np_random: Any = [None] * num_envs
        self._np_random_seed: Any = [None] * num_envs
        self._elapsed_steps = np.zeros(num_envs, dtype=np.int64)
        self._episodes = np.zeros(num_envs, dtype=np.int64)
        self._succeeded = np.zeros(num_envs, dtype=bool)
        self._copies: BatchFamily | ProcessCopies
        if isinstance(one, BatchFamily):
            self._copies, one.nthread = one, nthread
            one._allocate(num_envs)
            # no method of this object, which would live as long as the family does
            facts = self._elapsed_steps, self._episodes, self._np_random_seed
            one._describe_episode = functools.partial(_describe, *facts)  # type: ignore[method-assign]
        else:
            self._copies = ProcessCopies(make, num_envs, nthread, one.observation_space)
        self.closed = False

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "family" or name in OF_ONE_COPY:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.family, name)

    @property
    def tasks(self) -> np.ndarray | None:
        """The tasks in effect, ``(num_envs, task_dim)``; None before the first reset."""
        return None if self._tasks is None else self._tasks.copy()

    def set_tasks(self, tasks: npt.ArrayLike, copies: npt.ArrayLike | None = None) -> None:
        """Choose the tasks of the episodes that begin from each copy's next reset on; errors as of
        :meth:`TaskFamily.set_task`.

        :param tasks: ``(num_envs, task_dim)``, or one row for each of ``copies``
        """
        index = np.arange(self.num_envs) if copies is None else np.asarray(copies, dtype=np.intp)
        shape = (len(index), *self.family.task_space.shape)
        self._next_tasks[index] = self.family._checked_tasks(tasks, shape, "tasks")
        self._task_chosen[index] = True

    def keep_tasks(self) -> None:
        """Keep every copy's task, the one chosen last or else the one in effect, through its next
        reset, also if that has a seed, which would draw another.
        """
        self._tasks_kept[:] = self._tasks is not None

    def set_attribute(self, name: str, value: Any) -> None:
        """Set an attribute of the family, as if on each copy."""
        setattr(self.family, name, value)
        if isinstance(self._copies, ProcessCopies):
            self._copies.set_attribute(name, value)
        if name in self.__dict__:
            setattr(self, name, value)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode in every copy.

        :param seed: ``s`` seeds copy ``i`` with ``s + i``; or one seed (or None) for each copy. It
            draws other tasks, except for copies whose task was chosen
        :param options: ``{"tasks": tasks}`` is short for :meth:`set_tasks` just before
        """
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + copy for copy in range(self.num_envs)]
        given = [None] * self.num_envs if seed is None else seed
        seeds = [None if own is None else int(own) for own in given]
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"seed={seed!r} holds {len(seeds)} seeds, expected one for each of "
                f"num_envs={self.num_envs}"
            )
        seeded = np.array([own is not None for own in seeds])
        if (tasks := task_option(options, "tasks")) is not None:
            self.set_tasks(tasks)
        for copy, own in enumerate(seeds):
            if own is not None or self._np_random[copy] is None:
                self._np_random[copy], self._np_random_seed[copy] = seeding.np_random(own)
        self._episodes[seeded] = 0
        undecided = ~self._task_chosen
        if self._tasks is None:
            self._tasks = self._next_tasks.copy()
        else:
            undecided &= seeded & ~self._tasks_kept
        for copy in np.flatnonzero(undecided).tolist():
            self._tasks[copy] = self.family._sample_task(self._np_random[copy])
        self._begin(np.arange(self.num_envs))
        if self.render_mode == "human":
            self.render()
        return self._copies._observations(), {}

    def step(
        self, actions: npt.ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step every copy by ``(num_envs, action_dim)``; errors as of :meth:`TaskFamily.step`."""
        if self._tasks is None:
            raise ResetNeeded("step() was called before the first reset()")
        space = self.single_action_space
        actions = checked(actions, space, (self.num_envs, *space.shape), "actions")
        self._elapsed_steps += 1
        features, terminations = self._copies._advance(actions)
        rewards = self.family.compute_rewards(self._tasks, features)
        observations = self._copies._observations()
        truncations = self._elapsed_steps >= (self.max_episode_steps or np.inf)
        infos: dict[str, Any] = {"reward_features": features, **self._copies._step_infos()}
        if "success" in infos:
            self._succeeded |= infos["success"].astype(bool)
            infos["is_success"] = self._succeeded.copy()
        done = terminations | truncations
        if done.any():
            infos["final_obs"], infos["_final_obs"] = observations, done
            self._begin(np.flatnonzero(done))
            observations = self._copies._observations()
        if self.render_mode == "human":
            self.render()
        return observations, rewards, terminations, truncations, infos

    def render(self) -> tuple[Any, ...] | None:
        """Render every copy as ``render_mode`` says, and return the images."""
        if self.render_mode is None:
            gym.logger.warn(f"render() was called {NO_RENDER_MODE}")
            return None
        return tuple(self.render_copy(copy) for copy in range(self.num_envs))

    def render_copy(self, copy: int) -> Any:
        """What :meth:`render` would hold for one copy, by number."""
        if self.render_mode is None:
            raise ValueError(f"render_copy() was called {NO_RENDER_MODE}")
        task = self._tasks[copy] if self.family.render_task and self._tasks is not None else None
        return self._copies._render_copy(copy, self.render_mode, task)

    def close_extras(self, **kwargs: Any) -> None:
        self._copies.close()
        self.family.close()

    def _begin(self, copies: np.ndarray) -> None:
        assert self._tasks is not None
        chosen = copies[self._task_chosen[copies]]
        self._tasks[chosen] = self._next_tasks[chosen]
        self._tasks_kept[copies] = False
        self._elapsed_steps[copies] = 0
        self._succeeded[copies] = False
        self._episodes[copies] += 1
        rngs, seeds = self._np_random, self._np_random_seed
        if isinstance(self._copies, BatchFamily):
            self._copies._begin_episodes(copies, [rngs[copy] for copy in copies])
            return
        tasks, episodes = self._tasks.copy(), self._episodes.tolist()
        starts = {
            copy: EpisodeStart(rngs[copy], tasks[copy], seeds[copy], episodes[copy])
            for copy in copies.tolist()
        }
        for copy, drawn in self._copies.begin(starts).items():  # perhaps in other processes
            rngs[copy] = drawn


def _describe(steps: np.ndarray, episodes: np.ndarray, seeds: list[int], copy: int = 0) -> str:
    return (
        f"step {steps[copy]} of episode {episodes[copy]} since reset(seed={seeds[copy]}) in "
        f"environment copy {copy}"
    )


def set_task(env: Any, task: npt.ArrayLike) -> None:
    """Choose the task of a family that may be inside wrappers, from the next reset on.

    >>> import gymnasium as gym
    >>> env = gym.make("poem_envs:poem/PointGoal-v0")
    >>> set_task(env, [1.5])
    >>> observation, info = env.reset(seed=0)
    >>> env.unwrapped.task
    array([1.5])

    :param env: A ``gym.Env``, a Gymnasium ``VectorEnv``, or an SB3 ``VecEnv``
    :param task: ``(task_dim,)``; of a vectorised environment for all copies, or
        ``(num_envs, task_dim)``, one for each
    :raises TypeError: If ``env`` is none of these, or no task family
    """
    if isinstance(env, gym.Env) and env.has_wrapper_attr("set_task"):
        env.get_wrapper_attr("set_task")(task)
    elif isinstance(getattr(env, "unwrapped", None), gym.vector.SyncVectorEnv):
        for single, row in zip(env.unwrapped.envs, _task_of_each(task, env.num_envs), strict=True):
            set_task(single, row)
    elif isinstance(env, gym.vector.VectorEnv) and isinstance(env.unwrapped, TaskFamilyVector):
        env.unwrapped.set_tasks(_task_of_each(task, env.num_envs))
    elif hasattr(env, "env_method") and env.has_attr("set_task"):  # SB3's, not imported here
        for copy, row in enumerate(_task_of_each(task, env.num_envs)):
            env.env_method("set_task", row, indices=[copy])
    else:
        raise TypeError(
            f"env={env!r} must be a task family (poem_envs.TaskFamily), by itself, inside "
            "wrappers, or vectorised within this process"
        )


def _task_of_each(task: npt.ArrayLike, num_envs: int) -> np.ndarray:
    """A task for each copy, ``(num_envs, task_dim)``."""
    tasks = np.asarray(task)
    if tasks.ndim == 1:
        return np.tile(tasks, (num_envs, 1))
    if tasks.shape[:-1] != (num_envs,):
        raise ValueError(
            f"task has shape {tasks.shape}, expected (task_dim,) or (num_envs, task_dim) with "
            f"num_envs={num_envs}"
        )
    return tasks
