"""`gsencoder ask` against a server that repeats the key wherever it can: nothing on disk or screen holds it."""

import html
import json
import re
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from chat_server import Handler, completion, serving

from gsencoder.app import main as cli

pytestmark = pytest.mark.slow

pytest.importorskip("openai")

KEY = "sk-never+to/be&written=0123456789"
SPELLINGS = {
    KEY, quote(KEY, safe=""), quote(KEY), html.escape(KEY), json.dumps(KEY)[1:-1].replace("/", "\\/"), KEY[:20],
}  # fmt: skip
ESCAPE = "\x1b[31m"


def echo(status: int, spelling: str, form: str) -> Any:
    """A reply that holds the key in every part that it has."""
    told = f"{ESCAPE}{spelling}"

    def behave(handler: Handler, body: Any) -> None:
        whole = completion(f"a {told}", told) | {"model": told, "id": told, "system_fingerprint": told}
        whole["usage"] = {"prompt_tokens": 5, "completion_tokens": told, "total_tokens": 5}
        half = len(told) // 2
        if form == "error":
            error = {"message": told, "type": told, "code": told, "param": told}
            kind, data = "application/json", json.dumps({"error": error, "detail": told}).encode()
        elif form == "page":
            kind, data = "text/html", f"<html>{told}</html>".encode()
        else:
            pieces = [
                {"index": 0, "delta": {"content": text, "role": told}, "finish_reason": finish}
                for text, finish in ((told[:half], None), (told[half:], told))
            ]
            chunks = [whole | {"object": "chat.completion.chunk", "choices": [piece]} for piece in pieces]
            chunks += [{"error": {"message": told}}] if form == "broken" else []
            kind, data = "text/event-stream", b"".join(f"data: {json.dumps(chunk)}\n\n".encode() for chunk in chunks)
        handler.send_response(status, spelling)
        handler.send_header("Content-Type", kind)
        handler.send_header("Content-Length", str(len(data)))
        handler.send_header("X-Request-Id", spelling)
        if 300 <= status < 400:
            handler.send_header("Location", f"http://{quote(KEY, safe='')}.invalid/{spelling}")
        handler.end_headers()
        handler.wfile.write(data)

    return behave


@pytest.mark.parametrize(("many", "debug"), [(False, ("--debug",)), (True, ())])
def test_a_key_that_a_server_repeats_reaches_no_disk_or_screen(features, tmp_path, monkeypatch, capsys, many, debug):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    (tmp_path / "q.jsonl").write_text('{"question": "Where is the cube?"}\n{"question": "the left one"}\n')
    question = f"questions={tmp_path / 'q.jsonl'}" if many else "question=Where is the cube?"
    words = ["vlm.model=m", "vlm.retries=0", "choose.source=frames", "choose.candidates=2", "choose.count=1"]
    escaped = quote(KEY, safe="")
    cases = [(200, "answer", KEY), (200, "answer", escaped), (200, "broken", KEY), (200, "page", KEY)]
    cases += [(status, "error", KEY) for status in ((400,) if many else (307, 401, 404, 500))]
    codes = set()
    for number, (status, form, spelling) in enumerate(cases):
        with serving(echo(status, spelling, form)) as server:
            where = [f"vlm.base_url={server.url}", f"out={tmp_path / f'out{number}'}"]
            codes.add(cli.main(["ask", str(features), question, *where, *words, *debug]))
            assert server.requests[0][0]["authorization"] == f"Bearer {KEY}"
    assert codes == {0, 2}
    screen = "".join(capsys.readouterr())
    assert ESCAPE not in screen
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert any(path.name.startswith("answer") for path in files)
    everything = b"".join(path.read_bytes() for path in files).decode("utf-8", "replace") + screen
    assert {spelling for spelling in SPELLINGS if spelling in everything} == set()


MISSPELT = ("vlm.kee", "kee", "vlm.key.x", "VLM.KEY", "vlm.Key ", "vlm-key", "+vlm.key", "++vlm.key", "~vlm.key")
MISSPELT += ("--key", "-key", "--vlm.key", "vlm", "@vlm.key")


@pytest.mark.parametrize("flags", [(), ("--debug",), ("--cfg",), ("-m", "out=o")])
def test_a_secret_whose_option_is_misspelt_is_not_repeated(tmp_path, capsys, flags):
    words = [f"{name}={KEY}" for name in (MISSPELT if not flags else MISSPELT[:2])]
    for word in [*words, f"vlm={{key: {KEY}}}"]:
        assert cli.main(["ask", str(tmp_path), "question=x", word, *flags]) == 2
        assert KEY[:8] not in "".join(capsys.readouterr())


def test_a_secret_in_the_wrong_position_is_not_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        [f"vlm.key={KEY}", "ask"],
        ["synthetic", "--", f"vlm.key={KEY}"],
        ["ask", f"vlm.key={KEY}", "paths=a"],
    ):
        cli.main(words)
        assert KEY[:8] not in "".join(capsys.readouterr())
    with pytest.MonkeyPatch.context() as within:
        within.chdir(tmp_path)
        assert cli.main(["ask", "folder", "paths=a", "--", f"vlm.kee={KEY}"]) == 2
    assert re.search(r"error: paths: given both", capsys.readouterr().err)
