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

from poem_envs.family import Symmetry, TaskFamily
from poem_envs.vector import TaskFamilyVector, available_cores


class EpisodeStart(NamedTuple):
    """What a copy needs to begin an episode as a single environment would."""

    copy: int
    rng: np.random.Generator
    task: np.ndarray
    seed: int
    episode: int


class GroupStep(NamedTuple):
    """A step of a group: observations, reward features, early ends, and further infos, a row for
    each of its copies.
    """

    observations: np.ndarray
    features: np.ndarray
    terminated: np.ndarray
    infos: dict[str, np.ndarray]


class CopyGroup:
    """Copies of a task family that one process steps in turn.

    :param envs: the copies
    :param first: the number of the first one among the copies of all groups, for messages
    """

    def __init__(self, envs: Sequence[TaskFamily], first: int) -> None:
        self.envs = list(envs)
        self.first = first

    def begin(
        self, starts: Sequence[EpisodeStart]
    ) -> tuple[list[np.ndarray], list[np.random.Generator]]:
        """Begin episodes in some copies; returns their observations, and their generators after all
        draws.
        """
        observations = []
        for start in starts:
            env = self.envs[start.copy]
            env._task, env._np_random_seed = start.task, start.seed
            env._episode, env._elapsed_steps = start.episode, 0
            observations.append(self.call(start.copy, "_begin_episode", start.rng))
        return observations, [start.rng for start in starts]

    def step(self, actions: np.ndarray) -> GroupStep:
        """Step every copy, ``(copies, action_dim)``."""
        results, infos = [], []
        for copy, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            env._elapsed_steps += 1
            results.append(self.call(copy, "_simulate", action))
            infos.append(env._step_info())
        observations, features, terminated = zip(*results, strict=True)
        return GroupStep(
            np.stack(observations),
            np.stack(features),
            np.array(terminated, dtype=bool),
            {key: np.stack([info[key] for info in infos]) for key in infos[0]},
        )

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
    """The traceback of an error in a worker process, as text; the cause of the error that is raised
    for it.
    """

    def __str__(self) -> str:
        return "\n" + str(self.args[0])


