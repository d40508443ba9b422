import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.data.scenes import load_scene
from gsencoder.data.synthetic import (
    COLORS,
    HALF_ROOM,
    SHELF,
    TABLE,
    Solid,
    color_words,
    make_room,
    plan_room,
    write_room,
)


@pytest.fixture(scope="module")
def room():
    return make_room(3)


def _arrays(scene):
    views, g = scene.views, scene.gaussians
    yield from (g.means, g.quats, g.scales, g.opacities, g.sh, views.cameras.cam_from_world, views.cameras.Ks)
    for kind in (views.images, views.depths, views.instances):
        yield from kind


def _world_points(views, view):
    depth = views.depths[view].astype(np.float64)
    K, pose = views.cameras.Ks[view].astype(np.float64), views.cameras.cam_from_world[view].astype(np.float64)
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    local = np.stack([(u - K[0, 2]) / K[0, 0] * depth, (v - K[1, 2]) / K[1, 1] * depth, depth], axis=-1)
    return (local - pose[:3, 3]) @ pose[:3, :3]


def test_the_same_seed_gives_the_same_bits_and_another_seed_another_room(room):
    again, other = make_room(3), make_room(4)
    assert all(np.array_equal(a, b) for a, b in zip(_arrays(room), _arrays(again), strict=True))
    assert [o.name for o in room.objects] != [o.name for o in other.objects]


def test_every_pixel_lies_on_its_own_object_and_inside_its_box(room):
    things = {thing.id: thing for thing in plan_room(3)}
    boxes = {each.id: (each.aabb_min, each.aabb_max) for each in room.objects}
    for view in range(0, len(room.views), 5):
        points, labels = _world_points(room.views, view), room.views.instances[view]
        assert ((labels > 0) == (room.views.depths[view] > 0)).all()
        for label in np.unique(labels[labels > 0]):
            mine = points[labels == label]
            lower, upper = boxes[int(label)]
            assert (mine > lower - 1e-5).all()
            assert (mine < upper + 1e-5).all()
            parts = things[int(label)].parts
            assert np.any([part.contains(mine, 1e-5) for part in parts], axis=0).all()
            assert not np.any([part.contains(mine, -1e-5) for part in parts], axis=0).any()


@pytest.mark.parametrize("seed", range(4))
def test_objects_rest_on_something_keep_apart_and_show_in_several_views(seed):
    scene = make_room(seed, width=80, height=60)
    placed = [thing for thing in scene.objects if thing.placed]
    assert len(placed) == 8
    assert len({thing.name for thing in placed}) == 8
    for row, thing in enumerate(placed):
        assert np.abs(thing.aabb_min[2] - np.array([0, TABLE[2], SHELF[2]])).min() < 1e-9
        assert (np.abs([thing.aabb_min[:2], thing.aabb_max[:2]]) < HALF_ROOM).all()
        assert thing.views >= 3, f"{thing.name} shows in {thing.views} views"
        for other in placed[:row]:
            apart = (thing.aabb_min >= other.aabb_max) | (other.aabb_min >= thing.aabb_max)
            parts = [plan for plan in plan_room(seed) if plan.id in (thing.id, other.id)]
            points = np.concatenate([part.lattice(0.01) for part in parts[0].parts])
            touching = np.any([part.contains(points, 0.005) for part in parts[1].parts], axis=0)
            assert apart.any() or not touching.any()


def test_gaussians_lie_on_the_surfaces_with_the_colors_of_the_pictures(room):
    g = room.gaussians
    assert 5_000 < len(g) < 40_000
    assert (np.abs(g.means[:, 2]) < 3).all()
    colors = 0.5 + 0.28209479177387814 * g.sh[:, 0]
    checked, wrong = 0, 0
    for view in range(0, 16, 4):
        pose, K = room.views.cameras.cam_from_world[view], room.views.cameras.Ks[view]
        local = g.means @ pose[:3, :3].T + pose[:3, 3]
        ahead = local[:, 2] > 0.1
        pixel = np.floor(local[ahead, :2] / local[ahead, 2:] * np.diag(K)[:2] + K[:2, 2]).astype(int)
        inside = (pixel >= 0).all(axis=1) & (pixel < [160, 120]).all(axis=1)
        rows, (x, y) = np.flatnonzero(ahead)[inside], pixel[inside].T
        visible = np.abs(room.views.depths[view][y, x] - local[rows, 2]) < 0.004
        apart = np.abs(colors[rows] * 255 - room.views.images[view][y, x]).max(axis=1)[visible]
        checked, wrong = checked + apart.size, wrong + int((apart > 20).sum())
    assert checked > 5_000
    assert wrong < 0.03 * checked  # A pixel on the border of a check or of an object shows the other side.


