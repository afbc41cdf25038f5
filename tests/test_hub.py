"""Models on the Hub: the Hub's own client, against a small Hub on this machine."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from sb3_poem import PEARLSAC, POEMSAC, PreferenceAdapter, cli
from sb3_poem.hub import FILES
from sb3_poem.label.families import find_models
from sb3_poem.loading import load_model

constants = pytest.importorskip("huggingface_hub.constants", reason="without the extra [hub]")
ModelCard = pytest.importorskip("huggingface_hub").ModelCard
COMMIT, NAME = "0" * 39 + "1", "ann/runner"


class Hub(BaseHTTPRequestHandler):
    """As much of the Hub's HTTP interface as the client asks for. A repository is a folder."""

    root: Path
    token = "hf_right"
    protocol_version = "HTTP/1.1"

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        if self.headers.get("Authorization") != f"Bearer {self.token}":
            return self.answer(401, {"error": "Invalid credentials"})
        if self.path == "/api/repos/create":
            asked = json.loads(body)
            repository = f"{asked.get('organization', 'ann')}/{asked['name'].split('/')[-1]}"
            (self.root / repository).mkdir(parents=True, exist_ok=True)
            (self.root / repository / ".visibility").write_text(asked.get("visibility", ""))
            return self.answer(200, {"url": f"http://{self.headers['Host']}/{repository}"})
        if self.path == "/api/validate-yaml":
            return self.answer(200, {"errors": [], "warnings": []})
        repository, action = self.repository()
        if action.startswith("preupload"):
            files = [
                {"path": file["path"], "uploadMode": "regular", "shouldIgnore": False}
                for file in json.loads(body)["files"]
            ]
            return self.answer(200, {"files": files})
        for line in map(json.loads, body.splitlines()):
            if line["key"] == "file":
                content = base64.b64decode(line["value"]["content"])
                (self.root / repository / line["value"]["path"]).write_bytes(content)
        url = f"http://{self.headers['Host']}/{repository}/commit/{COMMIT}"
        return self.answer(200, {"commitUrl": url, "commitOid": COMMIT})

    def do_GET(self, body: bool = True) -> None:
        repository, action = self.repository()
        folder = self.root / repository
        if not folder.is_dir() or not action:
            return self.answer(404, {"error": "no"}, {"X-Error-Code": "RepoNotFound"})
        files = [file for file in folder.iterdir() if not file.name.startswith(".")]
        if action.startswith("revision"):
            siblings = [{"rfilename": file.name} for file in files]
            return self.answer(200, {"id": repository, "sha": COMMIT, "siblings": siblings})
        if action.startswith("tree"):
            return self.answer(
                200,
                [
                    {
                        "type": "file",
                        "path": file.name,
                        "size": file.stat().st_size,
                        "oid": hashlib.sha1(file.read_bytes()).hexdigest(),
                    }
                    for file in files
                ],
            )
        content = (folder / action.split("/")[-1]).read_bytes()
        headers = {"ETag": f'"{hashlib.sha1(content).hexdigest()}"', "X-Repo-Commit": COMMIT}
        return self.answer(200, content, headers, body)

    def do_HEAD(self) -> None:
        self.do_GET(body=False)

    def repository(self) -> tuple[str, str]:
        """``user/name``, and what is asked of it."""
        found = re.fullmatch(r"/(?:api/models/)?([^/]+/[^/]+)/(.*)", self.path)
        return (found[1], found[2]) if found is not None else ("", "")

    def answer(
        self, status: int, content: object, headers: dict[str, str] | None = None, body: bool = True
    ) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        self.send_response(status)
        for name, value in {**(headers or {}), "Content-Length": str(len(data))}.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of the Hub's repositories; the client has an empty cache and the right token."""
    (tmp_path / "hub").mkdir()
    handler = type("Handler", (Hub,), {"root": tmp_path / "hub"})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}"
    # read from HF_ENDPOINT and HF_HUB_CACHE when the client is imported
    monkeypatch.setattr(constants, "ENDPOINT", address)
    template = f"{address}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_TOKEN", Hub.token)
    monkeypatch.chdir(tmp_path)
    yield tmp_path / "hub"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def model() -> POEMSAC:
    return POEMSAC.from_pretrained("PointGoal", device="cpu")