class RemoteGroup:
    """A :class:`CopyGroup` in a process of its own: calls are sent, and their results received
    later.

    :param make: what makes the copies there, pickled by ``cloudpickle``
    :param first: the number of the first copy
    """

    def __init__(self, make: bytes, first: int) -> None:
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
        self._end = weakref.finalize(self, _end_worker, self._connection, self._process)
        self.send("__init__", make, first)

    def send(self, method: str, *arguments: Any) -> None:
        """Begin a call of a group's method."""
        try:
            self._connection.send_bytes(cloudpickle.dumps((method, arguments)))
        except (BrokenPipeError, ConnectionResetError):
            raise RuntimeError(self._gone()) from None

    def receive(self) -> Any:
        """The result of the oldest call that is under way.

        :raises RuntimeError: if the call failed, or the worker is gone
        """
        try:
            succeeded, result = pickle.loads(self._connection.recv_bytes())
        except (EOFError, ConnectionResetError):
            raise RuntimeError(self._gone()) from None
        if not succeeded:
            message, trace = result
            raise RuntimeError(message) from WorkerError(trace)
        return result

    def close(self) -> None:
        """End the worker."""
        self._end()

    def _gone(self) -> str:
        status = self._process.wait()
        return f"a worker process of the environment ended with exit status {status} (negative: the signal that ended it)"


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

        gym.register("my/Walk-v0", Walk1D, vector_entry_point=functools.partial(ProcessFamilyVector, Walk1D), ...)

    :param family: a :class:`~poem_envs.TaskFamily` class, or a function that makes such an
        environment
    :param num_envs: number of copies
    :param nthread: number of processes; None for as many as this process may use cores
    :param max_episode_steps: episodes are truncated after so many steps; None for as many as a
        :class:`GoalFamily`'s environment has, or never
    :param render_mode: as the family has them; ``"human"`` for one copy only
    :param render_task: whether rendering shows the hidden tasks
    :param family_kwargs: further arguments of the family
    :raises TypeError: if what ``family`` makes is no task family
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
        if nthread is not None and nthread < 1:
            raise ValueError(f"nthread={nthread!r} must be at least 1, or None for all cores")
        if render_mode is not None:
            family_kwargs["render_mode"] = render_mode
        if render_task:
            family_kwargs["render_task"] = render_task
        self._make = functools.partial(family, **family_kwargs)
        self._nthread = available_cores() if nthread is None else nthread
        self._groups: list[CopyGroup | RemoteGroup] = []
        self._interrupted = False
        self._attributes: dict[str, Any] = {}
        self._template = self._make()
        if not isinstance(self._template, TaskFamily):
            raise TypeError(
                f"family={family!r} makes a {type(self._template).__name__}, but it must make a poem_envs.TaskFamily"
            )
        self.metadata = {**self._template.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}
        if max_episode_steps is None:
            max_episode_steps = getattr(self._template, "max_episode_steps", None)
        self._copy_definition()
        observation_space, action_space = (
            self._template.observation_space,
            self._template.action_space,
        )
        assert isinstance(observation_space, spaces.Box)
        assert isinstance(action_space, spaces.Box)
        super().__init__(
            observation_space=observation_space,
            action_space=action_space,
            num_envs=num_envs,
            max_episode_steps=max_episode_steps,
            render_mode=render_mode,
            render_task=render_task,
            split=self._template.split,
        )

    def _copy_definition(self) -> None:
        family = self._template
        self.task_space, self.all_tasks = family.task_space, family.all_tasks
        self.reward_feature_dim, self.shared_dynamics = (
            family.reward_feature_dim,
            family.shared_dynamics,
        )
        self.splits = family.splits

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(
            self._template, name
        )  # what a family has of its own, as a single environment does

    def set_attribute(self, name: str, value: Any) -> None:
        setattr(self._template, name, value)
        self._attributes[name] = value  # for copies that are made anew
        self._call("set_attribute", {index: (name, value) for index in range(len(self._sizes))})
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

    @property
    def symmetries(self) -> tuple[Symmetry, ...]:  # type: ignore[override]
        return self._template.symmetries

    def _checked_tasks(self, tasks: npt.ArrayLike, shape: tuple[int, ...], name: str) -> np.ndarray:
        return self._template._checked_tasks(tasks, shape, name)

    def _allocate(self, n: int) -> None:
        chunks = np.array_split(np.arange(n), min(self._nthread, n))
        # Which copies each group has: (group, number within the group) of every copy.
        self._places = [
            (group, place) for group, chunk in enumerate(chunks) for place in range(len(chunk))
        ]
        self._firsts = [int(chunk[0]) for chunk in chunks]
        self._sizes = [len(chunk) for chunk in chunks]
        space = self._template.observation_space
        assert space.shape is not None
        self._last_observations = np.zeros((n, *space.shape), dtype=space.dtype)
        self._last_infos: dict[str, np.ndarray] = {}

    def _start(self) -> None:
        """Start the workers; this process has the last, smallest group."""
        try:
            for index, (first, size) in enumerate(zip(self._firsts, self._sizes, strict=True)):
                make = functools.partial(_make_copies, self._make, size, self._attributes)
                last = index == len(self._sizes) - 1
                self._groups.append(
                    CopyGroup(make(), first)
                    if last
                    else RemoteGroup(cloudpickle.dumps(make), first)
                )
            self._receive({index: None for index in range(len(self._groups) - 1)})
        except BaseException:  # the next call tries again, rather than to use what is half made
            self._end_groups()
            raise

    def _receive(self, local: dict[int, Any]) -> dict[int, Any]:
        """Collect the results of a call to the groups in ``local``, all of them even if one failed:
        none may be left over.
        """
        results: dict[int, Any] = {}
        failure: Exception | None = None
        for index, result in local.items():
            group = self._groups[index]
            try:
                results[index] = group.receive() if isinstance(group, RemoteGroup) else result
                if isinstance(results[index], Exception):
                    raise results[index]
            except Exception as error:
                failure = failure or error
        if failure is not None:
            raise failure
        return results

    def _call(self, method: str, arguments: dict[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Call a method of some groups, all at once.

        :param method: its name
        :param arguments: by the number of the group
        :return: results by the number of the group
        """
        if self._interrupted and method != "begin":
            raise ResetNeeded(
                "a call of this environment was interrupted, and left its copies in the middle of it; reset it"
            )
        try:
            if not self._groups:
                self._start()
            local: dict[int, Any] = dict.fromkeys(arguments)
            for index in sorted(
                arguments
            ):  # this process's own group is the last, so that the others work meanwhile
                group = self._groups[index]
                if isinstance(group, RemoteGroup):
                    group.send(method, *arguments[index])
                else:
                    try:
                        local[index] = getattr(group, method)(*arguments[index])
                    except Exception as error:
                        local[index] = error
            results = self._receive(local)
        except Exception:
            raise
        except BaseException:  # Ctrl-C: answers may be under way, or half read, and would be taken for those of later calls
            self._end_groups()
            self._interrupted = True
            raise
        self._interrupted = False
        return results

    def _call_copy(self, copy: int, method: str, *arguments: Any) -> Any:
        group, place = self._places[copy]
        return self._call("call", {group: (place, method, *arguments)})[group]

    def _begin_episodes(self, copies: np.ndarray, rngs: Sequence[np.random.Generator]) -> None:
        assert self._tasks is not None
        starts: dict[int, list[EpisodeStart]] = {}
        members: dict[int, list[int]] = {}
        for copy, rng in zip(copies.tolist(), rngs, strict=True):
            group, place = self._places[copy]
            start = EpisodeStart(
                place, rng, self._tasks[copy].copy(), self._seeds[copy], int(self._episodes[copy])
            )
            starts.setdefault(group, []).append(start)
            members.setdefault(group, []).append(copy)
        results = self._call(
            "begin", {group: (group_starts,) for group, group_starts in starts.items()}
        )
        for group, (observations, generators) in results.items():
            for copy, observation, generator in zip(
                members[group], observations, generators, strict=True
            ):
                self._last_observations[copy] = observation
                self._rngs[copy] = generator  # which has drawn, in another process

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        chunks = np.split(actions, self._firsts[1:])
        results = self._call("step", {index: (chunk,) for index, chunk in enumerate(chunks)})
        steps: list[GroupStep] = [results[index] for index in range(len(chunks))]
        self._last_observations = np.concatenate([step.observations for step in steps])
        self._last_infos = {
            key: np.concatenate([step.infos[key] for step in steps]) for key in steps[0].infos
        }
        return np.concatenate([step.features for step in steps]), np.concatenate(
            [step.terminated for step in steps]
        )

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


def _make_copies(
    make: Callable[[], TaskFamily], n: int, attributes: dict[str, Any]
) -> list[TaskFamily]:
    envs = [make() for _ in range(n)]
    for env in envs:
        for name, value in attributes.items():
            setattr(env, name, value)
    return envs
