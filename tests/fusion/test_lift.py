"""Lifting a view: masks, codes and shares, occlusion tests, centers."""

import numpy as np
import pytest
import torch
from splats import front_camera, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.fusion import lift
from gsencoder.fusion.lift import (
    FeatureSums,
    VisibilityConfig,
    center_matrix,
    keep_visible,
    limit_rays,
    row_mask,
    view_matrix,
)
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, Views

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
    sums = FeatureSums(100, FeatureSpace(name="s", channels=channels), None, None)
    sums.add(b, map_of(cells), mask)
    dense = b.render(torch.eye(100)).numpy().astype(np.float64)
    vectors = cells.reshape(-1, channels)
    share = np.where(np.isnan(vectors[:, 0]), 0, share)
    np.testing.assert_allclose(sums.weights, dense.T @ share, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(sums.sums, dense.T @ (share[:, None] * np.nan_to_num(vectors)), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("form", ["codes", "shares"])
def test_shares_are_masked_in_part_and_codes_where_most_of_their_cell_is_out(rng, form):
    shape, space = (HEIGHT // STRIDE, WIDTH // STRIDE), FeatureSpace(name="s", channels=2)
    affine, table = np.array([[1 / STRIDE, 0, 0], [0, 1 / STRIDE, 0]]), rng.normal(size=(3, 2)).astype(np.float32)
    mask = np.zeros((*shape, STRIDE * STRIDE), bool)
    # Cells of which nothing, a half, more than that and all is in the mask.
    counts = np.resize([0, 8, 9, 16], shape)
    mask[np.arange(STRIDE * STRIDE) < counts[..., None]] = True
    mask = mask.reshape(*shape, STRIDE, STRIDE).transpose(0, 2, 1, 3).reshape(HEIGHT, WIDTH)
    codes, shares = rng.integers(-1, 3, shape).astype(np.int32), rng.random((*shape, 3)).astype(np.float32)
    values = {"codes": codes} if form == "codes" else {"shares": shares}
    made = FeatureMap(**values, table=table, grid_from_image=affine, space=space)
    b = blend(random_gaussians(100), CAMERA, like=made)
    sums = FeatureSums(100, space, None, table)
    sums.add(b, made, mask)
    sums.add(b, made, None)
    one_hot = (codes[..., None] == np.arange(3)) * np.where(counts > 8, 2.0, 1.0)[..., None]
    rows = one_hot if form == "codes" else shares * (1 + counts / 16)[..., None]
    dense = b.render(torch.eye(100)).numpy().astype(np.float64)
    np.testing.assert_allclose(sums.sums, dense.T @ rows.reshape(-1, 3), rtol=1e-3, atol=1e-5)
    assert not sums.weights.any()


@pytest.mark.parametrize("rank", [None, 2])
@pytest.mark.parametrize("form", ["codes", "shares", "own tables"])
def test_many_codes_are_lifted_as_vectors_with_the_same_result(rng, monkeypatch, form, rank):
    shape, space = (HEIGHT // STRIDE, WIDTH // STRIDE), FeatureSpace(name="s", channels=4)
    table, affine = rng.normal(size=(9, 4)).astype(np.float32), np.array([[1 / STRIDE, 0, 0], [0, 1 / STRIDE, 0]])
    basis = None
    if rank is not None:
        axes = np.linalg.qr(rng.normal(size=(4, rank)))[0].T.astype(np.float32)
        basis = FeatureBasis(mean=table.mean(axis=0), components=axes, energy_kept=0.9, space=space)
    codes = rng.integers(-1, 9, shape).astype(np.int32)
    values = {"shares": rng.random((*shape, 9)).astype(np.float32)} if form == "shares" else {"codes": codes}
    made = FeatureMap(**values, table=table, grid_from_image=affine, space=space)
    b, mask = blend(random_gaussians(100), CAMERA, like=made), rng.random((HEIGHT, WIDTH)) < 0.8

    def lifted() -> tuple[np.ndarray, np.ndarray]:
        sums = FeatureSums(100, space, basis, None if form == "own tables" else table)
        sums.add(b, made, mask)
        sums.add(b, made, None)
        return sums.finish()

    features, weights = lifted()
    # Each table has now more rows than are summed by code.
    monkeypatch.setattr(lift, "MAX_CODES", 0)
    assert FeatureSums(100, space, basis, table).table is None
    for one, other in zip(lifted(), (features, weights), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)
    assert (weights > 0).sum() > 50


def test_sensor_depth_hides_what_lies_behind_it() -> None:
    gaussians, config = random_gaussians(200, log_scale=-1.5), BlendConfig(rays_per_patch=4)
    depth = np.full((HEIGHT, WIDTH), np.median(gaussians.means[:, 2]), np.float32)
    views = Views(cameras=CAMERA, names=("v",), depths=[depth])
    feature_map = map_of(np.zeros((HEIGHT // STRIDE, WIDTH // STRIDE, 2), np.float32))
    visibility = VisibilityConfig(against=("sensor",), relative=0.1)
    b = view_matrix(gaussians, views, 0, feature_map, lift="blend", visibility=visibility, config=config)
    plain = blend(gaussians, CAMERA, like=feature_map, config=config)
    expected = keep_visible(plain, depth, visibility)
    assert 0 < len(expected.col) < len(plain.col)
    assert torch.equal(b.col, expected.col)


def test_rendered_depth_is_that_of_pixels_whatever_cells_are_lifted() -> None:
    gaussians, config = random_gaussians(200, log_scale=-1.5), BlendConfig(rays_per_patch=1)
    feature_map = map_of(np.zeros((HEIGHT // STRIDE, WIDTH // STRIDE, 2), np.float32))
    visibility = VisibilityConfig(against=("rendered",), relative=0.1)
    b = view_matrix(gaussians, VIEWS, 0, feature_map, lift="blend", visibility=visibility, config=config)
    plain = blend(gaussians, CAMERA, like=feature_map, config=config)
    assert plain.lattice.side == 1
    expected = keep_visible(plain, blend(gaussians, CAMERA, config=config).depth_map(), visibility)
    assert 0 < len(expected.col) < len(plain.col)
    assert torch.equal(b.crow, expected.crow)
    assert torch.equal(b.col, expected.col)


def test_a_center_is_lifted_from_the_cell_that_it_projects_into() -> None:
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


@pytest.mark.parametrize(
    ("across", "down", "rays", "most"), [(4, 4, 64, 16), (4, 4, 9, 9), (4, 9, 100, 36), (0.5, 0.5, 16, 1)]
)
def test_a_cell_has_no_more_rays_than_pixels(across: float, down: float, rays: int, most: int) -> None:
    feature_map = FeatureMap(
        features=np.zeros((2, 2, 1), np.float32),
        grid_from_image=np.array([[1 / across, 0, 0], [0, 1 / down, 0]]),
        space=FeatureSpace(name="s", channels=1),
    )
    config = BlendConfig(rays_per_patch=rays, near=0.5)
    assert limit_rays(config, feature_map) == BlendConfig(rays_per_patch=most, near=0.5)


@pytest.mark.parametrize("coded", [False, True])
def test_sums_are_divided_by_their_weights_and_rows_of_hardly_any_weight_are_zero(rng, coded):
    table = rng.normal(size=(3, 2)).astype(np.float32)
    shares = np.array([[1, 2, 3], [0, 0, 0], [0, 1e-39, 0], [0.5, 0, 0.25]], np.float32)
    sums = FeatureSums(4, FeatureSpace(name="s", channels=2), None, table if coded else None)
    if coded:
        sums.sums[:] = shares
    else:
        sums.sums[:], sums.weights[:] = shares @ table, shares.sum(axis=1)
    features, weights = sums.finish()
    np.testing.assert_allclose(weights, [6, 0, 0, 0.75])
    np.testing.assert_allclose(features[[0, 3]], (shares @ table)[[0, 3]] / [[6], [0.75]], rtol=1e-5)
    assert (features[[1, 2]] == 0).all()


ACROSS, DOWN, PATCH, SIDE = 30, 22, 8, 2
"""Patches reach over the right and lower border of the image; their rays there meet its last pixels."""


def patches(n: int = 200) -> Blend:
    config = BlendConfig(rays_per_patch=SIDE**2)
    return blend(random_gaussians(n), front_camera(ACROSS, DOWN, 25.0), patch=PATCH, config=config)


def pixels_of(row: int) -> list[tuple[int, int]]:
    """Line and column of the pixel that each ray of a row meets."""
    line, column = divmod(row, -(-ACROSS // PATCH))
    step = PATCH / SIDE
    centers = [(line * PATCH + (i + 0.5) * step, column * PATCH + (j + 0.5) * step) for i in range(2) for j in range(2)]
    return [(min(int(y), DOWN - 1), min(int(x), ACROSS - 1)) for y, x in centers]


def entries(b: Blend) -> set[tuple[int, int]]:
    rows = np.repeat(np.arange(b.rows), b.crow.diff().numpy())
    return set(zip(rows.tolist(), b.col.tolist(), strict=True))


@pytest.mark.parametrize(("relative", "absolute"), [(0.1, 0.0), (0.0, 0.3), (0.1, 0.2), (1.0, 0.0), (0.0, 9.0)])
def test_an_entry_stays_if_its_depth_is_among_those_that_its_rows_rays_meet(rng, relative, absolute):
    b = patches()
    depth = rng.uniform(2, 4, (DOWN, ACROSS)).astype(np.float32)
    # Rays without depth, and a row of them alone, which lets nothing pass whatever the tolerance.
    depth[rng.random(depth.shape) < 0.3] = 0
    depth[:PATCH, PATCH : 2 * PATCH] = 0
    expected = set()
    for row, gaussian in entries(b):
        measured = [float(depth[pixel]) for pixel in pixels_of(row) if depth[pixel] > 0]
        if not measured:
            continue
        z, near, far = float(b.depths[gaussian]), min(measured), max(measured)
        passes = not relative or near * (1 - relative) <= z <= far * (1 + relative)
        if passes and (not absolute or near - absolute <= z <= far + absolute):
            expected.add((row, gaussian))
    assert 0 < len(expected) < len(entries(b))
    visibility = VisibilityConfig(against=("sensor",), relative=relative, absolute=absolute)
    assert entries(keep_visible(b, depth, visibility)) == expected


def test_a_row_counts_by_the_share_of_its_rays_that_a_mask_lets_through(rng: np.random.Generator) -> None:
    b, mask = patches(1), rng.random((DOWN, ACROSS)) < 0.5
    expected = [np.mean([mask[pixel] for pixel in pixels_of(row)]) for row in range(b.rows)]
    np.testing.assert_array_equal(row_mask(mask, b.lattice), np.array(expected, np.float32))


def test_a_test_needs_a_tolerance_and_no_test_needs_none() -> None:
    nothing = {"relative": 0.0, "absolute": 0.0}
    assert VisibilityConfig(against=(), **nothing).against == ()
    with pytest.raises(InputError, match="needs relative or absolute"):
        VisibilityConfig(against=("rendered",), **nothing)
