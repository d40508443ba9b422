"""`gsencoder ask` and the server of transformers, with a tiny model."""

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from asked_rooms import ask
from tiny_vlm import save_tiny_vlm

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("vlm_environment")]

pytest.importorskip("openai")


@pytest.fixture(scope="module")
def real_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """`transformers serve` with a tiny random model: its address and the model's name."""
    pytest.importorskip("fastapi")
    folder = tmp_path_factory.mktemp("vlm")
    save_tiny_vlm(folder / "model")
    (folder / "home" / "hub").mkdir(parents=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [str(Path(sys.executable).with_name("transformers")), "serve", str(folder / "model")]
    options = ["--device", "cpu", "--no-continuous-batching", "--host", "127.0.0.1", "--port", str(port)]
    environment = os.environ | {"HF_HOME": str(folder / "home"), "HF_HUB_OFFLINE": "1"}
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen([*command, *options], stdout=log, stderr=log, env=environment)
    try:
        for _ in range(240):
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5).close()
                break
            except OSError:
                assert process.poll() is None, (folder / "log").read_text()[-2000:]
                time.sleep(0.5)
        else:
            pytest.fail((folder / "log").read_text()[-2000:])
        yield f"http://127.0.0.1:{port}/v1", str(folder / "model")
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def test_a_real_server_takes_what_is_sent_and_answers(features, tmp_path, real_server):
    url, model = real_server
    words = (f"vlm.base_url={url}", f"vlm.model={model}", "vlm.max_tokens=12")
    assert ask(features, tmp_path / "out", *words, "question=Where is the crate?", "query=crate", "task=ground") == 0
    row = json.loads((tmp_path / "out" / "answer.json").read_text())
    assert row["answer"]
    assert row["finish"] in ("stop", "length")
    assert row["tokens"]["prompt"] > 10


def test_a_real_server_refuses_another_model_in_its_own_words(features, tmp_path, real_server, capsys):
    url, _ = real_server
    assert ask(features, tmp_path / "out", f"vlm.base_url={url}", "vlm.model=other", "question=Is it the cube?") == 2
    output = capsys.readouterr().err
    assert "refuses the request" in output or "has no model of that name" in output
    assert "other" in output
