"""Copies of a task family in processes: for simulators whose steps spend their time in Python,
where threads would wait.

A worker process starts with this module alone, so that user scripts need no ``if __name__ ==
"__main__"`` and no worker loads torch. What a worker does is in :class:`CopyGroup`; this process
steps a group of its own meanwhile.
"""

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import traceback
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Connection, Pipe
from typing import Any, NamedTuple

import cloudpickle
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from poem_envs.family import TaskFamily

SERVE = "from poem_envs.processes import serve; serve"


class EpisodeStart(NamedTuple):
    """What a copy, by its number, needs to begin an episode, which is the copy's how-manieth."""

    copy: int
    rng: np.random.Generator
    task: np.ndarray
    seed: int
    episode: int


class CopyGroup:
    """Copies of a task family that one process steps in turn, numbered from ``first``."""

    def __init__(self) -> None:
        self.envs: list[TaskFamily] = []

    def make(
        self, make: Callable[[], TaskFamily], n: int, first: int, attributes: dict[str, Any]
    ) -> None:
        self.envs, self.first = [make() for _ in range(n)], first
        for name, value in attributes.items():
            self.set_attribute(name, value)

    def send(self, method: str, *arguments: Any) -> None:
        """As :meth:`RemoteGroup.send`; the call is made when its result is asked for."""
        self._call = partial(getattr(self, method), *arguments)

    def receive(self) -> Any:
        return self._call()

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
        try:
            return getattr(self.envs[copy], method)(*arguments)
        except Exception as error:
            raise RuntimeError(
                f"environment copy {self.first + copy}: {type(error).__name__}: {error}"
            ) from error

    def set_attribute(self, name: str, value: Any) -> None:
        for env in self.envs:
            setattr(env, name, value)

    def close(self) -> None:
        for env in self.envs:
            env.close()


def serve(file_descriptor: int) -> None:
    """Answer a :class:`RemoteGroup`'s calls of a group's methods."""
    # Ctrl-C reaches all processes; the parent's end ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection, group = Connection(file_descriptor), CopyGroup()
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            call = connection.recv_bytes()
            answer: tuple[bool, Any]
            try:
                method, arguments = pickle.loads(call)
                answer = True, getattr(group, method)(*arguments)
            except Exception as error:
                answer = False, (str(error), traceback.format_exc())
            connection.send_bytes(cloudpickle.dumps(answer))
    group.close()


class RemoteGroup:
    """A :class:`CopyGroup` in a process of its own: calls are sent, results received."""

    def __init__(self) -> None:
        self._connection, theirs = Pipe()
        # The worker imports what the parent can import, and "" is the parent's working directory.
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"{SERVE}({theirs.fileno()})"],
            pass_fds=[theirs.fileno()],
            env={**os.environ, "PYTHONPATH": paths},
            stdin=subprocess.DEVNULL,
        )
        theirs.close()
        self.close = weakref.finalize(self, _end_worker, self._connection, self._process)

    def send(self, method: str, *arguments: Any) -> None:
        """Begin a call of a group's method."""
        try:
            self._connection.send_bytes(cloudpickle.dumps((method, arguments)))
        except (BrokenPipeError, ConnectionResetError):
            raise self._gone() from None

    def receive(self) -> Any:
        try:
            succeeded, result = pickle.loads(self._connection.recv_bytes())
        except (EOFError, ConnectionResetError):
            raise self._gone() from None
        if not succeeded:
            message, trace = result
            error = RuntimeError(message)
            error.add_note(f"In the worker process:\n{trace}")
            raise error
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


