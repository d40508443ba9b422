"""Every layout of RGB-D sequences gives the scene that was written; what does not fit is refused or counted."""

import numpy as np
import pytest
from rgbd_layouts import WRITERS, write_replica, write_tum
from scipy.spatial.transform import Rotation

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.images import register_depth
from gsencoder.data.scenes import LAYOUTS, SceneConfig, find_scenes, layout_of, load_scene
from gsencoder.data.synthetic import make_room
from gsencoder.types import Scene


@pytest.fixture(scope="module")
def room():
    return make_room(3, objects=4, views=5, width=96, height=72)


def options_for(layout: str, room: Scene) -> SceneConfig:
    """TUM sequences do not say their intrinsics."""
    K = room.views.cameras.Ks[0].astype(float)
    stated = (K[0, 0], K[1, 1], K[0, 2], K[1, 2]) if layout == "TUM RGB-D" else None
    return SceneConfig(intrinsics=stated)


@pytest.mark.parametrize("layout", WRITERS)
def test_a_room_is_read_back_from_every_layout(room, tmp_path, layout):
    folder = tmp_path / "room"
    folder.mkdir()
    WRITERS[layout](room, folder)
    recognized = layout_of(folder)
    assert recognized.name == layout
    assert find_scenes([tmp_path]) == (folder,)
    read = load_scene(folder, options=options_for(layout, room))
    ours, theirs = read.views, room.views
    assert len(ours) == len(theirs)
    shift = room.origin - read.origin
    np.testing.assert_allclose(ours.cameras.centers, theirs.cameras.centers + shift, atol=2e-6)
    np.testing.assert_allclose(*(views.cameras.cam_from_world[:, :3, :3] for views in (ours, theirs)), atol=1e-6)
    np.testing.assert_allclose(ours.cameras.Ks, theirs.cameras.Ks, rtol=1e-6)
    for view in range(len(theirs)):
        np.testing.assert_array_equal(ours.images[view], theirs.images[view])
        if ours.depths is not None:
            np.testing.assert_allclose(ours.depths[view], theirs.depths[view], atol=6e-4)
    assert (ours.depths is None) == (layout == "ScanNet++")
    assert (read.metres_per_unit, read.up is None) == (1.0, layout == "7-Scenes")


def test_named_objects_that_a_layout_does_not_read_are_not_passed_over_silently(room, tmp_path):
    WRITERS["7-Scenes"](room, tmp_path)
    (tmp_path / "objects.json").write_text("{}")
    with pytest.warns(SceneWarning, match=r"objects\.json is not used; .* this is 7-Scenes"):
        assert load_scene(tmp_path).objects == ()


def test_the_error_that_recognizes_nothing_lists_every_layout(tmp_path):
    with pytest.raises(InputError, match="neither a scene nor a folder of scenes") as error:
        find_scenes([tmp_path])
    for layout in LAYOUTS:
        assert layout.files in str(error.value)


def test_intrinsics_that_are_missing_and_times_that_do_not_match_are_refused(room, tmp_path):
    write_tum(room, tmp_path)
    with pytest.raises(InputError, match=r"give data.intrinsics=\[fx,fy,cx,cy\]"):
        load_scene(tmp_path)
    text = (tmp_path / "groundtruth.txt").read_text().replace("13050311", "13050399")
    (tmp_path / "groundtruth.txt").write_text(text)
    with pytest.raises(InputError, match=r"no view: rgb.txt has times from 1305031102.000 to"):
        load_scene(tmp_path, options=options_for("TUM RGB-D", room))


def test_depth_of_another_time_is_not_taken(room, tmp_path):
    write_tum(room, tmp_path, late=5.0)
    with pytest.warns(SceneWarning, match="5 of 5 depth files are missing"):
        assert load_scene(tmp_path, options=options_for("TUM RGB-D", room)).views.depths is None


@pytest.mark.parametrize("count", [0, 7])
def test_poses_of_the_wrong_count_are_refused(room, tmp_path, count):
    folder = tmp_path / "room"
    write_replica(room, folder)
    rows = np.resize(np.loadtxt(folder / "traj.txt"), (count, 16))
    np.savetxt(folder / "traj.txt", rows)
    wanted = r"expected n×16 numbers" if count == 0 else rf"{count} poses for 5 pictures in results"
    with pytest.raises(InputError, match=wanted):
        load_scene(folder)


