"""A transforms.json that cannot be used is refused in a line that names the frame, whatever it holds."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scene_files import OPENGL, change, photograph, rewrite, save, world_from_cams, write_transforms

from gsencoder.core.errors import InputError
from gsencoder.data.readers.posed import ReadOptions
from gsencoder.data.readers.transforms_json import read_transforms
from gsencoder.data.scenes import load_scene


@pytest.mark.parametrize("key", ["file_path", "depth_file_path", "mask_path", "instance_file_path"])
@pytest.mark.parametrize("kind", ["dots", "absolute", "link"])
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
        ({"transform_matrix": matrix(0.0)}, "singular"),
        ({"transform_matrix": matrix(m00=3.0)}, "not rigid"),
        ({"transform_matrix": matrix(m03=float("nan"))}, "finite"),
        ({"transform_matrix": matrix(m03=float("inf"))}, "finite"),
        ({"transform_matrix": matrix(m03=1e20)}, "units away"),
        ({"transform_matrix": matrix(m00=1e200)}, "not rigid"),
        ({"transform_matrix": matrix(m33=2.0)}, "last row"),
        ({"transform_matrix": (np.array(matrix()) @ np.diag([1, 1, -1, 1])).tolist()}, "mirrors"),
        ({"transform_matrix": [[1, 2], [3, 4]]}, "4 rows"),
        ({"transform_matrix": [["1", 0, 0, 0]] * 4}, "must be a number"),
        ({"transform_matrix": [[None, 0, 0, 0]] * 4}, "got null"),
        ({"transform_matrix": None}, "4 rows"),
        ({"fl_x": float("nan")}, "fl_x must be finite"),
        ({"cx": float("inf")}, "cx must be finite"),
        ({"fl_x": 10**400}, "fl_x must be finite"),
        ({"fl_y": -3.0}, "focal length"),
        ({"fl_x": "30"}, "fl_x must be a number"),
        ({"k1": True}, "k1 must be a number"),
        ({"w": 640}, "w is 640 but the image"),
        ({"h": 23.5}, "h is 23.5 but the image"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"camera_model": ["OPENCV"]}, "camera_model must be a name"),
        ({"k4": 0.1}, "k4"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "p1 and p2"),
        ({"file_path": "images/000.png"}, "repeated"),
        ({"file_path": ""}, "no file_path"),
        ({"file_path": 7}, "no file_path"),
        ({"file_path": "a\0b"}, "not a path"),
        ({"file_path": "x" * 5000}, "not a path"),
        ({"mask_path": 3}, "mask_path must be a path"),
        ({"depth_file_path": "images/000.png", "depth_unit_scale_factor": -1}, "depth scale must be positive"),
        ({"depth_file_path": "images/000.png", "depth_unit_scale_factor": 0}, "depth scale must be positive"),
    ],
)
def test_a_frame_that_cannot_be_used_is_named(tmp_path, values, problem):
    path = change(tmp_path, write_transforms(tmp_path), **values)
    with pytest.raises(InputError, match="frame 1") as caught:
        read_transforms(path)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


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


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.just(10**400)
    | st.just("../x.png"),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)
KEYS = [
    "w",
    "h",
    "fl_x",
    "fl_y",
    "cx",
    "cy",
    "k1",
    "k2",
    "k3",
    "k4",
    "p1",
    "p2",
    "camera_model",
    "camera_angle_x",
    "up",
]
KEYS += ["metres_per_unit", "depth_unit_scale_factor", "file_path", "transform_matrix", "depth_file_path", "mask_path"]
KEYS += ["instance_file_path", "depth_path", "integer_depth_scale", "is_fisheye", "frames"]


def loads_or_complains(folder: Path) -> None:
    try:
        scene = load_scene(folder)
    except InputError as error:
        message = str(error)
    else:
        message = ""
        assert np.isfinite(scene.views.cameras.cam_from_world).all()
        for name in ("images", "depths", "masks", "instances"):
            sequence = getattr(scene.views, name)
            try:
                assert sequence is None or len(list(sequence)) == len(scene.views)
            except InputError as error:  # Files are read on access, and what is wrong with them is said then.
                message = str(error)
    assert "\n" not in message


@pytest.mark.filterwarnings("ignore::gsencoder.core.errors.SceneWarning")
@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
@pytest.mark.slow
def test_mutated_values_give_a_scene_or_an_input_error(tmp_path, no_jaxtyping, data):
    scene = write_transforms(tmp_path, 2, depth=True)
    for _ in range(data.draw(st.integers(1, 3))):
        target = data.draw(st.sampled_from([scene, *scene["frames"]])) if isinstance(scene["frames"], list) else scene
        if not isinstance(target, dict):
            continue
        key = data.draw(st.sampled_from(KEYS))
        target[key] = data.draw(json_values)
        if key == "transform_matrix" and data.draw(st.booleans()):
            pose = matrix()
            pose[data.draw(st.integers(0, 3))][data.draw(st.integers(0, 3))] = data.draw(st.floats())
            target[key] = pose
    rewrite(tmp_path, scene)
    loads_or_complains(tmp_path)


@pytest.mark.filterwarnings("ignore::gsencoder.core.errors.SceneWarning")
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_mutated_text_gives_a_scene_or_an_input_error(tmp_path, no_jaxtyping, data):
    text = bytearray(json.dumps(write_transforms(tmp_path, 2, depth=True)).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        text[at : at + data.draw(st.integers(0, 2))] = data.draw(
            st.binary(max_size=2) | st.sampled_from([b"9", b"-", b"e9", b".", b"NaN", b'"', b"]", b","])
        )
    (tmp_path / "transforms.json").write_bytes(bytes(text))
    loads_or_complains(tmp_path)


def test_a_depth_beyond_float32_is_refused_where_it_is_read(tmp_path, no_jaxtyping):
    scene = write_transforms(tmp_path, 2, depth=True)
    rewrite(tmp_path, {**scene, "depth_unit_scale_factor": 1e37})
    views = load_scene(tmp_path).views
    with pytest.raises(InputError, match=r"depth/000.png: depth of .* world units; check the depth scale"):
        views.depths[0]


@pytest.mark.parametrize("key", ["file_path", "depth_file_path", "mask_path", "instance_file_path"])
@pytest.mark.parametrize("unit", ["a", "a/", "../", "é/"])
def test_a_path_longer_than_any_file_has_is_refused_at_once(tmp_path, key, unit):
    data = write_transforms(tmp_path)
    data["frames"][1][key] = unit * 500_000
    rewrite(tmp_path, data)
    begun = time.monotonic()
    with pytest.raises(InputError, match="frame 1 .* is not a path .* characters, at most 4,096") as caught:
        read_transforms(tmp_path / "transforms.json")
    assert time.monotonic() - begun < 2
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("up", [[0, 0, 0], [1e-7, 0, 0], [1e7, 0, 0], [1, 0], [1, 0, 0, 0], "z", [None, 0, 1]])
def test_a_direction_that_is_none_is_refused(tmp_path, up):
    with pytest.raises(InputError, match="up must be"):
        read_transforms(rewrite(tmp_path, write_transforms(tmp_path) | {"up": up}))


@pytest.mark.parametrize("metres", [0, -1.0])
def test_a_unit_of_no_length_is_refused(tmp_path, metres):
    with pytest.raises(InputError, match="metres_per_unit must be positive"):
        read_transforms(rewrite(tmp_path, write_transforms(tmp_path) | {"metres_per_unit": metres}))
