"""The server over HTTP: what it answers, and what a hostile client gets."""

from __future__ import annotations

import sqlite3
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import numpy as np
import pytest
from label_world import make_sessions
from starlette.testclient import TestClient

from sb3_poem import Bayes
from sb3_poem.adaptation.noise import MistakeNoise
from sb3_poem.adaptation.paper import Paper
from sb3_poem.adaptation.policy import AdaptedPolicy
from sb3_poem.adaptation.rule import Rule
from sb3_poem.cli.arguments import build_parser
from sb3_poem.cli.label import page_options
from sb3_poem.label.access import MAX_BODY, PAUSE_AFTER_WRONG_PASSWORD, Access, is_loopback
from sb3_poem.label.families import ModelInfo
from sb3_poem.label.rendering import session_rule
from sb3_poem.label.server import PAGE, make_app
from sb3_poem.label.store import Store

HOST = "http://localhost"


@pytest.fixture(scope="module")
def served(
    tmp_path_factory: pytest.TempPathFactory, point_goal: ModelInfo
) -> Iterator[tuple[TestClient, Store]]:
    store = Store(tmp_path_factory.mktemp("served"))
    app = make_app(make_sessions(store, point_goal, n_queries=3, max_sessions=30))
    with TestClient(app, base_url=HOST, follow_redirects=False) as client:
        yield client, store
    store.close()


@pytest.fixture(scope="module")
def shared(served: tuple[TestClient, Store]) -> str:
    """One session for many requests that must not change it."""
    return begin(served[0])


def begin(client: TestClient) -> str:
    response = client.post("/start", data={"model": "PointGoal"})
    assert response.status_code == 303
    return response.headers["location"]


def settled(client: TestClient, session: str) -> dict[str, Any]:
    for _ in range(1500):
        view = client.get(f"{session}/state").json()
        if view["phase"] != "preparing":
            return view
        time.sleep(0.02)
    raise AssertionError("nothing was shown")


def test_a_whole_conversation(served: tuple[TestClient, Store], tmp_path: Path) -> None:
    client, store = served
    assert "A dot that goes to a place" in client.get("/").text
    session = begin(client)
    assert client.get(session).status_code == 200
    assert client.post(f"{session}/wish", json={"wish": "to the <b>right</b>"}).status_code == 200
    for number, preference in enumerate(("left", "equal", "right")):
        view = settled(client, session)
        assert (view["phase"], view["answered"], view["target"]) == ("question", number, 3)
        assert [given["preference"] for given in view["answers"]] == ["left", "equal"][:number]
        for given in view["answers"]:
            assert client.get(f"{session}/video/{given['question']}").status_code == 200
        assert len(view["belief"]["points"]) == len(view["belief"]["weights"])
        video = client.get(f"{session}/video/{view['turn']['id']}")
        assert video.headers["content-type"] == "video/mp4"
        assert video.content[4:8] == b"ftyp"
        assert (
            client.get(
                f"{session}/video/{view['turn']['id']}", headers={"Range": "bytes=0-9"}
            ).status_code
            == 206
        )
        client.post(
            f"{session}/answer", json={"question": view["turn"]["id"], "preference": preference}
        )
    view = settled(client, session)
    assert view["phase"] == "result"
    response = client.post(
        f"{session}/verdict", json={"result": view["turn"]["id"], "verdict": "yes"}
    )
    assert response.json()["turn"]["verdict"] == "yes"
    assert "&lt;b&gt;right" in client.get(session).text

    answers = client.get(f"{session}/answers.json")
    assert "attachment" in answers.headers["content-disposition"]
    record = answers.json()
    assert record["wish"] == "to the <b>right</b>"
    assert [answer["preference"] for answer in record["answers"]] == ["left", "equal", "right"]
    assert str(tmp_path.parent) not in answers.text  # no path of this machine

    policy = AdaptedPolicy.from_bytes(client.get(f"{session}/policy.safetensors").content)
    assert policy.model.env_id == "poem/PointGoal-v0"
    direction, _ = policy.predict(np.zeros(2))
    assert direction.shape == (2,)
    with sqlite3.connect(store.path) as connection:
        found = store.find(session.removeprefix("/s/"))
        assert found is not None
        connection.execute("update sessions set model = 'Other' where id = ?", (found.id,))
    refused = client.get(f"{session}/policy.safetensors")
    assert (refused.status_code, "needs the model 'Other'" in refused.text) == (409, True)


