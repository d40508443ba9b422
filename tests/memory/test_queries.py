"""Queries without training: what they stand for, and which banks they may attend to."""

from dataclasses import replace

import numpy as np
import pytest
from feature_fields import SPACE, make_features
from memory_samples import make_bank, memory_of_features

from gsencoder.core.errors import InputError
from gsencoder.memory.bank import principal_queries
from gsencoder.types import FeatureSpace, GaussianFeatures, MemoryBank
from gsencoder.types.features import Scoring


def bank_of(features: GaussianFeatures, scoring: Scoring = "centered") -> MemoryBank:
    """Every seventh feature that was seen."""
    rows = features.decode(np.flatnonzero(features.seen)[::7])
    mean = features.mean if scoring == "centered" else np.zeros_like(features.mean)
    return make_bank(rows, mean, features.space)


@pytest.mark.parametrize("basis", [True, False])
@pytest.mark.parametrize("scoring", ["centered", "cosine", "dot"])
def test_queries_of_all_directions_stand_for_the_features(basis: bool, scoring: Scoring) -> None:
    features = make_features(basis=basis)
    queries, projection = principal_queries(features, bank_of(features), 13, scoring)
    seen = features.seen
    np.testing.assert_array_equal(queries[~seen], 0)
    products = queries[seen].astype(np.float64) @ projection
    expected = features.decode(seen) - (features.mean if scoring == "centered" else 0)
    cosines = (products * expected).sum(axis=1) / np.linalg.norm(products, axis=1) / np.linalg.norm(expected, axis=1)
    np.testing.assert_allclose(cosines, 1, atol=1e-5)
    if scoring == "dot":
        np.testing.assert_allclose(products, expected, rtol=1e-3, atol=1e-4)
    else:
        assert queries[seen].std() == pytest.approx(1, abs=1e-5)
        directions = projection[int(scoring == "cosine") :]
        lengths = np.linalg.norm(directions, axis=1)
        np.testing.assert_allclose(lengths[lengths > 1e-3], np.sqrt(12), rtol=1e-5)


def test_fewer_channels_keep_the_directions_in_which_the_components_differ_most() -> None:
    features = make_features(basis=False)
    bank = bank_of(features)
    keys = (bank.components - features.mean).astype(np.float64)
    keys /= np.linalg.norm(keys, axis=1, keepdims=True)
    values = np.linalg.eigvalsh(keys.T @ keys)[::-1]
    for channels in (1, 3, 6):
        queries, projection = principal_queries(features, bank, channels)
        unit = projection / np.linalg.norm(projection, axis=1, keepdims=True)
        assert ((keys @ unit.T) ** 2).sum() == pytest.approx(values[:channels].sum(), rel=1e-5)
        assert queries.shape == (3000, channels)


def test_with_cosines_the_directions_are_those_about_the_mean_of_the_features_whatever_the_bank_subtracts() -> None:
    features = make_features(basis=False)
    bank = bank_of(features, "cosine")
    assert not bank.mean.any()
    keys = (bank.components - features.mean).astype(np.float64)
    keys /= np.linalg.norm(keys, axis=1, keepdims=True)
    _, projection = principal_queries(features, bank, 4, "cosine")
    unit = projection[1:] / np.linalg.norm(projection[1:], axis=1, keepdims=True)
    expected = np.linalg.eigvalsh(keys.T @ keys)[::-1][:3].sum()
    assert ((keys @ unit.T) ** 2).sum() == pytest.approx(expected, rel=1e-5)
    # The first channel is the mean, and 1 for every Gaussian before all channels are divided by their spread.
    assert projection[0] @ features.mean == pytest.approx(
        np.linalg.norm(projection[0]) * np.linalg.norm(features.mean), rel=1e-5
    )


def test_rare_kinds_are_told_apart_where_most_gaussians_are_of_one_kind() -> None:
    rng = np.random.default_rng(0)
    kinds = np.linalg.qr(rng.normal(size=(12, 6)))[0].T.astype(np.float32)
    features = make_features(basis=False)
    number = np.where(rng.random(3000) < 0.99, 0, rng.integers(0, 6, 3000))
    values = features.mean + kinds[number] + 0.3 * rng.normal(size=(3000, 1)).astype(np.float32) * kinds[0]
    values[~features.seen] = 0
    features = replace(features, features=values.astype(np.float32))
    bank = replace(
        bank_of(features),
        components=features.mean + kinds,
        sources=np.zeros((6, 3), np.int32),
        grid_from_image=bank_of(features).grid_from_image[:6],
    )
    memory = memory_of_features(features, bank, channels=5)
    seen = np.flatnonzero(features.seen)
    nearest = memory.attention(memory.queries[seen]).argmax(axis=1)
    assert (nearest == number[seen])[number[seen] > 0].mean() > 0.95


@pytest.mark.parametrize("scoring", ["centered", "cosine"])
def test_a_memory_without_training_decodes_to_features_near_those_it_was_made_of(scoring: Scoring) -> None:
    features = make_features()
    memory = memory_of_features(features, bank_of(features, scoring), channels=7, scoring=scoring, temperature=0.01)
    decoded, seen = memory.features(), features.seen
    np.testing.assert_array_equal(decoded.seen, seen)
    a, b = decoded.decode(seen) - features.mean, features.decode(seen) - features.mean
    cosines = (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    assert np.median(cosines) > 0.95


def test_an_index_is_taken_as_the_features_that_it_stands_for() -> None:
    features = make_features(kinds=5)
    seen = np.flatnonzero(features.seen)
    table, index = np.unique(features.features[seen], axis=0, return_inverse=True)
    full = np.full(len(features), -1, np.int32)
    full[seen] = index
    indexed = replace(features, features=table, index=full)
    one, other = (principal_queries(each, bank_of(features), 4) for each in (features, indexed))
    np.testing.assert_allclose(np.abs(one[0]), np.abs(other[0]), atol=1e-4)


def test_equal_features_have_finite_queries() -> None:
    features = make_features(basis=False)
    equal = replace(features, features=np.repeat(features.mean[None], len(features), axis=0))
    for scoring in ("centered", "cosine", "dot"):
        queries, projection = principal_queries(equal, bank_of(features), 4, scoring)
        assert np.isfinite(queries).all()
        assert np.isfinite(projection).all()


def test_features_and_banks_of_different_spaces_are_refused() -> None:
    features = make_features()
    bank = replace(bank_of(features), space=FeatureSpace(name="other", channels=SPACE.channels))
    with pytest.raises(InputError, match=r"the features are of \(s .*, and the bank is of \(other"):
        principal_queries(features, bank, 4)
    nothing = replace(features, weights=np.zeros_like(features.weights))
    with pytest.raises(InputError, match="no Gaussian has features"):
        principal_queries(nothing, bank_of(features), 4)
