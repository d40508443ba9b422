"""What a transforms.json and a file of cameras mean: axes, intrinsics, units; what cannot be used is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
from scene_files import OPENGL, change, photograph, rewrite, save, world_from_cams, write_transforms
from splats import random_rotation

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.posed import ReadOptions
from gsencoder.data.readers.transforms_json import MAX_PIXELS, read_cameras, read_transforms
from gsencoder.data.scenes import load_scene
from gsencoder.types.scene import OPENCV_FROM_OPENGL


def test_opengl_axes_become_opencv_axes(tmp_path):
    # A camera at (0, 0, 5) with OpenGL's identity rotation looks down -z with y up: OpenCV sees the origin in front.
    pose = np.eye(4)
    pose[2, 3] = 5
    data = write_transforms(tmp_path, 1)
    path = change(tmp_path, data, 0, transform_matrix=pose.tolist())
    (image,) = read_transforms(path).images
    assert (image.cam_from_world @ [0, 0, 0, 1] == [0, 0, 5, 1]).all()
    assert (image.cam_from_world @ [0, 1, 0, 1] == [0, -1, 5, 1]).all()


def test_a_frames_own_intrinsics_come_before_the_files(tmp_path):
    data = write_transforms(tmp_path)
    change(tmp_path, data, fl_x=40.0, cx=10.0)
    cameras = [image.camera.params[:4] for image in read_transforms(tmp_path / "transforms.json").images]
    assert cameras == [(30, 31, 15.5, 12.5), (40, 31, 10, 12.5), (30, 31, 15.5, 12.5)]


def test_blender_files_without_suffix_size_or_focal_length(tmp_path):
    data = write_transforms(tmp_path)
    angle = 2 * np.arctan(16 / 30.0)
    frames = [frame | {"file_path": f"./images/{i:03d}"} for i, frame in enumerate(data["frames"])]
    (tmp_path / "transforms.json").unlink()
    rewrite(tmp_path, {"camera_angle_x": angle, "frames": frames}, "transforms_train.json")
    views = load_scene(tmp_path).views
    assert views.names[0] == "./images/000"
    assert np.abs(views.cameras.Ks[0] - [[30, 0, 16], [0, 30, 12], [0, 0, 1]]).max() < 1e-5
    # A frame's own angle comes before a length of the file.
    frames[0]["camera_angle_x"] = float(2 * np.arctan(16 / 50.0))
    path = rewrite(tmp_path, {"fl_x": 30.0, "frames": frames}, "transforms_train.json")
    assert read_transforms(path).images[0].camera.params[0] == pytest.approx(50)


def test_distortion_takes_the_right_model(tmp_path):
    data = write_transforms(tmp_path, 1)
    for values, model, tail in (
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "OPENCV", (0.1, 0.2, 0.3, 0.4)),
        ({"k1": 0.1, "k3": 0.2}, "FULL_OPENCV", (0.1, 0, 0, 0, 0.2, 0, 0, 0)),
        ({"k1": 0.1, "k4": 0.2, "camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE", (0.1, 0, 0, 0.2)),
        ({"k1": 0.1, "is_fisheye": True}, "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
    ):
        (image,) = read_transforms(rewrite(tmp_path, data | values)).images
        assert image.camera.model == model
        assert image.camera.params[4:] == tail


def test_metres_and_up_are_known_only_where_the_file_says_so(tmp_path):
    plain = write_transforms(tmp_path, depth=True)
    for top, metres, up in (
        ({}, None, None),
        ({"depth_unit_scale_factor": 0.001}, 1.0, [0, 0, 1]),
        ({"metres_per_unit": 0.5, "up": [0, -2, 0]}, 0.5, [0, -1, 0]),
        ({"depth_unit_scale_factor": 0.001, "metres_per_unit": 2.0}, 2.0, [0, 0, 1]),
    ):
        rewrite(tmp_path, plain | top)
        scene = load_scene(tmp_path)
        assert scene.metres_per_unit == metres
        assert (None if scene.up is None else scene.up.tolist()) == up
    without = write_transforms(tmp_path / "rgb", depth_unit_scale_factor=0.001)
    assert "depth_file_path" not in without["frames"][0]
    assert load_scene(tmp_path / "rgb").metres_per_unit is None


def test_depth_masks_and_instances_are_read(tmp_path):
    data = write_transforms(tmp_path, depth=True, instances=True, depth_unit_scale_factor=0.01)
    mask = np.zeros((24, 32), np.uint8)
    mask[5:, 3:] = 255
    save(tmp_path / "masks/1.png", mask)
    change(tmp_path, data, mask_path="masks/1.png")
    views = load_scene(tmp_path).views
    assert (views.depths[2] == np.float32(10.02)).all()
    assert (views.instances[0] == 300).all()
    assert (views.masks[1] == (mask > 0)).all()
    assert views.masks[0].all()


def test_listed_but_missing_files_are_counted_once(tmp_path):
    data = write_transforms(tmp_path, 5, depth=True, instances=True)
    for name in ("images/001.png", "images/003.png"):
        (tmp_path / name).unlink()
    with pytest.warns(SceneWarning, match=r"2 of 5 listed images are missing \(first: 'images/001.png'\)") as caught:
        scene = load_scene(tmp_path)
    assert len(caught) == 1
    assert scene.views.names == ("images/000.png", "images/002.png", "images/004.png")
    assert (np.asarray(scene.views.images[1]) == photograph(2)).all()  # type: ignore[index]
    save(tmp_path / "images/001.png", photograph(1))
    save(tmp_path / "images/003.png", photograph(3))
    (tmp_path / "depth/002.png").unlink()
    with pytest.warns(SceneWarning, match="1 of 5 listed depth files are missing"):
        scene = load_scene(tmp_path)
    assert not scene.views.depths[2].any()
    assert scene.views.depths[3].all()
    for frame in data["frames"]:
        (tmp_path / frame["file_path"]).unlink()
    with pytest.raises(InputError, match="none of the 5 listed images exists"):
        load_scene(tmp_path)


def test_the_scale_of_depth_is_the_callers_then_the_files_then_millimetres(tmp_path):
    data = write_transforms(tmp_path, 1, depth=True)
    listed = data["frames"][0]["depth_file_path"]
    instant = {"depth_file_path": None, "depth_path": listed}
    for top, frame, scale, metric in (
        ({}, {}, 0.001, False),
        ({"depth_unit_scale_factor": 0.25}, {}, 0.25, True),
        ({"depth_unit_scale_factor": 0.25}, {"depth_unit_scale_factor": 0.5}, 0.5, True),
        ({"integer_depth_scale": 0.25}, {}, 0.001, False),
        ({"integer_depth_scale": 0.25}, instant, 0.25, False),
        ({"depth_unit_scale_factor": 0.25}, instant, 0.001, False),
    ):
        path = change(tmp_path, data | top, 0, **frame)
        posed = read_transforms(path)
        assert posed.images[0].depth == tmp_path / listed
        assert posed.images[0].depth_scale == scale
        assert posed.metres_per_unit == (1.0 if metric else None)


def test_a_field_of_view_lies_between_nothing_and_half_a_turn(tmp_path):
    data = write_transforms(tmp_path, 1)
    bare = {key: value for key, value in data.items() if key not in ("fl_x", "fl_y")}
    for wide in (0.5, 2.4):
        (image,) = read_transforms(rewrite(tmp_path, bare | {"camera_angle_y": wide})).images
        np.testing.assert_allclose(image.camera.params[:2], 12 / np.tan(wide / 2))
        both = {"camera_angle_x": 1.0, "camera_angle_y": wide}
        (image,) = read_transforms(rewrite(tmp_path, bare | both)).images
        np.testing.assert_allclose(image.camera.params[:2], [16 / np.tan(0.5), 12 / np.tan(wide / 2)])
    for wrong in (0, -1.0, np.pi, 4.0):
        with pytest.raises(InputError, match="camera_angle_x must lie between"):
            read_transforms(rewrite(tmp_path, bare | {"camera_angle_x": wrong}))


def test_a_matrix_may_come_without_its_last_row_and_in_no_other_size(tmp_path):
    data = write_transforms(tmp_path, 1)
    (whole,) = read_transforms(rewrite(tmp_path, data)).images
    rows = data["frames"][0]["transform_matrix"]
    (upper,) = read_transforms(change(tmp_path, data, 0, transform_matrix=rows[:3])).images
    np.testing.assert_array_equal(upper.cam_from_world, whole.cam_from_world)
    for wrong in (rows[:2], [row[:3] for row in rows], [*rows[:3], 1]):
        with pytest.raises(InputError, match="transform_matrix must be 4×4 or 3×4 numbers"):
            read_transforms(change(tmp_path, data, 0, transform_matrix=wrong))


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
    with pytest.raises(InputError, match=r"frame 1|view 'images/001") as caught:
        load_scene(path)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("top", [{"up": [0, 0, 0]}, {"up": [1, 0]}, {"metres_per_unit": 0}])
def test_an_up_or_a_unit_that_is_none_is_refused(tmp_path, top):
    with pytest.raises(InputError, match=f"{next(iter(top))} must be"):
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