def test_wrong_tokens_find_nothing(served: tuple[TestClient, Store]) -> None:
    client, _ = served
    session = begin(client)
    token = session.removeprefix("/s/")
    wrong = (token + "x", token[::-1], "x", "a" * 5000, "%00", "..%2f" + token, "*")
    for path in (
        *wrong,
        *(f"{token[:-1]}{rest}" for rest in ("", "/state", "/answers.json", "/video/1")),
        f"{token[:-1]}/policy.safetensors",
    ):
        assert client.get(f"/s/{path}").status_code == 404, path
    assert client.post(f"/s/{token[:-1]}/stop", json={}).status_code == 404


def test_one_session_does_not_see_anothers_video(served: tuple[TestClient, Store]) -> None:
    client, _ = served
    mine, other = begin(client), begin(client)
    turn = settled(client, other)["turn"]["id"]
    assert client.get(f"{other}/video/{turn}").status_code == 200
    assert client.get(f"{mine}/video/{turn}").status_code == 404
    assert (
        client.post(f"{mine}/answer", json={"question": turn, "preference": "left"}).status_code
        == 409
    )


@pytest.mark.parametrize(
    "path",
    [
        *(
            "/static/%2e%2e/start.html",
            "/static/..%2f..%2fstore.py",
            "/static/%2fetc/passwd",
        ),
        *("/static/....//....//etc/passwd", "//etc/passwd", "/static/", "/answers.sqlite", "/.env"),
    ],
)
def test_no_path_leads_out(served: tuple[TestClient, Store], path: str) -> None:
    response = served[0].get(path)
    assert response.status_code in (404, 405)
    assert "root:" not in response.text


def test_video_numbers_that_are_names_lead_nowhere(served: tuple[TestClient, Store]) -> None:
    client, _ = served
    session = begin(client)
    for name in (
        "../../answers.sqlite",
        "..%2f..%2fanswers.sqlite",
        "1.mp4",
        "-1",
        "%2fetc%2fpasswd",
        "9" * 20,
        "9" * 5000,
        "%d9%a1",
    ):
        assert client.get(f"{session}/video/{name}").status_code == 404, name


def test_repeated_late_and_contradicting_posts(served: tuple[TestClient, Store]) -> None:
    client, store = served
    session = begin(client)
    question = settled(client, session)["turn"]["id"]
    body = {"question": question, "preference": "left"}
    for _ in range(3):
        assert client.post(f"{session}/answer", json=body).status_code == 200
    assert settled(client, session)["answered"] == 1
    assert client.post(f"{session}/answer", json={**body, "preference": "right"}).status_code == 409
    assert (
        client.post(f"{session}/answer", json={**body, "question": question + 1000}).status_code
        == 409
    )
    assert client.post(f"{session}/undo", json={"answered": 2}).status_code == 409
    assert client.post(f"{session}/undo", json={"answered": 1}).status_code == 200
    assert client.post(f"{session}/undo", json={"answered": 1}).status_code == 409
    assert (
        client.post(f"{session}/verdict", json={"result": question, "verdict": "yes"}).status_code
        == 409
    )
    found = store.find(session.removeprefix("/s/"))
    assert found is not None
    assert store.answers(found.id) == []


