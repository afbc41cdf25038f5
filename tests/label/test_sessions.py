"""Sessions: the same questions and the same posterior, whether rendered ahead, resumed, undone or
computed anew.
"""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import load_env_creator
from label_world import make_sessions, settled

from sb3_poem import Bayes, ReturnOracle
from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.common.trajectory import Trajectory
from sb3_poem.label import rendering
from sb3_poem.label.families import ModelInfo, find_models
from sb3_poem.label.rendering import load_shown_model
from sb3_poem.label.sessions import UNWORDED, FullError, SessionManager
from sb3_poem.label.store import RefusedError, Session, Store

ANSWERS = ("left", "right", "equal")


async def begin(sessions: SessionManager) -> tuple[Session, str]:
    token = await sessions.begin("PointGoal")
    session = await sessions.find(token)
    assert session is not None
    return session, token


async def give_answers(
    sessions: SessionManager, session: Session, answers: tuple[str, ...]
) -> dict[str, Any]:
    view = await settled(sessions, session)
    for preference in answers:
        sessions.store.add_answer(session.id, view["turn"]["id"], preference)
        view = await settled(sessions, session)
    return view


def contents(
    store: Store, session: Session, number: int, kind: str = "question"
) -> tuple[Any, ...]:
    """Everything that a turn is, apart from when it was made and how its files are called."""
    turn = store.turn(session.id, kind, number)
    assert turn is not None
    row = store.whole_turn(turn["id"])
    assert row is not None
    columns = ("state", "trajectories", "belief", "latent", "fps", "frames")
    return (*(row[name] for name in columns), (store.videos / row["video"]).read_bytes())


def test_the_page_asks_what_an_adapter_asks(
    run_server: Callable[..., Any], store: Store, point_goal: ModelInfo
) -> None:
    async def life(sessions: SessionManager) -> Session:
        session, _ = await begin(sessions)
        await give_answers(sessions, session, ANSWERS)
        return session

    session = run_server(life)
    model = load_shown_model(point_goal)
    adapter = PreferenceAdapter(model, "poem/PointGoal-v0", seed=5, rule=Bayes(noise_model="infer"))
    for number, preference in enumerate(ANSWERS):
        query = adapter.ask()
        kept = contents(store, session, number)
        sides = {"left": query.left.to_dict(), "right": query.right.to_dict()}
        assert json.loads(kept[1]) == sides
        adapter.tell(preference)
    assert json.loads(contents(store, session, len(ANSWERS))[3]) == adapter.policy().latent.tolist()


@pytest.mark.parametrize(
    ("kind", "word", "n_answers"), [("pair", "right", 3), ("best-of-four", "third", 5)]
)
def test_what_follows_from_each_answer_is_rendered_ahead(
    run_server: Callable[..., Any],
    store: Store,
    point_goal: ModelInfo,
    kind: str,
    word: str,
    n_answers: int,
) -> None:
    async def life(sessions: SessionManager) -> Session:
        session, _ = await begin(sessions)
        view = await settled(sessions, session)
        assert view["question"] == kind
        first = store.videos / store.turn(session.id, "question", 0)["video"]
        ahead: set[Path] = set()
        while len(ahead) < n_answers:
            await asyncio.sleep(0.02)
            ahead = set(store.videos.glob("[0-9]*.mp4")) - {first}
        store.add_answer(session.id, view["turn"]["id"], word)
        await settled(sessions, session)
        used = store.videos / store.turn(session.id, "question", 1)["video"]
        assert used in ahead
        assert [path for path in ahead if path.exists()] == [used]
        return session

    session = run_server(life, render_ahead=True, options={"question": kind})
    rule = Bayes(question=kind, noise_model="infer")
    adapter = PreferenceAdapter(
        load_shown_model(point_goal), "poem/PointGoal-v0", seed=5, rule=rule
    )
    adapter.ask()
    adapter.tell(word)
    assert json.loads(contents(store, session, 1)[3]) == adapter.policy().latent.tolist()


def test_a_new_server_continues_at_the_same_question_with_the_same_posterior(
    run_server: Callable[..., Any], store: Store
) -> None:
    async def first_half(sessions: SessionManager) -> str:
        session, token = await begin(sessions)
        view = await give_answers(sessions, session, ANSWERS[:1])
        # The second is given, and the server ends before anything follows from it.
        sessions.store.add_answer(session.id, view["turn"]["id"], ANSWERS[1])
        return token

    token = run_server(first_half)

    async def second_half(sessions: SessionManager) -> tuple[Session, dict[str, Any]]:
        session = await sessions.find(token)
        assert session is not None
        view = await settled(sessions, session)
        assert view["answered"] == 2
        sessions.store.add_answer(session.id, view["turn"]["id"], ANSWERS[2])
        return session, await settled(sessions, session)

    resumed, view = run_server(second_half)

    async def in_one_go(sessions: SessionManager) -> tuple[Session, dict[str, Any]]:
        session, _ = await begin(sessions)
        return session, await give_answers(sessions, session, ANSWERS)

    whole, whole_view = run_server(in_one_go)
    assert view["belief"] == whole_view["belief"]
    for number in range(len(ANSWERS) + 1):
        assert contents(store, resumed, number) == contents(store, whole, number)


