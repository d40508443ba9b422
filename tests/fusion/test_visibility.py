"""Occlusion tests and masks against loops over the rays of each row."""

import numpy as np
import pytest
from splats import front_camera, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.fusion.lift import VisibilityConfig, keep_visible, row_mask
from gsencoder.render import Blend, BlendConfig, blend

WIDTH, HEIGHT, PATCH, SIDE = 30, 22, 8, 2
"""Patches reach over the right and lower border of the image; their rays there meet its last pixels."""


def patches(n: int = 200) -> Blend:
    config = BlendConfig(rays_per_patch=SIDE**2)
    return blend(random_gaussians(n), front_camera(WIDTH, HEIGHT, 25.0), patch=PATCH, config=config)


def pixels_of(row: int) -> list[tuple[int, int]]:
    """Line and column of the pixel that each ray of a row meets."""
    line, column = divmod(row, -(-WIDTH // PATCH))
    step = PATCH / SIDE
    centers = [(line * PATCH + (i + 0.5) * step, column * PATCH + (j + 0.5) * step) for i in range(2) for j in range(2)]
    return [(min(int(y), HEIGHT - 1), min(int(x), WIDTH - 1)) for y, x in centers]


def entries(b: Blend) -> set[tuple[int, int]]:
    rows = np.repeat(np.arange(b.rows), b.crow.diff().numpy())
    return set(zip(rows.tolist(), b.col.tolist(), strict=True))


@pytest.mark.parametrize(("relative", "absolute"), [(0.1, 0.0), (0.0, 0.3), (0.1, 0.2), (1.0, 0.0), (0.0, 9.0)])
def test_an_entry_stays_if_its_depth_is_among_those_that_its_rows_rays_meet(
    rng: np.random.Generator, relative: float, absolute: float
) -> None:
    b = patches()
    depth = rng.uniform(2, 4, (HEIGHT, WIDTH)).astype(np.float32)
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
    b, mask = patches(1), rng.random((HEIGHT, WIDTH)) < 0.5
    expected = [np.mean([mask[pixel] for pixel in pixels_of(row)]) for row in range(b.rows)]
    np.testing.assert_array_equal(row_mask(mask, b.lattice), np.array(expected, np.float32))


@pytest.mark.parametrize("name", ["relative", "absolute"])
def test_a_tolerance_is_neither_negative_nor_without_end(name: str) -> None:
    for value in (0.0, 1e12):
        assert getattr(VisibilityConfig(against=(), **{name: value}), name) == value
    for wrong in (-1e-9, 1.01e12, float("nan")):
        with pytest.raises(InputError, match=f"{name}: expected"):
            VisibilityConfig(**{name: wrong})


def test_a_test_needs_a_tolerance_and_no_test_needs_none() -> None:
    nothing = {"relative": 0.0, "absolute": 0.0}
    assert VisibilityConfig(against=(), **nothing).against == ()
    with pytest.raises(InputError, match="needs relative or absolute"):
        VisibilityConfig(against=("rendered",), **nothing)
