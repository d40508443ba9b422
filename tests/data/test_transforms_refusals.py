"""A transforms.json that cannot be used is refused in a line that names the frame, whatever it holds."""

import numpy as np
import pytest
from scene_files import OPENGL, change, photograph, rewrite, save, world_from_cams, write_transforms

from gsencoder.core.errors import InputError
from gsencoder.data.readers.posed import ReadOptions
from gsencoder.data.readers.transforms_json import read_transforms
from gsencoder.data.scenes import load_scene


@pytest.mark.parametrize(
    ("key", "kind"),
    [("file_path", "dots"), ("depth_file_path", "absolute"), ("mask_path", "link"), ("instance_file_path", "dots")],
)
def test_paths_that_leave_the_scene_folder_are_refused(tmp_path, key, kind):
    folder = tmp_path / "scene"
    data = write_transforms(folder)
    wide = np.full((24, 32), 1, np.uint16)
    outside = save(tmp_path / "outside.png", photograph(1) if key == "file_path" else wide)
    if kind == "link":
        (folder / "linked.png").symlink_to(outside)
    value = {"dots": "images/../../outside.png", "absolute": str(outside), "link": "linked.png"}[kind]
    path = change(folder, data, **{key: value})
    with pytest.raises(InputError, match=r"frame 1 .* leads out of the scene folder"):
        read_transforms(path)
    assert len(read_transforms(path, ReadOptions(allow_outside=True)).images) == 3


def matrix(scale: float = 1.0, **entries: float) -> list[list[float]]:
    pose = world_from_cams(3)[1] @ OPENGL
    pose[:3, :3] *= scale
    for name, value in entries.items():
        pose[int(name[1]), int(name[2])] = value
    return pose.tolist()


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"transform_matrix": matrix(0.5)}, "uniform scale of 0.5"),
        ({"transform_matrix": matrix(m00=1e200)}, "not rigid"),
        ({"transform_matrix": matrix(m03=float("nan"))}, "finite"),
        ({"transform_matrix": matrix(m03=1e20)}, "units away"),
        ({"transform_matrix": matrix(m33=2.0)}, "last row"),
        ({"transform_matrix": (np.array(matrix()) @ np.diag([1, 1, -1, 1])).tolist()}, "mirrors"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, "4×4 or 3×4 numbers"),
        ({"fl_x": 10**400}, "fl_x must be finite"),
        ({"fl_y": -3.0}, "focal length"),
        ({"fl_x": "30"}, "fl_x must be a number"),
        ({"w": 640}, "w is 640 but the image"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"k4": 0.1}, "k4"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "p1 and p2"),
        ({"file_path": "images/000.png"}, "repeated"),
        ({"file_path": 7}, "no file_path"),
        ({"mask_path": "a/" * 500_000}, "not a path"),
        ({"depth_file_path": "images/000.png", "depth_unit_scale_factor": -1}, "depth scale must be positive"),
    ],
)
def test_a_frame_that_cannot_be_used_is_named(tmp_path, values, problem):
    path = change(tmp_path, write_transforms(tmp_path), **values)
    with pytest.raises(InputError, match="frame 1") as caught:
        read_transforms(path)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    ("top", "problem"),
    [
        ({"up": [0, 0, 0]}, "up must be"),
        ({"up": [1, 0]}, "up must be"),
        ({"metres_per_unit": 0}, "metres_per_unit must be positive"),
    ],
)
def test_an_up_or_a_unit_that_is_none_is_refused(tmp_path, top, problem):
    with pytest.raises(InputError, match=problem):
        read_transforms(rewrite(tmp_path, write_transforms(tmp_path) | top))


def test_depth_of_another_size_names_both(tmp_path):
    write_transforms(tmp_path, depth=True)
    save(tmp_path / "depth/002.png", np.ones((12, 24), np.uint16))
    with pytest.raises(InputError, match=r"depth/002.png has 24×12 pixels but .*images/002.png has 32×24"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"{}", b'{"frames": []}', b'{"frames": {}}', b'{"frames": [1]}', b"\xff\xfe", b"[" * 100_000],
)
def test_files_that_are_no_transforms_are_errors(tmp_path, content):
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(InputError, match=r"transforms\.json"):
        load_scene(tmp_path)


def test_a_depth_beyond_float32_is_refused_where_it_is_read(tmp_path, no_jaxtyping):
    scene = write_transforms(tmp_path, 2, depth=True)
    rewrite(tmp_path, {**scene, "depth_unit_scale_factor": 1e37})
    views = load_scene(tmp_path).views
    with pytest.raises(InputError, match=r"depth/000.png: depth of .* world units; check the depth scale"):
        views.depths[0]
