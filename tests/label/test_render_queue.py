"""The render queue: what nobody wants any more makes room."""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import cast

import gymnasium
import numpy as np
import pytest

from sb3_poem.common.trajectory import Trajectory
from sb3_poem.label import render_queue
from sb3_poem.label.families import ModelInfo
from sb3_poem.label.render_queue import Priority, RenderQueue, process_pool
from sb3_poem.label.rendering import (
    FilmedVecEnv,
    RenderCancelledError,
    Turn,
    TurnRequest,
    film_rate,
    make_turn,
    renderer_of,
)

TURN = Turn(None, None, None, None, 20.0, 1)


def request(info: ModelInfo, folder: Path, name: str) -> TurnRequest:
    return TurnRequest(info, 5, {}, "question", folder / f"{name}.mp4")


def test_a_turn_that_nobody_wants_any_more_is_stopped_for_the_next(
    point_goal: ModelInfo, tmp_path: Path
) -> None:
    started = threading.Event()

    def make(wanted: TurnRequest) -> Turn:
        if wanted.video.stem == "next":
            return TURN
        started.set()
        deadline = time.monotonic() + 30.0
        while wanted.marker.exists():  # a turn that would take half a minute
            assert time.monotonic() < deadline, "nobody stopped this turn"
            time.sleep(0.005)
        raise RenderCancelledError

    async def life() -> None:
        queue = RenderQueue(1, lambda: ThreadPoolExecutor(1), make)
        unwanted = queue.submit(request(point_goal, tmp_path, "unwanted"), Priority.LIKELY)
        following = queue.submit(request(point_goal, tmp_path, "next"), Priority.WAITED_FOR)
        await asyncio.to_thread(started.wait, 10.0)
        assert not following.done.done()
        queue.cancel(unwanted)
        assert await asyncio.wait_for(following.done, 10.0) is TURN
        assert unwanted.done.cancelled()
        await queue.close()

    asyncio.run(life())
    assert not list(tmp_path.iterdir())


def hang_the_first_time(wanted: TurnRequest) -> Turn:
    """Made in a worker process."""
    tried = wanted.video.with_suffix(".tried")
    if not tried.exists():
        tried.touch()
        time.sleep(60.0)
    return TURN


def test_a_worker_that_hangs_is_replaced(
    point_goal: ModelInfo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(render_queue, "LONGEST_SECONDS", 0.3)

    async def life() -> None:
        queue = RenderQueue(1, lambda: ProcessPoolExecutor(1), hang_the_first_time)
        job = queue.submit(request(point_goal, tmp_path, "turn"), Priority.WAITED_FOR)
        assert await asyncio.wait_for(job.done, 20.0) == TURN
        await queue.close()

    asyncio.run(life())
    assert (tmp_path / "turn.tried").exists()


def test_rendering_ends_when_the_marker_is_taken_away(
    point_goal: ModelInfo, tmp_path: Path
) -> None:
    env = renderer_of(point_goal).env
    env.reset()
    marker = tmp_path / "turn.wanted"
    marker.touch()
    env.marker = marker
    clip = Trajectory(np.zeros((2, 2)), np.zeros((1, 2)), np.zeros(1), frames=env.get_images() * 2)
    assert len(env.films(clip)) == 2
    marker.unlink()
    for film in (env.get_images, lambda: env.films(clip)):
        with pytest.raises(RenderCancelledError):
            film()
    env.marker = None
    assert len(env.films(clip)) == 2


def test_a_worker_leaves_a_turn_whose_marker_goes(
    point_goal: ModelInfo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = request(point_goal, tmp_path, "turn")
    images = 0
    record = FilmedVecEnv.get_images

    def record_and_lose_interest(env: FilmedVecEnv) -> object:
        nonlocal images
        images += 1
        if images == 3:
            wanted.marker.unlink()
        return record(env)

    monkeypatch.setattr(FilmedVecEnv, "get_images", record_and_lose_interest)
    wanted.marker.touch()
    with pytest.raises(RenderCancelledError):
        make_turn(wanted)
    assert images == 3
    assert not list(tmp_path.iterdir())
    with pytest.raises(RenderCancelledError):  # nor does it begin one that has none any more
        make_turn(wanted)
    assert images == 4
    wanted.marker.touch()
    turn = make_turn(wanted)  # made to the end, in the same environment
    assert cast(int, turn.frames) > 3
    assert wanted.video.is_file()


@pytest.mark.parametrize(
    ("fps", "steps", "alone", "crowded"),
    [
        (10, 25, (1, 8.0), (1, 8.0)),  # PointGoal
        (20, 200, (1, 20.0), (2, 10.0)),  # Ant and HalfCheetah, as fast as they are
        (25, 50, (1, 10.0), (1, 10.0)),  # Fetch
        (67, 200, (3, 40 / 3), (3, 40 / 3)),  # Humanoid, which else were over in three seconds
        (80, 200, (3, 40 / 3), (3, 40 / 3)),  # Meta-World
        (80, 2000, (5, 16.0), (10, 8.0)),
    ],
)
def test_films_last_five_seconds_and_show_enough_frames_a_second(
    fps: int, steps: int, alone: tuple[int, float], crowded: tuple[int, float]
) -> None:
    assert [film_rate(fps, steps, wanted) for wanted in (1, 2)] == [alone, crowded]


def test_workers_know_the_packages_that_register_environments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "walk_package.py").write_text(
        "import gymnasium\ngymnasium.register('Strolling-v0', entry_point=dict)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with process_pool(1, packages=["walk_package"]) as pool:
        assert pool.submit(gymnasium.spec, "Strolling-v0").result(60).id == "Strolling-v0"
