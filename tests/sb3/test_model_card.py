"""The model card, and pushing a run to a hub: here one that runs in this process."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from huggingface_hub import ModelCard, constants
from huggingface_hub.utils import close_session

from regil_sb3.cli import main
from regil_sb3.model_card import write_card

REPO = "someone/reach"
COMMIT = "0" * 40


@pytest.fixture
def run(toy_run, tmp_path):
    """A copy: pushing writes a new card."""
    return shutil.copytree(toy_run, tmp_path / "run")


class Hub(BaseHTTPRequestHandler):
    """As much of the hub's interface as uploads and downloads of small files use."""

    def answer(self, value, status=200, **headers):
        body = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.send_response(status)
        for name, text in {"Content-Length": str(len(body)), **headers}.items():
            self.send_header(name.replace("_", "-"), text)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        hub = self.server
        if self.headers["Authorization"] != "Bearer hf_let_me_in":
            self.answer({"error": "Invalid credentials"}, 401)
        elif self.path == "/api/repos/create":
            wanted = json.loads(body)
            known = hub.private is not None
            if not known:
                hub.private = wanted.get("private") or wanted.get("visibility") == "private"
            url = f"{hub.address}/{wanted['organization']}/{wanted['name']}"
            self.answer({"url": url}, 409 if known else 200)
        elif self.path == "/api/validate-yaml":
            self.answer({"errors": [], "warnings": []})
        elif self.path.startswith(f"/api/models/{REPO}/preupload/"):
            files = json.loads(body)["files"]
            modes = [{"path": f["path"], "uploadMode": "regular"} for f in files]
            self.answer({"files": [m | {"shouldIgnore": False} for m in modes]})
        elif self.path.startswith(f"/api/models/{REPO}/commit/"):
            for line in map(json.loads, body.splitlines()):
                if line["key"] == "file":
                    content = base64.b64decode(line["value"]["content"])
                    hub.files[line["value"]["path"]] = content
            url = f"{hub.address}/{REPO}/commit/{COMMIT}"
            self.answer({"success": True, "commitOid": COMMIT, "commitUrl": url})
        else:
            self.answer({"error": self.path}, 404)

    def do_GET(self):
        hub = self.server
        found = re.fullmatch(rf"/{REPO}/resolve/\w+/(.+)", self.path)
        if found and found[1] in hub.files:
            content = hub.files[found[1]]
            tag = f'"{hashlib.sha1(content).hexdigest()}"'
            self.answer(content, ETag=tag, X_Repo_Commit=COMMIT)
        elif re.match(rf"/api/models/{REPO}/tree/", self.path):
            entries = [(name, content) for name, content in hub.files.items()]
            self.answer(
                [
                    {
                        "type": "file",
                        "path": name,
                        "size": len(content),
                        "oid": hashlib.sha1(content).hexdigest(),
                    }
                    for name, content in entries
                ]
            )
        elif re.match(rf"/api/models/{REPO}(/revision/|\?|$)", self.path):
            siblings = [{"rfilename": name} for name in hub.files]
            facts = {"id": REPO, "sha": COMMIT, "siblings": siblings}
            self.answer({**facts, "private": hub.private, "tags": []})
        else:
            self.answer({"error": self.path}, 404)

    do_HEAD = do_GET  # noqa: N815

    def log_message(self, *_):
        pass


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """A hub with nothing on it, and somebody logged in."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    server.socket.listen(64)  # a download connects many times at once
    server.files, server.private = {}, None
    server.address = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    monkeypatch.setattr(constants, "ENDPOINT", server.address)
    template = constants.HUGGINGFACE_CO_URL_TEMPLATE.removeprefix(constants._HF_DEFAULT_ENDPOINT)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", server.address + template)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "token"))
    monkeypatch.setenv("HF_TOKEN", "hf_let_me_in")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    close_session()
    yield server
    close_session()
    server.shutdown()
    server.server_close()


def test_the_hub_understands_the_card(run):
    card = ModelCard.load(run / "README.md")
    evaluation = json.loads((run / "evaluation.json").read_text())
    assert card.data.library_name == "stable-baselines3"
    assert {"regil", "td3bc", "ToyReach-v0"} <= set(card.data.tags)
    results = {r.metric_name: r for r in card.data.eval_results}
    assert {r.dataset_name for r in results.values()} == {"ToyReach-v0"}
    assert {r.metric_type for r in results.values()} == {"success_rate"}
    said = results["success of model.zip in 2 unseen episodes"].metric_value
    assert said == evaluation["policy"]["success"]
    best = results["success of best_model.zip in 2 unseen episodes"].metric_value
    assert best == evaluation["best_policy"]["success"]
    for name in ("policy", "guide", "bc"):
        assert f"| {evaluation[name]['success']:.2f} |" in card.text


def test_the_card_follows_the_evaluation(run):
    evaluation = json.loads((run / "evaluation.json").read_text())
    evaluation["policy"]["success"] = 0.625
    (run / "evaluation.json").write_text(json.dumps(evaluation))
    write_card(run)
    assert ModelCard.load(run / "README.md").data.eval_results[0].metric_value == 0.625


def test_pushed_and_used_as_the_card_says(run, hub, capsys):
    assert main(["push", str(run), REPO]) == 0
    printed = capsys.readouterr().out
    assert printed.strip().endswith(f"{hub.address}/{REPO}")
    assert "model.zip" in printed
    assert not hub.private
    for name, content in hub.files.items():
        assert content == (run / name).read_bytes()
    left = {path.name for path in run.iterdir()} - set(hub.files)
    assert left == {".lock", "success_buffer.npz"}
    card = hub.files["README.md"].decode()
    (code,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    assert REPO in code
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    names["env"].close()
    assert names["run"] != run
    assert names["action"].shape == (1, 2)


def test_private_stays_private(run, hub, capsys):
    assert main(["push", str(run), REPO, "--private"]) == 0
    assert hub.private is True
    hub.private, hub.files = False, {}
    assert main(["push", str(run), REPO, "--private"]) == 2
    assert f"{REPO} exists and is public" in capsys.readouterr().err
    assert not hub.files


@pytest.mark.parametrize(
    ("token", "repo", "message"),
    [
        (None, REPO, "not logged in"),
        ("hf_wrong", REPO, "did not take"),
        ("hf_let_me_in", "a/b/c", "a/b/c"),
    ],
)
def test_what_fails_is_one_line_and_uploads_nothing(
    token, repo, message, run, hub, monkeypatch, capsys
):
    monkeypatch.delenv("HF_TOKEN")
    if token:
        monkeypatch.setenv("HF_TOKEN", token)
    assert main(["push", str(run), repo]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1, error
    assert not hub.files


def test_no_hub_is_one_line(run, hub, monkeypatch, capsys):
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert main(["push", str(run), REPO]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_only_an_evaluated_run_is_pushed(run, hub, capsys):
    (run / "evaluation.json").unlink()
    assert main(["push", str(run), REPO]) == 2
    assert f"regil evaluate {run}" in capsys.readouterr().err
    (run / "config.yaml").unlink()
    assert main(["push", str(run), REPO]) == 2
    assert "is not a run folder" in capsys.readouterr().err
    assert not hub.files


def test_without_the_extra(run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    assert main(["push", str(run), REPO]) == 2
    assert "pip install 'regil-sb3[hub]'" in capsys.readouterr().err