@pytest.mark.parametrize(
    ("content", "kind", "status"),
    [
        (b"{}", "application/json", 400),
        (b"[]", "application/json", 400),
        (b"null", "application/json", 400),
        (b"{", "application/json", 400),
        (b"\xff\xfe", "application/json", 400),
        (b"[" * 8000, "application/json", 400),
        (b'{"question": 1}', "application/json", 400),
        (b'{"question": "1", "preference": "left"}', "application/json", 400),
        (b'{"question": true, "preference": "left"}', "application/json", 400),
        (b'{"question": 1e400, "preference": "left"}', "application/json", 400),
        (b'{"question": -1, "preference": "left"}', "application/json", 400),
        (b'{"question": 99999999999999999999999, "preference": "left"}', "application/json", 400),
        (b'{"question": 1, "preference": ["left"]}', "application/json", 400),
        (b'{"question": 1, "preference": "left", "more": 1}', "application/json", 400),
        (b'{"question": ' + b"9" * 5000 + b', "preference": "left"}', "application/json", 400),
        (b'{"question": 1, "preference": "\\ud800"}', "application/json", 400),
        (b'{"question": 1, "preference": "middle"}', "application/json", 409),
        (b'{"question": 1, "preference": "left"}', "text/plain", 415),
        (b"question=1&preference=left", "application/x-www-form-urlencoded", 415),
    ],
)
def test_bodies_that_are_no_answer(
    served: tuple[TestClient, Store], shared: str, content: bytes, kind: str, status: int
) -> None:
    client, store = served
    response = client.post(f"{shared}/answer", content=content, headers={"Content-Type": kind})
    assert response.status_code == status
    found = store.find(shared.removeprefix("/s/"))
    assert found is not None
    assert store.answers(found.id) == []


def test_huge_bodies_are_refused_declared_or_not(
    served: tuple[TestClient, Store], shared: str
) -> None:
    client, _ = served
    assert client.post(f"{shared}/wish", json={"wish": "x" * MAX_BODY}).status_code == 413
    assert client.post(f"{shared}/wish", json={"wish": "x" * 2001}).status_code == 409
    assert client.post(f"{shared}/wish", json={"wish": "é" * 2000}).status_code == 200
    assert client.post(f"{shared}/wish", json={"wish": "\U0001f600"}).status_code == 200
    for half in (b"\\ud800", b"\\udfff", b"\xed\xa0\x80"):
        content = b'{"wish": "' + half + b'"}'
        response = client.post(
            f"{shared}/wish", content=content, headers={"Content-Type": "application/json"}
        )
        assert (response.status_code, "half a character" in response.text) == (400, True)
    assert (
        client.post(f"{shared}/wish", content=b"{}", headers={"Content-Length": "-5"}).status_code
        == 413
    )
    for length in (b"9" * 5000, b"\xb2", b"+1", b"0x1"):
        response = client.post(f"{shared}/wish", content=b"{}", headers={b"Content-Length": length})
        assert response.status_code == 413
    assert client.post(f"{shared}/wish", content=iter([b"{}"])).status_code == 411
    # A length that is said beside it does not count, as HTTP has it.
    both = {"Content-Length": "2", "Transfer-Encoding": "chunked"}
    assert client.post(f"{shared}/wish", content=b"{}", headers=both).status_code == 411


