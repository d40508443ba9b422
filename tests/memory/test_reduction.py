"""Reductions of raw features: the published algorithm beside its transcription, and what holds of a cover."""

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.memory import reduction
from gsencoder.memory.reduction import CoverReduction, reduce_as_published, unit_rows


def redundant_rows(rng: np.random.Generator, count: int, channels: int = 16) -> np.ndarray:
    """Rows between pairs of a few directions, most near one of them, of many lengths."""
    centers = rng.normal(size=(12, channels))
    one, other = centers[rng.integers(0, 12, (2, count))]
    share = rng.random((count, 1)) ** 3
    rows = one * (1 - share) + other * share + 0.08 * rng.normal(size=(count, channels))
    return (rows * np.exp(rng.normal(size=(count, 1)))).astype(np.float32)


def cover_of(features: np.ndarray, threshold: float) -> np.ndarray:
    cover = CoverReduction(features.shape[1], threshold)
    cover.add(features)
    return cover.rows


def published(features: np.ndarray, threshold: float) -> np.ndarray:
    return reduce_as_published(unit_rows(features), threshold)[0]


def transcription(
    features: np.ndarray, threshold: float, chunk: int, *, drop_last: bool
) -> tuple[list[int], np.ndarray]:
    """Algorithm 1, line by line; the code that M3's authors published does not drop the last chunk."""
    unit = features / np.linalg.norm(features, axis=1, keepdims=True)
    components, used = [], np.zeros(len(unit), bool)
    for k in range(len(unit) // chunk if drop_last else -(-len(unit) // chunk)):
        similarities = unit[k * chunk : (k + 1) * chunk] @ unit.T
        for j, row in enumerate(similarities, start=k * chunk):
            if not used[j]:
                neighbors = np.flatnonzero(row >= threshold)
                if not used[neighbors].any():
                    components.append(j)
                    used[neighbors] = True
    return components, used


@pytest.mark.parametrize("drop_last", [False, True])
@pytest.mark.parametrize("threshold", [0.5, 0.9, 0.98])
def test_the_published_algorithm_gives_what_its_transcription_gives(rng, monkeypatch, threshold, drop_last):
    # Few witnesses and small products, so that rows are settled in all three ways.
    monkeypatch.setattr(reduction, "WITNESSES", 20)
    monkeypatch.setattr(reduction, "BLOCK", 100)
    monkeypatch.setattr(reduction, "PRODUCT_VALUES", 30_000)
    features = redundant_rows(rng, 1070)
    components, used = transcription(features, threshold, 100, drop_last=drop_last)
    rows, in_use = reduce_as_published(unit_rows(features), threshold, drop_last=100 if drop_last else 0)
    assert 5 <= len(components) < 1000
    assert rows.tolist() == components
    np.testing.assert_array_equal(in_use, used)


@pytest.mark.parametrize("threshold", [0.3, 0.9, 0.99])
def test_every_feature_is_within_the_threshold_of_a_component_of_a_cover(rng, threshold):
    features = redundant_rows(rng, 3000)
    rows = cover_of(features, threshold)
    unit = features.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    cosines = unit @ unit[rows].T
    assert cosines.max(axis=1).min() >= threshold
    assert 1 < len(rows) < 3000
    # No component stands for another one.
    among = np.triu(cosines[rows], k=1)
    assert among.max() < threshold + 2 * reduction.ROUNDING


def test_a_feature_whose_cosine_only_rounds_to_the_threshold_has_a_component_of_its_own(rng):
    """So that a cover holds in exact arithmetic."""
    leader = rng.normal(size=96)
    leader /= np.linalg.norm(leader)
    across = rng.normal(size=(150, 96))
    across -= (across @ leader)[:, None] * leader
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    cosine = 0.5 + rng.uniform(-1e-7, 1e-7, (150, 1))
    features = np.concatenate([leader[None], cosine * leader + np.sqrt(1 - cosine**2) * across]).astype(np.float32)
    unit = features.astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    assert ((unit @ unit[0])[1:] < 0.5).sum() > 30
    assert (unit @ unit[cover_of(features, 0.5)].T).max(axis=1).min() >= 0.5


def test_a_cover_is_the_same_however_features_are_divided(rng: np.random.Generator) -> None:
    features, whole = redundant_rows(rng, 3000), CoverReduction(16, 0.8)
    whole.add(features)
    parts = CoverReduction(16, 0.8)
    for part in np.split(features, [1, 500, 501, 2600]):
        parts.add(part)
    assert parts.rows.tolist() == whole.rows.tolist()
    np.testing.assert_array_equal(whole.components, features[whole.rows])
    np.testing.assert_array_equal(whole.unit, unit_rows(features)[whole.rows])


@pytest.mark.parametrize("reduce", [published, cover_of])
def test_equal_directions_are_one_component_and_others_each_at_a_threshold_of_one(rng, reduce):
    """Though the product of a row with itself may round to less than 1."""
    direction = np.linspace(-1, 2, 384, dtype=np.float32)
    features = np.stack([direction * length for length in (1e-30, 1, 3e37, 7, 1e-3)]).astype(np.float32)
    for threshold in (0.5, 1.0):
        assert reduce(features, threshold).tolist() == [0]
        assert reduce(features[:1], threshold).tolist() == [0]
    assert reduce(rng.normal(size=(300, 17)).astype(np.float32), 1.0).tolist() == list(range(300))


def test_what_has_no_direction_is_refused() -> None:
    for value, what in ((0.0, "zero"), (np.nan, "not finite"), (np.inf, "not finite")):
        broken = np.ones((4, 3), np.float32)
        broken[2] = value
        with pytest.raises(InputError, match=f"1 of 4 rows have no direction: row 2 is {what}"):
            cover_of(broken, 0.5)
