"""The folders of ScanNet and of ScanNet++'s iPhone; what is still to be extracted is named."""

import json
import shutil
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from PIL import Image
from scene_files import photograph, save, write_scannet
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.rgbd import read_scannet
from gsencoder.data.scenes import find_scenes, layout_of, load_scene
from gsencoder.data.synthetic import make_room
from gsencoder.types import Scene
from gsencoder.types.scene import OPENCV_FROM_OPENGL

Poses = Literal["colmap", "nerfstudio", "arkit"]
EVERY = 10


@pytest.fixture(scope="module")
def room():
    return make_room(3, objects=4, views=4, width=96, height=72)


def write_iphone(scene: Scene, folder: Path, poses: Poses, *, prefix: str = "") -> Path:
    """A scene whose frames are every tenth of the video; depth is a quarter as large as the photographs."""
    views, iphone = scene.views, folder / "iphone"
    for name in ("rgb", "depth", "rgb_masks", "colmap", "nerfstudio"):
        (iphone / name).mkdir(parents=True)
    K = views.cameras.Ks[0].astype(float)
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    world_from_cam = views.cameras.world_from_cam.astype(float)
    world_from_cam[:, :3, 3] += scene.origin
    lines, frames, arkit = [], [], {}
    for view, pose in enumerate(world_from_cam):
        stem = f"frame_{EVERY * view:06d}"
        Image.fromarray(views.images[view]).save(iphone / "rgb" / f"{stem}.jpg", quality=100, subsampling=0)
        steps = np.round(1000 * views.depths[view][2::4, 2::4]).astype(np.uint16)
        Image.fromarray(steps).save(iphone / "depth" / f"{stem}.png")
        mask = np.full((72, 96), 255, np.uint8)
        mask[:9] = 0
        Image.fromarray(mask).save(iphone / "rgb_masks" / f"{stem}.png")
        inverse = np.linalg.inv(pose)
        quat = Rotation.from_matrix(inverse[:3, :3]).as_quat()[[3, 0, 1, 2]]
        lines += [" ".join(map(str, (view + 1, *quat, *inverse[:3, 3], 1, f"{prefix}{stem}.jpg"))), ""]
        # In nerfstudio's world x and y are exchanged, and z is turned around.
        matrix = (pose @ OPENCV_FROM_OPENGL)[[1, 0, 2, 3]] * np.array([[1], [1], [-1], [1]])
        frames.append({"file_path": f"{stem}.jpg", "transform_matrix": matrix.tolist()})
        arkit[stem] = {"timestamp": view / 6, "pose": np.eye(4).tolist(), "intrinsic": K.tolist()}
        arkit[stem]["aligned_pose"] = pose.tolist()
    if poses == "colmap":
        (iphone / "colmap/cameras.txt").write_text(f"1 OPENCV 96 72 {' '.join(map(str, params))} 0 0 0 0\n")
        (iphone / "colmap/images.txt").write_text("\n".join(lines) + "\n")
        (iphone / "colmap/points3D.txt").write_text("1 0.5 0.5 0.5 10 20 30 0.1 1 0\n".replace(" 1 0", ""))
    elif poses == "nerfstudio":
        camera = dict(zip(("fl_x", "fl_y", "cx", "cy"), params, strict=True))
        content = {**camera, "camera_model": "OPENCV", "k1": 0.0, "frames": frames, "test_frames": []}
        (iphone / "nerfstudio/transforms.json").write_text(json.dumps(content))
    # In downloads the file is always there.
    (iphone / "pose_intrinsic_imu.json").write_text(json.dumps(arkit))
    for stream in ("rgb.mkv", "rgb_mask.mkv", "depth.bin", "exif.json"):
        (iphone / stream).write_bytes(b"")
    return iphone


