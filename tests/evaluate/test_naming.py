"""The naming protocol, on features whose names are known."""

from dataclasses import replace

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.naming import NamingCounts, naming_scores, nearest_words
from gsencoder.evaluate.validation import nearest_classes
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures


def outcome(total: dict[str, int], correct: dict[str, int]) -> NamingCounts:
    return NamingCounts(total=total, correct=correct, cosine=0.5)


def test_every_name_counts_the_same_over_all_scenes_together() -> None:
    scenes = [
        outcome({"other": 1000, "mug": 10}, {"other": 900, "mug": 5}),
        outcome({"mug": 10, "fork": 4}, {"mug": 10, "fork": 0}),
    ]
    scores = naming_scores(scenes)
    assert scores["accuracy"] == pytest.approx((0.9 + 0.75 + 0.0) / 3)
    assert scores["accuracy_named"] == pytest.approx((0.75 + 0.0) / 2)
    assert scores["accuracy_gaussians"] == pytest.approx(915 / 1024)
    assert list(scores["names"]) == ["fork", "mug", "other"]
    with pytest.raises(InputError, match="the views of no scene show a Gaussian"):
        naming_scores([outcome({}, {})])


def test_the_nearest_word_is_that_of_the_largest_cosine_with_a_basis_or_without() -> None:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(5, 8)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    features = rng.normal(size=(40, 8)).astype(np.float32)
    space = FeatureSpace(name="s", channels=8)
    mean, weights = rng.normal(size=8).astype(np.float32), np.ones(40, np.float32)
    plain = GaussianFeatures(features=features, weights=weights, mean=mean, space=space)
    whole = FeatureBasis(mean=mean, components=np.eye(8, dtype=np.float32), energy_kept=1.0, space=space)
    in_basis = replace(plain, features=features - mean, basis=whole)
    rows = np.arange(40)
    expected = (features @ vectors.T / np.linalg.norm(features, axis=1, keepdims=True)).argmax(axis=1)
    assert np.array_equal(nearest_words(plain, rows, vectors), expected)
    assert np.array_equal(nearest_words(in_basis, rows, vectors), expected)
    # In standard units the nearest unit vector is the one of largest cosine, whatever was taken off and divided out.
    classes = nearest_classes((features - mean) / 3, (vectors - mean) / 3, np.arange(5))
    assert np.array_equal(classes, expected)
