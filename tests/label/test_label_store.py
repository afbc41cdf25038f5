"""The store: what is answered stays, in order, whatever happens."""

from __future__ import annotations

import multiprocessing
import os
import sqlite3
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from sb3_poem.label.rendering import Turn
from sb3_poem.label.store import RefusedError, Store

SHOWN = {"left": {"observations": None}, "right": {"observations": [1e-300, 0.1]}}


def turn() -> Turn:
    return Turn({"n": 1}, SHOWN, {"sentence": "x"}, [0.0], 20.0, 5)


def begin(store: Store, step: int = 10, **options: str) -> tuple[int, str]:
    session, token = store.create_session("M", "poem/PointGoal-v0", 1, options, step)
    assert store.add_turn(session.id, "question", 0, None, turn(), "0.mp4")
    return session.id, token


def answer(store: Store, session: int, preference: str) -> int:
    """Answer the question that waits, and pose the next."""
    number = len(store.answers(session))
    question = store.turn(session, "question", number)
    assert question is not None
    given = store.add_answer(session, question["id"], preference)
    assert store.add_turn(session, "question", number + 1, given, turn(), f"{number + 1}.mp4")
    return int(question["id"])


def preferences(store: Store, session: int) -> list[str]:
    return [row["preference"] for row in store.answers(session)]


def test_a_session_is_found_by_its_token_alone_and_the_file_does_not_hold_it(store: Store) -> None:
    session, token = begin(store)
    assert len(token) >= 40
    found = store.find(token)
    assert found is not None
    assert found.id == session
    for wrong in ("", token[:-1], token + "A", token.swapcase(), "' OR 1=1 --", "\x00"):
        assert store.find(wrong) is None
    store.close()
    content = b"".join(file.read_bytes() for file in store.folder.glob("answers.sqlite*"))
    assert token.encode() not in content
    assert store.path.stat().st_mode & 0o077 == 0


def test_repeated_answers_count_once_and_late_ones_are_refused(store: Store) -> None:
    session, _ = begin(store)
    first = answer(store, session, "left")
    store.add_answer(session, first, "left")
    assert preferences(store, session) == ["left"]
    with pytest.raises(RefusedError, match="not the one that waits"):
        store.add_answer(session, first, "right")
    other, _ = begin(store)
    waiting = store.turn(other, "question", 0)
    assert waiting is not None
    for no_question in (waiting["id"], 10**9):  # another session's question, and nobody's
        with pytest.raises(RefusedError, match="not the one that waits"):
            store.add_answer(session, no_question, "left")
    assert preferences(store, session) == ["left"]


def test_graded_questions_take_five_answers_and_pairs_three(store: Store) -> None:
    session, _ = begin(store, question="graded")
    words = ["much left", "left", "equal", "right", "much right"]
    for word in words:
        answer(store, session, word)
    assert preferences(store, session) == words
    pairs, _ = begin(store)
    with pytest.raises(RefusedError, match=r"graded question .*\"much right\", but is 'better'"):
        answer(store, session, "better")
    with pytest.raises(RefusedError, match=r"a pair question .* 'much left', which only graded"):
        answer(store, pairs, "much left")


def test_the_best_of_four_takes_five_answers(store: Store) -> None:
    session, _ = begin(store, question="best-of-four")
    words = ["first", "second", "third", "fourth", "equal"]
    for word in words:
        answer(store, session, word)
    assert preferences(store, session) == words
    with pytest.raises(RefusedError, match=r"'left', which only pair and graded questions have"):
        answer(store, session, "left")


def test_undo_goes_back_to_the_first_question_and_keeps_a_record(store: Store) -> None:
    session, _ = begin(store)
    for preference in ("left", "right", "equal"):
        answer(store, session, preference)
    for answered in (3, 2, 1):
        store.undo(session, answered)
        with pytest.raises(RefusedError, match="moved on"):
            store.undo(session, answered)  # a second click on the same button
    with pytest.raises(RefusedError, match="no answer to take back"):
        store.undo(session, 0)
    assert preferences(store, session) == []
    answer(store, session, "right")
    assert preferences(store, session) == ["right"]
    rows = list(store.records())
    assert [(row["preference"], row["undone"] is not None) for row in rows] == [
        ("left", True),
        ("right", True),
        ("equal", True),
        ("right", False),
    ]


def test_a_turn_made_for_an_answer_that_was_taken_back_is_not_kept(store: Store) -> None:
    session, _ = begin(store)
    question = store.turn(session, "question", 0)
    assert question is not None
    given = store.add_answer(session, question["id"], "left")
    store.undo(session, 1)
    again = store.add_answer(session, question["id"], "right")
    assert not store.add_turn(session, "question", 1, given, turn(), "late.mp4")
    assert store.add_turn(session, "question", 1, again, turn(), "new.mp4")
    (store.videos / "new.mp4").touch()
    assert not store.add_turn(session, "question", 1, again, turn(), "twice.mp4")


