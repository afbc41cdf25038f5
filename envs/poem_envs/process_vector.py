"""Any task family, vectorised over processes: for simulators whose steps spend their time in
Python, where threads would wait.

A worker process starts with :mod:`poem_envs.worker` alone, so that user scripts need no ``if
__name__ == "__main__"`` and no worker loads torch. What a worker does is in :class:`CopyGroup`; the
vectorised environment steps a group of its own meanwhile.
"""

from __future__ import annotations

import functools
import os
import pickle
import subprocess
import sys
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, Pipe
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from poem_envs.family import TaskFamily
from poem_envs.vector import TaskFamilyVector, checked_nthread


class EpisodeStart(NamedTuple):
    """What a copy, by its number within its group, needs to begin an episode."""

    copy: int
    rng: np.random.Generator
    task: np.ndarray
    seed: int
    episode: int


class CopyGroup:
    """Copies of a task family that one process steps in turn, numbered from ``first``."""

    def __init__(
        self, make: Callable[[], TaskFamily], n: int, first: int, attributes: dict[str, Any]
    ) -> None:
        self.envs, self.first = [make() for _ in range(n)], first
        for name, value in attributes.items():
            self.set_attribute(name, value)
        self._answer: tuple[Any, Exception | None] = None, None

    def send(self, method: str, *arguments: Any) -> None:
        """As :meth:`RemoteGroup.send`, but what is called is done when this returns."""
        try:
            self._answer = getattr(self, method)(*arguments), None
        except Exception as error:
            self._answer = None, error

    def receive(self) -> Any:
        """The result of the last call, or its error."""
        result, error = self._answer
        if error is not None:
            raise error
        return result

    def begin(
        self, starts: Sequence[EpisodeStart]
    ) -> tuple[list[np.ndarray], list[np.random.Generator]]:
        """Begin episodes in some copies: observations, and generators after all draws."""
        observations = []
        for start in starts:
            env = self.envs[start.copy]
            env._task, env._np_random_seed = start.task, start.seed
            env._episode, env._elapsed_steps = start.episode, 0
            observations.append(self.call(start.copy, "_begin_episode", start.rng))
        return observations, [start.rng for start in starts]

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Step every copy: observations, reward features, early ends and further infos."""
        results, infos = [], []
        for copy, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            env._elapsed_steps += 1
            results.append(self.call(copy, "_simulate", action))
            infos.append(env._step_info())
        observations, features, terminated = zip(*results, strict=True)
        together = {key: np.stack([info[key] for info in infos]) for key in infos[0]}
        return np.stack(observations), np.stack(features), np.array(terminated, bool), together

    def call(self, copy: int, method: str, *arguments: Any) -> Any:
        """Call a method of one copy."""
        try:
            return getattr(self.envs[copy], method)(*arguments)
        except Exception as error:
            raise RuntimeError(
                f"environment copy {self.first + copy}: {type(error).__name__}: {error}"
            ) from error

    def set_attribute(self, name: str, value: Any) -> None:
        """Set an attribute of every copy."""
        for env in self.envs:
            setattr(env, name, value)

    def close(self) -> None:
        """Close every copy."""
        for env in self.envs:
            env.close()


class WorkerError(Exception):
    """An error's traceback in a worker process, as text; the cause of the error raised for it."""

    def __str__(self) -> str:
        return "\n" + str(self.args[0])


class RemoteGroup:
    """A :class:`CopyGroup` in a process: calls are sent, results received, first of making it."""

    def __init__(self, *arguments: Any) -> None:
        self._connection, theirs = Pipe()
        # The worker imports what the parent can import, and "" is the parent's working directory.
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "poem_envs.worker", str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            env={**os.environ, "PYTHONPATH": paths},
            stdin=subprocess.DEVNULL,
        )
        theirs.close()
        self.close = weakref.finalize(self, _end_worker, self._connection, self._process)
        self.send("__init__", *arguments)

    def send(self, method: str, *arguments: Any) -> None:
        """Begin a call of a group's method."""
        try:
            self._connection.send_bytes(cloudpickle.dumps((method, arguments)))
        except (BrokenPipeError, ConnectionResetError):
            raise self._gone() from None

    def receive(self) -> Any:
        """The result of the oldest call that is under way."""
        try:
            succeeded, result = pickle.loads(self._connection.recv_bytes())
        except (EOFError, ConnectionResetError):
            raise self._gone() from None
        if not succeeded:
            message, trace = result
            raise RuntimeError(message) from WorkerError(trace)
        return result

    def _gone(self) -> RuntimeError:
        return RuntimeError(
            "a worker process of the environment ended with exit status "
            f"{self._process.wait()} (negative: the signal that ended it)"
        )


