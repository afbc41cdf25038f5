"""Conversations: the same questions and the same posterior, whether rendered ahead, resumed, undone
or computed anew.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from label_world import make_conversations, settled

from sb3_poem.adaptation.adapter import PreferenceAdapter
from sb3_poem.adaptation.noise import MistakeNoise
from sb3_poem.label import turns
from sb3_poem.label.catalogue import Choice
from sb3_poem.label.sessions import Conversations, FullError
from sb3_poem.label.store import RefusedError, Session, Store
from sb3_poem.label.turns import load_choice

ANSWERS = ("left", "right", "equal", "left")


async def begin(conversations: Conversations) -> tuple[Session, str]:
    token = await conversations.begin("PointGoal")
    session = await conversations.find(token)
    assert session is not None
    return session, token


async def talk_through(
    conversations: Conversations, session: Session, answers: tuple[str, ...]
) -> dict[str, Any]:
    view = await settled(conversations, session)
    for preference in answers:
        await conversations.answer(session, view["turn"]["id"], preference)
        view = await settled(conversations, session)
    return view


def contents(
    store: Store, session: Session, number: int, kind: str = "question"
) -> tuple[Any, ...]:
    """Everything that a turn is, apart from when it was made and how its files are called."""
    turn = store.turn(session.id, kind, number)
    assert turn is not None
    row = store.whole_turn(turn["id"])
    assert row is not None
    columns = ("state", "left_trajectory", "right_trajectory", "belief", "latent", "fps", "frames")
    return (*(row[name] for name in columns), (store.videos / row["video"]).read_bytes())


def test_the_page_asks_what_an_adapter_asks(
    with_conversations: Callable[..., Any], store: Store, point_goal: Choice
) -> None:
    async def talk(conversations: Conversations) -> Session:
        session, _ = await begin(conversations)
        await talk_through(conversations, session, ANSWERS)
        return session

    session = with_conversations(talk)
    model = load_choice(point_goal)
    adapter = PreferenceAdapter(model, "poem/PointGoal-v0", seed=5, noise_model=MistakeNoise(0.05))
    for number, preference in enumerate(ANSWERS):
        query = adapter.ask()
        kept = contents(store, session, number)
        assert json.loads(kept[1]) == query.left.to_dict()
        assert json.loads(kept[2]) == query.right.to_dict()
        adapter.tell(preference)
    assert json.loads(contents(store, session, len(ANSWERS))[4]) == adapter.policy().latent.tolist()


def test_a_new_server_continues_at_the_same_question_with_the_same_posterior(
    with_conversations: Callable[..., Any], store: Store
) -> None:
    async def first_half(conversations: Conversations) -> str:
        session, token = await begin(conversations)
        view = await talk_through(conversations, session, ANSWERS[:2])
        # The third is given, and the server ends before anything follows from it.
        await conversations.answer(session, view["turn"]["id"], ANSWERS[2])
        return token

    token = with_conversations(first_half)

    async def second_half(conversations: Conversations) -> tuple[Session, dict[str, Any]]:
        session = await conversations.find(token)
        assert session is not None
        view = await settled(conversations, session)
        assert view["answered"] == 3
        await conversations.answer(session, view["turn"]["id"], ANSWERS[3])
        return session, await settled(conversations, session)

    resumed, view = with_conversations(second_half)

    async def in_one_go(conversations: Conversations) -> tuple[Session, dict[str, Any]]:
        session, _ = await begin(conversations)
        return session, await talk_through(conversations, session, ANSWERS)

    whole, whole_view = with_conversations(in_one_go)
    assert view["belief"] == whole_view["belief"]
    for number in range(len(ANSWERS) + 1):
        assert contents(store, resumed, number) == contents(store, whole, number)


def test_a_session_does_not_go_on_with_a_model_of_other_weights(
    with_conversations: Callable[..., Any], store: Store, point_goal: Choice, tmp_path: Path
) -> None:
    async def first_half(conversations: Conversations) -> str:
        session, token = await begin(conversations)
        view = await settled(conversations, session)
        await conversations.answer(session, view["turn"]["id"], "left")
        return token

    token = with_conversations(first_half)
    model = load_choice(point_goal)
    model.train_tasks.latent_means += 0.1
    model.save_pretrained(tmp_path / "PointGoal")

    async def second_half() -> str:
        conversations = make_conversations(
            store, replace(point_goal, folder=tmp_path / "PointGoal")
        )
        session = await conversations.find(token)
        assert session is not None
        view = await conversations.view(session)
        for _ in range(600):
            if "failed" in view:
                break
            await asyncio.sleep(0.05)
            view = await conversations.view(session)
        await conversations.workshop.close()
        return view["failed"]

    assert "with a model of other weights" in asyncio.run(second_half())


def test_undo_and_the_same_answer_lead_to_the_same_question(
    with_conversations: Callable[..., Any], store: Store
) -> None:
    async def talk(conversations: Conversations) -> None:
        session, _ = await begin(conversations)
        await talk_through(conversations, session, ANSWERS)
        before = [contents(store, session, number) for number in range(5)]
        for answered in (4, 3, 2, 1):
            store.undo(session.id, answered)
        view = await settled(conversations, session)
        assert (view["answered"], view["can_undo"]) == (0, False)
        assert contents(store, session, 0) == before[0]
        await talk_through(conversations, session, ("right",))
        assert contents(store, session, 1) != before[1]
        store.undo(session.id, 1)
        await talk_through(conversations, session, ANSWERS)
        assert [contents(store, session, number) for number in range(5)] == before

    with_conversations(talk)


def test_the_likely_next_pairs_are_rendered_ahead(
    with_conversations: Callable[..., Any], store: Store
) -> None:
    async def talk(conversations: Conversations) -> None:
        session, _ = await begin(conversations)
        view = await settled(conversations, session)
        jobs = conversations._present[session.id].jobs
        assert {key[1] for key in jobs} == {"left", "right", "equal"}
        ahead = {key[1]: job for key, job in jobs.items()}
        await asyncio.gather(*(job.done for job in ahead.values()))
        await conversations.answer(session, view["turn"]["id"], "right")
        await settled(conversations, session)
        turn = store.turn(session.id, "question", 1)
        assert turn is not None
        assert (
            turn["video"] == ahead["right"].request.video.name
        )  # what was rendered ahead, not another
        assert not ahead["left"].request.video.exists()

    with_conversations(talk, ahead=True)


def test_after_the_last_answer_comes_the_result_and_not_quite_asks_more(
    with_conversations: Callable[..., Any], store: Store
) -> None:
    async def talk(conversations: Conversations) -> None:
        session, _ = await begin(conversations)
        view = await talk_through(conversations, session, ("left", "right"))
        assert (view["phase"], view["answered"], view["target"]) == ("result", 2, 2)
        store.judge(session.id, view["turn"]["id"], "not quite")
        view = await settled(conversations, session)
        assert (view["phase"], view["target"]) == ("question", 4)
        view = await talk_through(conversations, session, ("left",))
        store.stop(session.id)
        view = await settled(conversations, session)
        assert (view["phase"], view["answered"]) == ("result", 3)

    with_conversations(talk, n_queries=2)


def test_a_video_that_was_deleted_is_filmed_again(
    with_conversations: Callable[..., Any], store: Store
) -> None:
    async def talk(conversations: Conversations) -> None:
        session, _ = await begin(conversations)
        view = await talk_through(conversations, session, ("left",))
        before = contents(store, session, 1)
        path = conversations.video(session, view["turn"]["id"])
        assert path is not None
        path.unlink()
        await settled(conversations, session)
        assert contents(store, session, 1) == before

    with_conversations(talk)


def test_no_more_people_than_the_server_takes(with_conversations: Callable[..., Any]) -> None:
    async def talk(conversations: Conversations) -> None:
        await begin(conversations)
        with pytest.raises(FullError, match="1 people"):
            await conversations.begin("PointGoal")
        with pytest.raises(RefusedError, match="no model"):
            await conversations.begin("../PointGoal")

    with_conversations(talk, max_sessions=1)


def test_films_show_every_second_step_while_more_people_are_at_work_than_workers(
    with_conversations: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(turns, "SMOOTH_FPS", 2.0)

    def last_ones_film(people: int) -> dict[str, Any]:
        async def talk(conversations: Conversations) -> dict[str, Any]:
            sessions = [(await begin(conversations))[0] for _ in range(people)]
            return (await settled(conversations, sessions[-1]))["turn"]

        return with_conversations(talk)

    alone, crowded = last_ones_film(1), last_ones_film(2)  # of one worker
    assert (crowded["fps"], crowded["frames"]) == (alone["fps"] / 2, -(-alone["frames"] // 2))


def test_a_film_made_again_while_crowded_is_described_as_it_is(
    with_conversations: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(turns, "SMOOTH_FPS", 2.0)

    async def talk(conversations: Conversations) -> tuple[Any, Any]:
        first, _ = await begin(conversations)
        before = (await settled(conversations, first))["turn"]
        path = conversations.video(first, before["id"])
        assert path is not None
        path.unlink()
        await begin(conversations)
        return before, (await settled(conversations, first))["turn"]

    before, after = with_conversations(talk)
    assert (after["id"], after["fps"], after["frames"]) == (
        before["id"],
        before["fps"] / 2,
        -(-before["frames"] // 2),
    )