class ProcessCopies:
    """What :class:`~poem_envs.TaskFamilyVector` asks of copies, of ``n`` in ``nthread`` processes.

    :param space: of their observations
    """

    def __init__(
        self, make: Callable[[], TaskFamily], n: int, nthread: int, space: spaces.Box
    ) -> None:
        self._make, self._n = make, n
        groups = np.array_split(np.arange(n), min(nthread, n))
        self._firsts = [int(copies[0]) for copies in groups]
        # Where each copy is: its group, and its number there.
        self._places = [(group, k) for group, own in enumerate(groups) for k in range(len(own))]
        self._groups: list[CopyGroup | RemoteGroup] = []
        self._interrupted = False
        self._attributes: dict[str, Any] = {}
        self._last_observations = np.zeros((n, *space.shape), dtype=space.dtype)
        self._last_infos: dict[str, np.ndarray] = {}

    def set_attribute(self, name: str, value: Any) -> None:
        self._attributes[name] = value  # for copies that are made anew
        self._call("set_attribute", dict.fromkeys(range(len(self._firsts)), (name, value)))

    def _start(self) -> None:
        """Start the workers; this process has the last, smallest group."""
        ends = [*self._firsts[1:], self._n]
        try:
            for first, end in zip(self._firsts, ends, strict=True):
                group = CopyGroup() if end == self._n else RemoteGroup()
                self._groups.append(group)
                group.send("make", self._make, end - first, first, self._attributes)
            for group in reversed(self._groups):
                group.receive()
        except BaseException:  # the next call tries again, rather than to use what is half made
            self._release()
            raise

    def _call(self, method: str, arguments: dict[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Call a method of some groups, all at once; arguments and results are by group."""
        if self._interrupted and method != "begin":
            raise ResetNeeded(
                "a call of this environment was interrupted, and left its copies in the middle of "
                "it; reset it"
            )
        results: dict[int, Any] = {}
        failures: list[Exception] = []
        try:
            if not self._groups:
                self._start()
            for index in arguments:
                self._groups[index].send(method, *arguments[index])
            # This process's own first: the others work meanwhile. All of them even if one failed:
            # none may be left over.
            for index in sorted(arguments, reverse=True):
                try:
                    results[index] = self._groups[index].receive()
                except Exception as problem:
                    failures.append(problem)
        except Exception:
            raise
        except BaseException:  # answers under way would be taken for later ones
            self._release()
            self._interrupted = True
            raise
        if failures:
            raise failures[0]
        self._interrupted = False
        return results

    def begin(self, starts: Sequence[EpisodeStart]) -> dict[int, np.random.Generator]:
        """Begin episodes of some copies, and return their generators after all draws."""
        by_group: dict[int, list[EpisodeStart]] = {}
        for start in starts:
            group, place = self._places[start.copy]
            by_group.setdefault(group, []).append(start._replace(copy=place))
        results = self._call("begin", {group: (own,) for group, own in by_group.items()})
        drawn: dict[int, np.random.Generator] = {}
        for group, answer in results.items():
            for start, observation, rng in zip(by_group[group], *answer, strict=True):
                copy = self._firsts[group] + start.copy
                self._last_observations[copy], drawn[copy] = observation, rng
        return drawn

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Step all copies; returns reward features and early ends."""
        chunks = np.split(actions, self._firsts[1:])
        results = self._call("step", {index: (chunk,) for index, chunk in enumerate(chunks)})
        in_order = [results[index] for index in sorted(results)]
        observations, features, terminated, infos = zip(*in_order, strict=True)
        self._last_observations = np.concatenate(observations)
        self._last_infos = {key: np.concatenate([info[key] for info in infos]) for key in infos[0]}
        return np.concatenate(features), np.concatenate(terminated)

    def _step_infos(self) -> dict[str, np.ndarray]:
        return dict(self._last_infos)

    def _observations(self) -> np.ndarray:
        return self._last_observations.copy()

    def _render_copy(self, copy: int, render_mode: str, task: np.ndarray | None) -> Any:
        group, place = self._places[copy]
        return self._call("call", {group: (place, "render")})[group]

    def _release(self) -> None:
        for group in self._groups:
            group.close()
        self._groups = []
