"""Curves against their definitions: every cell once, neighbors in the order are neighbors in space, levels nest."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsencoder.core.errors import InputError
from gsencoder.models.grid import ALIGN, MAX_EXTENT, Order, curve_from_morton, morton_codes
from gsencoder.models.plan import grid_coords

ORDERS = ("z", "z-trans", "hilbert", "hilbert-trans")


def cube(bits: int) -> torch.Tensor:
    """All cells of a cube, in no particular order of any curve."""
    return torch.tensor(list(itertools.product(range(2**bits), repeat=3)))


def curve_codes(cells: Any, order: Order, bits: int) -> Any:
    return curve_from_morton(morton_codes(cells), order, bits)


def interleaved(x: int, y: int, z: int) -> int:
    """A Morton code, bit by bit."""
    return sum(((x >> i & 1) << 3 * i + 2) | ((y >> i & 1) << 3 * i + 1) | ((z >> i & 1) << 3 * i) for i in range(21))


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_a_curve_visits_every_cell_of_a_cube_once(order: str, bits: int) -> None:
    codes = curve_codes(cube(bits), order, bits)
    assert sorted(codes.tolist()) == list(range(8**bits))


@pytest.mark.parametrize("order", ["hilbert", "hilbert-trans"])
@pytest.mark.parametrize("bits", [1, 2, 3, 4, 5])
def test_hilbert_steps_to_a_face_neighbor_always(order: str, bits: int) -> None:
    cells = cube(bits)
    path = cells[torch.argsort(curve_codes(cells, order, bits))]
    assert (path.diff(dim=0).abs().sum(dim=1) == 1).all()


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("bits", [2, 3, 4])
def test_cutting_three_bits_off_a_code_gives_the_code_of_the_larger_cell_up_to_the_curve(order: str, bits: int) -> None:
    codes = curve_codes(cube(bits), order, bits) >> 3
    parents = morton_codes(cube(bits) >> 1)
    # One code for all eight children, and different codes for different parents.
    pairs = set(zip(codes.tolist(), parents.tolist(), strict=True))
    assert len(pairs) == 8 ** (bits - 1)


def test_transposed_orders_are_the_orders_of_swapped_cells() -> None:
    cells = torch.randint(0, 2**20, (500, 3))
    swapped = cells[:, [1, 0, 2]]
    assert torch.equal(curve_codes(cells, "z-trans", 20), curve_codes(swapped, "z", 20))
    assert torch.equal(curve_codes(cells, "hilbert-trans", 20), curve_codes(swapped, "hilbert", 20))


@given(st.lists(st.tuples(*[st.integers(0, 2**21 - 1)] * 3), min_size=1, max_size=20))
def test_morton_codes_interleave_bits(cells: list[tuple[int, int, int]]) -> None:
    assert morton_codes(torch.tensor(cells)).tolist() == [interleaved(*cell) for cell in cells]


@pytest.mark.parametrize("bits", range(2, 22))
def test_hilbert_codes_do_not_depend_on_how_many_bits_are_looked_at(bits: int) -> None:
    """The corner of a large scene is ordered as a small scene of its own."""
    assert torch.equal(curve_codes(cube(2), "hilbert", bits), curve_codes(cube(2), "hilbert", 2))


def test_a_part_counted_from_the_corner_of_the_whole_has_the_codes_of_the_whole() -> None:
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 20 - 7
    part = points[points[:, 0] > 5]
    corner = points.amin(dim=0)
    whole, alone = grid_coords(points, 0.02), grid_coords(part, 0.02, corner)
    assert torch.equal(alone, whole[points[:, 0] > 5])
    assert not torch.equal(grid_coords(part, 0.02), alone)
    # A corner that lies within the part, by rounding, is no reason for cells below zero.
    assert (grid_coords(part, 0.02, part.amax(dim=0)) >= 0).all()


def test_cells_are_anchored_so_that_a_part_falls_into_the_cells_of_the_whole() -> None:
    points = torch.from_numpy(np.random.default_rng(0).uniform(-5, 5, (1000, 3)).astype(np.float32))
    whole, part = grid_coords(points, 0.02), grid_coords(points[:100], 0.02)
    shift = whole[:100] - part
    assert (shift == shift[0]).all()
    assert (shift[0] % ALIGN == 0).all()


def test_a_cloud_may_spread_over_almost_a_million_cells_but_no_further() -> None:
    ends = torch.tensor([[0.0, 0, 0], [MAX_EXTENT - 1.5, 0, 0]])
    assert grid_coords(ends, 1.0).max() < MAX_EXTENT + ALIGN
    with pytest.raises(InputError, match="check the unit"):
        grid_coords(torch.tensor([[0.0, 0, 0], [MAX_EXTENT + 0.0, 0, 0]]), 1.0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_positions_that_are_not_finite_are_counted_and_refused(bad: float) -> None:
    with pytest.raises(InputError, match="1 of 2 positions are not finite"):
        grid_coords(torch.tensor([[0.0, 0, 0], [0, bad, 0]]), 1.0)


@pytest.mark.parametrize("order", ORDERS)
def test_arrays_and_tensors_have_the_same_codes(order: str) -> None:
    cells = np.random.default_rng(0).integers(0, MAX_EXTENT, (500, 3))
    codes = curve_codes(cells, order, 20)
    assert isinstance(codes, np.ndarray)
    np.testing.assert_array_equal(curve_codes(torch.from_numpy(cells), order, 20).numpy(), codes)
