"""``sb3-poem label``: the page on which people answer, the data set, and what others make of it."""

import argparse
import os
import secrets
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
from rich.console import Console

from sb3_poem.adaptation.preference import BEST_OF_FOUR
from sb3_poem.cli.needs import check_output, import_packages, parse_pairs, say
from sb3_poem.common.files import write_json_atomically
from sb3_poem.label.export import export
from sb3_poem.label.families import find_models
from sb3_poem.label.minari_export import export_minari
from sb3_poem.label.render_queue import RenderQueue, process_pool
from sb3_poem.label.rendering import make_env, renderer_of, session_rule
from sb3_poem.label.replay import OtherRobotError, recorded_digest, replay
from sb3_poem.label.sessions import SessionManager
from sb3_poem.label.store import Store
from sb3_poem.loading import load_model
from sb3_poem.resources import pretrained_folder

SHORTEST_PASSWORD = 12
AUTH_VARIABLE = "SB3_POEM_AUTH"


def run_label(arguments: argparse.Namespace) -> None:
    {"export": run_export, "replay": run_replay, None: run_page}[arguments.label_command](arguments)


def run_page(arguments: argparse.Namespace) -> None:
    """Serve the page until it is stopped."""
    for package in ("jinja2", "markdown_it", "starlette", "uvicorn"):
        if find_spec(package) is None:
            install = "pip install -c constraints.txt '.[label]' in a checkout"
            raise ValueError(f"the page needs {package}: {install}")
    from sb3_poem.label.access import LOOPBACK, Access, is_loopback
    from sb3_poem.label.server import bind, link_host, make_app, make_server

    user, password = read_password(arguments.auth, arguments.auth_file)
    instructions = read_text("--instructions", arguments.instructions)
    if arguments.instructions is not None and not instructions.strip():
        raise ValueError(f"--instructions {arguments.instructions}: must be a text, but is empty")
    token = secrets.token_urlsafe(24) if arguments.token else None
    is_open = not is_loopback(arguments.host)
    if is_open and password is None and token is None:
        raise ValueError(
            f"--host {arguments.host} lets other machines reach the page, where whoever comes can "
            "make this machine render and read what it shows; add --token or --auth-file FILE"
        )
    workers, packages = arguments.workers, arguments.gym_packages
    import_packages(packages)
    options = page_options(arguments)
    session_rule(options)  # says now what is out of range
    env_kwargs = parse_pairs("--env-kwargs", arguments.env_kwargs)
    models = find_models(arguments.model, arguments.env, env_kwargs)
    if arguments.env is not None or env_kwargs:
        check_shown(models)
    elif arguments.model is not None:  # of those that ship, one may need an extra
        for info in models:
            make_env(info.env_id, **dict(info.env_kwargs)).close()
    listener = bind(arguments.host, arguments.port)
    port = listener.getsockname()[1]
    try:
        store = Store(arguments.store)
    except (FileExistsError, FileNotFoundError, NotADirectoryError, PermissionError) as error:
        raise OSError(f"--store {arguments.store}: {error.strerror}") from error
    store.remove_orphans()
    queue = RenderQueue(workers, lambda: process_pool(workers, models, packages))
    limits = (arguments.queries, arguments.max_sessions, arguments.seed)
    sessions = SessionManager(store, queue, models, options, *limits)
    hosts = LOOPBACK | {name.lower() for name in (arguments.host, *arguments.allow_host)}
    app = make_app(sessions, Access(user, password, token, hosts), instructions)
    name = link_host(listener, arguments.host)
    name = f"[{name}]" if ":" in name else name
    query = "" if token is None else f"/?token={token}"
    say(f"The page is at http://{name}:{port}{query}")
    names = ", ".join(info.name for info in models)
    say(f"Models: {names}. Answers are kept in {store.path}.")
    if is_open:
        say(
            "Other machines can reach it: with the password or the token they can begin sessions "
            "and make this machine render. The connection is not encrypted; put a proxy with TLS "
            "in front of it where others could listen."
        )
    try:
        make_server(app, arguments.host, port).run(sockets=[listener])
    finally:
        store.close()


def page_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the sessions of a page are like."""
    usual = "pair" if arguments.inference == "paper" else "graded"
    return {**rule_options(arguments), "question": arguments.question or usual}


def rule_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """The rule of the arguments, as a session's options name it."""
    told = {"inference": arguments.inference, "mistake_rate": arguments.mistake_rate}
    return {name: value for name, value in told.items() if value is not None}