def test_intrinsics_and_a_depth_sensor_beside_the_camera_can_be_stated(room, tmp_path):
    """Depth that is registered already, stated to come from 10 cm aside: every surface moves by f · 0.1 / z pixels."""
    folder = tmp_path / "room"
    write_replica(room, folder)
    aside = (1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    moved = load_scene(folder, options=SceneConfig(depth_from_color=aside)).views
    plain = load_scene(folder).views
    K = plain.cameras.Ks[0].astype(float)
    transform = np.eye(4)
    transform[0, 3] = -0.1
    wanted = register_depth(plain.depths[0], K, transform, K, 96, 72)
    np.testing.assert_allclose(moved.depths[0], wanted, rtol=1e-6)
    assert not np.array_equal(moved.depths[0], plain.depths[0])
    with pytest.raises(InputError, match="12 or 16 numbers, got 3"):
        SceneConfig(depth_from_color=(1.0, 2.0, 3.0))


def test_registered_depth_hides_what_is_behind():
    """A bar before a wall: from the side the bar covers other parts of the wall, and bares some that have no depth."""
    depth = np.full((40, 60), 4.0, np.float32)
    depth[:, 28:32] = 1.0
    K = np.array([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    aside = np.eye(4)
    aside[0, 3] = 0.2
    seen = register_depth(depth, K, aside, K, 60, 40)
    # The bar moves by 50 · 0.2 / 1 = 10 pixels, the wall by 2.5.
    assert (seen[:, 39:41] == 1).all()
    assert (seen[:, 20:28] == 4).all()
    assert (seen[:, 32:34] == 0).all()
    assert np.isin(seen, (0, 1, 4)).all()
    np.testing.assert_array_equal(register_depth(depth, K, np.eye(4), K, 60, 40), depth)


def test_registered_depth_follows_a_turned_and_shifted_sensor_pixel_by_pixel():
    """The oracle: each depth pixel as a point, projected; a plane that faces no camera has a depth everywhere."""
    height, width = 60, 80
    depth_K = np.array([[70.0, 0, 41], [0, 74, 29], [0, 0, 1]])
    color_K = np.array([[55.0, 0, 45], [0, 52, 33], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec([0.05, -0.08, 0.02]).as_matrix()
    matrix[:3, 3] = 0.06, -0.04, 0.1
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack(((columns - 41) / 70, (rows - 29) / 74, np.ones((height, width))), axis=2)
    normal, offset = np.array([0.3, -0.2, 1.0]), 2.0
    depth = (offset / (rays @ normal)).astype(np.float32)
    seen = register_depth(depth, depth_K, matrix, color_K, 90, 64)
    columns, rows = np.meshgrid(np.arange(90) + 0.5, np.arange(64) + 0.5)
    rays = np.stack(((columns - 45) / 55, (rows - 33) / 52, np.ones((64, 90))), axis=2)
    turned = matrix[:3, :3] @ normal
    exact = (offset + turned @ matrix[:3, 3]) / (rays @ turned)
    covered = seen > 0
    assert 0.3 < covered.mean() < 1
    assert np.abs(seen[covered] / exact[covered] - 1).max() < 0.02
    # The corners of the sensor's picture are the corners of what is covered, and inside there are no holes.
    corners = (
        depth[[0, 0, -1, -1], [0, -1, 0, -1], None]
        * np.stack([((u - 41) / 70, (v - 29) / 74, 1) for v in (0.5, 59.5) for u in (0.5, 79.5)])
    ) @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = corners[:, :2] / corners[:, 2:] * (55, 52) + (45, 33)
    edges = [(pixels[a], pixels[b]) for a, b in ((0, 1), (1, 3), (3, 2), (2, 0))]
    sides = np.stack([
        (end - start)[0] * (rows - start[1]) - (end - start)[1] * (columns - start[0])
        for start, end in edges
    ]) / np.array([np.linalg.norm(end - start) for start, end in edges])[:, None, None]  # fmt: skip
    within = sides.min(axis=0)
    assert covered[within > 0].all()
    assert not covered[within < -1.5].any()


def test_a_pixel_of_depth_covers_its_own_square_a_tenth_wider():
    depth = np.zeros((3, 4), np.float32)
    depth[1, 2] = 2.0
    sensor = np.array([[10.0, 0, 2], [0, 10, 1.5], [0, 0, 1]])
    # Its center is at (2.5, 1.5), twenty small pixels wide: 40 to 60 and 20 to 40, and a pixel more on each side.
    wide = register_depth(depth, sensor, np.eye(4), np.array([[200.0, 0, 40], [0, 200, 30], [0, 0, 1]]), 80, 60)
    assert set(np.flatnonzero(wide.any(axis=0))) == set(range(39, 61))
    assert set(np.flatnonzero(wide.any(axis=1))) == set(range(19, 41))
