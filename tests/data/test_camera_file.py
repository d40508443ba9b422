"""Files of cameras: both forms of poses, the origin of the scene, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from splats import random_rotation

from gsencoder.core.errors import InputError
from gsencoder.data.readers.transforms_json import MAX_PIXELS, read_cameras
from gsencoder.types.scene import OPENCV_FROM_OPENGL

ORIGIN = np.zeros(3)
INTRINSICS = {"fx": 500.0, "fy": 510.0, "cx": 320.5, "cy": 239.5, "width": 640, "height": 480}


def pose(rng: np.random.Generator, distance: float = 3.0) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = random_rotation(rng), distance * rng.normal(size=3)
    return matrix


def write(path: Path, value: object) -> Path:
    path.write_text(json.dumps(value))
    return path


def test_a_camera_or_a_list_of_cameras_is_read_as_it_stands(tmp_path, rng):
    poses = [pose(rng), pose(rng)]
    entries = [{"cam_from_world": matrix.tolist(), **INTRINSICS} for matrix in poses]
    entries[1] |= {"width": 320.0, "cam_from_world": poses[1][:3].tolist()}
    both = read_cameras(write(tmp_path / "both.json", entries), ORIGIN)
    np.testing.assert_allclose(both.cam_from_world, poses, atol=1e-6)
    assert both.widths.tolist() == [640, 320]
    assert both.heights.tolist() == [480, 480]
    assert both.Ks[0].tolist() == [[500, 0, 320.5], [0, 510, 239.5], [0, 0, 1]]
    one = read_cameras(write(tmp_path / "one.json", entries[0]), ORIGIN)
    assert np.array_equal(one.cam_from_world, both.cam_from_world[:1])


def test_poses_of_nerfstudio_are_the_same_cameras(tmp_path, rng):
    matrix = pose(rng)
    opengl = np.linalg.inv(matrix) @ OPENCV_FROM_OPENGL
    names = {"fx": "fl_x", "fy": "fl_y", "width": "w", "height": "h"}
    theirs = {names.get(key, key): value for key, value in INTRINSICS.items()}
    ours = read_cameras(write(tmp_path / "a.json", {"cam_from_world": matrix.tolist(), **INTRINSICS}), ORIGIN)
    other = read_cameras(write(tmp_path / "b.json", {"transform_matrix": opengl.tolist(), **theirs}), ORIGIN)
    np.testing.assert_allclose(other.cam_from_world, ours.cam_from_world, atol=1e-6)
    assert np.array_equal(other.Ks, ours.Ks)
    assert (other.widths, other.heights) == (ours.widths, ours.heights)


def test_a_distant_origin_is_taken_off_before_anything_is_rounded(tmp_path, rng):
    near, origin = pose(rng), np.array([1e6, -2e6, 5e5])
    far = near.copy()
    far[:3, 3] -= far[:3, :3] @ origin
    made = read_cameras(write(tmp_path / "far.json", {"cam_from_world": far.tolist(), **INTRINSICS}), origin)
    np.testing.assert_allclose(made.cam_from_world[0], near, atol=1e-6)


MIRROR = np.diag([-1.0, 1, 1, 1]).tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cam_from_world": None}, "cam_from_world must be 4×4 or 3×4 numbers"),
        ({"transform_matrix": np.eye(4).tolist()}, "cam_from_world or transform_matrix, and fx, fy"),
        ({"fl_x": 500}, "expected an object with .*fl_x"),
        ({"cx": None}, "camera must be 6 numbers"),
        ({"k1": 0.1}, "expected an object with .*k1"),
        ({"cam_from_world": MIRROR}, "mirrors the world"),
        ({"cam_from_world": np.diag([2.0, 2, 2, 1]).tolist()}, "uniform scale"),
        ({"cam_from_world": [[1, 0, 0, float("nan")], *np.eye(4)[1:].tolist()]}, "not finite"),
        ({"fx": float("nan")}, "expected focal lengths"),
        ({"cy": 1e12}, "expected focal lengths"),
        ({"width": 0}, "expected width and height"),
        ({"width": 1_000_000, "height": 1000}, "expected width and height"),
    ],
)
def test_a_malformed_camera_is_refused_in_one_line_that_names_it(tmp_path, change, message):
    good = {"cam_from_world": np.eye(4).tolist(), **INTRINSICS}
    path = write(tmp_path / "cameras.json", [good, good | change])
    with pytest.raises(InputError, match=message) as error:
        read_cameras(path, ORIGIN)
    assert f"{path}: camera 1" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "got 0"),
        ("[3]", "camera 0: expected an object"),
        ("null", "expected an object"),
        ("{", "not a readable JSON file"),
        ('{"fx": 1, "fx": 2}', "'fx' is there twice"),
        ("{}", "expected an object with cam_from_world or transform_matrix"),
    ],
)
def test_a_file_without_cameras_is_refused(tmp_path, text, message):
    path = tmp_path / "cameras.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_cameras(path, ORIGIN)


def test_principal_points_beside_the_picture_and_pictures_of_the_largest_size_are_read(tmp_path):
    """A crop may leave the principal point out."""
    entry = {"cam_from_world": np.eye(4).tolist(), **INTRINSICS, "cx": -35.5, "cy": 1e6}
    made = read_cameras(write(tmp_path / "crop.json", entry), ORIGIN)
    assert made.Ks[0, :2, 2].tolist() == [-35.5, 1e6]
    largest = entry | {"width": MAX_PIXELS // 1024, "height": 1024}
    assert read_cameras(write(tmp_path / "large.json", largest), ORIGIN).widths.tolist() == [MAX_PIXELS // 1024]
    with pytest.raises(InputError, match="expected width and height"):
        read_cameras(write(tmp_path / "larger.json", largest | {"width": MAX_PIXELS // 1024 + 1}), ORIGIN)
