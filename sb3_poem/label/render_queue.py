"""The queue of turns to render: what somebody waits for first, then what may be wanted next."""

import asyncio
import faulthandler
import importlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from enum import IntEnum
from functools import partial

import torch as th

from sb3_poem.label.families import ModelInfo
from sb3_poem.label.rendering import (
    MAX_RENDERERS,
    RenderCancelledError,
    Turn,
    TurnRequest,
    make_turn,
    renderer_of,
)

_logger = logging.getLogger(__name__)

# A worker that dies (say the system ran out of memory) is replaced, and its turn made once more.
ATTEMPTS = 2
# So long a worker process may take for a turn, many times what any needs, before it counts as hung
# and ends.
LONGEST_SECONDS = 180.0


class Priority(IntEnum):
    """The smaller, the sooner."""

    WAITED_FOR = 0
    LIKELY = 1
    POSSIBLE = 2


@dataclass(eq=False)
class Job:
    """A turn that is being made, or will be, unless ``done`` is cancelled; its priority may change
    while it waits.
    """

    request: TurnRequest
    priority: Priority
    done: asyncio.Future[Turn] = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )


class RenderQueue:
    """Makes turns on an executor, by priority; belongs to one event loop."""

    def __init__(
        self,
        n_workers: int,
        make_executor: Callable[[], Executor],
        make: Callable[[TurnRequest], Turn] = make_turn,
    ) -> None:
        self.n_workers = n_workers
        self._make_executor, self._make = make_executor, make
        self._executor = make_executor()
        self._waiting: list[Job] = []
        self._running: set[asyncio.Task[None]] = set()
        self._closed = False

    def prepare(self) -> None:
        """Start the workers now, so that the first person does not wait for it."""
        for _ in range(self.n_workers):
            self._executor.submit(os.getpid)

    def submit(self, request: TurnRequest, priority: Priority) -> Job:
        job = Job(request, priority)
        self._waiting.append(job)
        self._start_jobs()
        return job

    def cancel(self, job: Job) -> None:
        """Nobody will want a job's turn: do not start it, or stop it soon, and delete its video."""
        if not job.done.cancel():  # it is made
            job.request.video.unlink(missing_ok=True)
        elif job in self._waiting:
            self._waiting.remove(job)
        else:
            job.request.marker.unlink(missing_ok=True)

    async def close(self) -> None:
        """Start nothing any more, and end the workers once they have made what they are at."""
        self._closed = True
        for job in self._waiting:
            job.done.cancel()
        self._waiting.clear()
        for task in self._running:
            task.cancel()
        await asyncio.to_thread(self._executor.shutdown, wait=True, cancel_futures=True)

    def _start_jobs(self) -> None:
        while self._waiting and len(self._running) < self.n_workers and not self._closed:
            job = min(self._waiting, key=lambda job: job.priority)  # of several the first
            self._waiting.remove(job)
            task = asyncio.create_task(self._run(job))
            self._running.add(task)
            task.add_done_callback(self._finished)

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._running.discard(task)
        self._start_jobs()

    async def _run(self, job: Job) -> None:
        request = job.request
        try:
            request.marker.touch()
            turn = await self._attempt(request)
        except (asyncio.CancelledError, RenderCancelledError):
            job.done.cancel()
            return
        except Exception as error:
            words = "a %s of %s could not be made: %r"
            _logger.error(words, request.kind, request.model.name, error)
            if not job.done.done():
                job.done.set_exception(error)
                job.done.exception()  # somebody may wait for it or not
            return
        finally:
            request.marker.unlink(missing_ok=True)
        if job.done.cancelled():
            request.video.unlink(missing_ok=True)
        else:
            job.done.set_result(turn)

    async def _attempt(self, request: TurnRequest, attempts: int = ATTEMPTS) -> Turn:
        executor, make = self._executor, self._make
        if isinstance(executor, ProcessPoolExecutor):
            make = partial(make_or_end, make, LONGEST_SECONDS)
        try:
            return await asyncio.get_running_loop().run_in_executor(executor, make, request)
        except BrokenProcessPool:
            if self._executor is executor:
                self._executor = self._make_executor()
            if attempts == 1:
                raise
        _logger.warning("a worker process ended unexpectedly; starting another")
        return await self._attempt(request, attempts - 1)


def make_or_end(make: Callable[[TurnRequest], Turn], seconds: float, request: TurnRequest) -> Turn:
    """Make a turn, or end this process, whatever it hangs in, and say where."""
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        return make(request)
    finally:
        faulthandler.cancel_dump_traceback_later()


def process_pool(
    n_workers: int, models: Sequence[ModelInfo] = (), packages: Sequence[str] = ()
) -> ProcessPoolExecutor:
    """Worker processes, which end with this one, import ``packages``, and load ``models``."""
    spawn, about = multiprocessing.get_context("spawn"), (tuple(models), tuple(packages))
    return ProcessPoolExecutor(n_workers, spawn, _begin_worker, about)


def _begin_worker(models: tuple[ModelInfo, ...], packages: tuple[str, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent says when to stop
    th.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    for package in packages:
        importlib.import_module(package)
    for info in models[:MAX_RENDERERS]:
        try:
            renderer_of(info).warm_up()
        except Exception as error:  # the session that chooses it says so; the others go on
            _logger.error("the model %s cannot be shown: %r", info.name, error)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
