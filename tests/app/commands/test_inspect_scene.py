"""`inspect` and `repair` of scenes: what they say, what they write, and what they refuse."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from textured_box import box_cameras, box_views, write_box

from gsencoder.app import main as cli
from gsencoder.data.readers.transforms_json import read_transforms, transforms_of
from gsencoder.data.readers.undistort import CameraModel
from gsencoder.data.scenes import load_scene, read_posed
from gsencoder.types import Cameras
from gsencoder.types.checks import OPENCV_FROM_OPENGL

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


def wrong_focal(content: dict[str, Any]) -> None:
    content["fl_x"] *= 1.1
    content["fl_y"] *= 1.1


def two_exchanged(content: dict[str, Any]) -> None:
    second, last = (content["frames"][row] for row in (1, 6))
    second["transform_matrix"], last["transform_matrix"] = last["transform_matrix"], second["transform_matrix"]


FAULTS: dict[str, tuple[Change, str, str]] = {
    "axes": (opencv_axes, "OpenGL's camera axes", f"{VIEWS} of {VIEWS} views"),
    "focal length": (wrong_focal, r"focal length of the photographs is 0\.9", f"{VIEWS} of {VIEWS} views"),
    "two exchanged": (two_exchanged, "view images/00[16].png: its pose does not fit", "6 of 8 views"),
}


def changed(box: Path, folder: Path, change: Change) -> Path:
    """The same scene with a changed transforms.json."""
    folder.mkdir()
    for name in ("images", "depth"):
        (folder / name).symlink_to(box / name)
    content = json.loads((box / "transforms.json").read_text())
    change(content)
    content["frames"] = [
        {**frame, "file_path": frame["file_path"], "depth_file_path": frame["depth_file_path"]}
        for frame in content["frames"]
    ]
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def said(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, on one line."""
    return " ".join(capsys.readouterr().out.split())


def test_inspect_shows_what_a_scene_holds_and_draws_its_check(box, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["inspect", str(box), f"out={out}"]) == 0
    printed = said(capsys)
    for text in (
        "transforms.json",
        f"{VIEWS}: 160×120 ({VIEWS})",
        "f = 112.0 pixels, 71° × 56°",
        f"{VIEWS} of {VIEWS} views, 100% of the",
    ):
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
        "depth",
        "images",
        "repaired.json",
        "repaired.json.summary.json",
        "transforms.json",
    ]


def test_repair_of_a_scene_without_faults_writes_nothing(box, tmp_path, capsys):
    out = tmp_path / "repaired.json"
    assert cli.main(["repair", str(box), f"out={out}"]) == 2
    assert "nothing wrong was seen, so there is nothing to repair" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert cli.main(["repair", str(box), f"out={tmp_path / 'repaired.ply'}"]) == 2
    assert "give a name in .json" in capsys.readouterr().err


def test_photographs_and_depth_of_two_cameras_are_registered_by_repair(tmp_path, capsys):
    cameras, beside = few_cameras(8), few_cameras(8, 0.9 * 112)
    poses = beside.cam_from_world.copy()
    poses[:, 0, 3] += 0.03
    write_box(tmp_path / "box", box_views(cameras, color_cameras=replace(beside, cam_from_world=poses)))
    repaired = tmp_path / "box" / "registered.json"
    assert cli.main(["repair", str(tmp_path / "box"), f"out={repaired}"]) == 0
    said(capsys)
    assert cli.main(["inspect", str(repaired)]) == 0
    printed = said(capsys)
    assert "not registered in the files: f = 112 (photographs 100" in printed
    assert "nothing wrong was seen" in printed
    views = load_scene(repaired).views
    np.testing.assert_allclose(views.cameras.Ks[:, 0, 0], 0.9 * 112, rtol=0.005)
    np.testing.assert_allclose(views.cameras.centers, replace(beside, cam_from_world=poses).centers, atol=0.004)


def test_posed_images_that_are_written_are_read_back(box: Path) -> None:
    posed = read_posed(box)[0]
    models = [
        CameraModel(model="SIMPLE_RADIAL", width=160, height=120, params=(100.0, 80.0, 60.0, 0.01)),
        CameraModel(model="RADIAL", width=160, height=120, params=(100.0, 80.0, 60.0, 0.01, -0.02)),
        CameraModel(
            model="FULL_OPENCV",
            width=160,
            height=120,
            params=(100.0, 105.0, 80.0, 60.0, 0.01, -0.02, 0.001, 0.002, 0.003, 0.0, 0.0, 0.0),
        ),
        CameraModel(
            model="OPENCV_FISHEYE", width=160, height=120, params=(100.0, 105.0, 80.0, 60.0, 0.01, 0.02, 0.03, 0.04)
        ),
    ]
    depth_from_color = np.eye(4)
    depth_from_color[0, 3] = 0.025
    images = tuple(
        replace(
            image,
            camera=models[view % 4],
            depth_camera=models[0] if view % 2 else None,
            depth_from_color=depth_from_color if view % 2 else None,
            depth_measure="ray" if view % 3 else "z",
            no_depth=65535 if view % 2 else None,
        )
        for view, image in enumerate(posed.images)
    )
    written = replace(posed, images=images, metres_per_unit=0.5, up=np.array([0.0, 1.0, 0.0]))
    path = box / "written.json"
    path.write_text(json.dumps(transforms_of(written, box)))
    try:
        read = read_transforms(path)
    finally:
        path.unlink()
    assert (read.metres_per_unit, read.up is not None and read.up.tolist()) == (0.5, [0, 1, 0])
    for before, after in zip(images, read.images, strict=True):
        np.testing.assert_allclose(after.cam_from_world, before.cam_from_world, atol=1e-9)
        assert after.camera.pinhole_params() == before.camera.pinhole_params()
        distortion = [value for value in before.camera.params[3:] if value]
        assert [value for value in after.camera.params[3:] if value][-len(distortion) :] == distortion
        for name in ("depth_measure", "no_depth", "depth_scale", "image", "depth"):
            assert getattr(after, name) == getattr(before, name)
        assert (after.depth_camera is None) == (before.depth_camera is None)
        if before.depth_from_color is not None:
            np.testing.assert_array_equal(after.depth_from_color, before.depth_from_color)


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
