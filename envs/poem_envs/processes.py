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
from collections.abc import Callable
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
    """What a copy needs to begin an episode, which is the copy's how-manieth."""

    #: None goes on with the one that it has, from which steps may have drawn.
    rng: np.random.Generator | None
    task: np.ndarray
    seed: int
    episode: int


class CopyGroup:
    """Copies of a task family that one process steps in turn, by their numbers."""

    def __init__(self) -> None:
        self.envs: dict[int, TaskFamily] = {}

    def make(
        self, make: Callable[[], TaskFamily], copies: list[int], attributes: dict[str, Any]
    ) -> None:
        self.envs = {copy: make() for copy in copies}
        for name, value in attributes.items():
            self.set_attribute(name, value)

    def send(self, method: str, *arguments: Any) -> None:
        """As :meth:`RemoteGroup.send`; the call is made when its result is asked for."""
        self._call = partial(getattr(self, method), *arguments)

    def receive(self) -> Any:
        return self._call()

    def begin(
        self, starts: dict[int, EpisodeStart]
    ) -> dict[int, tuple[np.ndarray, np.random.Generator]]:
        """Begin episodes in some copies: observations, and generators after all draws."""
        begun = {}
        for copy, start in starts.items():
            env = self.envs[copy]
            if start.rng is not None:
                env._np_random = start.rng
            env._task, env._np_random_seed = start.task, start.seed
            env._episode, env._elapsed_steps = start.episode, 0
            begun[copy] = self.call(copy, "_begin_episode", env.np_random), env.np_random
        return begun

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Step every copy: observations, reward features, early ends and further infos."""
        results, infos = [], []
        for (copy, env), action in zip(self.envs.items(), actions, strict=True):
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
                f"environment copy {copy}: {type(error).__name__}: {error}"
            ) from error

    def set_attribute(self, name: str, value: Any) -> None:
        for env in self.envs.values():
            setattr(env, name, value)

    def close(self) -> None:
        for env in self.envs.values():
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
    """What :class:`~poem_envs.TaskFamilyVector` asks of copies, of ``n`` in ``nthread`` processes,
    whose observations are of a space.
    """

    def __init__(
        self, make: Callable[[], TaskFamily], n: int, nthread: int, space: spaces.Box
    ) -> None:
        self._make = make
        # The numbers of each group's copies.
        self._copies = [own.tolist() for own in np.array_split(np.arange(n), min(nthread, n))]
        self._groups: list[CopyGroup | RemoteGroup] = []
        self._attributes: dict[str, Any] = {}
        #: The generators that copies have, as they were when their episodes had begun.
        self._drawn: dict[int, np.random.Generator] = {}
        self._last_observations = np.zeros((n, *space.shape), dtype=space.dtype)
        self._last_infos: dict[str, np.ndarray] = {}

    def set_attribute(self, name: str, value: Any) -> None:
        self._attributes[name] = value  # for copies that are made anew
        if self._groups:
            self._call("set_attribute", dict.fromkeys(range(len(self._groups)), (name, value)))

    def _start(self) -> None:
        """Start the workers; this process has the last, smallest group."""
        self._groups = [*(RemoteGroup() for _ in self._copies[1:]), CopyGroup()]
        for group, copies in zip(self._groups, self._copies, strict=True):
            group.send("make", self._make, copies, self._attributes)
        for group in reversed(self._groups):
            group.receive()

    def _call(self, method: str, arguments: dict[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Call a method of some groups, all at once; arguments and results are by group."""
        results: dict[int, Any] = {}
        failures: list[Exception] = []
        try:
            if not self._groups and method != "begin":
                raise ResetNeeded("a call of this environment was interrupted, or it closed: reset")
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
        except BaseException:  # answers under way would be taken for later ones
            self.close()
            raise
        if failures:
            raise failures[0]
        return dict(sorted(results.items()))

    def begin(self, starts: dict[int, EpisodeStart]) -> dict[int, np.random.Generator]:
        """Begin episodes of some copies, and return their generators after all draws."""
        by_group: dict[int, tuple[dict[int, EpisodeStart]]] = {}
        for group, copies in enumerate(self._copies):
            own = {copy: starts[copy] for copy in copies if copy in starts}
            for copy, start in own.items():
                if start.rng is self._drawn.get(copy):
                    own[copy] = start._replace(rng=None)
            if own:
                by_group[group] = (own,)
        for answer in self._call("begin", by_group).values():
            for copy, (observation, rng) in answer.items():
                self._last_observations[copy], self._drawn[copy] = observation, rng
        return {copy: self._drawn[copy] for copy in starts}

    def _advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Step all copies; returns reward features and early ends."""
        chunks = {group: (actions[copies],) for group, copies in enumerate(self._copies)}
        results = self._call("step", chunks).values()
        observations, features, terminated, infos = zip(*results, strict=True)
        self._last_observations = np.concatenate(observations)
        self._last_infos = {key: np.concatenate([info[key] for info in infos]) for key in infos[0]}
        return np.concatenate(features), np.concatenate(terminated)

    def _step_infos(self) -> dict[str, np.ndarray]:
        return dict(self._last_infos)

    def _observations(self) -> np.ndarray:
        return self._last_observations.copy()

    def _render_copy(self, copy: int, render_mode: str, task: np.ndarray | None) -> Any:
        group = next(group for group, copies in enumerate(self._copies) if copy in copies)
        return self._call("call", {group: (copy, "render")})[group]

    def close(self) -> None:
        for group in self._groups:
            group.close()
        self._groups, self._drawn = [], {}
