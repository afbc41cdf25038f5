"""Where turns are made: a few workers, what somebody waits for first, what may be wanted next in
the time that is left.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import multiprocessing
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from typing import Any

from sb3_poem.label.catalogue import Choice
from sb3_poem.label.turns import BENCHES, NotWantedError, Request, Turn, bench_of, make_turn

_logger = logging.getLogger(__name__)

#: Urgencies: somebody waits; likely to be wanted next; possibly.
WAITED_FOR, LIKELY, POSSIBLE = 0, 1, 2
# A worker that dies (say the system ran out of memory) is replaced, and its turn made once more.
ATTEMPTS = 2


@dataclass(eq=False)
class Job:
    """A turn that is being made, or will be.

    :param request: What from.
    :param urgency: The smaller, the sooner.
    :param done: Its turn, when it is there.
    """

    request: Request
    urgency: int
    order: int
    done: asyncio.Future[Turn] = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )
    running: bool = False
    discarded: bool = False


class Workshop:
    """Makes turns on an executor, in the order of their urgency. All methods belong to one event
    loop.

    :param n_workers: How many turns are made at a time.
    :param make_executor: Makes the executor; None takes processes.
    :param make: What a worker does.
    """

    def __init__(
        self,
        n_workers: int = 2,
        make_executor: Callable[[], Executor] | None = None,
        make: Callable[[Request], Turn] = make_turn,
    ) -> None:
        self.n_workers = n_workers
        self._make_executor = make_executor or (lambda: process_pool(n_workers))
        self._make = make
        self._executor: Executor | None = None
        self._waiting: list[Job] = []
        self._running: set[asyncio.Task[None]] = set()
        self._count = itertools.count()
        self._closed = False

    def prepare(self) -> None:
        """Start the workers now, so that the first person does not wait for it."""
        if self._executor is None:
            self._executor = self._make_executor()
        for _ in range(self.n_workers):
            self._executor.submit(_nothing)

    def submit(self, request: Request, urgency: int) -> Job:
        """Have a turn made.

        :param request: What from.
        :param urgency: See above.
        :return: The job.
        """
        job = Job(request, urgency, next(self._count))
        self._waiting.append(job)
        self._start_jobs()
        return job

    def hurry(self, job: Job) -> None:
        """Somebody waits for a job now."""
        job.urgency = WAITED_FOR

    def discard(self, job: Job) -> None:
        """Nobody will want a job's turn: do not start it, or stop it soon, and delete its video."""
        job.discarded = True
        if job in self._waiting:
            self._waiting.remove(job)
            job.done.cancel()
        elif job.done.done():
            job.request.video.unlink(missing_ok=True)
        else:
            job.request.marker.unlink(missing_ok=True)

    @property
    def n_waiting(self) -> int:
        """How many jobs have not been started."""
        return len(self._waiting)

    async def close(self) -> None:
        """Start nothing any more, and end the workers once they have made what they are at."""
        self._closed = True
        for job in self._waiting:
            job.done.cancel()
        self._waiting.clear()
        for task in self._running:
            task.cancel()
        if self._executor is not None:
            await asyncio.to_thread(self._executor.shutdown, wait=True, cancel_futures=True)

    def _start_jobs(self) -> None:
        while self._waiting and len(self._running) < self.n_workers and not self._closed:
            job = min(self._waiting, key=lambda job: (job.urgency, job.order))
            self._waiting.remove(job)
            job.running = True
            task = asyncio.get_running_loop().create_task(self._run(job))
            self._running.add(task)
            task.add_done_callback(self._finished)

    def _finished(self, task: asyncio.Task[None]) -> None:
        self._running.discard(task)
        self._start_jobs()

    async def _run(self, job: Job) -> None:
        try:
            job.request.marker.touch()
            turn = await self._attempt(job.request)
        except asyncio.CancelledError:
            job.done.cancel()
            raise
        except NotWantedError:
            job.done.cancel()
            return
        except Exception as error:
            _logger.error(
                "a %s of %s could not be made: %r",
                job.request.wanted,
                job.request.choice.name,
                error,
            )
            if not job.done.done():
                job.done.set_exception(error)
                job.done.exception()  # somebody may wait for it or not
            return
        finally:
            job.request.marker.unlink(missing_ok=True)
        if job.discarded:
            job.request.video.unlink(missing_ok=True)
        if not job.done.done():
            job.done.set_result(turn)

    async def _attempt(self, request: Request) -> Turn:
        for attempt in range(ATTEMPTS):
            if self._executor is None:
                self._executor = self._make_executor()
            executor = self._executor
            try:
                return await asyncio.get_running_loop().run_in_executor(
                    executor, self._make, request
                )
            except BrokenProcessPool:
                if self._executor is executor:
                    self._executor = None
                if attempt + 1 == ATTEMPTS:
                    raise
                _logger.warning("a worker process ended unexpectedly; starting another")
        raise AssertionError("unreachable")


def process_pool(
    n_workers: int, choices: Sequence[Choice] = (), packages: Sequence[str] = ()
) -> ProcessPoolExecutor:
    """Worker processes that end with this one, even if it is killed.

    :param n_workers: How many.
    :param choices: Models that they load at once.
    :param packages: Modules that register environments; they import these first.
    :return: The pool.
    """
    context: Any = multiprocessing.get_context("spawn")
    arguments = (tuple(choices), tuple(packages))
    return ProcessPoolExecutor(
        n_workers, mp_context=context, initializer=_begin_worker, initargs=arguments
    )


def _nothing() -> None:
    pass


def _begin_worker(choices: tuple[Choice, ...], packages: tuple[str, ...]) -> None:
    import importlib
    import signal

    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent says when to stop
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    for package in packages:
        importlib.import_module(package)
    for choice in choices[:BENCHES]:
        try:
            bench_of(choice).warm_up()
        except Exception as error:  # the session that chooses it says so; the others go on
            _logger.error("the model %s cannot be shown: %r", choice.name, error)
