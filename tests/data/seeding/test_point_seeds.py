"""Seeds from points: their normals, spacing and colors."""

import numpy as np
import pytest
from seed_views import camera, colors_of, normals_of

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.seeding.seed import seed_from_points
from gsencoder.types import Views


class TestPoints:
    def test_a_sphere_of_points_gets_normals_spacing_and_colors(self, rng):
        points = rng.standard_normal((4000, 3))
        points = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
        colors = np.where(points[:, :1] > 0, [[250, 10, 10]], [[10, 10, 250]]).astype(np.uint8)
        g = seed_from_points(points, colors)
        assert len(g) == 4000
        assert np.quantile(np.abs((normals_of(g) * g.means).sum(1)), 0.02) > 0.97
        spacing = np.sqrt(4 * np.pi / 4000)
        assert 0.5 * spacing < np.median(g.scales[:, 0]) < spacing
        assert np.array_equal(colors_of(g)[:, 0] > 0.5, g.means[:, 0] > 0)

    def test_the_grid_averages_and_a_stray_point_stays_small(self, rng):
        points = np.concatenate([rng.uniform(0, 1, (3000, 3)) * [1, 1, 0], [[0.5, 0.5, 30.0]]]).astype(np.float32)
        g = seed_from_points(points, np.full((3001, 3), 90, np.uint8), voxel=0.05)
        assert 390 < len(g) <= 20 * 20 + 1
        assert g.scales[:, 0].max() < 0.2

    def test_a_point_at_the_lens_stays_small(self, rng):
        sheet = (rng.uniform(-1, 1, (500, 3)) * [1, 1, 0] + [0, 0, 3]).astype(np.float32)
        points = np.concatenate([sheet, [[0, 0, 0.05]]]).astype(np.float32)
        views = Views(cameras=camera(), names=("a",))
        g = seed_from_points(points, np.zeros((501, 3), np.uint8), views=views)
        assert g.scales[np.argmin(g.means[:, 2]), 0] < 0.1 * 0.05

    def test_a_cloud_without_a_sheet_is_thick_and_a_sheet_is_thin(self, rng):
        cloud = rng.standard_normal((2000, 3)).astype(np.float32)
        black = np.zeros((2000, 3), np.uint8)
        thick, thin = (seed_from_points(p, black) for p in (cloud, cloud * np.float32([1, 1, 0.001])))
        assert np.median(thick.scales[:, 2] / thick.scales[:, 0]) > 0.3
        assert np.median(thin.scales[:, 2] / thin.scales[:, 0]) < 0.15

    @pytest.mark.parametrize(
        "points", [[[1, 2, 3]], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0]] * 20, np.eye(3)[:, [0]] * np.ones(3)]
    )
    def test_one_two_equal_and_collinear_points_work(self, points):
        points = np.array(points, np.float32)
        g = seed_from_points(points, np.zeros((len(points), 3), np.uint8))
        assert len(g) == len(np.unique(points, axis=0))

    @pytest.mark.usefixtures("no_jaxtyping")
    def test_bad_points_are_errors(self):
        black = np.zeros((2, 3), np.uint8)
        with pytest.raises(InputError, match="no points"):
            seed_from_points(np.zeros((0, 3), np.float32), None)
        with pytest.raises(InputError, match=r"1 of 2 points are not finite \(first: row 1\)"):
            seed_from_points(np.array([[0, 0, 0], [0, np.nan, 0]], np.float32), black)
        with pytest.raises(InputError, match="expected 3 colors"):
            seed_from_points(np.zeros((3, 3), np.float32), black)
        with pytest.raises(InputError, match="too small"):
            seed_from_points(np.full((2, 3), 1e30, np.float32), black, voxel=1e-6)

    def test_points_without_colors_are_grey_with_a_warning(self):
        with pytest.warns(SceneWarning, match="2 points without colors"):
            g = seed_from_points(np.float32([[0, 0, 0], [1, 0, 0]]), None)
        assert np.abs(colors_of(g) - 0.5).max() < 0.01
