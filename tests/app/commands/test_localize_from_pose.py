"""`gsencoder localize … pose=` and `view=`: what they write, and what they refuse."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from asked_rooms import ORIGIN
from command_runs import refusal, results_of
from PIL import Image

from gsencoder.app import main as cli
from gsencoder.fusion.folder import WORDS_FILE, load_features, save_memories
from gsencoder.text.table import load_text_table, save_text_table
from gsencoder.types import MemoryBank, QueryMemory
from gsencoder.types.checks import OPENCV_FROM_OPENGL

pytestmark = pytest.mark.slow

CUBE = ORIGIN + np.array([0.3, 0.2, 0.8])


def world_pose(features: Path, view: int) -> np.ndarray:
    """cam_from_world of a view in world coordinates."""
    scene = load_features(features)
    pose = scene.views.cameras.cam_from_world[view].astype(np.float64)
    pose[:3, 3] -= pose[:3, :3] @ scene.origin
    return pose


def camera(pose: np.ndarray, key: str = "cam_from_world") -> dict[str, object]:
    return {key: pose.tolist(), "fx": 38.4, "fy": 38.4, "cx": 32, "cy": 24, "width": 64, "height": 48}


def test_words_are_found_from_the_poses_of_a_file_and_from_views_of_the_scene(features: Path, tmp_path: Path) -> None:
    pose = world_pose(features, 3)
    # The same camera, turned to the wall behind it.
    away = np.diag([-1.0, 1, -1, 1]) @ pose
    opengl = np.linalg.inv(pose) @ OPENCV_FROM_OPENGL
    (tmp_path / "poses.json").write_text(json.dumps([camera(pose), camera(opengl, "transform_matrix"), camera(away)]))
    out = tmp_path / "boxes"
    words = ["query=cube,wall", f"pose={tmp_path / 'poses.json'}", "view=frame 03", "pictures=1", f"out={out}"]
    assert cli.main(["localize", str(features), *words, "quiet=true"]) == 0
    points = json.loads((out / "from_pose.json").read_text())
    assert [(each["camera"], each["view"], each["query"]) for each in points] == [
        (number, "frame 03" if number == 3 else None, word) for number in range(4) for word in ("cube", "wall")
    ]
    assert results_of(out)["from_pose"] == points
    assert [each["visible"] for each in points] == [True, True, True, True, False, True, True, True]
    for number in (0, 1, 3):
        cube = points[2 * number]
        assert np.abs(np.array(cube["position"]) - CUBE).max() < 0.25
        at = pose @ np.append(cube["position"], 1)
        np.testing.assert_allclose(at[2], cube["depth"], rtol=1e-4)
        np.testing.assert_allclose(38.4 * at[:2] / at[2] + (32, 24), cube["pixel"], atol=0.01)
        assert cube["relevancy"] >= cube["threshold"]
        assert 0.5 <= cube["alpha"] <= 1.001
    names = {path.name for path in out.glob("pose*.png")}
    assert names == {f"pose{c:03d}_{w}.png" for c in range(4) for w in ("00_cube", "01_wall")}
    with Image.open(out / "pose000_00_cube.png") as picture:
        assert picture.size > (2 * 640, 480)
        # The view on the left and relevancy on the right, both with the cube.
        left, right = (np.asarray(picture)[:, half] for half in (slice(0, 640), slice(-640, None)))
        assert min(left.std(axis=(0, 1)).min(), right.std(axis=(0, 1)).min()) > 1
        assert not np.array_equal(left, right)


def test_without_the_options_nothing_is_added_and_without_pictures_none_is_drawn(features, tmp_path):
    plain, asked = tmp_path / "plain", tmp_path / "asked"
    common = ["localize", str(features), "query=cube", "pictures=0", "quiet=true"]
    assert cli.main([*common, f"out={plain}"]) == 0
    assert cli.main([*common, f"out={asked}", "view=frame 00"]) == 0
    assert {path.name for path in asked.iterdir()} - {path.name for path in plain.iterdir()} == {"from_pose.json"}
    assert (plain / "boxes.json").read_bytes() == (asked / "boxes.json").read_bytes()
    assert "from_pose" not in results_of(plain)


def test_memories_are_asked_by_their_queries(features: Path, tmp_path: Path) -> None:
    scene = load_features(features)
    (kept,) = scene.features.values()
    bank = MemoryBank(
        components=np.eye(4, 16, dtype=np.float32), sources=np.zeros((4, 3), np.int32), threshold=0.9, mean=kept.mean,
        grid_from_image=np.tile(np.eye(2, 3), (4, 1, 1)),
        coverage=1.0, cosine=1.0, space=kept.space,
    )  # fmt: skip
    memory = QueryMemory(
        queries=kept.decode() - kept.mean, weights=kept.weights, projection=np.eye(16, dtype=np.float32), bank=bank,
        scoring="centered", temperature=0.02, mean=kept.mean,
    )  # fmt: skip
    folder, out = tmp_path / "memory", tmp_path / "boxes"
    folder.mkdir()
    save_memories(folder, replace(scene, features={}), {"labels": memory})
    save_text_table(folder / WORDS_FILE, load_text_table(features / WORDS_FILE))
    words = ["query=cube", "view=frame 03", "pictures=1", f"out={out}", "quiet=true"]
    assert cli.main(["localize", str(folder), *words]) == 0
    (cube,) = json.loads((out / "from_pose.json").read_text())
    assert cube["visible"]
    assert np.abs(np.array(cube["position"]) - CUBE).max() < 0.25
    # Every fourth pixel is looked at, from the middle of the first four on.
    assert [value % 4 for value in cube["pixel"]] == [2.5, 2.5]
    assert (out / "pose000_00_cube.png").is_file()


def test_what_cannot_be_asked_is_refused_in_one_line(features, tmp_path, capsys):
    def refused(*words: str) -> str:
        out = tmp_path / "out"
        message = refusal(capsys, "localize", str(features), "query=cube", f"out={out}", *words)
        assert not out.exists()
        return message

    assert "has no view 'frame 99'; its views are frame 00, frame 01" in refused("view=frame 99")
    assert "gone.json: no such file" in refused(f"pose={tmp_path / 'gone.json'}")
    (tmp_path / "pose.json").write_text(json.dumps(camera(np.eye(4)) | {"width": 0}))
    assert "expected width and height as whole numbers" in refused(f"pose={tmp_path / 'pose.json'}")
    assert "leave localize.contrast=true out" in refused("view=frame 00", "localize.contrast=true")