def _end_worker(connection: Connection, process: subprocess.Popen[bytes]) -> None:
    connection.close()  # which the worker takes as the end
    try:
        process.wait(timeout=5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class ProcessFamilyVector(TaskFamilyVector):
    """The vectorised version of any task family: its copies share the work of ``nthread``
    processes, this one among them.

    Results equal those of single environments bit for bit, whatever the number of processes.
    Register a family with it::

        vector = functools.partial(ProcessFamilyVector, Walk1D)
        gym.register("my/Walk-v0", Walk1D, vector_entry_point=vector, max_episode_steps=50)

    :param family: a :class:`~poem_envs.TaskFamily` class, or a function that makes such an
        environment; ``family_kwargs`` are its arguments
    :param nthread: number of processes; None for as many as this process may use cores
    :param max_episode_steps: None for as many as a :class:`GoalFamily`'s environment has, or no
        limit
    """

    def __init__(
        self,
        family: Callable[..., TaskFamily],
        *,
        num_envs: int = 1,
        nthread: int | None = None,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        render_task: bool = False,
        **family_kwargs: Any,
    ) -> None:
        self._nthread = checked_nthread(nthread)
        if render_mode is not None:
            family_kwargs["render_mode"] = render_mode
        if render_task:
            family_kwargs["render_task"] = render_task
        self._make = functools.partial(family, **family_kwargs)
        self._groups: list[CopyGroup | RemoteGroup] = []
        self._interrupted = False
        self._attributes: dict[str, Any] = {}
        self._template = template = self._make()
        if not isinstance(template, TaskFamily):
            raise TypeError(
                f"family={family!r} makes a {type(template).__name__}, but it must make a "
                "poem_envs.TaskFamily"
            )
        self.metadata = {**template.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        if max_episode_steps is None:
            max_episode_steps = getattr(template, "max_episode_steps", None)
        self.task_space, self.all_tasks = template.task_space, template.all_tasks
        self.reward_feature_dim = template.reward_feature_dim
        self.shared_dynamics = template.shared_dynamics
        self.splits = template.splits
        assert isinstance(template.observation_space, spaces.Box)
        assert isinstance(template.action_space, spaces.Box)
        super().__init__(
            observation_space=template.observation_space,
            action_space=template.action_space,
            num_envs=num_envs,
            max_episode_steps=max_episode_steps,
            render_mode=render_mode,
            render_task=render_task,
            split=template.split,
        )

    def __getattr__(self, name: str) -> Any:
        """What a family has of its own, as a single environment does."""
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self._template, name)

    def set_attribute(self, name: str, value: Any) -> None:
        setattr(self._template, name, value)
        self._attributes[name] = value  # for copies that are made anew
        self._call("set_attribute", dict.fromkeys(range(len(self._firsts)), (name, value)))
        if hasattr(type(self), name) or name in self.__dict__:
            setattr(self, name, value)

    def sample_tasks(self, n: int, rng: np.random.Generator) -> np.ndarray:
        return self._template.sample_tasks(n, rng)

    def _reward(self, tasks: np.ndarray, features: np.ndarray) -> np.ndarray:
        return self._template._reward(tasks, features)

    @property
    def has_potential(self) -> bool:
        return self._template.has_potential

    def _potential(self, tasks: np.ndarray, observations: np.ndarray) -> np.ndarray:
        return self._template._potential(tasks, observations)

    def _checked_tasks(self, tasks: npt.ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
        return self._template._checked_tasks(tasks, shape, name)

    def _allocate(self, n: int) -> None:
        groups = np.array_split(np.arange(n), min(self._nthread, n))
        self._firsts = [int(copies[0]) for copies in groups]
        # Where each copy is: its group, and its number there.
        self._places = [
            (group, k) for group, copies in enumerate(groups) for k in range(len(copies))
        ]
        space = self.single_observation_space
        assert space.shape is not None
        self._last_observations = np.zeros((n, *space.shape), dtype=space.dtype)
        self._last_infos: dict[str, np.ndarray] = {}

    def _start(self) -> None:
        """Start the workers; this process has the last, smallest group."""
        ends = [*self._firsts[1:], self.num_envs]
        try:
            for first, end in zip(self._firsts, ends, strict=True):
                group = CopyGroup if end == self.num_envs else RemoteGroup
                self._groups.append(group(self._make, end - first, first, self._attributes))
            for remote in self._groups[:-1]:
                remote.receive()
        except BaseException:  # the next call tries again, rather than to use what is half made
            self._end_groups()
            raise

    def _call(self, method: str, arguments: dict[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Call a method of some groups, all at once; arguments and results are by group."""
        if self._interrupted and method != "begin":
            raise ResetNeeded(
                "a call of this environment was interrupted, and left its copies in the middle of "
                "it; reset it"
            )
        results: dict[int, Any] = {}
        failure: Exception | None = None
        try:
            if not self._groups:
                self._start()
            for index in sorted(arguments):  # this process's own last: the others work meanwhile
                self._groups[index].send(method, *arguments[index])
            for index in arguments:  # all of them even if one failed: none may be left over
                try:
                    results[index] = self._groups[index].receive()
                except Exception as problem:
                    failure = failure or problem
        except BaseException as error:
            if not isinstance(error, Exception):  # answers under way would be taken for later ones
                self._end_groups()
                self._interrupted = True
            raise
        if failure is not None:
            raise failure
        self._interrupted = False
        return results

    def _call_copy(self, copy: int, method: str, *arguments: Any) -> Any:
        group, place = self._places[copy]
        return self._call("call", {group: (place, method, *arguments)})[group]

    def _begin_episodes(self, copies: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        assert self._tasks is not None
        starts: dict[int, list[EpisodeStart]] = {}
        for copy, rng in zip(copies.tolist(), rngs, strict=True):
            group, place = self._places[copy]
            task, seed, episode = self._tasks[copy].copy(), self._seeds[copy], self._episodes[copy]
            start = EpisodeStart(place, rng, task, seed, int(episode))
            starts.setdefault(group, []).append(start)
        results = self._call("begin", {group: (own,) for group, own in starts.items()})
        for group, answer in results.items():
            for start, observation, rng in zip(starts[group], *answer, strict=True):
                copy = self._firsts[group] + start.copy
                self._last_observations[copy] = observation
                self._rngs[copy] = rng  # which has drawn, in another process

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        chunks = np.split(actions, self._firsts[1:])
        results = self._call("step", {index: (chunk,) for index, chunk in enumerate(chunks)})
        observations, features, terminated, infos = zip(*results.values(), strict=True)
        self._last_observations = np.concatenate(observations)
        self._last_infos = {key: np.concatenate([info[key] for info in infos]) for key in infos[0]}
        return np.concatenate(features), np.concatenate(terminated)

    def _step_infos(self) -> dict[str, np.ndarray]:
        return dict(self._last_infos)

    def _observations(self) -> np.ndarray:
        return self._last_observations.copy()

    def _physics_state(self, copy: int) -> np.ndarray:
        return self._call_copy(copy, "get_physics_state")

    def _set_physics_state(self, copy: int, state: np.ndarray) -> None:
        self._call_copy(copy, "set_physics_state", state)

    def _render_copy(self, copy: int, render_mode: str, task: np.ndarray | None) -> Any:
        return self._call_copy(copy, "render")

    def _release(self) -> None:
        self._end_groups()
        self._template.close()

    def _end_groups(self) -> None:
        for group in self._groups:
            group.close()
        self._groups = []