def test_other_sites_cannot_post_and_other_names_are_not_answered(
    served: tuple[TestClient, Store], shared: str
) -> None:
    client, _ = served
    for headers in (
        {"Origin": "https://evil.example"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Origin": "null"},
        {"Origin": "http://["},
    ):
        assert (
            client.post("/start", data={"model": "PointGoal"}, headers=headers).status_code == 403
        )
        assert client.post(f"{shared}/stop", json={}, headers=headers).status_code == 403
    assert client.get("/", headers={"Host": "evil.example"}).status_code == 421
    assert client.get("/", headers={"Host": "127.0.0.1:7860"}).status_code == 200
    assert (
        client.post("/start", data={"model": "PointGoal"}, headers={"Origin": HOST}).status_code
        == 303
    )


def test_unknown_models_are_refused_and_no_path_is_one(served: tuple[TestClient, Store]) -> None:
    client, _ = served
    for name in (
        "",
        "Nobody",
        "../PointGoal",
        "/etc/passwd",
        "pretrained/PointGoal",
        "PointGoal\x00",
    ):
        assert client.post("/start", data={"model": name}).status_code == 409


def test_instructions_come_before_the_first_question(store: Store, point_goal: ModelInfo) -> None:
    text = "# Before you begin\n\nThink of *one* place. <script>alert(1)</script>"
    app = make_app(make_sessions(store, point_goal), instructions=text)
    with TestClient(app, base_url=HOST, follow_redirects=False) as client:
        page = begin(client)
        session = page.removesuffix("/instructions")
        assert page != session
        told = client.get(page).text
        assert "<h1>Before you begin</h1>" in told
        assert "Think of <em>one</em> place." in told
        assert "<script" not in told
        assert f'href="{session}"' in told  # onwards
        # The first question is made meanwhile; the page itself has not asked for it.
        found = store.find(session.rpartition("/")[2])
        assert found is not None
        for _ in range(1500):
            turn = store.turn(found.id, "question", 0)
            if turn is not None:
                break
            time.sleep(0.02)
        assert turn is not None
        assert turn["shown"] is None
        assert settled(client, session)["turn"]["id"] == turn["id"]
        assert f'href="{page}"' in client.get(session).text  # and back to read again


def test_without_instructions_the_first_question_comes_at_once(
    served: tuple[TestClient, Store],
) -> None:
    client, _ = served
    session = begin(client)
    assert "nstructions" not in client.get(session).text
    assert client.get(f"{session}/instructions").status_code == 404


def test_pages_load_nothing_from_elsewhere(served: tuple[TestClient, Store], shared: str) -> None:
    client, _ = served
    files = [file for file in PAGE.rglob("*.*") if file.suffix != ".webp"]
    assert {file.suffix for file in files} == {".html", ".css", ".js", ".svg"}
    for file in files:
        text = file.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "http://" not in text, file
        assert "https://" not in text, file
    response = client.get(shared)
    policy = response.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self';" in policy
    assert "frame-ancestors 'none'" in policy
    assert response.headers["cache-control"] == "no-store"
    assert response.headers["x-content-type-options"] == "nosniff"


@pytest.fixture
def guarded(store: Store, point_goal: ModelInfo) -> Iterator[TestClient]:
    access = Access(user="ann", password="a long password", token="t" * 32)
    with TestClient(
        make_app(make_sessions(store, point_goal), access), base_url=HOST, follow_redirects=False
    ) as client:
        yield client


def test_a_password_or_a_token_is_asked_for(guarded: TestClient) -> None:
    for path in ("/", "/static/style.css", "/s/x", "/s/x/state"):
        response = guarded.get(path)
        assert response.status_code == 401
        assert response.headers["www-authenticate"].startswith("Basic")
    assert guarded.get("/", auth=("ann", "a long password")).status_code == 200
    entry = guarded.get("/?token=" + "t" * 32)
    assert entry.status_code == 303
    assert entry.headers["location"] == "/"
    assert "httponly" in entry.headers["set-cookie"].lower()
    assert (
        "samesite=lax" in entry.headers["set-cookie"].lower()
    )  # a browser keeps a strict one back after a click elsewhere
    assert guarded.get("/").status_code == 200  # the client keeps the cookie


def test_who_guesses_waits(guarded: TestClient) -> None:
    guesses: list[tuple[str, list[tuple[bytes, bytes]]]] = [
        ("/", [(b"authorization", b"Basic YW5uOndyb25n")]),  # ann:wrong
        ("/", [(b"authorization", b"Basic %%%")]),
        ("/", [(b"authorization", b"Basic \xe9\xff")]),
        ("/", [(b"authorization", b"\xff")]),
        ("/?token=wrong", []),
        ("/?%74oken=" + "9" * 5000, []),
        ("/", [(b"cookie", b"sb3_poem_access_80=wrong")]),
    ]

    def guess(given: tuple[str, list[tuple[bytes, bytes]]]) -> tuple[int, bool]:
        begun = time.monotonic()
        status = guarded.get(given[0], headers=given[1]).status_code
        return status, time.monotonic() - begun >= PAUSE_AFTER_WRONG_PASSWORD

    with ThreadPoolExecutor(len(guesses)) as all_at_once:
        assert [*all_at_once.map(guess, guesses)] == [(401, True)] * len(guesses)


@pytest.mark.parametrize(
    "path",
    [
        "//evil.example/",
        "///evil.example/",
        "/%2Fevil.example/",
        "/%5Cevil.example/",
        "/%09/evil.example",
    ],
)
def test_a_token_leads_to_no_other_site(guarded: TestClient, path: str) -> None:
    entry = guarded.get(f"{HOST}{path}?token=" + "t" * 32)
    assert entry.status_code == 303
    assert urlsplit(urljoin(HOST, entry.headers["location"])).netloc == "localhost"


def test_two_servers_of_one_host_keep_their_cookies(store: Store, point_goal: ModelInfo) -> None:
    jar = ""
    clients = []
    for port, token in ((7860, "a" * 32), (7861, "b" * 32)):
        app = make_app(make_sessions(store, point_goal), Access(token=token))
        clients.append(TestClient(app, base_url=f"{HOST}:{port}", follow_redirects=False))
        jar += clients[-1].get(f"/?token={token}").headers["set-cookie"].partition(";")[0] + "; "
        clients[-1].cookies.clear()
    assert [client.get("/").status_code for client in clients] == [401, 401]
    assert [client.get("/", headers={"Cookie": jar}).status_code for client in clients] == [
        200,
        200,
    ]


def test_no_redirect_names_a_scheme(served: tuple[TestClient, Store], shared: str) -> None:
    client, _ = served
    for path in ("/static", f"{shared}/", "/start/"):
        assert client.get(path).status_code == 404  # behind a proxy with TLS it would name http://


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("127.0.0.1", True),
        ("127.8.9.1", True),
        ("localhost", True),
        ("::1", True),
        ("0.0.0.0", False),
        ("192.168.1.4", False),
    ],
)
def test_loopback(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_a_browser_gets_pages_where_something_is_refused(
    store: Store, point_goal: ModelInfo
) -> None:
    app = make_app(make_sessions(store, point_goal, max_sessions=1))
    with TestClient(app, base_url=HOST, headers={"Accept": "text/html,*/*;q=0.8"}) as client:
        begun = client.post("/start", data={"model": "PointGoal"}, follow_redirects=False)
        full = client.post("/start", data={"model": "PointGoal"})
        lost, nowhere = client.get("/s/lost"), client.get("/nowhere")
        unknown = client.post("/start", data={"model": "R2D2"})
    assert (begun.status_code, full.status_code, unknown.status_code) == (303, 503, 409)
    assert (lost.status_code, nowhere.status_code) == (404, 404)
    for response, words in (
        (full, "all places of this server are taken (1)"),
        (lost, "no conversation under this link"),
        (nowhere, "There is nothing here"),
        (unknown, "choose one from the list"),
    ):
        assert words in response.text
        assert '<a href="/">Choose a robot</a>' in response.text
        assert response.headers["content-type"] == "text/html; charset=utf-8"


@pytest.mark.parametrize(
    ("words", "rule", "buttons"),
    [
        ([], Bayes(question="graded", noise_model="infer"), 5),
        (["--question", "pair"], Bayes(noise_model="infer"), 3),
        (["--question", "best-of-four"], Bayes(question="best-of-four", noise_model="infer"), 5),
        (["--mistake-rate", "0.1"], Bayes(question="graded", noise_model=MistakeNoise(0.1)), 5),
        (["--inference", "paper"], Paper(), 3),
    ],
)
def test_what_the_page_asks(
    store: Store, point_goal: ModelInfo, words: list[str], rule: Rule, buttons: int
) -> None:
    options = page_options(build_parser().parse_args(["label", *words]))
    assert session_rule(options) == rule
    app = make_app(make_sessions(store, point_goal, options=options))
    with TestClient(app, base_url=HOST, follow_redirects=False) as client:
        assert client.get(begin(client)).text.count("data-preference=") == buttons
        films = "four short" if "best-of-four" in words else "two short"
        assert f"You will see {films}" in " ".join(client.get("/").text.split())


def test_the_widget_names_the_extra_that_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "sb3_poem.label.widget", raising=False)
    monkeypatch.setitem(sys.modules, "sb3_poem.label.server", None)  # as without starlette
    with pytest.raises(ImportError, match=r"pip install -c constraints.txt '\.\[label\]'"):
        from sb3_poem.label import LabelWidget  # noqa: F401
