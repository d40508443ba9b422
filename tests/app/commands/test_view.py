"""`gsencoder view`: the page as a file, the server until Ctrl-C, and what is refused."""

import json
import os
import re
import signal
import subprocess
import sys
import urllib.request
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import pytest
from command_runs import refusal
from viewed_rooms import STUB, save_viewed_room

from gsencoder.app import main as cli
from gsencoder.app.commands import view
from gsencoder.infer.page import page as bundle
from gsencoder.types import Scene

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("view")
    save_viewed_room(made)
    return made


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A bundle that was built, in a folder of its own."""
    made = tmp_path / "static"
    made.mkdir()
    (made / bundle.SCRIPT).write_text(STUB.script)
    (made / bundle.STYLE).write_text(STUB.style)
    monkeypatch.setattr(bundle, "STATIC", made)
    return made


def test_a_page_is_written_with_a_summary_of_what_it_holds(folder: Path, built: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    arguments = ["view", str(folder / "features"), f"photos={folder / 'room'}", f"out={out}", "photographs=2"]
    assert cli.main([*arguments, "quiet=true"]) == 0
    results = json.loads(Path(f"{out}.summary.json").read_text())["results"]
    assert results["bytes"] == out.stat().st_size
    assert results["photographs"] == [2]
    assert results["gaussians"] == [5156]
    assert 'id="scene-0"' in out.read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["out=page.txt"], "ends in .html"),
        (["port=70000"], "port: expected 0 or more and below 65,536"),
        (["localize.contrast=true"], "centered cosines"),
        (["photos=nowhere"], "nowhere"),
        (["space=other"], "none of 'other'"),
    ],
)
def test_wrong_options_are_refused_in_one_line(folder, built, options, message, capsys):
    assert message in refusal(capsys, "view", str(folder / "features"), *options)


def test_a_page_that_was_not_built_is_refused_in_one_line(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bundle, "STATIC", tmp_path / "nowhere")
    assert "make viewer" in refusal(capsys, "view", str(folder / "features"))


SERVE = """
import sys
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from gsencoder.infer.page import page as bundle
from gsencoder.types import Scene
bundle.STATIC = Path(sys.argv[1])
from gsencoder.app import main as cli
from gsencoder.app.commands import view
sys.exit(cli.main(["view", sys.argv[2], "open=false"]))
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_the_server_answers_until_it_is_stopped_and_then_says_how_it_ended(folder, built, number, code):
    # The address comes at once even where Python collects what is printed into a pipe.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-c", SERVE, str(built), str(folder / "features")]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        # A background job of a shell begins with the signal ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        line = process.stdout.readline()
        address = re.match(r"http://127\.0\.0\.1:\d+/[\w-]{32}/", line)
        assert address is not None, line
        with urllib.request.urlopen(address[0]) as page:
            assert page.read().startswith(b"<!doctype html>")
        process.send_signal(number)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == code
    assert "Traceback" not in errors


def test_folders_of_two_scenes_are_not_shown_side_by_side(folder, built, tmp_path, capsys, monkeypatch):
    features, other = folder / "features", tmp_path / "other"
    copytree(features, other)
    load = view.load_features

    def renamed(path: Path) -> Scene:
        scene = load(path)
        return replace(scene, name="elsewhere") if path == other else scene

    monkeypatch.setattr(view, "load_features", renamed)
    message = refusal(capsys, "view", str(features), str(other), f"out={tmp_path / 'two.html'}")
    assert "and" in message
    assert "of elsewhere; give two folders of one scene" in message
    assert not (tmp_path / "two.html").exists()
