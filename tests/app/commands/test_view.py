"""`gsencoder view`: the page as a file, its options, the server until Ctrl-C, and what is refused."""

import gzip
import json
import os
import re
import signal
import subprocess
import sys
import urllib.request
from base64 import b64decode
from dataclasses import replace
from pathlib import Path
from shutil import copytree
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command_runs import refusal
from viewed_rooms import STUB, name_features, read_container, room_scene, save_viewed_room

from gsencoder.app import main as cli
from gsencoder.app.commands import view
from gsencoder.fusion.folder import save_features
from gsencoder.infer.page import page as bundle
from gsencoder.infer.page.page import Container, jpeg_of
from gsencoder.text.table import WORDS_FILE
from gsencoder.types import Scene

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("view")
    save_viewed_room(made)
    return made


@pytest.fixture(autouse=True)
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A bundle that was built, in a folder of its own."""
    made = tmp_path / "static"
    made.mkdir()
    (made / bundle.SCRIPT).write_text(STUB.script)
    (made / bundle.STYLE).write_text(STUB.style)
    monkeypatch.setattr(bundle, "STATIC", made)
    return made


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
def test_wrong_options_are_refused_in_one_line(folder, options, message, capsys):
    assert message in refusal(capsys, "view", str(folder / "features"), *options)


def test_a_page_that_was_not_built_is_refused_in_one_line(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bundle, "STATIC", tmp_path / "nowhere")
    assert "make viewer" in refusal(capsys, "view", str(folder / "features"))


SERVE = """
import sys
from pathlib import Path
from gsencoder.infer.page import page as bundle
bundle.STATIC = Path(sys.argv[1])
from gsencoder.app import main as cli
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


def test_folders_of_two_scenes_are_not_shown_side_by_side(folder, tmp_path, capsys, monkeypatch):
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


ROOM = room_scene()


def written(out: Path, *arguments: str | Path) -> tuple[list[Container], dict[str, Any]]:
    """The scenes of the page that a run writes, and the results in its summary."""
    assert cli.main(["view", *map(str, arguments), f"out={out}", "quiet=true"]) == 0
    return page(out)


def page(out: Path) -> tuple[list[Container], dict[str, Any]]:
    """The scenes of a page, and the results in its summary."""
    matches = re.findall(r'id="scene-\d+">([^<]+)<', out.read_text())
    results: dict[str, Any] = json.loads(Path(f"{out}.summary.json").read_text())["results"]
    return [read_container(gzip.decompress(b64decode(blob))) for blob in matches], results


