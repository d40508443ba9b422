"""Relevancy against plain formulas on decoded features; thresholds at their ends."""

import math
from dataclasses import replace

import numpy as np
import pytest
from feature_fields import plain_features

from gsencoder.core.errors import InputError
from gsencoder.infer.relevancy import ThresholdConfig, otsu, relevancy, threshold
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures

SPACE = FeatureSpace(name="toy", channels=24, text_encoder="toy")


def in_basis(rng: np.random.Generator, n: int = 500, rank: int = 5, scale: float = 1.0) -> GaussianFeatures:
    components = np.linalg.qr(rng.normal(size=(24, rank)))[0].T.astype(np.float32)
    mean = (scale * rng.normal(size=24)).astype(np.float32)
    basis = FeatureBasis(mean=mean, components=components, energy_kept=1.0, space=SPACE)
    coordinates = (scale * rng.normal(size=(n, rank))).astype(np.float32)
    weights = rng.random(n).astype(np.float32)
    weights[::7] = 0
    coordinates[::7] = 0
    return GaussianFeatures(features=coordinates, weights=weights, mean=mean, space=SPACE, basis=basis)


def words(rng: np.random.Generator, count: int = 3) -> np.ndarray:
    vectors = rng.normal(size=(count, 24)).astype(np.float32)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def plain_cosine(features: np.ndarray, text: np.ndarray) -> np.ndarray:
    a, b = features.astype(np.float64), text.astype(np.float64)
    a, b = (x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300) for x in (a, b))
    return b @ a.T


@pytest.mark.parametrize("mode", ["raw", "centered"])
def test_relevancy_in_coordinates_is_the_cosine_of_decoded_vectors(rng: np.random.Generator, mode: str) -> None:
    features, text, text_mean = in_basis(rng), words(rng), rng.normal(size=24).astype(np.float32) / 9
    scores = relevancy(features, text, text_mean, mode=mode)
    seen = features.seen
    vectors = features.features.astype(np.float64) @ features.basis.components + features.basis.mean
    centered = mode == "centered"
    expected = plain_cosine(vectors - (features.mean if centered else 0), text - (text_mean if centered else 0))
    # A feature's length below a thousandth of the mean's fades: here that is a millionth of the square.
    np.testing.assert_allclose(scores[:, seen], expected[:, seen], atol=1e-4 if centered else 1e-6)
    assert np.isnan(scores[:, ~seen]).all()


def test_a_mean_that_is_not_the_bases_own_is_removed_exactly(rng: np.random.Generator) -> None:
    features, text = in_basis(rng), words(rng)
    other = rng.normal(size=24).astype(np.float32)
    moved = replace(features, mean=other)
    scores = relevancy(moved, text, np.zeros(24, np.float32))
    expected = plain_cosine(features.decode().astype(np.float64) - other, text)
    np.testing.assert_allclose(scores[:, moved.seen], expected[:, moved.seen], atol=1e-5)


@pytest.mark.parametrize("scale", [1e-8, 1e-3, 1e6])
def test_the_length_of_features_does_not_matter_at_either_end(rng: np.random.Generator, scale: float) -> None:
    features, text, text_mean = in_basis(rng), words(rng), np.zeros(24, np.float32)
    basis = features.basis
    mean = (basis.mean * scale).astype(np.float32)
    values = (features.features * scale).astype(np.float32)
    scaled = replace(features, features=values, mean=mean, basis=replace(basis, mean=mean))
    for mode in ("raw", "centered"):
        a = relevancy(scaled, text, text_mean, mode=mode)
        assert np.isfinite(a[:, scaled.seen]).all()
        np.testing.assert_allclose(a, relevancy(features, text, text_mean, mode=mode), atol=1e-5)


def test_a_feature_equal_to_the_mean_answers_nothing_however_it_was_rounded(rng: np.random.Generator) -> None:
    mean = rng.normal(size=24).astype(np.float32)
    rows = np.stack([mean, mean * np.float32(1 + 1e-7), mean.astype(np.float16).astype(np.float32)])
    features = plain_features(rows, SPACE, mean=mean)
    text = words(rng, 20)
    assert np.abs(relevancy(features, text, np.zeros(24, np.float32))).max() < 0.2


def test_a_zero_feature_and_a_zero_word_score_zero() -> None:
    zeros = np.zeros((2, 24), np.float32)
    features = plain_features(zeros, SPACE)
    text = np.zeros((1, 24), np.float32)
    assert np.array_equal(relevancy(features, text, np.zeros(24, np.float32), mode="raw"), np.zeros((1, 2), np.float32))


