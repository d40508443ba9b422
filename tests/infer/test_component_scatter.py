"""The scatter plot of a bank: the plane of most variance, what the picture holds, and the ends of the range."""

from dataclasses import replace

import numpy as np
import pytest
from memory_samples import make_bank, make_memory
from sklearn.decomposition import PCA

from gsencoder.core.errors import InputError
from gsencoder.infer.memory_pictures import UMAP_LEAST, component_scatter, principal_plane, umap_plane
from gsencoder.memory.bank import RawSample
from gsencoder.types import FeatureSpace, MemoryBank


def red(picture: np.ndarray) -> np.ndarray:
    """Pixels in the color of the components."""
    return (np.abs(picture.astype(int) - [214, 39, 40]) < 20).all(axis=2)


def blue(picture: np.ndarray) -> np.ndarray:
    """Pixels in a tint of the color of raw features."""
    return picture[..., 2].astype(int) - picture[..., 0] > 25


def bank_of(components: np.ndarray) -> MemoryBank:
    channels = components.shape[1]
    return make_bank(components, np.zeros(channels, np.float32), FeatureSpace(name="toy", channels=channels))


def sample_of(features: np.ndarray, total: int | None = None) -> RawSample:
    return RawSample(features=features.astype(np.float32), total=len(features) if total is None else total)


@pytest.mark.parametrize(("count", "channels"), [(400, 12), (8, 40), (2, 5)])
def test_the_plane_is_that_of_a_principal_component_analysis(count: int, channels: int) -> None:
    rng = np.random.default_rng(count)
    features = (rng.normal(size=(count, channels)) * np.geomspace(3, 0.1, channels) + 7).astype(np.float32)
    mean, axes, shares = principal_plane(features)
    oracle = PCA(n_components=2, svd_solver="full").fit(features.astype(np.float64))
    np.testing.assert_allclose(mean, oracle.mean_, atol=1e-5)
    np.testing.assert_allclose(shares, oracle.explained_variance_ratio_, atol=1e-6)
    for number in range(2 if count > 2 else 1):
        assert abs(axes[:, number] @ oracle.components_[number]) == pytest.approx(1, abs=1e-6)
        assert axes[np.abs(axes[:, number]).argmax(), number] > 0


def test_features_without_a_second_direction_have_a_plane_that_is_a_line_or_a_point() -> None:
    line = np.outer(np.linspace(-1, 1, 9), [3.0, 4.0]).astype(np.float32)
    _, axes, shares = principal_plane(line)
    np.testing.assert_allclose(axes[:, 0], [0.6, 0.8], atol=1e-6)
    np.testing.assert_array_equal(axes[:, 1], 0)
    np.testing.assert_allclose(shares, [1, 0])
    _, axes, shares = principal_plane(np.linspace(0, 1, 5, dtype=np.float32)[:, None])
    np.testing.assert_allclose(axes, [[1, 0]])
    np.testing.assert_allclose(shares, [1, 0])
    for same in (np.full((6, 3), 2.5, np.float32), np.full((6, 3), 0.1, np.float32), np.zeros((0, 3), np.float32)):
        _, axes, shares = principal_plane(same)
        assert not axes.any()
        assert not shares.any()


def test_components_are_drawn_over_raw_features_and_the_same_bytes_come_again() -> None:
    rng = np.random.default_rng(0)
    raw = rng.normal(size=(400, 6)) + 2
    bank, sample = bank_of(raw[:30]), sample_of(raw, 5000)
    picture = component_scatter(bank, sample)
    assert picture.dtype == np.uint8
    assert red(picture).sum() > 30 * 20
    assert blue(picture).sum() > 400
    np.testing.assert_array_equal(picture, component_scatter(bank, sample))
    fewer = component_scatter(bank_of(raw[:3]), sample)
    assert 0 < red(fewer).sum() < red(picture).sum() / 3


def test_a_dot_lies_where_its_coordinates_are() -> None:
    """On the axis of the largest variance the component that is farthest out is the rightmost red dot."""
    raw = np.concatenate([np.outer(np.linspace(-10, 10, 201), [1, 0, 0]), np.outer([-1, 1], [0, 1, 0])])
    left = component_scatter(bank_of(np.array([[-9.0, 0, 0]])), sample_of(raw))[150:]
    right = component_scatter(bank_of(np.array([[9.0, 0, 0]])), sample_of(raw))[150:]
    middle = left.shape[1] / 2
    assert np.nonzero(red(left))[1].mean() < middle < np.nonzero(red(right))[1].mean()


