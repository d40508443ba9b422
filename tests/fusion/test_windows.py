"""Windows over a large picture: their laws, on networks that are written down."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsencoder.teachers.tower import map_in_windows, window_starts

PATCH = 4


def pixels(rows: int, columns: int) -> torch.Tensor:
    values = np.random.default_rng(0).normal(size=(1, 3, rows * PATCH, columns * PATCH))
    return torch.from_numpy(values.astype(np.float32))


def means_of_patches(picture: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(picture, PATCH)[0].permute(1, 2, 0)


def means_of_neighborhoods(picture: torch.Tensor) -> torch.Tensor:
    """Translation-equivariant: each cell is the mean of 3 × 3 patches, zeros beyond the border."""
    cells = torch.nn.functional.avg_pool2d(picture, PATCH)
    return torch.nn.functional.avg_pool2d(cells, 3, stride=1, padding=1)[0].permute(1, 2, 0)


@given(st.integers(1, 60), st.integers(1, 30), st.floats(0, 0.9))
def test_windows_cover_a_side_and_overlap_by_at_least_their_share(count: int, window: int, overlap: float) -> None:
    starts = window_starts(count, window, overlap)
    inside = min(window, count)
    assert starts[0] == 0
    assert starts[-1] + inside == count
    steps = np.diff(starts)
    assert (steps >= 1).all()
    assert (steps <= max(1, int(window * (1 - overlap)))).all()


def test_one_window_is_enough_for_what_fits_into_it() -> None:
    assert window_starts(7, 7, 0.5) == window_starts(3, 7, 0.0) == [0]
    assert window_starts(8, 4, 0.5) == [0, 2, 4]


@pytest.mark.parametrize(("rows", "columns"), [(4, 4), (3, 4), (2, 1)])
def test_a_picture_of_one_window_has_the_map_of_a_single_pass(rows: int, columns: int) -> None:
    picture = pixels(rows, columns)
    windows = map_in_windows(means_of_neighborhoods, picture, PATCH, 4 * PATCH, 0.5)
    assert torch.equal(windows, means_of_neighborhoods(picture))


@pytest.mark.parametrize("overlap", [0.0, 0.25, 0.5, 0.9])
@pytest.mark.parametrize(("rows", "columns"), [(4, 9), (3, 11), (10, 7)])
def test_a_network_of_patches_does_not_see_the_windows(rows: int, columns: int, overlap: float) -> None:
    picture = pixels(rows, columns)
    windows = map_in_windows(means_of_patches, picture, PATCH, 4 * PATCH, overlap)
    torch.testing.assert_close(windows, means_of_patches(picture))


def test_a_translation_equivariant_network_gives_the_same_inside_of_a_window() -> None:
    picture = pixels(8, 8)
    windows = map_in_windows(means_of_neighborhoods, picture, PATCH, 6 * PATCH, 0.5)
    whole = means_of_neighborhoods(picture)
    # Windows begin at 0 and 2; cells 1 … 4 of each see all of their neighbors.
    same = (windows - whole).abs().amax(dim=-1) < 1e-6
    assert same[3:5, 3:5].all()
    assert not same[2, 2]  # a border of the second window


def test_where_windows_overlap_their_mean_counts() -> None:
    calls: list[float] = []

    def number_of_call(picture: torch.Tensor) -> torch.Tensor:
        calls.append(float(len(calls)))
        return torch.full((picture.shape[2] // PATCH, picture.shape[3] // PATCH, 1), calls[-1])

    made = map_in_windows(number_of_call, pixels(2, 4), PATCH, 2 * PATCH, 0.5)
    np.testing.assert_allclose(made[..., 0], [[0, 0.5, 1.5, 2], [0, 0.5, 1.5, 2]])