def test_color_words_are_the_hues_of_the_pictures(room):
    words, pictures, labels = color_words(3), np.stack(room.views.images), np.stack(room.views.instances)
    placed = [thing for thing in room.objects if thing.placed]
    assert len({words[thing.id] for thing in placed}) == 8
    for thing in placed:
        mean, wanted = pictures[labels == thing.id].mean(axis=0), np.array(COLORS[words[thing.id]], float)
        assert mean @ wanted / np.linalg.norm(mean) / np.linalg.norm(wanted) > 0.995
        assert 0.5 < np.linalg.norm(mean) / np.linalg.norm(wanted) <= 1.01


def test_a_written_room_loads_as_the_same_scene_and_is_written_over_nothing(room, tmp_path):
    write_room(room, tmp_path / "room")
    with pytest.raises(InputError, match="not an empty folder"):
        write_room(room, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["room"]
    loaded = load_scene(tmp_path / "room")
    assert loaded.metres_per_unit == 1
    assert loaded.up.tolist() == [0, 0, 1]
    assert loaded.views.names == room.views.names
    assert np.abs(loaded.views.cameras.centers + loaded.origin - room.views.cameras.centers).max() < 1e-6
    ours, theirs = (each.views.cameras.cam_from_world[:, :3, :3] for each in (loaded, room))
    assert np.abs(ours - theirs).max() < 1e-6
    assert np.array_equal(loaded.views.cameras.Ks, room.views.cameras.Ks)
    for view in (0, 9):
        assert np.array_equal(loaded.views.images[view], room.views.images[view])
        assert np.array_equal(loaded.views.instances[view], room.views.instances[view])
        assert np.abs(loaded.views.depths[view] - room.views.depths[view]).max() < 5.1e-4
    for read, made in zip(loaded.objects, room.objects, strict=True):
        for field in ("id", "name", "placed", "views", "max_pixels"):
            assert getattr(read, field) == getattr(made, field)
        assert np.array_equal(read.aabb_min, made.aabb_min)
        assert np.array_equal(read.aabb_max, made.aabb_max)


@pytest.mark.parametrize("shape", ["box", "ellipsoid", "cylinder"])
def test_solids_rays_normals_and_lattices_agree(shape, rng):
    solid = Solid(shape=shape, center=np.array([0.3, -0.2, 0.5]), half=np.array([0.3, 0.2, 0.1]), yaw=0.7)
    points = solid.lattice(0.02)
    assert not solid.contains(points, -1e-9).any()
    assert solid.contains(points, 1e-9).all()
    normals = solid.normals(points)
    assert not solid.contains(points + 1e-4 * normals, 0.0).any()
    assert solid.contains(points - 1e-4 * normals, 0.0).all()
    lower, upper = solid.aabb()
    assert np.abs(points.min(axis=0) - lower).max() < 0.02
    assert (points >= lower - 1e-9).all()
    assert (points <= upper + 1e-9).all()
    origin = np.array([2.0, 1.0, 1.5])
    hits = solid.hits(origin, points - origin)
    facing = np.einsum("ij,ij->i", normals, points - origin) < -1e-3
    assert np.abs(hits[facing] - 1).max() < 1e-9
    assert (hits[~np.isinf(hits)] < 1 + 1e-9).all()
    assert np.isinf(solid.hits(origin, origin - points)).all()


def test_ends_of_the_range():
    assert len(make_room(0, objects=0, views=0).views) == 0
    tiny = make_room(0, objects=18, views=1, width=1, height=1, spacing=0.2)
    assert tiny.views.depths[0].shape == (1, 1)
    assert len(tiny.objects) == 22
    with pytest.raises(InputError, match="synthetic room"):
        make_room(0, objects=19)
