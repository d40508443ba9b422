import numpy as np
import pytest
from scene_files import photograph, save, write_scannet

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.rgbd import read_scannet
from gsencoder.data.scenes import load_scene


def test_depth_is_metres_and_the_world_is_upright(tmp_path):
    write_scannet(tmp_path, 12)
    scene = load_scene(tmp_path)
    assert scene.metres_per_unit == 1.0
    assert scene.up.tolist() == [0, 0, 1]
    assert scene.views.names[9:] == ("color/9.png", "color/10.png", "color/11.png")
    assert np.abs(scene.views.depths[1][3] - (1 + np.arange(32) * 1e-3)).max() < 1e-6


def test_depth_of_another_size_is_resampled_by_its_own_intrinsics(tmp_path):
    factor = 2
    write_scannet(tmp_path, depth_size=(32 * factor, 24 * factor))
    views = load_scene(tmp_path).views
    depth = views.depths[0]
    assert depth.shape == (24, 32)
    # The center of color pixel c is the edge between depth pixels at factor·(c + ½), up to float rounding.
    wanted = 1 + (np.arange(32) + 0.5) * factor * 1e-3
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


def test_instances_are_read_where_they_are(tmp_path):
    write_scannet(tmp_path)
    save(tmp_path / "instance-filt/1.png", np.full((24, 32), 9, np.uint8))
    views = load_scene(tmp_path).views
    assert (views.instances[1] == 9).all()
    assert not views.instances[0].any()


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
