"""Models on the Hugging Face Hub. A model is :data:`FILES` and nothing else, in both directions:
weights as safetensors, JSON and a card, none of which can run code.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

FILES = ("model.safetensors", "config.json", "README.md")
REPOSITORY = re.compile(r"[\w-][\w.-]*/[\w-][\w.-]*", re.ASCII)


def is_repository(name: str | Path) -> bool:
    """Whether a name may be a model's on the Hub, ``"user/name"``; a ``Path`` never is."""
    is_file = Path(name).suffix in (".zip", ".safetensors")
    return isinstance(name, str) and REPOSITORY.fullmatch(name) is not None and not is_file


def download(repository: str) -> Path:
    """The folder of the Hub's model ``"user/name"``, in the Hub's own cache; without a network that
    of an earlier download. A ``FileNotFoundError`` if there is none, or no way to the Hub.
    """
    what = f"{repository}: there is no such file or folder of a model"
    client = _client(f"{what}, and one of the Hugging Face Hub")
    from httpx2 import HTTPError

    try:
        folder = Path(client.HfApi().snapshot_download(repository, allow_patterns=list(FILES)))
    except client.errors.RepositoryNotFoundError as error:
        raise FileNotFoundError(
            f"{what}, and the Hugging Face Hub has none of that name, or it is private: then log "
            "in with `hf auth login`, or set HF_TOKEN"
        ) from error
    except (OSError, ValueError, HTTPError) as error:
        raise FileNotFoundError(
            f"{what}, and none came from the Hugging Face Hub: {_first_line(error)}"
        ) from error
    missing = [name for name in FILES[:2] if not (folder / name).is_file()]
    if missing:
        raise FileNotFoundError(
            f"{repository} on the Hugging Face Hub is no model of sb3_poem: it has no {missing[0]}"
        )
    return folder


def upload(repository: str, contents: Mapping[str, bytes], private: bool | None = None) -> str:
    """Write the contents of :data:`FILES` to the Hub, in one commit; see
    :meth:`PEARLSAC.push_to_hub`.
    """
    if not is_repository(repository):
        raise ValueError(f'`repo_id` must have the form "user/name", but is {repository!r}')
    client = _client("the Hugging Face Hub")
    from httpx2 import HTTPError

    files = [client.CommitOperationAdd(name, contents[name]) for name in FILES]
    try:
        api = client.HfApi()
        address = api.create_repo(repository, private=private, exist_ok=True)
        api.create_commit(repository, files, commit_message="Upload a model of sb3_poem")
    except (OSError, HTTPError) as error:
        raise OSError(
            f"{repository} was not written to the Hugging Face Hub: {_first_line(error)}. "
            "Writing needs a network and a token: `hf auth login`, or HF_TOKEN"
        ) from error
    return str(address)


def _client(what: str) -> Any:
    try:
        import huggingface_hub
        import huggingface_hub.errors
    except ImportError as error:
        raise ImportError(
            f"{what} needs huggingface_hub: pip install -c constraints.txt '.[hub]' in a checkout"
        ) from error
    return huggingface_hub


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0].removeprefix("Got: ")