@pytest.mark.parametrize(
    ("poses", "prefix"), [("colmap", ""), ("colmap", "iphone/"), ("nerfstudio", ""), ("arkit", "")]
)
def test_a_room_is_read_back_from_each_kind_of_poses(room, tmp_path, poses, prefix):
    folder = tmp_path / "scene"
    iphone = write_iphone(room, folder, poses, prefix=prefix)
    for path in (folder, iphone):
        recognized = layout_of(path)
        assert recognized.name == "ScanNet++"
    assert find_scenes([tmp_path]) == (folder,)
    read = load_scene(folder)
    ours, theirs = read.views, room.views
    np.testing.assert_allclose(ours.cameras.cam_from_world, theirs.cameras.cam_from_world, atol=1e-5)
    np.testing.assert_allclose(ours.cameras.Ks, theirs.cameras.Ks, rtol=1e-6)
    for view in range(4):
        assert np.abs(ours.images[view].astype(int) - theirs.images[view]).mean() < 3
        np.testing.assert_allclose(ours.depths[view][2::4, 2::4], theirs.depths[view][2::4, 2::4], atol=6e-4)
        assert not ours.masks[view][:9].any()
        assert ours.masks[view][9:].all()
    assert read.metres_per_unit == 1.0
    assert (read.sfm_points is not None) == (poses == "colmap")


def test_streams_that_are_still_to_be_extracted_are_named_with_the_command(room, tmp_path):
    iphone = write_iphone(room, tmp_path / "scene", "colmap")
    shutil.rmtree(iphone / "depth")
    with pytest.warns(SceneWarning, match=r"depth.bin is still to be extracted to depth/"):
        assert load_scene(iphone).views.depths is None
    shutil.rmtree(iphone / "rgb")
    with pytest.raises(InputError, match=r"extracted from rgb.mkv to rgb/ .* ffmpeg -i rgb.mkv -start_number 0"):
        load_scene(tmp_path / "scene")
    (iphone / "rgb.mkv").rename(iphone / "rgb.mp4")
    with pytest.raises(InputError, match=r"ffmpeg -i rgb.mp4 -start_number 0"):
        load_scene(iphone)
    for stream in ("rgb.mp4", "depth.bin"):
        (iphone / stream).unlink()
    with pytest.raises(InputError, match=r"rgb.mkv, which is not here either"):
        load_scene(tmp_path / "scene")


def test_frames_without_a_pose_or_depth_are_counted(room, tmp_path):
    iphone = write_iphone(room, tmp_path / "scene", "arkit")
    path = iphone / "pose_intrinsic_imu.json"
    content = json.loads(path.read_text())
    del content["frame_000000"]
    content["frame_000010"]["aligned_pose"][0][3] = float("nan")
    path.write_text(json.dumps(content))
    (iphone / "depth/frame_000020.png").unlink()
    with pytest.warns(SceneWarning) as caught:
        assert load_scene(iphone).views.names == ("frame_000020.jpg", "frame_000030.jpg")
    messages = " ".join(str(warning.message) for warning in caught)
    assert "1 of 4 frames are not in pose_intrinsic_imu.json and are left out (first: 'frame_000000.jpg')" in messages
    assert "1 of 4 frames lost tracking" in messages
    assert "1 of 2 depth files are missing (first: 'frame_000020.jpg')" in messages
    path.write_text("{}")
    with pytest.raises(InputError, match="no view: of 4 pictures 4 are not in pose_intrinsic_imu.json"):
        load_scene(iphone)
    for picture in (iphone / "rgb").iterdir():
        picture.unlink()
    with pytest.raises(InputError, match="no view: of 0 pictures none has a picture"):
        load_scene(iphone)


@pytest.mark.parametrize("broken", ["[]", '{"frame_000000": 3}', '{"frame_000000": {"aligned_pose": [[1]]}}'])
def test_poses_that_are_none_are_refused(room, tmp_path, broken):
    iphone = write_iphone(room, tmp_path / "scene", "arkit")
    (iphone / "pose_intrinsic_imu.json").write_text(broken)
    with pytest.raises(InputError, match="expected an object of frames|aligned_pose must be 4×4 numbers"):
        load_scene(iphone)