def test_the_target_the_stop_and_the_verdict(store: Store) -> None:
    session, _ = begin(store, step=2)
    answer(store, session, "left")
    store.stop(session, 1)
    waiting = store.turn(session, "question", 1)
    assert waiting is not None
    with pytest.raises(RefusedError, match="over for now"):
        store.add_answer(session, waiting["id"], "left")
    for _ in range(2):  # back to the questions; no answer is lost, though it is sent twice
        store.stop(session, 0)
    assert preferences(store, session) == ["left"]
    answer(store, session, "right")
    last = store.turn(session, "question", 2)
    assert last is not None
    with pytest.raises(RefusedError, match="over for now"):
        store.add_answer(session, last["id"], "left")
    given = store.answers(session)[-1]["id"]
    assert store.add_turn(session, "result", 2, given, turn(), "result.mp4")
    result = store.turn(session, "result", 2)
    assert result is not None
    with pytest.raises(RefusedError, match="not the one that is shown"):
        store.judge(session, last["id"], "yes")
    store.judge(session, result["id"], "not quite")
    assert store.session(session).target == 4
    with pytest.raises(RefusedError, match="not the one that is shown"):
        store.judge(session, result["id"], "not quite")  # a repeated click asks for no more
    assert store.session(session).target == 4
    answer(store, session, "left")
    store.stop(session, 1)
    store.undo(session, 3)
    assert not store.session(session).stopped  # its question waits again


@pytest.mark.parametrize("version", [3, 99])
def test_other_versions_are_refused(tmp_path: Path, version: int) -> None:
    store = Store(tmp_path)
    store.close()
    with sqlite3.connect(store.path) as connection:
        connection.execute(f"PRAGMA user_version = {version}")
    with pytest.raises(ValueError, match=f"a store of version {version}, .* reads version 4"):
        Store(tmp_path)


def test_videos_without_a_turn_are_removed(store: Store) -> None:
    begin(store)
    for name in ("0.mp4", "orphan.mp4", ".writing-x.mp4"):
        (store.videos / name).write_bytes(b"x")
        os.utime(store.videos / name, (0, 0))
    (store.videos / "new.mp4").write_bytes(b"x")  # another process is about to add its turn
    assert store.remove_orphans() == 2
    assert {file.name for file in store.videos.iterdir()} == {"0.mp4", "new.mp4"}


def answer_without_end(folder: Path, said: Connection) -> None:
    store = Store(folder)
    session, _ = begin(store, step=10**6)
    for n in range(10**6):
        preference = ("left", "right", "equal")[n % 3]
        answer(store, session, preference)
        said.send(preference)


def test_a_kill_loses_no_answer(tmp_path: Path) -> None:
    fork = multiprocessing.get_context("fork")
    receiver, sender = fork.Pipe(duplex=False)
    process = fork.Process(target=answer_without_end, args=(tmp_path, sender), daemon=True)
    process.start()
    said = [receiver.recv() for _ in range(40)]
    process.kill()
    process.join()
    while receiver.poll():
        said.append(receiver.recv())
    store = Store(tmp_path)
    kept = preferences(store, 1)
    store.close()
    assert said[:40] == (["left", "right", "equal"] * 14)[:40]
    assert kept[: len(said)] == said
    assert len(kept) <= len(said) + 1  # the one that was kept and not yet said


def test_a_contradicted_answers_pair_is_asked_about_once_more(store: Store) -> None:
    session, _ = begin(store, question="graded")
    films = [answer(store, session, word) for word in ("left", "much left")]
    waiting = store.turn(session, "question", 2)
    assert waiting is not None
    with pytest.raises(RefusedError, match="no answer is contradicted"):
        store.ask_again(session, waiting["id"])
    store.undo(session, 2)
    contradicted = replace(turn(), belief={"contradicted": 0}, shown={"left": {"new": True}})
    given = store.add_answer(session, films[1], "much right")
    waiting = store.add_turn(session, "question", 2, given, contradicted, "new.mp4")
    assert waiting is not None
    for _ in range(2):  # what is sent twice counts once
        store.ask_again(session, waiting)
    again = store.turn(session, "question", 2)
    assert again is not None
    assert (again["repeats"], again["video"]) == (0, "0.mp4")
    data, first = store.adapter_data(again["id"]), store.whole_turn(films[0])
    assert data["pending"] == SHOWN
    assert data["state"] == {"n": 1}
    assert first is not None
    with pytest.raises(RefusedError, match="not the one that waits"):
        store.add_answer(session, waiting, "left")
    with pytest.raises(RefusedError, match="moved on"):
        store.ask_again(begin(store)[0], waiting)
    answer(store, session, "right")
    assert [row["repeats"] for row in store.records()] == [None, None, None, 0]
    store.undo(session, 3)
    assert store.turn(session, "question", 2)["repeats"] == 0  # it waits again
    store.undo(session, 2)
    assert store.turn(session, "question", 2) is None
