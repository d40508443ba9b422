"""Walks: depth, labels and colors belong together, and a splat has the labels of what it lies on."""

import math
from dataclasses import replace

import numpy as np
import pytest
from furniture import write_library

from gsencoder.data.furnished.kinds import STRUCTURE
from gsencoder.data.furnished.library import Model, load_libraries
from gsencoder.data.furnished.plan import Home, plan_home
from gsencoder.data.furnished.surfaces import Surfaces
from gsencoder.data.furnished.walk import WalkConfig, furnished_scene, furnished_splat, objects_of

SMALL = WalkConfig(views=6, width=64, noise=0.0, drift=0.0)


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> tuple[Model, ...]:
    return load_libraries([write_library(tmp_path_factory.mktemp("library") / "test.sh3f")])


@pytest.fixture(scope="module")
def home(models: tuple[Model, ...]) -> Home:
    return plan_home(models, np.random.default_rng(1), ["living room"])


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def test_each_pixel_lies_in_the_box_of_its_object(home: Home) -> None:
    scene = furnished_scene(home, "room", SMALL, rng())
    assert scene.views is not None
    assert scene.views.depths is not None
    assert scene.views.instances is not None
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
    scene = furnished_scene(home, "room", SMALL, rng())
    assert scene.views is not None
    centers = scene.views.cameras.centers
    (_, area, height), surfaces = home.rooms[0], Surfaces(home, rng())
    assert (surfaces.distance(centers) > 0.2).all()
    assert (centers > [area.x0, area.y0, 0]).all()
    assert (centers < [area.x1, area.y1, height]).all()


def test_without_noise_gaussians_lie_on_the_surfaces_that_they_are_named_for(home: Home) -> None:
    voxel = 0.05
    splat = furnished_splat(home, SMALL, voxel, rng())
    surfaces = Surfaces(home, rng())
    assert surfaces.distance(splat.means).max() < voxel
    objects = objects_of(home, surfaces)
    for item in np.unique(splat.items):
        means = splat.means[splat.items == item]
        assert (means > objects[item].aabb_min - voxel).all()
        assert (means < objects[item].aabb_max + voxel).all()
    assert {home.items[item].kind for item in np.unique(splat.items)} >= set(STRUCTURE)


def test_noise_grows_with_the_square_of_depth_and_drift_moves_poses(home: Home) -> None:
    exact = furnished_scene(home, "room", SMALL, rng())
    noisy = furnished_scene(home, "room", replace(SMALL, noise=1.0, drift=0.05), rng())
    assert exact.views is not None
    assert noisy.views is not None
    assert exact.views.depths is not None
    assert noisy.views.depths is not None
    true, measured = np.stack(list(exact.views.depths)), np.stack(list(noisy.views.depths))
    both = (true > 0) & (measured > 0)
    relative = (measured - true)[both] / (0.0014 * true[both] ** 2)
    assert relative.std() == pytest.approx(1, rel=0.1)
    assert 0.005 < ((true > 0) & (measured == 0)).mean() < 0.3
    moved = np.linalg.norm(exact.views.cameras.centers - noisy.views.cameras.centers, axis=1)
    assert moved.max() == pytest.approx(0.05, rel=1e-3)


def test_light_and_materials_are_drawn_for_each_home_and_a_seed_gives_the_same(home: Home) -> None:
    images = []
    for seed in (5, 5, 6):
        scene = furnished_scene(home, "room", SMALL, np.random.default_rng(seed))
        assert scene.views is not None
        assert scene.views.images is not None
        images.append(np.stack(list(scene.views.images)))
    assert (images[0] == images[1]).all()
    assert np.abs(images[0].astype(int) - images[2]).mean() > 5


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
