"""`inspect` and `repair` of scenes: what they say, what they write, and what they refuse."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from textured_box import box_cameras, box_views, write_box

from gsencoder.app import main as cli
from gsencoder.types import Cameras
from gsencoder.types.scene import OPENCV_FROM_OPENGL

VIEWS = 4
Change = Callable[[dict[str, Any]], None]


def few_cameras(count: int = VIEWS, focal: float = 112.0) -> Cameras:
    """The first of an arc of ten: what a check takes grows with the square of their number."""
    return box_cameras(width=160, height=120, focal=focal).select(range(count))


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "box"
    write_box(folder, box_views(few_cameras()))
    return folder


@pytest.fixture(scope="module")
def arc(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of so many views two are few."""
    folder = tmp_path_factory.mktemp("scenes") / "arc"
    write_box(folder, box_views(few_cameras(8)))
    return folder


def matrices(content: dict[str, Any]) -> np.ndarray:
    return np.array([frame["transform_matrix"] for frame in content["frames"]])


def set_matrices(content: dict[str, Any], poses: np.ndarray) -> None:
    for frame, pose in zip(content["frames"], poses, strict=True):
        frame["transform_matrix"] = pose.tolist()


def opencv_axes(content: dict[str, Any]) -> None:
    set_matrices(content, matrices(content) @ OPENCV_FROM_OPENGL)


def two_exchanged(content: dict[str, Any]) -> None:
    second, last = (content["frames"][row] for row in (1, 6))
    second["transform_matrix"], last["transform_matrix"] = last["transform_matrix"], second["transform_matrix"]


FAULTS: dict[str, tuple[Change, str, str]] = {
    "axes": (opencv_axes, "OpenGL's camera axes", f"{VIEWS} of {VIEWS} views"),
    "two exchanged": (two_exchanged, "view images/00[16].png: its pose does not fit", "6 of 8 views"),
}


def changed(box: Path, folder: Path, change: Change) -> Path:
    """The same scene with a changed transforms.json."""
    folder.mkdir()
    for name in ("images", "depth"):
        (folder / name).symlink_to(box / name)
    content = json.loads((box / "transforms.json").read_text())
    change(content)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, on one line."""
    return " ".join(capsys.readouterr().out.split())


def test_inspect_shows_what_a_scene_holds_and_draws_its_check(box, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["inspect", str(box), f"out={out}"]) == 0
    printed = said(capsys)
    shown = ("transforms.json", f"{VIEWS}: 160×120 ({VIEWS})", "f = 112.0 pixels, 71° × 56°")
    for text in (*shown, f"{VIEWS} of {VIEWS} views, 100% of the"):
        assert text in printed
    assert "nothing wrong was seen" in printed
    record = json.loads((out / "summary.json").read_text())["results"]["scenes"][0]
    assert record["layout"] == "transforms.json"
    assert record["depth"]["views"] == VIEWS
    assert record["up"] == {"direction": [0, 0, 1], "source": "files", "confidence": 1.0}
    assert record["findings"] == []
    assert record["check"]["depth"]["share"] > 0.95
    with Image.open(out / record["picture"]) as picture:
        colors = np.asarray(picture.convert("RGB"))
    assert (colors == (44, 160, 44)).all(axis=2).mean() > 0.1


@pytest.mark.parametrize("fault", FAULTS)
def test_repair_writes_a_scene_without_the_fault_that_inspect_names(box, arc, tmp_path, capsys, fault):
    change, message, views = FAULTS[fault]
    scene = changed(arc if fault == "two exchanged" else box, tmp_path / "wrong", change)
    outside = "data.allow_outside=true"
    assert cli.main(["inspect", str(scene), outside]) == 0
    assert re.search(f"wrong: .*{message}", said(capsys))
    repaired = scene / "repaired.json"
    assert cli.main(["repair", str(scene), f"out={repaired}", outside]) == 0
    assert views in said(capsys)
    assert cli.main(["inspect", str(repaired), outside]) == 0
    assert "nothing wrong was seen" in said(capsys)
    assert sorted(path.name for path in scene.iterdir()) == [
        "depth", "images", "repaired.json", "repaired.json.summary.json", "transforms.json",
    ]  # fmt: skip


def test_repair_of_a_scene_without_faults_writes_nothing(box, tmp_path, capsys):
    out = tmp_path / "repaired.json"
    assert cli.main(["repair", str(box), f"out={out}"]) == 2
    assert "nothing wrong was seen, so there is nothing to repair" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert cli.main(["repair", str(box), f"out={tmp_path / 'repaired.ply'}"]) == 2
    assert "give a name in .json" in capsys.readouterr().err


def test_inspect_of_a_folder_shows_each_scene_and_a_splat_beside_none(box, tmp_path, capsys):
    for name in ("one", "two"):
        changed(box, tmp_path / name, lambda content: None)
    assert cli.main(["inspect", str(tmp_path), "check=false", "data.allow_outside=true"]) == 0
    printed = said(capsys)
    assert str(tmp_path / "one") in printed
    assert str(tmp_path / "two") in printed
    assert "agree" not in printed
    empty = tmp_path / "empty"
    empty.mkdir()
    assert cli.main(["inspect", str(empty)]) == 2
    assert "neither a scene nor a folder of scenes" in capsys.readouterr().err


def test_one_view_alone_is_inspected(box: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["inspect", str(box), "data.max_views=1"]) == 0
    assert "one view alone has nothing to be held against" in said(capsys)
