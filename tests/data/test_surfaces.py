"""Oriented pieces of surfaces: from Gaussians, from planes through their means, and from depth."""

import numpy as np
import pytest
from scene_files import some_gaussians
from scipy.spatial.transform import Rotation

from gsencoder.data.enclosure import planes_of_gaussians, surfaces_of_depth, surfaces_of_gaussians
from gsencoder.types import Cameras, Gaussians, Views


def test_surfaces_of_gaussians_are_their_thin_axes_and_areas_count_opacity():
    rotations = Rotation.random(3, random_state=0)
    scales = np.array([[0.01, 0.2, 0.3], [0.2, 0.01, 0.5], [0.2, 0.3, 0.11]], np.float32)
    some = Gaussians(
        means=np.arange(9, dtype=np.float32).reshape(3, 3),
        quats=rotations.as_quat(scalar_first=True).astype(np.float32),
        scales=scales,
        opacities=np.array([0.5, 1.0, 1.0], np.float32),
        sh=np.zeros((3, 1, 3), np.float32),
    )
    surfaces = surfaces_of_gaussians(some)
    order = np.argsort(surfaces.means[:, 0])
    # The third is thicker than half of its middle axis.
    np.testing.assert_allclose(surfaces.means[order], some.means[:2])
    axes = rotations.as_matrix()
    for row, axis in ((0, axes[0][:, 0]), (1, axes[1][:, 1])):
        assert abs(surfaces.normals[order][row] @ axis) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(surfaces.areas[order], (0.2 * 0.3 * 0.5, 0.2 * 0.5), rtol=1e-6)


def test_areas_of_depth_samples_are_those_of_the_surfaces():
    """Of a plane across the view, seen by all pixels, z² / (fx fy) each; of a slanted one more by its cosine."""
    width, height, focal = 64, 48, 60.0
    cameras = Cameras(
        cam_from_world=np.eye(4, dtype=np.float32)[None],
        Ks=np.array([[[focal, 0, 32], [0, focal, 24], [0, 0, 1]]], np.float32),
        widths=np.array([width], np.int32),
        heights=np.array([height], np.int32),
    )
    columns = np.tile((np.arange(width) + 0.5 - 32) / focal, (height, 1))
    for slope in (0.0, 1.0):
        depth = (2 / (1 - slope * columns)).astype(np.float32)
        views = Views(cameras=cameras, names=("a",), depths=[depth])
        surfaces = surfaces_of_depth(views)
        normal = np.array([slope, 0, -1]) / np.hypot(1, slope)
        np.testing.assert_allclose(np.abs(surfaces.normals @ normal), 1, atol=1e-3)
        z = surfaces.means[:, 2]
        rays = surfaces.means / z[:, None]
        exact = z**2 / focal**2 / np.abs(rays @ normal) * np.linalg.norm(rays, axis=1)
        np.testing.assert_allclose(surfaces.areas, exact, rtol=0.01)
        np.testing.assert_allclose(z, 2 + slope * surfaces.means[:, 0], rtol=2e-3)


def cloud(means: np.ndarray, opacity: float = 1.0) -> Gaussians:
    return some_gaussians(means, np.full(len(means), opacity))


def test_planes_through_means_are_those_that_the_means_lie_on():
    made = np.random.default_rng(0)
    rotation = Rotation.random(random_state=1).as_matrix()
    flat = np.concatenate((made.uniform(0, 1, (2000, 2)), made.normal(0, 1e-3, (2000, 1))), axis=1)
    surfaces = planes_of_gaussians(cloud(flat @ rotation.T))
    assert len(surfaces.normals) == 2000
    assert surfaces.rest == 0
    assert np.abs(surfaces.normals @ rotation[:, 2]).min() > 0.99
    ball = made.normal(size=(2000, 3))
    surfaces = planes_of_gaussians(cloud(ball))
    assert surfaces.rest > 10 * surfaces.areas.sum()


def test_areas_of_planes_grow_with_the_square_of_the_spacing_and_lone_means_do_not_outvote():
    made = np.random.default_rng(0)
    dense = np.concatenate((made.uniform(0, 1, (3000, 2)), np.zeros((3000, 1))), axis=1)
    once, wide = planes_of_gaussians(cloud(dense)), planes_of_gaussians(cloud(3 * dense))
    assert wide.areas.sum() == pytest.approx(9 * once.areas.sum(), rel=1e-4)
    lone = planes_of_gaussians(cloud(np.concatenate((dense, [[1e4, 0, 0], [0, 1e4, 0]]))))
    assert lone.areas.max() < 3 * once.areas.max()


def test_faint_few_and_coincident_gaussians_have_no_planes():
    made = np.random.default_rng(0)
    flat = np.concatenate((made.uniform(0, 1, (100, 2)), np.zeros((100, 1))), axis=1)
    for gaussians in (cloud(flat, 0.2), cloud(flat[:31]), cloud(np.zeros((100, 3)))):
        surfaces = planes_of_gaussians(gaussians)
        assert len(surfaces.areas) == len(surfaces.normals) == len(surfaces.means) == 0
    assert len(planes_of_gaussians(cloud(flat[:32])).areas) == 32
