"""The workshop: what nobody wants any more makes room."""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import cast

import gymnasium
import pytest

from sb3_poem.label.catalogue import Choice
from sb3_poem.label.turns import (
    Bench,
    NotWantedError,
    Request,
    Turn,
    _RendersWhileWanted,
    make_env,
    make_turn,
)
from sb3_poem.label.workshop import LIKELY, WAITED_FOR, Workshop, process_pool

TURN = Turn(None, None, None, None, None, 20.0, 1)


def request(choice: Choice, folder: Path, name: str) -> Request:
    return Request(choice, 5, {}, "question", folder / f"{name}.mp4")


def test_a_turn_that_nobody_wants_any_more_is_stopped_for_the_next(
    point_goal: Choice, tmp_path: Path
) -> None:
    started = threading.Event()

    def make(wanted: Request) -> Turn:
        if wanted.video.stem == "next":
            return TURN
        started.set()
        deadline = time.monotonic() + 30.0
        while wanted.marker.exists():  # a turn that would take half a minute
            assert time.monotonic() < deadline, "nobody stopped this turn"
            time.sleep(0.005)
        raise NotWantedError

    async def talk() -> None:
        workshop = Workshop(1, lambda: ThreadPoolExecutor(1), make)
        unwanted = workshop.submit(request(point_goal, tmp_path, "unwanted"), LIKELY)
        following = workshop.submit(request(point_goal, tmp_path, "next"), WAITED_FOR)
        await asyncio.to_thread(started.wait, 10.0)
        assert not following.done.done()
        workshop.discard(unwanted)
        assert await asyncio.wait_for(following.done, 10.0) is TURN
        assert unwanted.done.cancelled()
        await workshop.close()

    asyncio.run(talk())
    assert not list(tmp_path.iterdir())


def test_rendering_ends_when_the_marker_is_taken_away(point_goal: Choice, tmp_path: Path) -> None:
    env = _RendersWhileWanted(make_env(point_goal.env_id, {}))
    env.reset(seed=0)
    marker = tmp_path / "turn.wanted"
    marker.touch()
    env.render_while(marker)
    assert env.render().ndim == 3
    marker.unlink()
    with pytest.raises(NotWantedError):
        env.render()
    env.render_while(None)
    assert env.render().ndim == 3


def test_a_worker_leaves_a_turn_whose_marker_goes(
    point_goal: Choice, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = request(point_goal, tmp_path, "turn")
    images = 0
    render = _RendersWhileWanted.render

    def render_and_lose_interest(env: _RendersWhileWanted) -> object:
        nonlocal images
        images += 1
        if images == 3:
            wanted.marker.unlink()
        return render(env)

    monkeypatch.setattr(_RendersWhileWanted, "render", render_and_lose_interest)
    wanted.marker.touch()
    with pytest.raises(NotWantedError):
        make_turn(wanted)
    assert images == 3
    assert not list(tmp_path.iterdir())
    turn = make_turn(wanted)  # nobody keeps a marker: made to the end, in the same environment
    assert cast(int, turn.frames) > 3
    assert wanted.video.is_file()


@pytest.mark.parametrize(
    ("fps", "alone", "crowded"), [(10, 1, 1), (20, 1, 2), (25, 1, 2), (80, 4, 8)]
)
def test_films_show_about_twenty_frames_a_second(
    point_goal: Choice, tmp_path: Path, fps: int, alone: int, crowded: int
) -> None:
    bench = object.__new__(Bench)
    bench.fps = float(fps)
    wanted = request(point_goal, tmp_path, "turn")
    assert [bench._film_every(replace(wanted, film_every=every)) for every in (1, 2)] == [
        alone,
        crowded,
    ]


def test_workers_know_the_packages_that_register_environments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "walk_package.py").write_text(
        "import gymnasium\ngymnasium.register('Strolling-v0', entry_point=dict)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with process_pool(1, packages=["walk_package"]) as pool:
        assert pool.submit(gymnasium.spec, "Strolling-v0").result(60).id == "Strolling-v0"