def test_depth_is_metres_the_world_is_upright_and_instances_are_read(tmp_path):
    write_scannet(tmp_path, 12)
    save(tmp_path / "instance-filt/1.png", np.full((24, 32), 9, np.uint8))
    scene = load_scene(tmp_path)
    assert (scene.views.instances[1] == 9).all()
    assert not scene.views.instances[0].any()
    assert scene.metres_per_unit == 1.0
    assert scene.up.tolist() == [0, 0, 1]
    assert scene.views.names[9:] == ("color/9.png", "color/10.png", "color/11.png")
    assert np.abs(scene.views.depths[1][3] - (1 + np.arange(32) * 1e-3)).max() < 1e-6


def test_depth_of_another_size_is_resampled_by_its_own_intrinsics(tmp_path):
    write_scannet(tmp_path, depth_size=(64, 48))
    depth = load_scene(tmp_path).views.depths[0]
    assert depth.shape == (24, 32)
    # The center of color pixel c is the edge between depth pixels at 2·(c + ½), up to float rounding.
    wanted = 1 + (np.arange(32) + 0.5) * 2e-3
    assert np.abs(depth - wanted).max() <= 1.01e-3


def test_lost_and_unposed_frames_are_counted(tmp_path):
    write_scannet(tmp_path, 5)
    np.savetxt(tmp_path / "pose/1.txt", np.full((4, 4), -np.inf))
    with pytest.warns(SceneWarning, match="1 of 5 frames lost tracking"):
        assert len(load_scene(tmp_path).views or ()) == 4
    np.savetxt(tmp_path / "pose/1.txt", np.eye(4))
    (tmp_path / "pose/2.txt").unlink()
    with pytest.warns(SceneWarning, match=r"1 of 5 frames have no pose file and are left out \(first: '2'\)"):
        assert len(load_scene(tmp_path).views or ()) == 4
    np.savetxt(tmp_path / "pose/2.txt", np.eye(4))
    (tmp_path / "depth/4.png").unlink()
    with pytest.warns(SceneWarning, match="1 of 5 depth files are missing"):
        views = load_scene(tmp_path).views
    assert not views.depths[4].any()
    for i in range(5):
        np.savetxt(tmp_path / f"pose/{i}.txt", np.full((4, 4), -np.inf))
    with pytest.raises(InputError, match="no view"):
        load_scene(tmp_path)


def test_bad_exports_are_errors_that_name_the_file(tmp_path):
    write_scannet(tmp_path)
    pose, k = tmp_path / "pose/1.txt", tmp_path / "intrinsic/intrinsic_color.txt"
    good_pose, good_k = pose.read_text(), k.read_text()
    for text, problem in (("1 2 3", "expected 4×4"), ("a b\nc d", "table of"), ("", "expected 4×4")):
        pose.write_text(text)
        with pytest.raises(InputError, match=rf"1\.txt.*{problem}"):
            read_scannet(tmp_path)
    pose.write_text(good_pose)
    for matrix, problem in (
        (np.diag([0.0, 31, 1, 1]), "focal length"),
        (np.array([[1170.0, 0, 648], [0, 1170, 484], [0, 0, 1]]), "principal point"),
        (np.array([[30.0, 5, 16], [0, 31, 12], [0, 0, 1]]), "expected"),
        (np.eye(2), "3×3 or 4×4"),
    ):
        np.savetxt(k, matrix)
        with pytest.raises(InputError, match=rf"intrinsic_color\.txt.*{problem}"):
            read_scannet(tmp_path)
    k.write_text(good_k)
    assert len(read_scannet(tmp_path).images) == 3
    save(tmp_path / "color/1.jpg", photograph(0))
    with pytest.raises(InputError, match="frame 1 is there twice"):
        read_scannet(tmp_path)
    (tmp_path / "color/1.jpg").unlink()
    for path in (tmp_path / "intrinsic").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="no intrinsics"):
        read_scannet(tmp_path)
