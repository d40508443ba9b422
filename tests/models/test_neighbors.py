"""Neighborhoods and the convolution over them, against plain twins."""

import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsencoder.models import transformer
from gsencoder.models.plan import neighbor_table
from gsencoder.models.transformer import NeighborConv, convolve_reference


def distinct_cells(count: int, extent: int, seed: int = 0) -> torch.Tensor:
    torch.manual_seed(seed)
    cells = torch.unique(torch.randint(0, extent, (count, 3)), dim=0)
    return cells[torch.randperm(len(cells))]


def slow_table(cells: torch.Tensor, size: int = 3) -> torch.Tensor:
    """The table by looking every cell up in a dictionary."""
    rows = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    steps = list(itertools.product(range(-(size // 2), size // 2 + 1), repeat=3))
    return torch.tensor(
        [[rows.get((x + dx, y + dy, z + dz), len(cells)) for dx, dy, dz in steps] for x, y, z in cells.tolist()],
        dtype=torch.int32,
    ).view(-1, size**3)


@pytest.mark.parametrize("size", [3, 5])
@given(st.sets(st.tuples(*[st.integers(0, 6)] * 3), min_size=1, max_size=60), st.randoms(), st.integers(0, 2**20))
def test_the_table_is_that_of_looking_each_cell_up(size: int, cells: set, random: object, shift: int) -> None:
    listed = sorted(cells)
    random.shuffle(listed)  # type: ignore[attr-defined]
    tensor = torch.tensor(listed) + shift
    assert torch.equal(neighbor_table(tensor, size), slow_table(tensor, size))


@pytest.mark.parametrize("size", [3, 5])
def test_columns_do_not_run_into_one_another(size: int) -> None:
    """The highest cell of a column and the lowest of the next are far apart in space, and close in the sorted keys."""
    cells = torch.tensor([[0, 0, 9], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 9, 9], [0, 0, 8], [0, 1, 1]])
    assert torch.equal(neighbor_table(cells, size), slow_table(cells, size))


def test_no_cells_have_no_neighbors() -> None:
    assert neighbor_table(torch.zeros(0, 3, dtype=torch.int64)).shape == (0, 27)
    assert neighbor_table(torch.zeros(0, 3, dtype=torch.int64), 5).shape == (0, 125)


@pytest.mark.parametrize("size", [3, 5])
def test_extents_of_a_million_cells_do_not_overflow(size: int) -> None:
    far = 2**20 + 62
    cells = torch.tensor([[0, 0, 0], [far, far, far], [far, far, far - 1], [far, 0, 0]])
    assert torch.equal(neighbor_table(cells, size), slow_table(cells, size))


@pytest.mark.parametrize("size", [3, 5])
def test_on_a_full_grid_the_convolution_is_a_dense_one_with_zeros_around(size: int) -> None:
    cells = torch.cartesian_prod(*[torch.arange(6)] * 3)
    layer = NeighborConv(3, 4, size).double()
    x = torch.randn(6, 6, 6, 3, dtype=torch.float64, requires_grad=True)
    ours = layer(x.reshape(-1, 3), neighbor_table(cells, size)).view(6, 6, 6, 4)
    kernel = layer.weight.view(size, size, size, 3, 4).permute(4, 3, 0, 1, 2)
    dense = torch.nn.functional.conv3d(x.permute(3, 0, 1, 2), kernel, layer.bias, padding=size // 2)
    torch.testing.assert_close(ours, dense.permute(1, 2, 3, 0), rtol=1e-10, atol=1e-10)
    upstream = torch.randn_like(ours)
    mine = torch.autograd.grad(ours, [x, layer.weight], upstream)
    theirs = torch.autograd.grad(dense.permute(1, 2, 3, 0), [x, layer.weight], upstream)
    for gradient, expected in zip(mine, theirs, strict=True):
        torch.testing.assert_close(gradient, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("size", [3, 5])
@pytest.mark.parametrize("count", [1, 5, 300])
@pytest.mark.parametrize("block_rows", [64, 8192])
@pytest.mark.parametrize("many", [1, 4])
def test_the_convolution_is_that_of_its_plain_twin_in_values_and_gradients(size, count, block_rows, many, monkeypatch):
    """Of whole neighborhoods, and cell by cell; the gradient of the latter's input has channels for either."""
    monkeypatch.setattr(transformer, "MANY_CHANNELS", many)
    monkeypatch.setattr(transformer, "CPU_BLOCK_ROWS", block_rows)
    table = neighbor_table(distinct_cells(count, 8), size)  # type: ignore[arg-type]
    layer = NeighborConv(3, 5, size).double()  # type: ignore[arg-type]
    x = torch.randn(len(table), 3, dtype=torch.float64, requires_grad=True)
    ours, plain = layer(x, table), convolve_reference(x, table, layer.weight) + layer.bias
    torch.testing.assert_close(ours, plain, rtol=1e-12, atol=1e-12)
    upstream = torch.randn_like(ours)
    ours_grads = torch.autograd.grad(ours, [x, layer.weight, layer.bias], upstream)
    plain_grads = torch.autograd.grad(plain, [x, layer.weight, layer.bias], upstream)
    for mine, theirs in zip(ours_grads, plain_grads, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-12, atol=1e-12)