def read_password(auth: str | None, file: Path | None) -> tuple[str | None, str | None]:
    """Read ``USER:PASSWORD`` from the flag, else from the file, else from the environment."""
    source = "--auth"
    if file is not None:
        source, auth = f"--auth-file {file}", read_text("--auth-file", file).rstrip("\r\n")
    elif auth is None:
        source, auth = AUTH_VARIABLE, os.environ.get(AUTH_VARIABLE)
    if auth is None:
        return None, None
    user, colon, password = auth.partition(":")
    if not user or not colon:
        raise ValueError(f"{source} must have the form USER:PASSWORD")
    if len(password) < SHORTEST_PASSWORD:
        least = f"at least {SHORTEST_PASSWORD} characters, but has {len(password)}"
        raise ValueError(f"{source}: the password must have {least}")
    return user, password


def read_text(flag: str, file: Path | None) -> str:
    """Read a file that a flag named, if it did."""
    if file is None:
        return ""
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", error)
        raise ValueError(f"{flag} {file}: must be a text in UTF-8 ({why})") from None


def check_shown(models: Sequence[Any]) -> None:
    """Refuse an environment of the user's in which a model cannot be shown, before people come."""
    for info in models:
        try:
            renderer_of(info)
        except (TypeError, ValueError, gymnasium.error.Error) as error:
            words = f"{info.name} cannot be shown in {info.env_id} by --env and --env-kwargs"
            raise ValueError(f"{words}: {error}") from error


def run_export(arguments: argparse.Namespace) -> None:
    kind, undone = arguments.format, arguments.undone
    for path in arguments.out:
        if kind is None:
            check_output("--out", path, (".jsonl", ".parquet"))
    import_packages(arguments.gym_packages)
    store = _open_store(arguments.store)
    for path in arguments.out:
        if kind == "minari":
            for dataset, where in export_minari(store, str(path), undone).items():
                say(f"Wrote the data set {dataset} to {where}")
        else:
            count = export(store, path, arguments.trajectories, undone, kind)
            say(f"Wrote {count} answers to {path}")
    store.close()


def run_replay(arguments: argparse.Namespace) -> None:
    """Feed the recorded answers to a model and a rule."""
    # A model that rl_zoo3 trained may hold its schedules.
    import rl_zoo3  # noqa: F401

    check_output("--json", arguments.json, (".json",))
    store, given = _open_store(arguments.store), arguments.model
    options = rule_options(arguments)
    answered = [session for session in store.sessions() if store.answers(session.id)]
    if not answered:
        raise ValueError(f"--store {arguments.store} holds no answers")
    results: list[dict[str, Any]] = []
    for session in answered:
        if session.question == BEST_OF_FOUR and arguments.inference == "paper":
            read = "asks which of four is best, which --inference bayes alone reads"
            say(f"Session {session.id} {read}: left out")
            continue
        try:
            # a store may come from anybody: it names no file to unpickle
            model = load_model(given or pretrained_folder(session.model))
        except FileNotFoundError:
            if given is not None:
                raise
            recorded = f"was recorded with a model {session.model!r} that does not ship"
            say(f"Session {session.id} {recorded}: name it by --model")
            continue
        # of an answer at a terminal, the store knows the model by its folder's name alone
        named = given is None or Path(given).resolve().name == session.model
        digest = recorded_digest(store, session)
        is_own = named if digest is None else digest == model.digest
        with Console().status(f"Session {session.id}"):
            how = (options, arguments.seed or 0, is_own)
            try:
                results.append(replay(store, session, model, *how))
            except OtherRobotError as error:
                say(f"Session {session.id} is left out: {error}")
                continue
        say(
            "Session {session} ({model}): foretold {foretold} of {decided} answers that decide. "
            "{sentence}".format_map(results[-1])
        )
    if not results:
        raise ValueError("no session could be replayed, for the reasons above")
    if arguments.json is not None:
        content = {"model": given, "options": options, "sessions": results}
        write_json_atomically(arguments.json, content)
        say(f"Wrote {arguments.json}")
    store.close()


def _open_store(folder: Path) -> Store:
    """The store that was named, if there is one."""
    if not (folder / "answers.sqlite").is_file():
        raise ValueError(f"--store {folder}: there are no answers there (no answers.sqlite)")
    return Store(folder)