def test_chunks_do_not_change_scores(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    features, text, mean = in_basis(rng), words(rng), np.zeros(24, np.float32)
    whole = relevancy(features, text, mean)
    monkeypatch.setattr("gsencoder.infer.relevancy.CHUNK_BYTES", 1000)
    np.testing.assert_allclose(relevancy(features, text, mean), whole, atol=1e-7)


@pytest.mark.parametrize("basis", [True, False])
def test_contrast_is_the_smallest_pairwise_softmax(rng: np.random.Generator, basis: bool) -> None:
    # Without a mean each rival is the strongest somewhere.
    features = in_basis(rng) if basis else plain_features(rng.normal(size=(300, 24)), SPACE)
    text, negatives, mean = words(rng), words(rng, 4), np.zeros(24, np.float32)
    scores = relevancy(features, text, mean, negatives=negatives, mode="raw", temperature=0.1)
    cosines = plain_cosine(features.decode(), np.concatenate([text, negatives]))
    for row in range(3):
        rivals = [other for other in range(7) if other != row]
        pairs = [np.exp(10 * cosines[row]) / (np.exp(10 * cosines[row]) + np.exp(10 * cosines[k])) for k in rivals]
        np.testing.assert_allclose(scores[row, features.seen], np.min(pairs, axis=0)[features.seen], atol=1e-5)
        assert basis or len(np.unique(np.argmin(pairs, axis=0))) == len(rivals)


def test_contrast_at_any_temperature_is_finite_and_a_word_is_no_rival_of_itself(rng: np.random.Generator) -> None:
    features, text, mean = in_basis(rng), words(rng), np.zeros(24, np.float32)
    for temperature in (1e-12, 1e12):
        scores = relevancy(features, text, mean, negatives=text[:0], temperature=temperature)
        assert np.isfinite(scores[:, features.seen]).all()
    twice = np.concatenate([text[:1], text])
    scores = relevancy(features, twice, mean, negatives=text[1:])
    np.testing.assert_array_equal(scores[0], scores[1])
    assert np.nanmax(scores[0]) > 0.6
    with pytest.raises(InputError, match="two different asked words"):
        relevancy(features, text[:1], mean, negatives=text[:1])


def test_wrong_sizes_and_values_are_named(rng: np.random.Generator, no_jaxtyping: None) -> None:
    features, text, mean = in_basis(rng), words(rng), np.zeros(24, np.float32)
    with pytest.raises(InputError, match="24 channels"):
        relevancy(features, text[:, :5], mean)
    with pytest.raises(InputError, match="NaN or Inf"):
        relevancy(features, text * np.nan, mean)
    with pytest.raises(InputError, match="temperature > 0"):
        relevancy(features, text, mean, temperature=0.0)


def test_thresholds_of_each_kind() -> None:
    scores = np.r_[np.linspace(0, 0.8, 81), np.nan].astype(np.float32)
    assert threshold(scores, ThresholdConfig(kind="fixed", fixed=0.3)) == 0.3
    assert threshold(scores, ThresholdConfig(kind="relative", relative=0.5)) == pytest.approx(0.4)
    assert math.isnan(threshold(scores[-1:], ThresholdConfig()))


def test_the_adaptive_threshold_follows_the_best_between_the_noise_and_the_fixed_value() -> None:
    config = ThresholdConfig(fixed=0.5, relative=0.6)
    # Values from 0 to 0.1: median 0.05, median deviation 0.025, so that the noise ends at 0.05 + 2 · 1.4826 · 0.025.
    background = np.linspace(0, 0.1, 10_001)
    noise = 0.05 + 2 * 1.4826 * 0.025
    for best, expected in ((1.0, 0.5), (0.9, 0.5), (0.7, 0.42), (0.5, 0.3), (0.2, noise), (0.1, noise)):
        values = np.r_[background, best if best > 0.1 else np.zeros(0)].astype(np.float32)
        assert threshold(values, config) == pytest.approx(expected, abs=1e-4)
    # The noise is no reason to ask for more than the fixed value.
    assert threshold(np.linspace(-0.9, 0.7, 99).astype(np.float32), config) == 0.5


def test_otsu_of_one_value_is_that_value() -> None:
    assert otsu(np.full(9, 0.25, np.float32)) == 0.25


def test_the_cosine_of_a_feature_fades_as_its_distance_from_the_mean_falls_below_a_thousandth() -> None:
    """cos · d / √(d² + (|mean| / 1000)²): halved in power where d is a thousandth of the mean's length."""
    mean, away = np.zeros(24), np.zeros(24)
    mean[0], away[1] = 2.0, 1.0
    distances = 2.0 * np.array([1e-5, 1e-3, 1e-2, 1.0])
    rows = (mean + distances[:, None] * away).astype(np.float32)
    features = plain_features(rows, SPACE, mean=mean.astype(np.float32))
    text = np.float32([[0, 0.6, 0.8, *[0] * 21]])
    expected = 0.6 * distances / np.sqrt(distances**2 + 0.002**2)
    np.testing.assert_allclose(relevancy(features, text, np.zeros(24, np.float32))[0], expected, rtol=1e-4)


@pytest.mark.parametrize("bins", [8, 64, 256])
def test_otsu_is_the_split_of_a_histogram_with_the_most_variance_between_its_sides(rng, bins):
    """By definition, split by split; of the splits in an empty gap the middle one."""
    values = np.r_[rng.normal(0.2, 0.05, 4000), rng.normal(0.25, 0.02, 2000), rng.normal(0.9, 0.02, 200)]
    upper = np.sort(values.astype(np.float32))[len(values) // 2 :].astype(np.float64)
    upper = upper[upper >= np.median(values.astype(np.float32))]
    edges = np.linspace(upper.min(), upper.max(), bins + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    cell = np.minimum(((upper - edges[0]) / (edges[-1] - edges[0]) * bins).astype(int), bins - 1)
    between = np.zeros(bins - 1)
    for split in range(1, bins):
        low, high = middle[cell[cell < split]], middle[cell[cell >= split]]
        if len(low) and len(high):
            between[split - 1] = len(low) * len(high) * (high.mean() - low.mean()) ** 2
    best = 1 + np.flatnonzero(between >= between.max() * (1 - 1e-9))
    assert len(best) > 1 or bins == 8
    assert otsu(values.astype(np.float32), bins) == pytest.approx(edges[best[len(best) // 2]], rel=1e-6)
