"""The page's doors: who holds connections, a full disk, and what else a hostile client tries over a
real socket.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_world import make_sessions
from starlette.applications import Starlette
from starlette.responses import PlainTextResponse
from starlette.routing import Route
from starlette.testclient import TestClient

from sb3_poem import cli
from sb3_poem.cli.label import read_password
from sb3_poem.common.video import write_video
from sb3_poem.label import sessions
from sb3_poem.label.access import MAX_BODY, MAX_OF_ADDRESS, Access, network_of
from sb3_poem.label.families import ModelInfo
from sb3_poem.label.server import DISK_FULL, BackgroundServer, bind, link_host, make_app
from sb3_poem.label.store import Store

POST = b"POST /start HTTP/1.1\r\nHost: localhost\r\n"
HALF = b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Waiting: "
PASSWORD = "a long password"

Serve = Callable[..., int]


@pytest.fixture
def serve(store: Store, point_goal: ModelInfo) -> Iterator[Serve]:
    """Starts the page, or another application, on loopback; gives the port."""
    servers = []

    def start(
        app: Starlette | None = None, deadline: float = 10.0, access: Access | None = None
    ) -> int:
        page = app or make_app(make_sessions(store, point_goal), access)
        servers.append(BackgroundServer(page, deadline=deadline))
        return servers[-1].port

    yield start
    for server in servers:
        server.close()


@pytest.fixture
def no_traceback(
    capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> Iterator[None]:
    """Fails the test if the server logs one."""
    yield
    assert "Traceback" not in capsys.readouterr().err
    assert not any(record.exc_info for record in caplog.get_records("call"))


def connect(port: int, sent: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
    connection = socket.create_connection(
        ("127.0.0.1", port), timeout=5.0, source_address=(source, 0)
    )
    connection.sendall(sent)
    return connection


def is_open(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return connection.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


def read_all(connection: socket.socket, seconds: float = 5.0) -> bytes:
    """What comes until the server closes."""
    connection.settimeout(seconds)
    content = b""
    with contextlib.suppress(ConnectionError):
        while part := connection.recv(65536):
            content += part
    return content


def status(port: int, path: str = "/", source: str = "127.0.0.1") -> int:
    client = http.client.HTTPConnection("127.0.0.1", port, timeout=5.0, source_address=(source, 0))
    try:
        client.request("GET", path)
        return client.getresponse().status
    finally:
        client.close()


@pytest.mark.parametrize(
    ("deadline", "seconds"), [(0.5, 1.5), pytest.param(10.0, 30.0, marks=pytest.mark.slow)]
)
def test_300_half_open_connections_shut_nobody_out(
    serve: Serve, deadline: float, seconds: float
) -> None:
    """They come from the address of those who are served, and each that is closed comes again."""
    port = serve(deadline=deadline)
    begun = time.monotonic()
    held = [connect(port, HALF) for _ in range(300)]
    first, served, closed = held[-1], 0, 0
    while time.monotonic() < begun + seconds or served < 10:
        for source in ("127.0.0.1", "127.0.0.2"):
            assert status(port, source=source) == 200
            served += 1
        for index, connection in enumerate(held):
            if connection is not first and not is_open(connection):
                connection.close()
                held[index] = connect(port, HALF)
                closed += 1
        time.sleep(0.05)
    assert closed >= 300 - MAX_OF_ADDRESS
    assert not is_open(first)
    for connection in held:
        connection.close()


def test_a_slow_body_ends_at_the_deadline_while_others_are_served(serve: Serve) -> None:
    port = serve(deadline=0.6)
    begun = time.monotonic()
    slow = connect(port, POST + b"Content-Length: 1000\r\n\r\n")
    with contextlib.suppress(ConnectionError):
        while time.monotonic() < begun + 3.0 and is_open(slow):
            slow.sendall(b"x")  # a byte now and then is no reason to wait longer
            assert status(port) == 200
            time.sleep(0.05)
    assert 0.5 < time.monotonic() - begun < 2.5


def test_a_request_that_takes_too_long_is_told_so(serve: Serve) -> None:
    slow = connect(serve(deadline=0.2), POST + b"Content-Length: 9\r\n\r\nmodel=")
    answer = read_all(slow)
    assert answer.startswith(b"HTTP/1.1 408 ")
    assert b"took too long" in answer


def test_no_connection_is_held_for_ever(serve: Serve) -> None:
    nowhere = b"GET /nowhere HTTP/1.1\r\nHost: localhost\r\n\r\n"
    upgrade = b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n"
    port = serve(deadline=0.2)
    for held in [
        connect(port, sent)
        for sent in (
            b"",
            nowhere,
            nowhere + b"GET / HTTP/1.1\r\nHo",
            POST + b"Content-Length: 99999\r\n\r\nx",
            POST + b"Content-Length: 99999\r\n\r\n" + b"x" * 99999,
            POST + b"Expect: 100-continue\r\nContent-Length: 5\r\n\r\n",
            b"GET / HTTP/1.1\r\nHost: localhost\r\n" + upgrade,
        )
    ]:
        read_all(held, seconds=3.0)  # raises TimeoutError if the server does not close it


def test_who_does_not_take_an_answer_is_left(serve: Serve) -> None:
    whole = 30_000_000
    port = serve(
        Starlette(routes=[Route("/", lambda _: PlainTextResponse(b"x" * whole))]), deadline=0.2
    )
    reader = socket.socket()
    reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    reader.connect(("127.0.0.1", port))
    reader.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
    time.sleep(1.0)
    assert len(read_all(reader)) < whole
    # Whoever takes a part now and then gets all of it.
    slow = connect(port, b"GET / HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
    content = b""
    while part := slow.recv(2_000_000):
        content += part
        time.sleep(0.05)
    assert len(content) > whole


def test_one_addresss_connections_do_not_end_anothers(serve: Serve) -> None:
    port = serve()
    other = connect(port, HALF, source="127.0.0.2")
    crowd = [connect(port, HALF) for _ in range(200)]
    deadline = time.monotonic() + 3.0
    while sum(map(is_open, crowd)) > MAX_OF_ADDRESS and time.monotonic() < deadline:
        time.sleep(0.02)
    assert [is_open(connection) for connection in crowd] == [False] * (200 - MAX_OF_ADDRESS) + [
        True
    ] * MAX_OF_ADDRESS
    assert is_open(other)
    for connection in (other, *crowd):
        connection.close()


def test_beyond_the_limit_wrong_passwords_are_told_to_come_later(serve: Serve) -> None:
    port = serve(access=Access("ann", PASSWORD))
    wrong = b"GET / HTTP/1.1\r\nHost: localhost\r\nAuthorization: Basic eDp5\r\n\r\n"
    crowd = [connect(port, wrong) for _ in range(MAX_OF_ADDRESS + 5)]
    assert all(connection.recv(65536).startswith(b"HTTP/1.1 401 ") for connection in crowd)
    last = crowd[-1]
    last.sendall(wrong)
    assert b" 503 " in read_all(last)
    for connection in crowd:
        connection.close()
    assert status(port) == 401


@pytest.mark.parametrize(
    ("host", "network"),
    [
        ("10.1.2.3", "10.1.2.3"),
        ("::ffff:10.1.2.3", "10.1.2.3"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::"),
        ("fe80::1%eth0", "fe80::"),
        ("", ""),
    ],
)
def test_an_address_is_what_one_household_has(host: str, network: str) -> None:
    assert network_of(host) == network


NO_REQUESTS = {
    b"GET /\xff\xfe HTTP/1.1\r\nHost: localhost\r\n\r\n": b"400",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil\r\n\r\n": b"400",
    b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 5000: b"400",
    b"GET http://evil.example/ HTTP/1.1\r\nHost: localhost\r\n\r\n": b"404",
    b"CONNECT evil.example:443 HTTP/1.1\r\nHost: localhost\r\n\r\n": b"404",
    POST + b"Origin: http://[\r\nContent-Length: 0\r\n\r\n": b"403",
    POST + b"Content-Length: " + b"9" * 5000 + b"\r\n\r\n": b"400",
    POST + b"Content-Length: 3\r\nContent-Length: 4\r\n\r\nabc": b"400",
    POST + b"Transfer-Encoding: chunked\r\n\r\n-1\r\n": b"400",
    b"POST /start HTTP/1.1\r\nHost: evil\r\nTransfer-Encoding: chunked\r\n\r\n-1\r\n": b"400",
}


@pytest.mark.usefixtures("no_traceback")
def test_what_is_no_request_is_refused_without_an_error(serve: Serve) -> None:
    port = serve(deadline=0.3)
    answers = [(sent, connect(port, sent), code) for sent, code in NO_REQUESTS.items()]
    for sent, connection, code in answers:
        assert read_all(connection)[:12] == b"HTTP/1.1 " + code, sent[:80]
    assert status(port) == 200


@pytest.mark.usefixtures("no_traceback")
def test_a_body_that_goes_wrong_after_the_answer_ends_the_connection(serve: Serve) -> None:
    port = serve()
    large = b"%x\r\n" % (2 * MAX_BODY) + b"x" * (2 * MAX_BODY)
    connection = connect(port, POST + b"Transfer-Encoding: chunked\r\n\r\n" + large)
    assert connection.recv(65536).startswith(b"HTTP/1.1 411 ")
    connection.sendall(b"\r\n-1\r\n")
    read_all(connection, seconds=3.0)
    assert status(port) == 200


def test_a_body_that_breaks_off_is_no_request(serve: Serve, store: Store) -> None:
    port = serve()
    cut = connect(port, POST + b"Content-Length: 99\r\n\r\nmodel=PointGoal")
    assert status(port) == 200
    cut.close()
    time.sleep(0.1)
    assert status(port) == 200
    assert store.sessions() == []


@contextlib.contextmanager
def full_disk(room: int = 0) -> Iterator[None]:
    """No file of this process, or of one that it starts, can be written beyond so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_is_a_sentence_and_what_was_answered_stays(
    store: Store,
    point_goal: ModelInfo,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(sessions, "RETRY_SECONDS", 0.0)
    app = make_app(make_sessions(store, point_goal))
    with TestClient(app, base_url="http://localhost", follow_redirects=False) as client:

        def state(wanted: int) -> dict[str, Any]:
            for _ in range(1000):
                response = client.get(f"{session}/state")
                if response.status_code == wanted and response.json().get("phase") != "preparing":
                    return response.json()
                time.sleep(0.02)
            raise AssertionError(response.text)

        with full_disk():
            refused = client.post("/start", data={"model": "PointGoal"})
            assert (refused.status_code, refused.json()) == (507, {"error": DISK_FULL})
            refused = client.post(
                "/start", data={"model": "PointGoal"}, headers={"Accept": "text/html,*/*"}
            )
            assert refused.status_code == 507
            assert DISK_FULL in refused.text
        session = client.post("/start", data={"model": "PointGoal"}).headers["location"]
        with full_disk():
            assert state(507) == {"error": DISK_FULL}  # the film cannot be written
            assert client.get(session).status_code == 200
        view = state(200)
        posts = {
            "answer": {"question": view["turn"]["id"], "preference": "left"},
            "wish": {"wish": "left"},
            "stop": {"stopped": 1},
        }
        with full_disk():
            for name, body in posts.items():
                refused = client.post(f"{session}/{name}", json=body)
                assert (refused.status_code, refused.json()) == (507, {"error": DISK_FULL})
        assert store.answers(store.sessions()[0].id) == []
        assert client.post(f"{session}/answer", json=posts["answer"]).status_code == 200
        assert len(store.answers(store.sessions()[0].id)) == 1
    assert "Traceback" not in caplog.text
    assert "disk I/O error" in caplog.text  # whoever runs the page reads what SQLite says


@pytest.mark.parametrize(
    ("name", "words"),
    [("a.mp4", "a.mp4 cannot be written: ffmpeg ended"), ("a.gif", "could not write .*a.gif")],
)
def test_a_film_that_does_not_fit_on_the_disk_is_no_film(
    tmp_path: Path, name: str, words: str
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (10, 24, 64, 3), dtype=np.uint8)
    frames, path = list(noise.repeat(10, axis=1).repeat(10, axis=2)), tmp_path / name
    whole = write_video(frames, path, 20.0).read_bytes()
    for room in (0, 4096, len(whole) // 2, len(whole) - 1):
        with full_disk(room), pytest.raises(OSError, match=words):
            write_video(frames, path, 20.0)
        assert [file.name for file in tmp_path.iterdir()] == [name]
        assert path.read_bytes() == whole


@pytest.mark.parametrize(
    "command", [["--model", "PointGoal", "--port", "0"], ["export", "--out", "a.jsonl"]]
)
def test_commands_say_that_the_disk_is_full_or_the_store_broken(
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SB3_POEM_TRACEBACK", raising=False)
    path = Path("label_data/answers.sqlite")
    Store(path.parent).close()
    with full_disk():
        assert cli.main(["label", *command]) == 1
    assert (
        f"error: {path} cannot be read or written: disk I/O error (is the disk full?)"
        in capsys.readouterr().err
    )
    path.write_bytes(b"no data base" * 1000)
    assert cli.main(["label", *command]) == 1
    assert (
        f"error: {path} cannot be read or written: file is not a database"
        in capsys.readouterr().err
    )


def test_the_stores_folders_are_its_owners(tmp_path: Path) -> None:
    mask = os.umask(0)
    try:
        store = Store(tmp_path / "above" / "store")
    finally:
        os.umask(mask)
    store.create_session("M", "poem/PointGoal-v0", 1, {})
    assert [folder.stat().st_mode & 0o777 for folder in (store.folder, store.videos)] == [
        0o700,
        0o700,
    ]
    assert {file.stat().st_mode & 0o077 for file in store.folder.glob("answers.sqlite*")} == {0}
    store.close()


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "0.0.0.0", "", "::1", "[::1]", "::"])
def test_the_printed_links_host_can_be_reached(host: str) -> None:
    try:
        listener = bind(host, 0)
    except OSError as error:
        pytest.skip(f"this machine has no such address: {error}")
    with (
        listener,
        socket.create_connection(
            (link_host(listener, host), listener.getsockname()[1]), timeout=5.0
        ),
    ):
        assert link_host(listener, host) not in ("0.0.0.0", "", "::", "[::1]")


@pytest.mark.parametrize(
    ("arguments", "environment", "words"),
    [
        (["--auth-file", "missing"], None, "--auth-file missing: must be a text in UTF-8 (No such"),
        (
            ["--auth-file", "short"],
            None,
            "--auth-file short: the password must have at least 12 characters, but has 5",
        ),
        (
            [],
            "ann:short",
            "SB3_POEM_AUTH: the password must have at least 12 characters, but has 5",
        ),
        (["--auth-file", "empty"], None, "--auth-file empty must have the form USER:PASSWORD"),
        ([], "", "SB3_POEM_AUTH must have the form USER:PASSWORD"),
        (["--auth", "nobody"], f"ann:{PASSWORD}", "--auth must have the form USER:PASSWORD"),
        (["--instructions", "missing"], None, "--instructions missing: must be a text in UTF-8"),
        (["--instructions", "empty"], None, "--instructions empty: must be a text, but is empty"),
        (["--instructions", "picture"], None, "--instructions picture: must be a text in UTF-8"),
    ],
)
def test_wrong_doors_are_named(
    arguments: list[str],
    environment: str | None,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("short").write_text("ann:short\n")
    Path("empty").write_text("\n")
    Path("picture").write_bytes(b"\x89PNG")
    if environment is not None:
        monkeypatch.setenv("SB3_POEM_AUTH", environment)
    assert cli.main(["label", *arguments]) == 1
    assert words in capsys.readouterr().err


def test_the_password_comes_from_a_file_or_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "password").write_text(f"ann:{PASSWORD}\n")
    assert read_password(None, None) == (None, None)
    assert read_password(None, tmp_path / "password") == ("ann", PASSWORD)
    monkeypatch.setenv("SB3_POEM_AUTH", "bob:of the environment")
    assert read_password(None, None) == ("bob", "of the environment")
    assert read_password(None, tmp_path / "password") == ("ann", PASSWORD)
    assert read_password("eve:of the command line", None) == ("eve", "of the command line")


@pytest.mark.slow
def test_the_list_of_processes_does_not_show_the_password(tmp_path: Path) -> None:
    (tmp_path / "password").write_text(f"ann:{PASSWORD}\n")
    command = [
        sys.executable,
        "-m",
        "sb3_poem",
        "label",
        "--model",
        "PointGoal",
        "--port",
        "0",
        "--workers",
        "1",
    ]
    command += [
        "--host",
        "0.0.0.0",
        "--store",
        str(tmp_path / "store"),
        "--auth-file",
        str(tmp_path / "password"),
    ]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert process.stdout is not None
        link = re.search(r"http://(\S+):(\d+)", process.stdout.readline())
        assert link is not None
        codes = []
        for given in ("ann:wrong", f"ann:{PASSWORD}"):
            client = http.client.HTTPConnection(link[1], int(link[2]), timeout=10.0)
            client.request(
                "GET", "/", headers={"Authorization": "Basic " + b64encode(given.encode()).decode()}
            )
            codes.append(client.getresponse().status)
            client.close()
        assert codes == [401, 200]
        assert PASSWORD.encode() not in Path(f"/proc/{process.pid}/cmdline").read_bytes()
        assert (tmp_path / "store").stat().st_mode & 0o777 == 0o700
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.communicate()
