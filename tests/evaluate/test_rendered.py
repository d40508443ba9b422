"""Errors of rendered features: beside sums over all cells in float64, and what pictures that are not finite do."""

import math

import numpy as np
import pytest
from sklearn.metrics.pairwise import paired_cosine_distances

from gsencoder.evaluate.sources import RenderedErrors, RenderedTally

CHANNELS = 6
MEAN = (3 * np.random.default_rng(9).normal(size=CHANNELS)).astype(np.float32)


def pictures(*sizes: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Predicted and true features of pictures with so many cells; each picture is worse than the one before."""
    rng = np.random.default_rng(0)
    made = []
    for number, size in enumerate(sizes):
        target = rng.normal(size=(size, CHANNELS)) + MEAN
        predicted = target + 0.3 * (number + 1) * rng.normal(size=(size, CHANNELS))
        made.append((predicted.astype(np.float32), target.astype(np.float32)))
    return made


def errors_of(renders: list[tuple[np.ndarray, np.ndarray]], mean: np.ndarray = MEAN) -> RenderedErrors:
    tally = RenderedTally(mean)
    for predicted, target in renders:
        tally.add(predicted, target)
    return tally.errors()


def test_errors_are_means_over_the_cells_of_all_pictures_however_large_each_is() -> None:
    renders = pictures(50, 7, 1)
    errors = errors_of(renders)
    predicted, target = (np.concatenate(each).astype(np.float64) for each in zip(*renders, strict=True))
    assert errors.cosine == pytest.approx(1 - paired_cosine_distances(predicted, target).mean(), abs=1e-6)
    centered = paired_cosine_distances(predicted - MEAN, target - MEAN)
    assert errors.centered == pytest.approx(1 - centered.mean(), abs=1e-6)
    assert errors.l2 == pytest.approx(np.square(predicted - target).mean(), rel=1e-6)
    assert (errors.cells, errors.pictures, errors.not_finite) == (58, 3, 0)
    assert errors.centered < errors.cosine - 0.01


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_picture_with_a_feature_that_is_not_finite_is_counted_and_changes_no_mean(side: int, bad: float) -> None:
    good, broken = pictures(20, 30)
    broken[side][4, 2] = bad
    alone, errors = errors_of([good]), errors_of([good, broken])
    assert (errors.cells, errors.pictures, errors.not_finite) == (20, 1, 1)
    assert (errors.cosine, errors.centered, errors.l2) == (alone.cosine, alone.centered, alone.l2)


def test_without_cells_there_are_no_means_and_a_picture_without_cells_changes_none() -> None:
    nothing = np.zeros((0, CHANNELS), np.float32)
    for renders in ([], [(nothing, nothing)]):
        errors = errors_of(renders)
        assert all(math.isnan(value) for value in (errors.cosine, errors.centered, errors.l2))
        assert (errors.cells, errors.pictures) == (0, len(renders))
    with_empty, without = errors_of([*pictures(9), (nothing, nothing)]), errors_of(pictures(9))
    assert (with_empty.cosine, with_empty.l2, with_empty.cells) == (without.cosine, without.l2, 9)


def test_features_that_are_the_same_have_no_error_and_those_without_a_direction_no_cosine() -> None:
    _, target = pictures(12)[0]
    errors = errors_of([(target, target)])
    assert (errors.cosine, errors.centered, errors.l2) == (pytest.approx(1), pytest.approx(1), 0)
    at_mean = np.repeat(MEAN[None], 12, axis=0)
    errors = errors_of([(at_mean, target)])
    assert errors.centered == 0
    assert errors_of([(np.zeros_like(target), target)]).cosine == 0
