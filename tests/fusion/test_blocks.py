"""Blocks of space, against a search of all Gaussians one by one."""

from dataclasses import replace

import numpy as np
import pytest
from splats import front_camera, random_gaussians

from gsencoder.fusion.view_coverage import BLOCKS, TILE, Blocks, near_rays
from gsencoder.geometry import ALPHA_MIN
from gsencoder.render.rays import pixel_lattice

WIDTH, HEIGHT = 64, 48
SHAPE = (WIDTH // TILE, HEIGHT // TILE)


@pytest.mark.parametrize("ahead", [-1.0, 0.0, 0.7, 4.0])
@pytest.mark.parametrize("count", [40, 3000])
def test_blocks_give_the_rows_that_a_search_of_all_gives(count: int, ahead: float, rng: np.random.Generator) -> None:
    """From within the Gaussians and from outside, some of which lie far off; of a square alone, and of many."""
    splat = random_gaussians(count, center=(0, 0, ahead), log_scale=-3.0)
    cameras, lattice, near = front_camera(WIDTH, HEIGHT, 50.0), pixel_lattice(WIDTH, HEIGHT), 0.05
    cameras.cam_from_world[0, :3, 3] = (-5, 3, -2)
    means = splat.means * (rng.pareto(2.0, (count, 1)) + 0.3) + (5, -3, 2)
    splat = replace(splat, means=means.astype(np.float32))
    reaches = np.sqrt(2 * np.log(splat.opacities.max() / ALPHA_MIN)) * splat.scales.max(axis=1)
    pose, K = (each[0].astype(np.float64) for each in (cameras.cam_from_world, cameras.Ks))
    rays = (lattice.x0, lattice.y0, lattice.dx, lattice.dy)
    blocks, squares, seen = Blocks(splat), SHAPE[0] * SHAPE[1], 0
    for lit in [1] * 60 + [squares // 4, squares]:
        ends = np.full(squares, -np.inf, np.float32)
        ends[rng.choice(squares, lit, replace=False)] = rng.uniform(0, 4, lit)
        out = np.empty(count, np.int64)
        number = near_rays(splat.means, reaches, 0.0, np.array([[0, count]]), pose, K, near, rays, ends, SHAPE, out)
        np.testing.assert_array_equal(blocks.near(cameras, 0, lattice, ends, SHAPE, near), out[:number])
        seen += number
    assert 0 < seen < 62 * count


def test_those_around_a_gaussian_are_the_nearest_of_its_block() -> None:
    """Along a line, which is cut into its blocks alone; the row itself is the first."""
    splat = random_gaussians(2400)
    line = np.random.default_rng(1).permutation(np.linspace(0, 1, 2400))
    blocks = Blocks(replace(splat, means=np.column_stack((line, 0 * line, 0 * line)).astype(np.float32)))
    whole = [blocks.around(row, 2400) for row in range(0, 2400, 7)]
    for row, rows in zip(range(0, 2400, 7), whole, strict=True):
        distances = np.abs(line[rows] - line[row])
        assert rows[0] == row
        assert (np.diff(distances) > -1e-6).all()
        np.testing.assert_array_equal(blocks.around(row, 5), rows[:5])
    members = {tuple(sorted(rows.tolist())) for rows in whole}
    assert len(members) == BLOCKS
    assert sorted(row for block in members for row in block) == list(range(2400))
