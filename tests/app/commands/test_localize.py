"""`gsencoder localize`: where its words come from; what `pose=` and `view=` write, hand on, and refuse."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asked_rooms import ORIGIN
from command_runs import refusal, results_of
from memory_samples import make_memory
from PIL import Image
from splats import front_camera, random_gaussians

from gsencoder.app import main as cli
from gsencoder.app.commands.localize import LocalizeCommandConfig, memory_of, search_from_poses
from gsencoder.app.scenes import MAX_QUERIES_BYTES, load_words, query_words
from gsencoder.core.errors import InputError
from gsencoder.fusion.folder import load_features, save_features, save_memories
from gsencoder.infer.from_pose import FromPoseConfig, from_pose
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.infer.relevancy import ThresholdConfig
from gsencoder.text.table import WORDS_FILE, make_text_table, save_text_table
from gsencoder.text.vocabulary import closed_table
from gsencoder.types import FeatureSpace, GaussianFeatures, QueryMemory, Scene
from gsencoder.types.scene import OPENCV_FROM_OPENGL

CUBE = ORIGIN + np.array([0.3, 0.2, 0.8])


def world_pose(features: Path, view: int) -> np.ndarray:
    """cam_from_world of a view in world coordinates."""
    scene = load_features(features)
    pose = scene.views.cameras.cam_from_world[view].astype(np.float64)
    pose[:3, 3] -= pose[:3, :3] @ scene.origin
    return pose


def camera(pose: np.ndarray, key: str = "cam_from_world") -> dict[str, object]:
    return {key: pose.tolist(), "fx": 38.4, "fy": 38.4, "cx": 32, "cy": 24, "width": 64, "height": 48}


@pytest.mark.slow
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


@pytest.mark.slow
def test_without_the_options_nothing_is_added_and_without_pictures_none_is_drawn(features, tmp_path):
    plain, asked = tmp_path / "plain", tmp_path / "asked"
    common = ["localize", str(features), "query=cube", "pictures=0", "quiet=true"]
    assert cli.main([*common, f"out={plain}"]) == 0
    assert cli.main([*common, f"out={asked}", "view=frame 00"]) == 0
    assert {path.name for path in asked.iterdir()} - {path.name for path in plain.iterdir()} == {"from_pose.json"}
    assert (plain / "boxes.json").read_bytes() == (asked / "boxes.json").read_bytes()
    assert "from_pose" not in results_of(plain)


@pytest.mark.slow
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


WIDTH = 24
NAMES = ("mug", "chair")
TEXT = make_text_table(NAMES, np.linalg.qr(np.ones((WIDTH, 2)) + np.eye(WIDTH, 2))[0].T.astype(np.float32), "toy")


def toy_scene(count: int = 200) -> Scene:
    rng = np.random.default_rng(0)
    features = GaussianFeatures(
        features=(rng.normal(size=(count, WIDTH)) + 1).astype(np.float32),
        weights=np.ones(count, np.float32),
        mean=np.ones(WIDTH, np.float32),
        space=FeatureSpace(name="s", channels=WIDTH, text_encoder="toy"),
    )
    ball = random_gaussians(count, log_scale=-1.6)
    return Scene(name="toy", gaussians=replace(ball, opacities=np.sqrt(ball.opacities)), features={"s": features})


FIXED, OTSU = ThresholdConfig(kind="fixed", fixed=0.99), ThresholdConfig(kind="otsu")


@pytest.mark.parametrize("settings", [{"mode": "raw"}, {"threshold": FIXED}, {"threshold": OTSU}])
def test_points_are_those_of_the_mode_and_the_threshold_that_are_asked_for(settings: dict[str, Any]) -> None:
    config, scene, cameras = LocalizeConfig(**settings), toy_scene(), front_camera()
    ((points, drawn),) = search_from_poses(scene, cameras, [None], NAMES, TEXT, config, pictures=False)
    expected = from_pose(scene, cameras, NAMES, TEXT, FromPoseConfig(mode=config.mode, threshold=config.threshold))
    assert [(each["relevancy"], each["threshold"], each["visible"]) for each in points] == [
        (each.relevancy, each.threshold, each.visible) for each in expected
    ]
    usual = from_pose(scene, cameras, NAMES, TEXT)
    assert points[0]["threshold"] != usual[0].threshold
    assert drawn == []


def memory_in(name: str) -> QueryMemory:
    memory = make_memory()
    return replace(memory, bank=replace(memory.bank, space=FeatureSpace(name=name, channels=WIDTH)))


def test_the_memory_that_is_asked_is_that_of_the_features_of_the_scene(tmp_path: Path) -> None:
    scene = Scene(name="toy", gaussians=random_gaussians(200))
    save_memories(tmp_path / "several", scene, {"a": memory_in("first"), "b": memory_in("second")})
    loaded = load_features(tmp_path / "several")
    for teacher, name in (("a", "first"), ("b", "second")):
        memory = memory_of(tmp_path / "several", replace(loaded, features={teacher: loaded.features[teacher]}))
        assert memory.space.name == name
    save_features(tmp_path / "features", scene, memory_in("first").features())
    assert memory_of(tmp_path / "features", load_features(tmp_path / "features")) is None


def asked_words(**settings: object) -> list[str]:
    config = LocalizeCommandConfig(**settings)  # type: ignore[arg-type]
    return query_words(config.query, config.queries)


def test_words_of_query_and_file_are_asked_once_each_in_order(tmp_path: Path) -> None:
    (tmp_path / "q.txt").write_bytes("\ufeffmug\r\n\n  red ball \nmug\n".encode())
    assert asked_words(query=(" ball", "mug"), queries=str(tmp_path / "q.txt")) == ["ball", "mug", "red ball"]


def test_a_file_of_queries_must_be_a_text_file_of_sensible_size(tmp_path: Path) -> None:
    (tmp_path / "q.txt").write_bytes(b"\n \n")
    with pytest.raises(InputError, match="query= is missing"):
        asked_words(queries=str(tmp_path / "q.txt"))
    (tmp_path / "q.txt").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match="cannot be read as text"):
        asked_words(queries=str(tmp_path / "q.txt"))
    (tmp_path / "q.txt").write_bytes(b"x" * (MAX_QUERIES_BYTES + 1))
    with pytest.raises(InputError, match="at most 1,048,576 are read"):
        asked_words(queries=str(tmp_path / "q.txt"))


def test_words_that_are_given_are_those_trained_on_that_the_folder_of_the_features_states(tmp_path: Path) -> None:
    table = make_text_table(["mug", "ball"], np.eye(2, dtype=np.float32), "toy")
    words_table = make_text_table(["mug", "cup"], np.eye(2, dtype=np.float32), "toy")
    save_text_table(tmp_path / WORDS_FILE, table.trained_on(["mug", "ball"]))
    save_text_table(tmp_path / "given.safetensors", words_table)
    path = str(tmp_path / "given.safetensors")

    def trained(folder: Path) -> tuple[str, ...] | None:
        return closed_table(load_words(folder, table.space, path)).trained

    assert trained(tmp_path) == ("mug",)
    save_text_table(tmp_path / "given.safetensors", replace(words_table, trained=("cup",)))
    assert trained(tmp_path) == ("cup",)
    # Where the folder states none, or its table is lost or damaged, the words that are given are taken as they are.
    save_text_table(tmp_path / "given.safetensors", words_table)
    (tmp_path / "without").mkdir()
    assert trained(tmp_path / "without") is None
    (tmp_path / WORDS_FILE).write_bytes(b"damaged")
    assert trained(tmp_path) is None