def test_photographs_and_labeled_objects_come_from_the_scene_that_was_fused(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.HTML"
    (scene,), results = written(out, folder / "features", f"photos={folder / 'room'}", "photographs=3")
    assert (results["bytes"], results["photographs"], results["gaussians"]) == (out.stat().st_size, [3], [5156])
    assert [name for name in scene.meta["objects"] if name] == [each.name for each in ROOM.objects if each.name]
    assert scene.meta["photographViews"] == [0, 2, 5]
    first = scene.arrays["photographs"][: scene.meta["photographSizes"][0]].tobytes()
    assert first == jpeg_of(ROOM.views, 0, 640)
    assert results["left_out"][0] == f"This file knows {len(scene.meta['words'])} words."
    (scene,), _ = written(tmp_path / "b.html", folder / "features", f"photos={folder / 'room'}", "photographs=0")
    assert scene.meta["photographs"] is False


def test_options_of_features_boxes_and_words_reach_the_page(folder, tmp_path, capsys):
    features = folder / "features"
    limit = ("localize.threshold.kind=fixed", "localize.threshold.fixed=0.9")
    (scene,), results = written(tmp_path / "a.html", features, *limit, "megabytes=1")
    assert {answer["threshold"] for answer in scene.meta["answers"]} == {float(np.float32(0.9))}
    assert scene.meta["featureError"] <= 0.01
    assert results["feature_error"] == [scene.meta["featureError"]]
    assert (tmp_path / "a.html").stat().st_size <= 1e6
    assert "not even 1,000" in refusal(capsys, "view", str(features), f"out={tmp_path / 'b.html'}", "megabytes=0.02")
    assert "siglip" in refusal(capsys, "view", str(features), f"out={tmp_path / 'b.html'}", "head=siglip")
    assert not (tmp_path / "b.html").exists()


def test_harmonics_stay_and_the_last_line_names_their_degree(tmp_path, capsys):
    for name, degree in (("plain", 0), ("rich", 3)):
        (tmp_path / name).mkdir()
        sh = np.random.default_rng(0).normal(size=(len(ROOM.gaussians), (degree + 1) ** 2, 3)) * 0.1
        save_viewed_room(tmp_path / name, gaussians=replace(ROOM.gaussians, sh=sh.astype(np.float32)))
    folders = [tmp_path / name / "features" for name in ("plain", "rich")]
    capsys.readouterr()
    assert cli.main(["view", *map(str, folders), f"out={tmp_path / 'a.html'}"]) == 0
    assert "spherical harmonics of degree 3" in " ".join(capsys.readouterr().out.split())
    scenes, results = page(tmp_path / "a.html")
    assert results["sh_degree"] == [0, 3]
    # Both folders are called features; their paths tell them apart.
    assert [scene.meta["title"] for scene in scenes] == [str(each) for each in folders]


def test_features_without_words_are_shown_unless_words_are_given(folder, tmp_path, capsys):
    features, _ = name_features(ROOM)
    dense = replace(features, space=replace(features.space, name="dense", text_encoder=""))
    (tmp_path / "dense").mkdir()
    save_features(tmp_path / "dense", replace(ROOM, up=None), dense)
    (scene,), _ = written(tmp_path / "a.html", tmp_path / "dense")
    assert scene.meta["words"] == []
    # Nobody said what is up; the cameras tell.
    np.testing.assert_allclose(scene.meta["up"], [0, 0, 1], atol=0.1)
    words = f"words={folder / 'features' / WORDS_FILE}"
    refused = refusal(capsys, "view", str(tmp_path / "dense"), words, f"out={tmp_path / 'b.html'}")
    assert "has no text encoder" in refused
    assert "none of 'names'" in refusal(capsys, "view", str(tmp_path / "dense"), "space=names")


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """What the server was given, and the addresses that a browser was told to open."""
    seen = SimpleNamespace(opened=[])

    class Recorder:
        address = "http://127.0.0.1:1/token/"

        def __init__(self, page: Any, searches: Any, scenes: Any, **options: Any) -> None:
            seen.page, seen.searches, seen.scenes, seen.options = page, searches, scenes, options

        def __enter__(self) -> "Recorder":
            return self

        def __exit__(self, *error: object) -> None:
            seen.closed = True

        def serve_forever(self, poll_interval: float) -> None:
            raise KeyboardInterrupt

    monkeypatch.setattr(view, "ViewServer", Recorder)
    monkeypatch.setattr(view.webbrowser, "open", seen.opened.append)
    return seen


def test_the_server_gets_the_scene_as_it_is_to_be_searched(folder, served, capsys):
    arguments = ["max_gaussians=1500", "localize.min_probability=0.1", "port=4321"]
    assert cli.main(["view", str(folder / "features"), f"photos={folder / 'room'}", *arguments]) == 0
    assert served.options == {"port": 4321}
    (search,) = served.searches
    assert len(search.display.gaussians) == 1500
    assert search.config.min_probability == 0.1
    assert search.display.title == "features"
    assert any(served.scenes[0].meta["objects"])
    assert served.scenes[0].meta["photographs"] is True
    assert served.closed
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("http://127.0.0.1:1/token/ shows ")


@pytest.mark.parametrize(
    ("option", "terminal", "opens"),
    [(None, True, True), (None, False, False), ("open=true", False, True), ("open=false", True, False)],
)
def test_a_browser_is_opened_when_told_or_at_a_terminal(folder, served, monkeypatch, option, terminal, opens):
    monkeypatch.setattr(view.sys.stdout, "isatty", lambda: terminal, raising=False)
    assert cli.main(["view", str(folder / "features"), "quiet=true", *([option] if option else [])]) == 0
    assert served.opened == (["http://127.0.0.1:1/token/"] if opens else [])
