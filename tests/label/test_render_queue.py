"""The render queue: what nobody wants any more makes room."""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import cast

import gymnasium
import pytest

from sb3_poem.label.families import ModelInfo
from sb3_poem.label.render_queue import Priority, RenderQueue, process_pool
from sb3_poem.label.rendering import (
    CancellableRendering,
    RenderCancelledError,
    Turn,
    TurnRequest,
    film_every,
    make_env,
    make_turn,
)

TURN = Turn(None, None, None, None, None, 20.0, 1)


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


def test_rendering_ends_when_the_marker_is_taken_away(
    point_goal: ModelInfo, tmp_path: Path
) -> None:
    env = CancellableRendering(make_env(point_goal.env_id))
    env.reset(seed=0)
    marker = tmp_path / "turn.wanted"
    marker.touch()
    env.render_while(marker)
    assert env.render().ndim == 3
    marker.unlink()
    with pytest.raises(RenderCancelledError):
        env.render()
    env.render_while(None)
    assert env.render().ndim == 3


def test_a_worker_leaves_a_turn_whose_marker_goes(
    point_goal: ModelInfo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = request(point_goal, tmp_path, "turn")
    images = 0
    render = CancellableRendering.render

    def render_and_lose_interest(env: CancellableRendering) -> object:
        nonlocal images
        images += 1
        if images == 3:
            wanted.marker.unlink()
        return render(env)

    monkeypatch.setattr(CancellableRendering, "render", render_and_lose_interest)
    wanted.marker.touch()
    with pytest.raises(RenderCancelledError):
        make_turn(wanted)
    assert images == 3
    assert not list(tmp_path.iterdir())
    turn = make_turn(wanted)  # nobody keeps a marker: made to the end, in the same environment
    assert cast(int, turn.frames) > 3
    assert wanted.video.is_file()


@pytest.mark.parametrize(
    ("fps", "alone", "crowded"), [(10, 1, 1), (20, 1, 2), (25, 1, 2), (80, 4, 8)]
)
def test_films_show_about_twenty_frames_a_second(fps: int, alone: int, crowded: int) -> None:
    assert [film_every(fps, wanted) for wanted in (1, 2)] == [alone, crowded]


def test_workers_know_the_packages_that_register_environments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "walk_package.py").write_text(
        "import gymnasium\ngymnasium.register('Strolling-v0', entry_point=dict)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with process_pool(1, packages=["walk_package"]) as pool:
        assert pool.submit(gymnasium.spec, "Strolling-v0").result(60).id == "Strolling-v0"
