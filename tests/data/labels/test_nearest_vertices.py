"""Labels of vertices for Gaussians and back, against brute force and scikit-learn's classifier."""

import numpy as np
import pytest
from sklearn.neighbors import KNeighborsClassifier

from gsencoder.data.labels import mesh as nearest_vertices
from gsencoder.data.labels.mesh import labels_of_vertices, nearest_rows


def points(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(0, 1, (count, 3)).astype(np.float32)


def test_the_nearest_row_is_that_of_brute_force_and_minus_one_where_none_is_near(rng: np.random.Generator) -> None:
    some, targets = points(rng, 300), points(rng, 50)
    distances = np.linalg.norm(some[:, None].astype(float) - targets[None], axis=2)
    assert np.array_equal(nearest_rows(some, targets), distances.argmin(axis=1))
    near = distances.min(axis=1) <= 0.1
    assert 0 < near.sum() < 300
    at_it = np.array([[0.25, 0, 0], [0.2500001, 0, 0]])
    assert nearest_rows(at_it, np.zeros((1, 3)), max_distance=0.25).tolist() == [0, -1]
    assert np.array_equal(nearest_rows(some, targets, max_distance=0.1), np.where(near, distances.argmin(axis=1), -1))
    assert nearest_rows(some, targets[:0]).tolist() == [-1] * 300
    assert nearest_rows(some[:0], targets).tolist() == []


@pytest.mark.parametrize("k", [1, 4, 25])
def test_the_majority_of_the_nearest_gaussians_is_that_of_scikit_learn(rng: np.random.Generator, k: int) -> None:
    """Its classifier also takes the smallest of equally frequent labels."""
    means, vertices = points(rng, 500), points(rng, 400)
    labels = rng.integers(0, 6, 500)
    expected = KNeighborsClassifier(n_neighbors=k).fit(means, labels).predict(vertices)
    assert np.array_equal(labels_of_vertices(vertices, means, labels, k=k), expected)


def test_chunks_change_nothing(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    means, vertices = points(rng, 300), points(rng, 257)
    labels = rng.integers(0, 40, 300)
    whole = labels_of_vertices(vertices, means, labels)
    monkeypatch.setattr(nearest_vertices, "CHUNK", 16)
    assert np.array_equal(labels_of_vertices(vertices, means, labels), whole)


def test_gaussians_without_a_label_are_among_the_nearest_but_do_not_count() -> None:
    means = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0], [9, 0, 1]], np.float32)
    vertex = np.zeros((1, 3), np.float32)
    labels = np.array([-1, -1, 3, 8, 8])
    # Of the three nearest, one says 3 and two nothing; the two nearest say nothing.
    assert labels_of_vertices(vertex, means, labels, k=3).tolist() == [3]
    assert labels_of_vertices(vertex, means, labels, k=2).tolist() == [-1]
    assert labels_of_vertices(vertex, means, labels, k=25).tolist() == [8]
    # Those that are not asked are not among the nearest.
    assert labels_of_vertices(vertex, means, labels, k=1, voters=labels >= 0).tolist() == [3]


def test_nothing_gives_no_labels(rng: np.random.Generator) -> None:
    none, some = np.zeros((0, 3), np.float32), points(rng, 3)
    empty = np.zeros(0, np.int32)
    assert labels_of_vertices(some, none, empty).tolist() == [-1, -1, -1]
    assert labels_of_vertices(none, some, np.arange(3)).shape == (0,)
    assert labels_of_vertices(some, some, np.arange(3), voters=np.zeros(3, bool)).tolist() == [-1, -1, -1]
