"""Metrics of grounding: Otsu's threshold against its definition, and scores against values worked out by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.grounding import GroundedPair, ground, grounding_scores, otsu_threshold


def best_variance(values: np.ndarray) -> tuple[float, list[float]]:
    """The largest variance between two classes of binned values over all splits, by two loops, and that of each split
    after a bin."""
    counts, edges = np.histogram(values.astype(np.float64), bins=256)
    binned = np.repeat((edges[:-1] + edges[1:]) / 2, counts)
    variances = []
    for split in (edges[:-1] + edges[1:])[:-1] / 2:
        below, above = binned[binned <= split], binned[binned > split]
        variances.append(len(below) * len(above) * (below.mean() - above.mean()) ** 2)
    return max(variances), variances


@pytest.mark.parametrize("seed", range(3))
def test_the_threshold_is_the_split_of_largest_variance_between_the_classes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts = [rng.normal(size=rng.integers(1, 300)), rng.normal(4, 0.3, size=rng.integers(1, 300))]
    values = np.concatenate(parts).astype(np.float32)
    largest, variances = best_variance(values)
    threshold = otsu_threshold(values)
    edges = np.histogram_bin_edges(values.astype(np.float64), bins=256)
    split = int(np.searchsorted(edges, threshold)) - 1
    assert threshold == (edges[split] + edges[split + 1]) / 2
    assert variances[split] == pytest.approx(largest, rel=1e-12)


@given(arrays(np.float32, st.integers(1, 40), elements=st.floats(-1, 1, width=32)))
def test_the_threshold_lies_within_the_values_and_parts_them_unless_all_are_equal(values: np.ndarray) -> None:
    threshold = otsu_threshold(values)
    assert values.min() <= threshold <= values.max()
    assert (values > threshold).any() == (values.min() < values.max())
    assert (values <= threshold).any()


def test_values_that_differ_by_rounding_are_parted_too() -> None:
    low = np.float32(0.7)
    values = np.array([low, np.nextafter(low, np.float32(1))], np.float32)
    assert (values > otsu_threshold(values)).tolist() == [False, True]


@pytest.mark.parametrize("value", [0.0, -3.5, 1e30])
def test_above_the_threshold_of_one_value_there_is_nothing(value: float) -> None:
    for shape in ((1, 1), (3, 4)):
        assert otsu_threshold(np.full(shape, value, np.float32)) == np.float32(value)
        pair = ground(np.full(shape, value, np.float32), np.ones(shape, bool), view="v", phrase="mug")
        assert (pair.intersection, pair.finite) == (0, True)


@pytest.mark.parametrize("bad", [[], [0.0, np.nan], [np.inf, 1.0]])
def test_a_threshold_needs_finite_values(bad: list[float]) -> None:
    with pytest.raises(InputError, match="expected finite values"):
        otsu_threshold(np.array(bad, np.float32))


def test_a_map_that_is_its_mask_is_found_whole() -> None:
    truth = np.zeros((4, 5), bool)
    truth[1:3, 2:4] = True
    pair = ground(np.where(truth, 0.3, 0.1).astype(np.float32), truth, view="v", phrase="mug")
    assert (pair.intersection, pair.union, pair.iou) == (4, 4, 1.0)
    other = ground(np.where(truth, 0.1, 0.3).astype(np.float32), truth, view="v", phrase="mug")
    assert (other.intersection, other.union) == (0, 20)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_map_that_is_not_finite_finds_nothing_and_is_counted(bad: float) -> None:
    truth = np.array([[True, False]])
    good = ground(np.array([[1.0, 0.0]], np.float32), truth, view="v", phrase="a")
    broken = ground(np.array([[1.0, bad]], np.float32), truth, view="v", phrase="b")
    assert (broken.iou, broken.finite) == (0.0, False)
    scores = grounding_scores([good, broken])
    assert scores == {"pairs": 2, "not_finite": 1, "miou": 0.5, "ciou": 0.5, "p50": 0.5, "p60": 0.5}


def pair(intersection: int, union: int) -> GroundedPair:
    return GroundedPair(view="v", phrase="p", intersection=intersection, union=union)


def test_scores_are_those_worked_out_by_hand() -> None:
    scores = grounding_scores([pair(1, 2), pair(6, 10), pair(0, 100), pair(59, 100)])
    assert scores["miou"] == pytest.approx((0.5 + 0.6 + 0 + 0.59) / 4)
    assert scores["ciou"] == pytest.approx(66 / 212)
    # An IoU that is the threshold counts.
    assert scores["p50"] == 0.75
    assert scores["p60"] == 0.25
    nothing = grounding_scores([])
    assert nothing["pairs"] == 0
    assert all(math.isnan(nothing[name]) for name in ("miou", "ciou", "p50", "p60"))


def test_masks_without_pixels_and_of_other_sizes_are_refused() -> None:
    relevancy = np.zeros((2, 3), np.float32)
    for truth in (np.zeros((2, 3), bool), np.ones((3, 2), bool)):
        with pytest.raises(InputError, match="'mug' in view 'frame 7'"):
            ground(relevancy, truth, view="frame 7", phrase="mug")
