"""What single frames of RGB-D sequences become: cameras, poses, and what is left out."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.posed import MAX_COORDINATE, ReadOptions, inside, rigid_pose
from gsencoder.data.readers.rgbd import (
    KINECTS,
    device_folder,
    interpolate_pose,
    is_seven_scenes,
    is_tum,
    read_replica,
    read_scannetpp,
    read_seven_scenes,
    read_trajectory,
    read_tum,
)
from gsencoder.types.scene import invert_rigid


def picture(path: Path, width: int, height: int, mode: str = "RGB") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, (width, height)).save(path)


def pose(seed: int) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    result[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return result


def seven_scenes(folder: Path, *, width: int = 640, height: int = 480, frames: int = 2) -> None:
    for frame in range(frames):
        picture(folder / f"frame-{frame:06d}.color.png", width, height)
        picture(folder / f"frame-{frame:06d}.depth.png", width, height, "I;16")
        np.savetxt(folder / f"frame-{frame:06d}.pose.txt", pose(frame))


def test_the_color_lens_of_a_kinect_stands_beside_the_depth_lens_whose_poses_are_given(tmp_path):
    seven_scenes(tmp_path)
    images = read_seven_scenes(tmp_path).images
    for frame, image in enumerate(images):
        assert image.camera.params == (525, 525, 320, 240)
        assert image.depth_camera.params == (585, 585, 320, 240)
        np.testing.assert_allclose(image.depth_from_color @ image.cam_from_world, invert_rigid(pose(frame)), atol=1e-9)
        np.testing.assert_allclose(image.depth_from_color[:3, 3], (0.025, 0, 0))
        np.testing.assert_array_equal(image.depth_from_color[:3, :3], np.eye(3))
        assert (image.depth_scale, image.no_depth) == (0.001, 65535)


def test_frames_of_other_intrinsics_are_registered_and_lost_ones_are_left_out(tmp_path):
    seven_scenes(tmp_path, frames=4)
    np.savetxt(tmp_path / "camera-intrinsics.txt", [[500, 0, 310], [0, 505, 250], [0, 0, 1]])
    np.savetxt(tmp_path / "frame-000001.pose.txt", np.full((4, 4), -np.inf))
    (tmp_path / "frame-000002.pose.txt").unlink()
    (tmp_path / "frame-000003.depth.png").unlink()
    with pytest.warns(SceneWarning) as warned:
        images = read_seven_scenes(tmp_path).images
    text = " ".join(str(warning.message) for warning in warned)
    assert "1 of 4 frames lost tracking" in text
    assert "1 of 4 frames have no pose file" in text
    assert "1 of 2 depth files are missing" in text
    assert [image.name[:12] for image in images] == ["frame-000000", "frame-000003"]
    assert images[0].camera.params == (500, 505, 310, 250)
    assert (images[0].depth_camera, images[0].depth_from_color) == (None, None)
    np.testing.assert_allclose(images[0].cam_from_world, invert_rigid(pose(0)), atol=1e-9)
    assert (images[0].depth is None, images[1].depth is None) == (False, True)


def test_pictures_of_no_kinect_need_intrinsics_and_frames_need_poses(tmp_path):
    seven_scenes(tmp_path, width=64, height=48)
    with pytest.raises(InputError, match="no pictures of a Kinect"):
        read_seven_scenes(tmp_path)
    for path in tmp_path.glob("*.pose.txt"):
        path.unlink()
    assert not is_seven_scenes(tmp_path)


def test_a_pose_between_two_is_on_the_way_and_none_is_invented():
    times = np.array([1.0, 1.08, 1.3])
    poses = np.stack([pose(0), pose(1), pose(2)])
    turn = Rotation.from_matrix(poses[1, :3, :3]) * Rotation.from_matrix(poses[0, :3, :3]).inv()
    between = interpolate_pose(1.02, times, poses)
    np.testing.assert_allclose(between[:3, 3], 0.75 * poses[0, :3, 3] + 0.25 * poses[1, :3, 3])
    quarter = Rotation.from_rotvec(0.25 * turn.as_rotvec()) * Rotation.from_matrix(poses[0, :3, :3])
    np.testing.assert_allclose(between[:3, :3], quarter.as_matrix(), atol=1e-12)
    for index, time in enumerate(times):
        np.testing.assert_array_equal(interpolate_pose(float(time), times, poses), poses[index])
    assert interpolate_pose(1.2, times, poses) is None
    np.testing.assert_array_equal(interpolate_pose(0.981, times, poses), poses[0])
    np.testing.assert_array_equal(interpolate_pose(1.319, times, poses), poses[2])
    assert interpolate_pose(0.979, times, poses) is None
    assert interpolate_pose(1.321, times, poses) is None


def test_a_trajectory_is_sorted_and_what_is_no_rotation_is_refused(tmp_path):
    path = tmp_path / "groundtruth.txt"
    path.write_text("2 0 0 0 0 0 0 1\n1 4 5 6 0 0 1.005 0\n3 nan 0 0 0 0 0 1\n")
    times, poses = read_trajectory(path)
    assert times.tolist() == [1, 2]
    np.testing.assert_allclose(poses[0], [[-1, 0, 0, 4], [0, -1, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]], atol=1e-9)
    path.write_text("1 0 0 0 0 0 0 1\n2.5 0 0 0 0 0 0 1.02\n")
    with pytest.raises(InputError, match=r"at time 2.500000 has norm 1.02, expected 1"):
        read_trajectory(path)
    path.write_text("1 nan 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="no finite pose"):
        read_trajectory(path)


def tum(folder: Path, *, width: int = 640, height: int = 480) -> None:
    for name in ("rgb", "depth"):
        picture(folder / name / "1.png", width, height, "RGB" if name == "rgb" else "I;16")
        (folder / f"{name}.txt").write_text(f"1.0 {name}/1.png\n")
    (folder / "groundtruth.txt").write_text("1.0 1 2 3 0 0 0 1\n")


@pytest.mark.parametrize("number_of_kinect", KINECTS)
def test_the_kinects_of_the_benchmark_are_known_by_the_folder(tmp_path, number_of_kinect):
    folder = tmp_path / f"rgbd_dataset_freiburg{number_of_kinect}_desk"
    tum(folder)
    assert is_tum(folder)
    posed = read_tum(folder)
    camera = posed.images[0].camera
    assert (camera.model, camera.width, camera.height) == ("FULL_OPENCV", 640, 480)
    # The benchmark's own table (Sturm et al. 2012).
    published = {
        "1": (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
        "2": (520.908620, 521.007327, 325.141442, 249.701764, 0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
        "3": (535.4, 539.2, 320.1, 247.6, 0, 0, 0, 0, 0),
    }
    assert camera.params == (*published[number_of_kinect], 0, 0, 0)
    np.testing.assert_allclose(posed.images[0].cam_from_world[:3, 3], (-1, -2, -3))
    assert posed.images[0].depth_scale == 1 / 5000
    assert (posed.up.tolist(), posed.metres_per_unit) == ([0, 0, 1], 1)
    stated = read_tum(folder, ReadOptions(intrinsics=(1.0, 2.0, 3.0, 4.0))).images[0]
    assert (stated.camera.model, stated.camera.params) == ("PINHOLE", (1, 2, 3, 4))


def test_a_list_needs_a_time_and_a_file_in_every_row(tmp_path):
    tum(tmp_path)
    for text, problem in (("1.0 a\nx b\n", "row 2 is not a time"), ("1.0\n", "row 1 is"), ("# x\n", "no file")):
        (tmp_path / "rgb.txt").write_text(text)
        with pytest.raises(InputError, match=problem):
            read_tum(tmp_path, ReadOptions(intrinsics=(1.0, 1.0, 1.0, 1.0)))


def replica(folder: Path, parameters: Any = None, *, width: int = 1200, height: int = 680) -> None:
    for frame in range(2):
        picture(folder / "results" / f"frame{frame:06d}.jpg", width, height)
        picture(folder / "results" / f"depth{frame:06d}.png", 4, 4, "I;16")
    np.savetxt(folder / "traj.txt", [pose(frame).reshape(-1) for frame in range(2)])
    if parameters is not None:
        (folder / "cam_params.json").write_text(json.dumps(parameters))


def test_replica_without_parameters_has_those_of_its_export(tmp_path):
    replica(tmp_path)
    images = read_replica(tmp_path).images
    assert images[1].camera.params == (600.0, 600.0, 599.5, 339.5)
    assert images[1].depth_scale == 1 / 6553.5
    np.testing.assert_allclose(images[1].cam_from_world, invert_rigid(pose(1)), atol=1e-9)


@pytest.mark.parametrize("name", ["fx", "scale"])
def test_replica_with_parameters_needs_all_of_them(tmp_path, name):
    camera = {"fx": 500.0, "fy": 510.0, "cx": 590.0, "cy": 330.0, "scale": 1000.0}
    replica(tmp_path, {"camera": camera})
    image = read_replica(tmp_path).images[0]
    assert (image.camera.params, image.depth_scale) == ((500, 510, 590, 330), 1e-3)
    replica(tmp_path, {"camera": {key: value for key, value in camera.items() if key != name}})
    with pytest.raises(InputError, match=f"camera: expected numbers for {name}"):
        read_replica(tmp_path)
    replica(tmp_path, {"camera": camera | {"scale": 0.0}})
    with pytest.raises(InputError, match="scale above 0"):
        read_replica(tmp_path)
    replica(tmp_path, [])
    with pytest.raises(InputError, match="expected an object with camera"):
        read_replica(tmp_path)


def colmap_text(folder: Path, name: str, *, width: int, height: int) -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text(f"1 PINHOLE {width} {height} 50 60 32 24\n")
    (folder / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {name}\n\n")
    (folder / "points3D.txt").write_text("")


def test_depth_of_an_iphone_has_its_own_size_and_the_photographs_field_of_view(tmp_path):
    iphone = tmp_path / "iphone"
    picture(iphone / "rgb" / "frame_000000.jpg", 64, 48)
    picture(iphone / "depth" / "frame_000000.png", 16, 24, "I;16")
    colmap_text(iphone / "colmap", "frame_000000.jpg", width=64, height=48)
    assert device_folder(tmp_path) == iphone
    posed = read_scannetpp(tmp_path)
    image = posed.images[0]
    assert image.depth == iphone / "depth" / "frame_000000.png"
    assert (image.depth_camera.width, image.depth_camera.height) == (16, 24)
    assert image.depth_camera.params == (12.5, 30, 8, 12)
    assert image.depth_scale == 0.001
    assert (posed.up.tolist(), posed.metres_per_unit) == ([0, 0, 1], 1)
    image.depth.unlink()
    with pytest.warns(SceneWarning, match="1 of 1 depth files are missing"):
        assert read_scannetpp(iphone).images[0].depth is None


def test_photographs_of_the_dslr_come_first_and_through_colmap_where_there_is_no_transforms_json(tmp_path):
    picture(tmp_path / "iphone" / "rgb" / "a.jpg", 64, 48)
    colmap_text(tmp_path / "iphone" / "colmap", "a.jpg", width=64, height=48)
    picture(tmp_path / "dslr" / "resized_images" / "b.jpg", 64, 48)
    assert device_folder(tmp_path) == tmp_path / "iphone"
    colmap_text(tmp_path / "dslr" / "colmap", "b.jpg", width=64, height=48)
    assert device_folder(tmp_path) == tmp_path / "dslr"
    assert [image.image.name for image in read_scannetpp(tmp_path).images] == ["b.jpg"]
    assert device_folder(tmp_path / "iphone" / "rgb") is None


def test_files_may_not_lead_out_of_the_folder_of_a_device(tmp_path):
    iphone = tmp_path / "scene" / "iphone"
    picture(iphone / "rgb" / "a.jpg", 64, 48)
    colmap_text(iphone / "colmap", "a.jpg", width=64, height=48)
    picture(tmp_path / "outside.png", 64, 48, "I;16")
    (iphone / "depth").mkdir()
    (iphone / "depth" / "a.png").symlink_to(tmp_path / "outside.png")
    with pytest.raises(InputError, match="leads out of the scene folder"):
        read_scannetpp(iphone)
    assert read_scannetpp(iphone, ReadOptions(allow_outside=True)).images[0].depth is not None


def test_poses_with_rounded_numbers_are_made_rigid_and_others_refused():
    exact = pose(3)
    np.testing.assert_allclose(rigid_pose(np.round(exact, 4), "x"), exact, atol=2e-4)
    made = rigid_pose(np.round(exact, 4), "x")[:3, :3]
    np.testing.assert_allclose(made @ made.T, np.eye(3), atol=1e-12)
    changes = {
        "not finite": lambda m: m.__setitem__((0, 1), np.nan),
        "last row": lambda m: m.__setitem__((3, 0), 1e-5),
        "units away": lambda m: m.__setitem__((1, 3), 1.1 * MAX_COORDINATE),
        "not rigid": lambda m: m.__setitem__((slice(3), 0), 0.0),
        r"uniform scale of 1\.002": lambda m: m.__setitem__((slice(3), slice(3)), 1.002 * m[:3, :3]),
        r"singular values 1\.1, 1, 1": lambda m: m.__setitem__((slice(3), 0), 1.1 * m[:3, 0]),
        "mirrors": lambda m: m.__setitem__((slice(3), 0), -m[:3, 0]),
    }
    for problem, change in changes.items():
        wrong = exact.copy()
        change(wrong)
        with pytest.raises(InputError, match=f"^x: .*{problem}"):
            rigid_pose(wrong, "x")
    nearly = exact.copy()
    nearly[:3, :3] *= 1.0009
    np.testing.assert_allclose(rigid_pose(nearly, "x"), exact, atol=1e-9)


def test_paths_stay_in_the_folder_unless_allowed(tmp_path):
    folder = tmp_path / "scene" / "sub"
    folder.mkdir(parents=True)
    assert inside(folder, "a.png", "x") == folder / "a.png"
    with pytest.raises(InputError, match="leads out of the scene folder"):
        inside(folder, "../a.png", "x")
    assert inside(folder, "../a.png", "x", root=tmp_path / "scene") == folder / "../a.png"
    assert inside(folder, "../../a.png", "x", allow_outside=True) == folder / "../../a.png"
    with pytest.raises(InputError, match=r"is not a path \(4,097 characters"):
        inside(folder, "a/" * 2048 + "b", "x")
    with pytest.raises(InputError, match="is not a path"):
        inside(folder, "a\0b", "x")
