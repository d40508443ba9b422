"""The matrix of a view and the sums over views, against what they are defined by."""

import numpy as np
import pytest
import torch
from splats import front_camera, random_gaussians

from gsencoder.fusion.lift import Clock, Sums, center_matrix, view_matrix
from gsencoder.fusion.visibility import VisibilityConfig, keep_visible
from gsencoder.render import BlendConfig, blend
from gsencoder.render.rgb import depth_image
from gsencoder.types import FeatureMap, FeatureSpace, Views

WIDTH, HEIGHT, STRIDE = 32, 24, 4
CAMERA = front_camera(WIDTH, HEIGHT, 30.0)
VIEWS = Views(cameras=CAMERA, names=("v",))
NO_TEST = VisibilityConfig(against=())


def map_of(features: np.ndarray, ax: float = 1 / STRIDE, bx: float = 0.0) -> FeatureMap:
    space = FeatureSpace(name="s", channels=features.shape[-1])
    return FeatureMap(features=features, grid_from_image=np.array([[ax, 0, bx], [0, 1 / STRIDE, 0]]), space=space)


@pytest.mark.parametrize("channels", [1, 3])
def test_cells_without_a_vector_give_neither_features_nor_weight(rng: np.random.Generator, channels: int) -> None:
    cells = rng.normal(size=(HEIGHT // STRIDE, WIDTH // STRIDE, channels)).astype(np.float32)
    cells[1:4, 2:5] = np.nan
    b = blend(random_gaussians(100), CAMERA, like=map_of(cells))
    mask = rng.random((HEIGHT, WIDTH)) < 0.8
    # Every pixel has equally many of a cell's rays.
    share = mask.reshape(HEIGHT // STRIDE, STRIDE, WIDTH // STRIDE, STRIDE).mean(axis=(1, 3)).ravel()
    sums = Sums(100, channels, None, None)
    sums.add(b, map_of(cells), mask)
    dense = b.render(torch.eye(100)).numpy().astype(np.float64)
    vectors = cells.reshape(-1, channels)
    share = np.where(np.isnan(vectors[:, 0]), 0, share)
    np.testing.assert_allclose(sums.weights, dense.T @ share, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(sums.sums, dense.T @ (share[:, None] * np.nan_to_num(vectors)), rtol=1e-3, atol=1e-4)


def test_rendered_depth_is_that_of_pixels_whatever_cells_are_lifted() -> None:
    gaussians, config = random_gaussians(200, log_scale=-1.5), BlendConfig(rays_per_patch=1)
    feature_map = map_of(np.zeros((HEIGHT // STRIDE, WIDTH // STRIDE, 2), np.float32))
    visibility = VisibilityConfig(against=("rendered",), relative=0.1)
    b = view_matrix(gaussians, VIEWS, 0, feature_map, Clock(), lift="blend", visibility=visibility, config=config)
    plain = blend(gaussians, CAMERA, like=feature_map, config=config)
    assert plain.lattice.side == 1
    expected = keep_visible(plain, depth_image(blend(gaussians, CAMERA, config=config)), visibility)
    assert 0 < len(expected.col) < len(plain.col)
    assert torch.equal(b.crow, expected.crow)
    assert torch.equal(b.col, expected.col)


def test_a_centre_is_lifted_from_the_cell_that_it_projects_into() -> None:
    """The map is a crop: the image begins a cell and a half to the left of it, and goes on for a cell below."""
    gaussians = random_gaussians(300, center=(0.3, -0.2, 2.0))
    feature_map = map_of(np.zeros((5, 7, 2), np.float32), bx=-1.5)
    b = center_matrix(gaussians, VIEWS, 0, feature_map, [], NO_TEST, BlendConfig())
    K, near = CAMERA.Ks[0].astype(np.float64), BlendConfig().near
    expected = set()
    for row, point in enumerate(gaussians.means.astype(np.float64)):
        if point[2] <= near:
            continue
        x, y, _ = K @ point / point[2]
        column, line = int(np.floor(x / STRIDE - 1.5)), int(np.floor(y / STRIDE))
        if 0 <= x < WIDTH and 0 <= y < HEIGHT and 0 <= column < 7 and 0 <= line < 5:
            expected.add((line * 7 + column, row))
    cells = np.repeat(np.arange(b.rows), b.crow.diff().numpy())
    assert set(zip(cells.tolist(), b.col.tolist(), strict=True)) == expected
    assert {cell % 7 for cell, _ in expected} == set(range(7))
    assert {cell // 7 for cell, _ in expected} == set(range(5))
    assert (b.weight == 1).all()


def test_a_clock_adds_up_the_seconds_of_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter([10.0, 11.0, 20.0, 22.5, 30.0, 34.0])
    monkeypatch.setattr("gsencoder.fusion.lift.time.perf_counter", lambda: next(times))
    clock = Clock()
    for step in ("blend", "lift", "blend"):
        with clock(step):
            pass
    assert clock.seconds == {"blend": 5.0, "lift": 2.5}