def test_a_pushed_model_comes_back_whole(model: POEMSAC, served: Path) -> None:
    card = {"license": "apache-2.0", "seed": 0}
    assert model.push_to_hub(NAME, card, private=True).endswith(f"/{NAME}")
    folder = served / NAME
    assert (folder / ".visibility").read_text() == "private"
    assert sorted(file.name for file in folder.glob("[!.]*")) == sorted(FILES)
    (folder / "policy.pkl").write_bytes(b"not fetched")
    loaded = POEMSAC.from_pretrained(NAME, device="cpu")
    fetched = [path.name for path in (served.parent / "cache").rglob("snapshots/*/*")]
    assert sorted(fetched) == sorted(FILES)
    rng = np.random.default_rng(0)
    obs, latents = rng.normal(size=(5, 2)), rng.normal(size=(5, model.latent_dim))
    np.testing.assert_array_equal(
        *(one.predict(obs, latents, deterministic=True)[0] for one in (model, loaded))
    )
    np.testing.assert_array_equal(model.task_latents, loaded.task_latents)
    with pytest.raises(ValueError, match=r"load it with POEMSAC.from_pretrained"):
        PEARLSAC.from_pretrained(NAME)


def test_the_card_is_as_the_hub_takes_it(model: POEMSAC, served: Path) -> None:
    model.push_to_hub(NAME, {"license": "apache-2.0"})
    card = ModelCard.load(served / NAME / "README.md")
    assert card.data.library_name == "sb3_poem"
    assert card.data.license == "apache-2.0"
    assert f'sb3_poem.POEMSAC.from_pretrained("{NAME}")' in card.text


def test_a_name_with_a_slash_is_a_model_of_the_hub_everywhere(
    model: POEMSAC, served: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model.push_to_hub(NAME)
    assert load_model(NAME, "cpu").env_id == "poem/PointGoal-v0"
    assert PreferenceAdapter(NAME, "poem/PointGoal-v0", seed=0).ask()
    assert [info.name for info in find_models(NAME)] == ["runner"]
    little = ["--tasks", "1", "--episodes", "1", "--queries", "1", "--n-candidates", "10"]
    assert cli.main(["adapt", "--model", NAME, *little]) == 0, capsys.readouterr().err
    # without a network it is the one of before
    shutil.rmtree(served / NAME)
    (served / NAME).write_text("gone")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
        assert load_model(NAME, "cpu").env_id == "poem/PointGoal-v0"


def test_a_folder_comes_before_the_hub(model: POEMSAC, served: Path) -> None:
    model.save_pretrained(NAME)
    assert POEMSAC.from_pretrained(NAME, device="cpu").num_timesteps == model.num_timesteps
    for local in (Path("ann/other"), "./ann/other", "ann/other.zip", "a/b/c", "/ann/other"):
        with pytest.raises(FileNotFoundError, match=r"no such file or folder of a model$"):
            load_model(local)


def test_what_is_not_to_be_had_is_said(
    model: POEMSAC,
    served: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(FileNotFoundError, match=r"ann/other: .*Hub has none of that name"):
        load_model("ann/other")
    (served / NAME).mkdir(parents=True)
    with pytest.raises(
        FileNotFoundError, match=r"ann/runner on.* is no model of sb3_poem: it has no"
    ):
        load_model(NAME)
    with pytest.raises(ValueError, match="\"user/name\", but is 'runner'"):
        model.push_to_hub("runner")
    monkeypatch.setenv("HF_TOKEN", "hf_wrong")
    with pytest.raises(OSError, match=r"ann/runner was not written.*hf auth login"):
        model.push_to_hub(NAME)
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    for call in (lambda: load_model("ann/new"), lambda: model.push_to_hub(NAME)):
        with pytest.raises(OSError, match=r"Hugging Face Hub: .*onnect"):
            call()
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    for call in (lambda: load_model(NAME), lambda: model.push_to_hub(NAME)):
        with pytest.raises(ImportError, match=r"pip install -c constraints.txt '\.\[hub\]'"):
            call()
    assert cli.main(["adapt", "--model", NAME]) == 1
    assert "sb3-poem adapt: error: ann/runner: there is no such file" in capsys.readouterr().err
