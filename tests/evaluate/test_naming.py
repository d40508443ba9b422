"""Classes of Gaussians and of sets of them, against cosines that numpy computes one by one."""

from dataclasses import replace

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.naming import NamingCounts, naming_scores, nearest_words
from gsencoder.evaluate.sources import NAMES_AT_ONCE, class_cosines, nearest_class
from gsencoder.evaluate.validation import nearest_classes
from gsencoder.text.table import TextTable, make_text_table
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures

CHANNELS = 6
NAMES = [f"name {number}" for number in range(2 * NAMES_AT_ONCE + 3)]


@pytest.fixture
def words() -> TextTable:
    vectors = np.random.default_rng(1).normal(size=(len(NAMES), CHANNELS)).astype(np.float32)
    return make_text_table(NAMES, vectors / np.linalg.norm(vectors, axis=1, keepdims=True), "words")


def features_of(words: TextTable, vectors: np.ndarray, seen: np.ndarray | None = None) -> GaussianFeatures:
    weights = (np.ones(len(vectors)) if seen is None else seen).astype(np.float32)
    vectors = vectors.astype(np.float32)
    return GaussianFeatures(features=vectors, weights=weights, mean=words.mean, space=words.space)


def cosine(vector: np.ndarray, word: np.ndarray, mean: np.ndarray, text_mean: np.ndarray) -> float:
    """Of one vector and one word, after their means are removed."""
    a, b = vector.astype(np.float64) - mean, word.astype(np.float64) - text_mean
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def expected(features: GaussianFeatures, vectors: np.ndarray, names: list[str], words: TextTable) -> np.ndarray:
    encoded = words.encode(names)
    return np.array([[cosine(vector, word, features.mean, words.mean) for word in encoded] for vector in vectors])


def test_the_nearest_class_is_that_of_the_largest_cosine_among_more_names_than_fit_at_once(words: TextTable) -> None:
    vectors = np.random.default_rng(2).normal(size=(200, CHANNELS))
    features = features_of(words, vectors)
    nearest = nearest_class(features, NAMES, words)
    assert np.array_equal(nearest, expected(features, vectors, NAMES, words).argmax(axis=1))
    # Every part of the names has some.
    assert {int(number) // NAMES_AT_ONCE for number in nearest} == {0, 1, 2}


def test_of_equal_classes_the_first_is_nearest_and_gaussians_without_a_feature_have_none(words: TextTable) -> None:
    vectors = words.encode(["name 3"]).repeat(3, axis=0)
    features = features_of(words, vectors * [[1], [1], [0]], np.array([1, 1, 0]))
    assert nearest_class(features, ["name 1", "name 3", "name 3"], words).tolist() == [1, 1, -1]


def test_a_set_has_the_cosine_of_the_mean_of_its_seen_gaussians(words: TextTable) -> None:
    vectors = np.random.default_rng(3).normal(size=(8, CHANNELS))
    seen = np.array([1, 1, 0, 0.1, 1, 5, 0, 1])
    features = features_of(words, vectors * (seen > 0)[:, None], seen)
    parts = [np.array([0, 1, 2]), np.array([3, 5]), np.array([2, 6]), np.array([], np.int64), np.array([7])]
    cosines = class_cosines(features, parts, NAMES[:3], words)
    # Each Gaussian counts the same, whatever its weight.
    means = [vectors[[0, 1]].mean(axis=0), vectors[[3, 5]].mean(axis=0), vectors[7]]
    assert cosines.shape == (5, 3)
    np.testing.assert_allclose(cosines[[0, 1, 4]], expected(features, np.array(means), NAMES[:3], words), atol=1e-5)
    assert np.isnan(cosines[[2, 3]]).all()


def test_words_of_another_space_are_refused(words: TextTable) -> None:
    other = FeatureSpace(name="others", channels=CHANNELS)
    features = replace(features_of(words, np.ones((2, CHANNELS))), space=other)
    for call in (lambda: nearest_class(features, NAMES, words), lambda: class_cosines(features, [], NAMES, words)):
        with pytest.raises(InputError, match="others"):
            call()


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