def test_a_session_does_not_go_on_with_a_model_of_other_weights(
    run_server: Callable[..., Any], store: Store, point_goal: ModelInfo, tmp_path: Path
) -> None:
    async def first_half(sessions: SessionManager) -> str:
        session, token = await begin(sessions)
        view = await settled(sessions, session)
        sessions.store.add_answer(session.id, view["turn"]["id"], "left")
        return token

    token = run_server(first_half)
    model = load_shown_model(point_goal)
    model.train_tasks.latent_means += 0.1
    model.save_pretrained(tmp_path / "PointGoal")

    async def second_half() -> str:
        sessions = make_sessions(store, replace(point_goal, folder=tmp_path / "PointGoal"))
        session = await sessions.find(token)
        assert session is not None
        view = await sessions.view(session)
        for _ in range(600):
            if "failed" in view:
                break
            await asyncio.sleep(0.05)
            view = await sessions.view(session)
        await sessions.queue.close()
        return view["failed"]

    assert "with a model of other weights" in asyncio.run(second_half())


def test_what_cannot_be_filmed_is_said_without_an_errors_name(
    run_server: Callable[..., Any], point_goal: ModelInfo
) -> None:
    async def life(sessions: SessionManager) -> str:
        session, _ = await begin(sessions)
        view = await sessions.view(session)
        while "failed" not in view:
            await asyncio.sleep(0.02)
            view = await sessions.view(session)
        return view["failed"]

    broken = replace(point_goal, env_kwargs=(("step_length", "far"),))
    assert run_server(life, broken) == UNWORDED


def test_undo_and_the_same_answer_lead_to_the_same_question(
    run_server: Callable[..., Any], store: Store
) -> None:
    async def life(sessions: SessionManager) -> None:
        session, _ = await begin(sessions)
        await give_answers(sessions, session, ANSWERS[:2])
        before = [contents(store, session, number) for number in range(3)]
        for answered in (2, 1):
            store.undo(session.id, answered)
        view = await settled(sessions, session)
        assert (view["answered"], view["can_undo"]) == (0, False)
        assert contents(store, session, 0) == before[0]
        await give_answers(sessions, session, ("right",))
        assert contents(store, session, 1) != before[1]
        store.undo(session.id, 1)
        await give_answers(sessions, session, ANSWERS[:2])
        assert [contents(store, session, number) for number in range(3)] == before

    run_server(life)


