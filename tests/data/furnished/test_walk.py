"""Walks: depth, labels and colors belong together, and a splat has the labels of what it lies on."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal
from furniture import MODELS, catalogue, write_library

from gsencoder.app import main as cli
from gsencoder.data.furnished import surfaces
from gsencoder.data.furnished.kinds import STRUCTURE
from gsencoder.data.furnished.library import Model, select_makes
from gsencoder.data.furnished.plan import Home, Item, plan_home, pose
from gsencoder.data.furnished.shapes import Rectangle, mesh_of_quads, slab
from gsencoder.data.furnished.surfaces import Look, Surfaces
from gsencoder.data.furnished.walk import WalkConfig, _commonest, furnished_scene, furnished_splat, objects_of

SMALL = WalkConfig(views=6, width=64, noise=0.0, drift=0.0)


@pytest.fixture(scope="module")
def home(models: tuple[Model, ...]) -> Home:
    return plan_home(models, np.random.default_rng(1), ["living room"])


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_each_pixel_lies_in_the_box_of_its_object(home: Home) -> None:
    scene = furnished_scene(home, "room", SMALL, rng())
    boxes = {each.id: (each.aabb_min, each.aabb_max) for each in scene.objects}
    for view in range(len(scene.views)):
        depth, labels = scene.views.depths[view], scene.views.instances[view]
        cameras = scene.views.cameras
        points = cameras.centers[view] + cameras.rays(view) * depth[..., None]
        for label in np.unique(labels[depth > 0]):
            seen = points[(labels == label) & (depth > 0)]
            lower, upper = boxes[int(label)]
            assert (seen > lower - 0.01).all()
            assert (seen < upper + 0.01).all()


def test_cameras_keep_away_from_things_and_stay_in_the_room(home: Home) -> None:
    centers = furnished_scene(home, "room", SMALL, rng()).views.cameras.centers
    (_, area, height), surfaces = home.rooms[0], Surfaces(home, rng())
    assert (surfaces.distance(centers) > 0.2).all()
    assert (centers > [area.x0, area.y0, 0]).all()
    assert (centers < [area.x1, area.y1, height]).all()


def test_without_noise_gaussians_lie_on_the_surfaces_that_most_of_their_pixels_show(home: Home) -> None:
    voxel = 0.05
    splat = furnished_splat(home, SMALL, voxel, np.random.default_rng(6))  # Its walk looks at the ceiling.
    surfaces = Surfaces(home, rng())
    assert surfaces.distance(splat.means).max() < voxel
    objects = objects_of(home, surfaces)
    for item in np.unique(splat.items):
        means = splat.means[splat.items == item]
        assert (means > objects[item].aabb_min - voxel).all()
        assert (means < objects[item].aabb_max + voxel).all()
    assert {home.items[item].kind for item in np.unique(splat.items)} >= set(STRUCTURE)
    keys = 3 * np.array([2, 7, 2, 2, 8, 8]) + [0, 2, 1, 1, 2, 0]
    assert _commonest(keys, 3, np.array([7, 2, 8])).tolist() == [2, 1, 0]


def test_the_first_part_of_a_walk_sees_a_part_of_what_the_whole_does(home: Home) -> None:
    whole, half = (furnished_splat(home, SMALL, 0.05, rng(), walked=share) for share in (1.0, 0.5))
    assert len(half.cameras) == len(whole.cameras) / 2
    np.testing.assert_array_equal(half.cameras.centers, whole.cameras.centers[: len(half.cameras)])
    assert 0.1 < len(half.means) / len(whole.means) < 0.9


def test_some_walks_look_at_ceilings_and_some_end_below(home: Home) -> None:
    _, _, height = home.rooms[0]
    config = WalkConfig(views=12, width=48, noise=0.0, drift=0.0)
    tops = [furnished_splat(home, config, 0.1, np.random.default_rng(seed)).means[:, 2].max() for seed in range(12)]
    assert max(tops) > height - 0.05
    assert min(tops) < height - 0.2


def test_a_splat_of_a_drifting_walk_lies_where_its_poses_say(home: Home) -> None:
    exact, moved = (furnished_splat(home, replace(SMALL, drift=drift), 0.05, rng()) for drift in (0.0, 0.4))
    assert np.linalg.norm(exact.cameras.centers - moved.cameras.centers, axis=1).max() == pytest.approx(0.4, rel=1e-3)
    assert Surfaces(home, rng()).distance(moved.means).max() > 0.2


def test_what_is_seen_of_a_picture_is_its_pixel_with_rows_from_the_top(home, monkeypatch):
    pictures = np.random.default_rng(0).random((2, 4, 6, 3)).astype(np.float32)
    monkeypatch.setattr(surfaces, "looks_of", lambda item, *_: [Look(pictures[int(item.kind)], 1)])
    monkeypatch.setattr(Surfaces, "_shade", lambda self, points, normals: np.ones((len(points), 1), np.float32))
    square = mesh_of_quads([np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)])
    items = [Item(kind=str(n), matrix=pose(2.0 * n, 0.0, 0.0, 0.0, np.ones(3)), shape=square) for n in range(2)]
    at, item = rng().uniform(0, 1, (400, 2)), np.arange(400) % 2
    rays = np.column_stack([at[:, 0] + 2 * item, at[:, 1], np.ones(400), np.tile([0, 0, -1], (400, 1))])
    both = Surfaces(replace(home, items=tuple(items)), rng())
    colors = both.cast(*np.split(rays.astype(np.float32), 2, axis=1)).colors
    seen = pictures[item, ((1 - at[:, 1]) * 4).astype(int), (at[:, 0] * 6).astype(int)]
    assert (np.abs(colors - seen).max(axis=1) < 1e-6).mean() > 0.98


def test_the_command_takes_the_makes_and_the_types_that_it_is_told(models, tmp_path, monkeypatch):
    given, library = [], write_library(tmp_path / "test.sh3f")
    monkeypatch.setattr("gsencoder.app.commands.rooms.plan_home", lambda *each: given.append(each) or plan_home(*each))
    options = ("makes=held_out", "types=[bathroom]", "walk.views=3", "walk.width=32", "quiet=true")
    assert cli.main(["rooms", str(library), *options, f"out={tmp_path / 'homes'}"]) == 0
    ((used, _, types),) = given
    assert [model.id for model in used] == [model.id for model in select_makes(models, "held_out")]
    assert types == ("bathroom",)


def test_homes_of_another_library_do_not_join_those_that_are_finished(tmp_path: Path, capsys) -> None:
    whole = write_library(tmp_path / "whole.sh3f")
    fewer = write_library(tmp_path / "fewer.sh3f", catalogue([each for each in MODELS if each[0] != "Cup"]))
    options = ("types=[bathroom]", "walk.views=3", "walk.width=32", f"out={tmp_path / 'homes'}")
    assert cli.main(["rooms", str(whole), *options, "quiet=true"]) == 0
    moved = whole.rename(tmp_path / "moved.sh3f")
    assert cli.main(["rooms", str(moved), *options, "count=2", "quiet=true"]) == 0
    assert "holds the results of other settings (models)" in refusal(capsys, "rooms", str(fewer), *options)


def test_noise_grows_with_the_square_of_depth_and_drift_moves_poses(home: Home) -> None:
    configs = (SMALL, replace(SMALL, noise=1.0, drift=0.05))
    exact, noisy = (furnished_scene(home, "room", each, rng()).views for each in configs)
    true, measured = np.stack(list(exact.depths)), np.stack(list(noisy.depths))
    both = (true > 0) & (measured > 0)
    relative = (measured - true)[both] / (0.0014 * true[both] ** 2)
    assert relative.std() == pytest.approx(1, rel=0.1)
    assert 0.005 < ((true > 0) & (measured == 0)).mean() < 0.3
    moved = np.linalg.norm(exact.cameras.centers - noisy.cameras.centers, axis=1)
    assert moved.max() == pytest.approx(0.05, rel=1e-3)


def test_light_and_materials_are_drawn_for_each_home_and_a_seed_gives_the_same(home: Home) -> None:
    scenes = [furnished_scene(home, "room", SMALL, np.random.default_rng(seed)) for seed in (5, 5, 6)]
    images = [np.stack(list(scene.views.images)) for scene in scenes]
    assert (images[0] == images[1]).all()
    assert np.abs(images[0].astype(int) - images[2]).mean() > 5


def test_things_of_one_make_look_alike(models: tuple[Model, ...]) -> None:
    chair = next(model for model in models if model.kind.name == "chair")
    items = [Item(kind="chair", matrix=pose(x, 0.0, 0.0, 0.0, np.ones(3)), model=chair) for x in (0.0, 2.0)]
    floor = Item(kind="floor", matrix=pose(0.0, 0.0, 0.0, 0.0, np.ones(3)), shape=slab(1.0, 1.0, 0.1), finish="floor")
    home = Home(rooms=(("office", Rectangle(-3.0, -3.0, 3.0, 3.0), 2.5),), items=(*items, floor))
    surfaces = Surfaces(home, rng())
    faces = np.arange(len(chair.mesh.faces))
    colors = [surfaces._albedo(faces + first, np.full((len(faces), 2), 0.3, np.float32)) for first in (0, len(faces))]
    np.testing.assert_array_equal(*colors)


def test_a_shadow_lies_behind_what_stands_before_a_lamp(home: Home) -> None:
    surfaces = Surfaces(home, rng())
    lamp = surfaces.light.lamps[0]
    rays = np.stack([np.cos(at := np.linspace(0, 2 * math.pi, 400)), np.sin(at), np.full(400, -1.0)], axis=1)
    origins = np.broadcast_to(lamp.astype(np.float32), rays.shape)
    hits = surfaces.cast(origins, rays.astype(np.float32))
    # From the lamp itself all that is seen is lit, but for the edge of what touches another surface.
    facing = -(rays * hits.normals).sum(axis=1) / np.linalg.norm(rays, axis=1)
    lit = surfaces._shade(origins + rays * hits.distances[:, None], hits.normals)[:, 0] / surfaces.light.gain[0]
    assert (lit[facing > 0.3] > surfaces.light.ambient + 1e-3).mean() > 0.95
    # Below what stands on the floor there is the ambient light alone.
    under = next(box for box, item in zip(surfaces.boxes, home.items, strict=True) if item.kind == "couch")
    below = np.array([[*under.mean(axis=0)[:2], 0.0]])
    hidden = surfaces._shade(below, np.array([[0.0, 0.0, 1.0]]))[:, 0] / surfaces.light.gain[0]
    np.testing.assert_allclose(hidden, surfaces.light.ambient, rtol=1e-6)