def test_umap_is_given_the_directions_that_the_bank_compares_and_its_dots_are_told_apart(monkeypatch):
    rng = np.random.default_rng(0)
    mean = np.array([5, 0, 0, 0], np.float32)
    raw, components = (rng.normal(size=(count, 4)).astype(np.float32) + mean for count in (50, 7))
    calls = []

    def plane(vectors: np.ndarray) -> np.ndarray:
        calls.append(vectors)
        return np.stack([np.arange(len(vectors)) >= 50, np.linspace(0, 1, len(vectors))], axis=1).astype(np.float32)

    monkeypatch.setattr("gsencoder.infer.memory_pictures.umap_plane", plane)
    monkeypatch.setattr("gsencoder.infer.memory_pictures.check_umap", lambda: None)
    picture = component_scatter(replace(bank_of(components), mean=mean), sample_of(raw), umap=True)
    (vectors,) = calls
    local = np.concatenate([raw, components]).astype(np.float64) - mean
    np.testing.assert_allclose(vectors, local / np.linalg.norm(local, axis=1, keepdims=True), atol=1e-6)
    left, right = np.split(picture[100:, picture.shape[1] // 2 :], 2, axis=1)
    # The legend has a dot of each color as well.
    assert red(right).sum() > 2 * red(left).sum()
    assert blue(left).sum() > 2 * blue(right).sum()


def test_tiny_banks_and_features_without_variance_are_drawn() -> None:
    one = np.ones((1, 4))
    for components, raw in ((one, one), (one, one[:0]), (np.array([[2.0]]), np.linspace(1, 3, 50)[:, None])):
        assert red(component_scatter(bank_of(components), sample_of(raw))).any()


def test_features_of_another_teacher_are_refused() -> None:
    with pytest.raises(InputError, match="raw features of 5 channels and components of 24"):
        component_scatter(make_memory().bank, sample_of(np.ones((3, 5))))


def test_umap_says_what_to_install_where_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsencoder.infer.memory_pictures.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"umap-learn: pip install 'gsencoder\[umap\]', or give umap=false"):
        component_scatter(bank_of(np.eye(3)), sample_of(np.eye(3)), umap=True)


@pytest.mark.slow
def test_umap_keeps_clusters_apart_and_is_the_same_for_a_seed() -> None:
    pytest.importorskip("umap")
    rng = np.random.default_rng(0)
    clusters = np.repeat(np.arange(3), 40)
    vectors = (np.eye(3, 8)[clusters] + 0.05 * rng.normal(size=(120, 8))).astype(np.float32)
    plane = umap_plane(vectors)
    np.testing.assert_array_equal(plane, umap_plane(vectors))
    centers = np.stack([plane[clusters == each].mean(axis=0) for each in range(3)])
    nearest = np.linalg.norm(plane[:, None] - centers, axis=2).argmin(axis=1)
    np.testing.assert_array_equal(nearest, clusters)
    wide = component_scatter(bank_of(vectors[::20]), sample_of(vectors), umap=True)
    assert wide.shape[1] > component_scatter(bank_of(vectors[::20]), sample_of(vectors)).shape[1]
    right = wide[:, wide.shape[1] // 2 :]
    assert red(right).any()
    assert blue(right).any()


@pytest.mark.slow
def test_umap_of_few_or_equal_features_is_drawn_or_says_why_not() -> None:
    pytest.importorskip("umap")
    with pytest.raises(InputError, match=f"expected {UMAP_LEAST} features or more, got 2"):
        umap_plane(np.eye(2, dtype=np.float32))
    assert component_scatter(bank_of(np.eye(3)), sample_of(np.eye(3)), umap=True).any()
    for vectors in (np.ones((20, 1)), np.zeros((30, 4)), np.ones((UMAP_LEAST, 3))):
        assert np.isfinite(umap_plane(vectors.astype(np.float32))).all()