def test_what_follows_from_all_answers_is_read_once_and_keeps_nobody_waiting(
    run_server: Callable[..., Any], store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, threads = store.adapter_data, []

    def recorded(turn: int) -> dict[str, Any]:
        threads.append(threading.get_ident())
        return read(turn)

    monkeypatch.setattr(store, "adapter_data", recorded)

    async def life(sessions: SessionManager) -> int:
        session, _ = await begin(sessions)
        for _ in range(3):
            await settled(sessions, session)
        return threading.get_ident()

    loop = run_server(life, render_ahead=True)
    assert len(threads) == 1
    assert loop not in threads


def test_after_the_last_answer_comes_the_result_and_not_quite_asks_more(
    run_server: Callable[..., Any], store: Store
) -> None:
    async def life(sessions: SessionManager) -> None:
        session, _ = await begin(sessions)
        view = await give_answers(sessions, session, ("left", "right"))
        assert (view["phase"], view["answered"], view["target"]) == ("result", 2, 2)
        store.judge(session.id, view["turn"]["id"], "not quite")
        view = await settled(sessions, session)
        assert (view["phase"], view["target"]) == ("question", 4)
        view = await give_answers(sessions, session, ("left",))
        store.stop(session.id, 1)
        view = await settled(sessions, session)
        assert (view["phase"], view["answered"]) == ("result", 3)

    run_server(life, n_queries=2)


def test_a_video_that_was_deleted_is_filmed_again(
    run_server: Callable[..., Any], store: Store
) -> None:
    async def life(sessions: SessionManager) -> None:
        session, _ = await begin(sessions)
        view = await give_answers(sessions, session, ("left",))
        before = contents(store, session, 1)
        path = sessions.video(session, view["turn"]["id"])
        assert path is not None
        path.unlink()
        await settled(sessions, session)
        assert contents(store, session, 1) == before

    run_server(life)


def test_a_model_is_shown_in_an_environment_whose_arguments_hold_a_list() -> None:
    healthy = {"healthy_z_range": [0.2, 1.0]}
    renderer = rendering.renderer_of(find_models("AntVel", env_kwargs=healthy)[0])
    assert renderer.env.get_attr("healthy_z_range") == [[0.2, 1.0]]


def test_no_more_people_than_the_server_takes(run_server: Callable[..., Any]) -> None:
    async def life(sessions: SessionManager) -> None:
        await begin(sessions)
        with pytest.raises(FullError, match="all places of this server are taken"):
            await sessions.begin("PointGoal")
        with pytest.raises(RefusedError, match="no model"):
            await sessions.begin("../PointGoal")

    run_server(life, max_sessions=1)


@pytest.fixture
def fast_point_goal(point_goal: ModelInfo, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModelInfo]:
    """One that is drawn twenty times a second, whose films may be as short."""
    monkeypatch.setattr(rendering, "SHORTEST_FILM", 0.1)
    spec = gym.spec(point_goal.env_id)
    assert isinstance(spec.entry_point, str)
    family = load_env_creator(spec.entry_point)
    metadata = {**family.metadata, "render_fps": 20}
    entry_point = type("FastPointGoal", (family,), {"metadata": metadata})
    gym.register("test/Fast-v0", entry_point, max_episode_steps=spec.max_episode_steps)
    yield replace(point_goal, env_id="test/Fast-v0")
    del gym.registry["test/Fast-v0"]


def test_films_show_every_second_step_while_more_people_are_at_work_than_workers(
    run_server: Callable[..., Any], fast_point_goal: ModelInfo
) -> None:
    def last_ones_film(people: int) -> dict[str, Any]:
        async def life(sessions: SessionManager) -> dict[str, Any]:
            begun = [(await begin(sessions))[0] for _ in range(people)]
            return (await settled(sessions, begun[-1]))["turn"]

        return run_server(life, fast_point_goal)

    alone, crowded = last_ones_film(1), last_ones_film(2)  # of one worker
    assert (crowded["fps"], crowded["frames"]) == (alone["fps"] / 2, -(-alone["frames"] // 2))


def test_a_film_made_again_while_crowded_is_described_as_it_is(
    run_server: Callable[..., Any], fast_point_goal: ModelInfo
) -> None:
    async def life(sessions: SessionManager) -> tuple[Any, Any]:
        first, _ = await begin(sessions)
        before = (await settled(sessions, first))["turn"]
        path = sessions.video(first, before["id"])
        assert path is not None
        path.unlink()
        await begin(sessions)
        return before, (await settled(sessions, first))["turn"]

    before, after = run_server(life, fast_point_goal)
    assert (after["id"], after["fps"], after["frames"]) == (
        before["id"],
        before["fps"] / 2,
        -(-before["frames"] // 2),
    )


def test_a_contradiction_is_noticed_and_its_pair_filmed_again_as_it_was(
    run_server: Callable[..., Any], store: Store, point_goal: ModelInfo
) -> None:
    oracle = ReturnOracle(gym.make(point_goal.env_id), np.array([2.5]), thresholds=(1.0, 8.0))

    async def life(sessions: SessionManager) -> None:
        session, _ = await begin(sessions)
        view = await settled(sessions, session)
        while view["belief"]["contradicted"] is None:
            kept = contents(store, session, view["answered"])
            answer = oracle(*map(Trajectory.from_dict, json.loads(kept[1]).values())).value
            if view["answered"] == 0:
                answer = "much right" if "left" in answer else "much left"
            store.add_answer(session.id, view["turn"]["id"], answer)
            view = await settled(sessions, session)
        assert view["belief"]["contradicted"] == 0
        answered = view["answered"]
        store.ask_again(session.id, view["turn"]["id"])
        again = await settled(sessions, session)
        assert (again["answered"], again["turn"]["repeats"]) == (answered, 0)
        shown, first = contents(store, session, answered), contents(store, session, 0)
        assert (shown[1], *shown[4:]) == (first[1], *first[4:])
        film = sessions.video(session, again["turn"]["id"])
        assert film is not None
        film.unlink()
        await settled(sessions, session)
        assert contents(store, session, answered) == shown
        sides = map(Trajectory.from_dict, json.loads(shown[1]).values())
        store.add_answer(session.id, again["turn"]["id"], oracle(*sides).value)
        view = await settled(sessions, session)
        assert (view["turn"]["repeats"], view["belief"]["contradicted"]) == (None, None)

    run_server(life, options={"question": "graded"})
