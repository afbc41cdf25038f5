"""``sb3-poem label``: the page on which people answer, the data set of their answers, and what
others make of these.
"""

import argparse
import os
import secrets
from pathlib import Path
from typing import Any

from rich.console import Console

from sb3_poem.cli.outputs import check_output
from sb3_poem.cli.packages import import_packages
from sb3_poem.cli.subject import parse_env_kwargs

SHORTEST_PASSWORD = 12
AUTH_VARIABLE = "SB3_POEM_AUTH"


def run_label(arguments: argparse.Namespace) -> None:
    """Run the command.

    :param arguments: as ``sb3_poem.cli`` parsed them
    :raises ValueError: if they do not fit
    :raises OSError: if a file or a port cannot be had
    """
    commands = {"export": run_export, "replay": run_replay, None: run_page}
    commands[arguments.label_command](arguments)


def run_page(arguments: argparse.Namespace) -> None:
    """Serve the page until it is stopped."""
    try:
        import jinja2  # noqa: F401
        import starlette  # noqa: F401
        import uvicorn  # noqa: F401
    except ImportError as error:
        raise ValueError(f"the page needs {error.name}: pip install 'sb3_poem[label]'") from None
    from sb3_poem.label.access import LOOPBACK, Access, is_loopback
    from sb3_poem.label.catalogue import read_catalogue
    from sb3_poem.label.hosting import bind, link_host, make_server
    from sb3_poem.label.server import make_app
    from sb3_poem.label.sessions import Conversations
    from sb3_poem.label.store import Store
    from sb3_poem.label.turns import adapter_options
    from sb3_poem.label.workshop import Workshop, process_pool

    console = Console()
    user, password = read_password(arguments.auth, arguments.auth_file)
    token = secrets.token_urlsafe(24) if arguments.token else None
    if not is_loopback(arguments.host) and password is None and token is None:
        raise ValueError(
            f"--host {arguments.host} lets other machines reach the page, where whoever comes can make this machine render "
            "and read what it shows; add --token or --auth-file FILE"
        )
    import_packages(arguments.gym_packages)
    options = {"inference": arguments.inference, "mistake_rate": arguments.mistake_rate}
    adapter_options(options)  # says now what is out of range
    catalogue = read_catalogue(
        arguments.model, arguments.env, parse_env_kwargs(arguments.env_kwargs)
    )
    listener = bind(arguments.host, arguments.port)
    port = listener.getsockname()[1]
    store = Store(arguments.store)
    store.remove_orphans()
    conversations = Conversations(
        store,
        Workshop(
            arguments.workers,
            lambda: process_pool(arguments.workers, catalogue, arguments.gym_packages),
        ),
        catalogue,
        options,
        arguments.queries,
        arguments.max_sessions,
        arguments.seed,
    )
    hosts = frozenset(
        (*LOOPBACK, arguments.host.lower(), *(name.lower() for name in arguments.allow_host))
    )
    app = make_app(conversations, Access(user, password, token, hosts))
    query = "" if token is None else f"/?token={token}"
    name = link_host(listener, arguments.host)
    name = f"[{name}]" if ":" in name else name
    console.print(f"The page is at http://{name}:{port}{query}", soft_wrap=True, highlight=False)
    console.print(
        f"Models: {', '.join(choice.name for choice in catalogue)}. Answers are kept in {store.path}.",
        soft_wrap=True,
        highlight=False,
    )
    if not is_loopback(arguments.host):
        console.print(
            "Other machines can reach it: with the password or the token they can begin sessions and make this machine "
            "render. The connection is not encrypted; put a proxy with TLS in front of it where others could listen.",
            highlight=False,
        )
    try:
        make_server(app, arguments.host, port).run(sockets=[listener])
    finally:
        store.close()


def read_password(auth: str | None, file: Path | None) -> tuple[str | None, str | None]:
    """Read ``USER:PASSWORD`` from the flag, else from the file, else from the environment.

    :raises ValueError: if it has another form, or the password is short
    :raises OSError: if there is no such file
    """
    source = "--auth"
    if file is not None:
        source, auth = f"--auth-file {file}", file.read_text(encoding="utf-8").rstrip("\r\n")
    elif auth is None:
        source, auth = AUTH_VARIABLE, os.environ.get(AUTH_VARIABLE)
    if auth is None:
        return None, None
    user, colon, password = auth.partition(":")
    if not user or not colon:
        raise ValueError(f"{source} must have the form USER:PASSWORD")
    if len(password) < SHORTEST_PASSWORD:
        raise ValueError(
            f"{source}: the password must have at least {SHORTEST_PASSWORD} characters, but has {len(password)}"
        )
    return user, password


def run_export(arguments: argparse.Namespace) -> None:
    """Write all answers."""
    from sb3_poem.label.export import export

    for path in arguments.out:
        check_output("--out", path, (".jsonl", ".parquet"))
    store = open_store(arguments)
    for path in arguments.out:
        count = export(store, path, arguments.trajectories, arguments.undone)
        Console().print(f"Wrote {count} answers to {path}", highlight=False)
    store.close()


def run_replay(arguments: argparse.Namespace) -> None:
    """Feed the recorded answers to a model and a rule."""
    from sb3_poem.adaptation.state import write_json_atomically
    from sb3_poem.label.replay import replay
    from sb3_poem.loading import load_model
    from sb3_poem.resources import pretrained_folder

    check_output("--json", arguments.json, (".json",))
    console = Console()
    store = open_store(arguments)
    options = {"inference": arguments.inference, "mistake_rate": arguments.mistake_rate}
    results: list[dict[str, Any]] = []
    left_out: list[str] = []
    for session in store.sessions():
        if not store.answers(session.id):
            continue
        with console.status(f"Session {session.id}"):
            try:
                # a store may come from anybody: it names no file to unpickle
                model = load_model(arguments.model or pretrained_folder(session.model))
            except FileNotFoundError:
                if arguments.model is not None:
                    raise
                left_out.append(session.id)
                console.print(
                    f"Session {session.id} was recorded with a model {session.model!r} that does not ship: name it by --model",
                    soft_wrap=True,
                    highlight=False,
                )
                continue
            # the store knows a model by its folder's name
            is_own = (
                arguments.model is None or Path(arguments.model).resolve().name == session.model
            )
            result = replay(store, session, model, options, arguments.seed or 0, is_own)
        results.append(result)
        console.print(
            f"Session {session.id} ({session.model}): foretold {result['foretold']} of {result['decided']} answers. "
            f"{result['sentence']}",
            highlight=False,
        )
    if not results and not left_out:
        raise ValueError(f"--store {arguments.store} holds no answers")
    if not results:
        raise ValueError(
            "no session could be replayed: name the model that they were recorded with by --model"
        )
    if arguments.json is not None:
        write_json_atomically(
            arguments.json, {"model": arguments.model, "options": options, "sessions": results}
        )
        console.print(f"Wrote {arguments.json}", highlight=False)
    store.close()


def open_store(arguments: argparse.Namespace):  # type: ignore[no-untyped-def]
    """The store that was named.

    :raises ValueError: if there is none
    """
    from sb3_poem.label.store import Store

    if not (arguments.store / "answers.sqlite").is_file():
        raise ValueError(
            f"--store {arguments.store}: there are no answers there (no answers.sqlite)"
        )
    return Store(arguments.store)
