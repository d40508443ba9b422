"""Scenes of every form: what is read and what is refused, and orbits around them."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scene_files import photograph, rewrite, save, some_gaussians, write_colmap, write_transforms

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.orbits import orbit_cameras, robust_ball
from gsencoder.data.readers.posed import choose_origin
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.data.splats.files import save_splat
from gsencoder.types import Gaussians, Scene


def world_centers(scene: Scene) -> np.ndarray:
    return scene.views.cameras.centers + scene.origin


@pytest.mark.parametrize("offset", [(1e6, -2e6, 3e6), (1e6 + 0.25, 0.125, -7e5)])
def test_a_scene_far_from_zero_equals_the_scene_at_zero(tmp_path, offset):
    for name, shift in (("near", (0.0, 0.0, 0.0)), ("far", offset)):
        write_transforms(tmp_path / name, offset=shift)
        write_colmap(tmp_path / f"{name}_colmap", offset=shift)
    for kind in ("", "_colmap"):
        near, far = load_scene(tmp_path / f"near{kind}"), load_scene(tmp_path / f"far{kind}")
        assert not near.origin.any()
        assert np.abs(far.origin - offset).max() <= 500
        assert np.abs(world_centers(far) - world_centers(near) - offset).max() < 1e-6
        if all(part % 1000 == 0 for part in offset):
            difference = far.views.cameras.cam_from_world - near.views.cameras.cam_from_world
            assert np.abs(difference).max() < 2e-6
        if kind:
            moved = far.sfm_points.astype(float) + far.origin - near.sfm_points
            assert np.abs(moved - offset).max() < 1e-6


def test_the_origin_follows_shifts_by_whole_steps_exactly(rng):
    points = rng.normal(size=(20, 3)) * 100
    shift = np.array([3000.0, -1_000_000.0, 0.0])
    assert (choose_origin(points + shift) - choose_origin(points) == shift).all()
    assert (choose_origin(np.zeros((0, 3))) == 0).all()


def test_fewer_views_are_evenly_spaced_and_keep_both_ends(tmp_path):
    write_transforms(tmp_path, 9)
    scene = load_scene(tmp_path, options=SceneConfig(max_views=3))
    assert scene.views.names == ("images/000.png", "images/004.png", "images/008.png")


def test_scaling_keeps_rays_and_sizes_in_step(tmp_path):
    write_transforms(tmp_path, depth=True, instances=True)
    full, half = (load_scene(tmp_path, options=SceneConfig(image_scale=scale)).views for scale in (1.0, 0.5))
    assert half.images[1].shape == (12, 16, 3)
    assert (half.depths[1] == np.float32(1.001)).all()
    assert (half.instances[2] == 302).all()
    corner = np.linalg.inv(full.cameras.Ks[0].astype(float)) @ [32, 24, 1]
    assert np.abs(half.cameras.Ks[0] @ corner - [16, 12, 1]).max() < 1e-5
    averages = photograph(1).reshape(12, 2, 16, 2, 3).mean(axis=(1, 3))
    assert np.abs(half.images[1] - averages).max() <= 1


def test_nothing_recognised_says_what_was_looked_for(tmp_path):
    with pytest.raises(InputError, match=r"one of: transforms\.json.*COLMAP.*ScanNet.*Replica.*; a splat"):
        load_scene(tmp_path)
    with pytest.raises(InputError, match="no such file or folder"):
        load_scene(tmp_path / "nowhere")
    for name in ("a\0b", "n" * 5000):
        with pytest.raises(InputError, match=r"no such file or folder|is not a path"):
            load_scene(name)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match=r"expected a transforms\.json or a splat"):
        load_scene(tmp_path / "notes.txt")


def test_a_splat_beside_the_views_is_not_taken_silently(tmp_path):
    write_transforms(tmp_path)
    (tmp_path / "splat.ply").write_bytes(b"not read")
    with pytest.warns(SceneWarning, match=r"splat\.ply lies with the views and is not used; say splat="):
        scene = load_scene(tmp_path)
    assert scene.gaussians is None
    with pytest.raises(InputError, match="no such file"):
        load_scene(tmp_path, splat="other.ply")


def test_a_given_splat_shares_the_origin_of_the_cameras(tmp_path):
    write_transforms(tmp_path, offset=(5000.0, 0.0, 0.0))
    means = np.array([[1.0, 2, 3], [2, 3, 4]], np.float32)
    save_splat(tmp_path / "mine.ply", some_gaussians(means), origin=np.array([5000.0, 0, 0]))
    scene = load_scene(tmp_path, splat="mine.ply")
    assert scene.origin.tolist() == [5000.0, 0.0, 0.0]
    np.testing.assert_allclose(scene.gaussians.means, means, atol=1e-6)
    with pytest.raises(InputError, match="splat= is for scenes with views"):
        load_scene(tmp_path / "mine.ply", splat="mine.ply")


def test_a_bare_splat_has_no_views_and_a_far_one_keeps_its_digits(tmp_path):
    near = np.array([[0.001, 0, 0], [4.002, 8, 0], [8.003, 4, 1]], np.float32)
    save_splat(tmp_path / "only.ply", some_gaussians(near), origin=np.array([1e6, 0, 0]))
    for path in (tmp_path, tmp_path / "only.ply"):
        scene = load_scene(path)
        assert scene.views is None
        assert scene.origin.tolist() == [1e6, 0, 0]
        # float32 columns would have rounded to 0.06.
        np.testing.assert_allclose(scene.gaussians.means, near, atol=1e-6)
    (tmp_path / "second.spz").write_bytes(b"")
    with pytest.raises(InputError, match=r"holds 2 splats \(only\.ply, second\.spz\)"):
        load_scene(tmp_path)


def test_objects_come_with_the_scene(tmp_path):
    write_transforms(tmp_path)
    row = {"id": 3, "name": None, "aabb_min": [0, 0, 0], "aabb_max": [1, 2, 3], "placed": False, "views": 2}
    (tmp_path / "objects.json").write_text(json.dumps([row]))
    (thing,) = load_scene(tmp_path).objects
    assert (thing.id, thing.name, thing.placed, thing.views, thing.max_pixels) == (3, None, False, 2, 0)
    assert thing.aabb_max.tolist() == [1, 2, 3]
    for change, message in (
        ({"id": 0}, "id must be a whole number from 1"),
        ({"views": 1.5}, "views must be a whole number from 0"),
        ({"aabb_min": [2, 0, 0]}, "expected aabb_min below aabb_max"),
        ({"aabb_max": [0, float("nan"), 1]}, "expected aabb_min below aabb_max"),
        ({"aabb_max": [0, 1]}, "aabb_max must be 3 numbers"),
        ({"name": "x" * 1_000_000}, "name must be null or at most 1,000"),
        ({"placed": 1}, "placed true or false"),
    ):
        (tmp_path / "objects.json").write_text(json.dumps([row | change]))
        with pytest.raises(InputError, match=message):
            load_scene(tmp_path)
    (tmp_path / "objects.json").write_text(json.dumps([row, row]))
    with pytest.raises(InputError, match="id 3 belongs to several"):
        load_scene(tmp_path)


def test_views_can_be_sent_to_another_process(tmp_path):
    write_colmap(tmp_path, model="SIMPLE_RADIAL", params=(30, 16, 12, 0.1))
    views = load_scene(tmp_path).views
    copy = pickle.loads(pickle.dumps(views.images))
    assert (copy[2] == views.images[2]).all()


def test_images_of_two_sizes_live_in_one_scene(tmp_path, no_jaxtyping):
    # jaxtyping would bind H and W of a random image and a random depth to each other.
    data = write_transforms(tmp_path, depth=True)
    save(tmp_path / "images/001.png", photograph(1, 16, 12))
    save(tmp_path / "depth/001.png", np.full((12, 16), 500, np.uint16))
    data["frames"][1] |= {"w": 16, "h": 12, "fl_x": 15.0}
    rewrite(tmp_path, data)
    views = load_scene(tmp_path).views
    assert [image.shape[:2] for image in views.images] == [(24, 32), (12, 16), (24, 32)]
    assert views.cameras.widths.tolist() == [32, 16, 32]


def test_a_scene_given_as_the_folder_above_has_that_folders_name(tmp_path, monkeypatch):
    write_transforms(tmp_path / "kitchen")
    monkeypatch.chdir(tmp_path / "kitchen" / "images")
    assert load_scene("..").name == "kitchen"


def test_each_scene_has_its_own_splat_and_mesh_before_those_from_here(tmp_path, monkeypatch):
    for name, x in {"a": 1.0, ".": 3.0}.items():
        box = trimesh.creation.box((0.2, 0.2, 0.2), trimesh.transformations.translation_matrix((x, 0, 0)))
        (tmp_path / name).mkdir(exist_ok=True)
        box.export(tmp_path / name / "mesh.ply")
        save_splat(tmp_path / name / "mine.ply", some_gaussians(np.array([[x, 0, 0]], np.float32)))
    (tmp_path / "c").mkdir()
    monkeypatch.chdir(tmp_path)
    config, options = SeedConfig(source="mesh", mesh="mesh.ply", voxel=0.1), SceneConfig(metres_per_unit=1.0)
    for name, x in (("a", 1.0), ("c", 3.0)):
        write_transforms(tmp_path / name)
        seeds = seed(load_scene(name, options=options), config)
        assert np.abs(seeds.means.mean(axis=0) - (x, 0, 0)).max() < 0.02
        assert load_scene(name, splat="mine.ply").gaussians.means[0, 0] == pytest.approx(x)
        (tmp_path / "splats" / name).mkdir(parents=True)
        save_splat(tmp_path / "splats" / name / "its.ply", some_gaussians(np.array([[2 * x, 0, 0]], np.float32)))
        named = load_scene(name, splat="splats/{scene}/its.ply")
        assert named.gaussians.means[0, 0] == pytest.approx(2 * x)
    with pytest.raises(InputError, match=r"seeds\.mesh=none\.ply: no such file .looked in .*a and from here"):
        seed(load_scene("a"), replace(config, mesh="none.ply"))


def test_a_folder_of_features_is_named_as_such(tmp_path):
    (tmp_path / "scene.safetensors").touch()
    with pytest.raises(InputError, match="a folder of features, not a scene; localize, views"):
        find_scenes([tmp_path])


def test_a_scene_that_is_given_twice_is_refused_under_whatever_name(tmp_path):
    write_transforms(tmp_path / "scenes" / "one", 1)
    scene = tmp_path / "scenes" / "one"
    with pytest.raises(InputError, match="one: is given twice; give it once"):
        find_scenes([scene, tmp_path / "scenes"])
    (tmp_path / "scenes" / "two").symlink_to(scene)
    with pytest.raises(InputError, match="two: is the same as .*one, which is given as well; give one of them"):
        find_scenes([tmp_path / "scenes"])
    assert find_scenes([scene]) == (scene,)


def test_a_folder_of_meshes_alone_is_said_to_hold_meshes(tmp_path):
    for name in ("scene0000_00_vh_clean_2.ply", "scene0000_00_vh_clean_2.labels.ply"):
        trimesh.creation.box().export(tmp_path / name)
    with pytest.raises(InputError, match=r"holds 2 \.ply files, meshes or points, and no splat and no views$"):
        load_scene(tmp_path)


def looks(gaussians: Gaussians, **options: object) -> tuple[np.ndarray, np.ndarray]:
    """Where each orbit camera sees the center, in pixels, and at what depth."""
    cameras = orbit_cameras(gaussians, **options)  # type: ignore[arg-type]
    center, _ = robust_ball(gaussians)
    pose = cameras.cam_from_world.astype(float)
    seen = pose[:, :3, :3] @ center + pose[:, :3, 3]
    pixel = np.einsum("vij,vj->vi", cameras.Ks.astype(float), seen)
    return pixel[:, :2] / pixel[:, 2:], seen[:, 2]


@pytest.mark.parametrize("up", [None, np.array([0.0, 0.0, 1.0]), np.array([0.0, 3.0, 0.0])])
def test_orbit_cameras_see_the_center_from_one_distance(rng, up):
    ball = rng.normal(size=(4000, 3))
    ball *= (rng.random((4000, 1)) ** (1 / 3)) / np.linalg.norm(ball, axis=1, keepdims=True)
    gaussians = some_gaussians(ball + np.array([4, 5, 6]))
    pixel, depth = looks(gaussians, count=24, width=640, height=480, up=up)
    assert np.abs(pixel - [320, 240]).max() < 1e-2
    _, radius = robust_ball(gaussians)
    assert 1.0 < radius < 1.3
    half = np.arctan(240 / (320 / np.tan(np.radians(30))))
    assert np.abs(depth - radius / np.sin(half)).max() < 1e-5
    cameras = orbit_cameras(gaussians, up=up)
    for view in range(0, 24, 5):
        p = cameras.cam_from_world[view].astype(float)
        q = (gaussians.means @ p[:3, :3].T + p[:3, 3]) @ cameras.Ks[view].T
        assert ((q[:, :2] / q[:, 2:] >= 0) & (q[:, :2] / q[:, 2:] <= (640, 480))).all()
    if up is not None:
        elevation = (cameras.centers - [4, 5, 6]) @ (up / np.linalg.norm(up)) / depth
        assert -0.3 < elevation.min() < 0
        assert 0.8 < elevation.max() < 0.9
        # Up in the world is up in the picture, where y points down.
        assert (cameras.cam_from_world[:, 1, :3] @ up < 0).all()


def test_floaters_and_transparent_gaussians_do_not_move_the_orbit(rng):
    ball = rng.normal(size=(1000, 3))
    clean = robust_ball(some_gaussians(ball))
    far = np.concatenate([ball, rng.normal(size=(30, 3)) * 1e6, 50 + rng.normal(size=(5000, 3))])
    opacities = np.concatenate([np.ones(1030), np.full(5000, 1e-4)])
    dirty = robust_ball(some_gaussians(far, opacities))
    assert np.abs(clean[0] - dirty[0]).max() < 0.1
    assert 0.9 * clean[1] < dirty[1] < 1.5 * clean[1]
    # Half of the weight in floaters is bounded by the median.
    many = np.concatenate([ball, rng.normal(size=(400, 3)) * 1e6])
    assert robust_ball(some_gaussians(many))[1] < 3 * clean[1]


@pytest.mark.parametrize("count", [1, 500])
@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_one_gaussian_and_coincident_ones_have_orbits(count, opacity):
    gaussians = some_gaussians(np.tile([[1.0, 2.0, 3.0]], (count, 1)), np.full(count, opacity), scale=0.2)
    pixel, depth = looks(gaussians, count=1, width=100, height=100)
    assert np.abs(pixel - 50).max() < 1e-2
    assert depth[0] == pytest.approx(0.6 / np.sin(np.radians(30)), rel=1e-5)
    tiny = some_gaussians(np.zeros((count, 3)), scale=1e-6)
    assert looks(tiny)[1].min() > 0.04
