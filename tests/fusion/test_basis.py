"""The basis keeps the energy that it says, commutes with rendering, and represents other vectors as figures say."""

import numpy as np
import pytest
import torch
from splats import front_camera, random_gaussians
from training_scenes import SPACE as SIDES
from training_scenes import TABLE, DenseSideTeacher, SideTeacher, scene

from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import (
    Moments,
    ProjectionSums,
    distinct_rows,
    fit_basis,
    project_maps,
    table_basis,
)
from gsencoder.render import blend
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace

SPACE = FeatureSpace(name="s", channels=24)


def low_rank(
    rng: np.random.Generator, n: int = 500, rank: int = 5, noise: float = 0.0, mean: float = 0.0
) -> np.ndarray:
    x = rng.normal(size=(n, rank)) @ rng.normal(size=(rank, 24)) + noise * rng.normal(size=(n, 24)) + mean
    return x.astype(np.float32)


def moments_of(vectors: np.ndarray, chunks: int = 1) -> Moments:
    moments = Moments(vectors.shape[1])
    for part in np.array_split(vectors, chunks):
        moments.add(part)
    return moments


def test_streaming_moments_equal_those_of_all_vectors_at_once(rng: np.random.Generator) -> None:
    x = low_rank(rng, noise=0.3, mean=2.0)
    moments = moments_of(x, chunks=7)
    np.testing.assert_allclose(moments.mean, x.mean(axis=0, dtype=np.float64), atol=1e-5)
    np.testing.assert_allclose(moments.covariance(), np.cov(x.T.astype(np.float64), bias=True), atol=1e-3)


@pytest.mark.parametrize("second", [True, False])
def test_moments_of_scenes_that_are_merged_are_those_of_all_vectors(rng: np.random.Generator, second: bool) -> None:
    scenes = [low_rank(rng, n=count, noise=0.3, mean=mean) for count, mean in ((40, 5.0), (150, -3.0), (90, 1.0))]
    merged = Moments(24, second=second)
    for vectors in (scenes[0][:0], *scenes, scenes[0][:0]):
        part = Moments(24, second=second)
        # Sums are about the mean of the first vectors that are added, and not zero after others.
        for chunk in (vectors[:7], vectors[7:]):
            part.add(chunk)
        merged.merge(part)
    x = np.concatenate(scenes)
    assert merged.count == len(x)
    np.testing.assert_allclose(merged.mean, x.mean(axis=0, dtype=np.float64), atol=1e-5)
    if second:
        np.testing.assert_allclose(merged.covariance(), np.cov(x.T.astype(np.float64), bias=True), atol=1e-3)


def test_a_mean_a_million_times_the_spread_does_not_swallow_it(rng: np.random.Generator) -> None:
    x = (rng.normal(size=(400, 24)) * 1e-2 + 1e4).astype(np.float32)
    np.testing.assert_allclose(np.diag(moments_of(x, 3).covariance()), x.astype(np.float64).var(axis=0), rtol=1e-2)


def test_the_rank_is_the_smallest_that_keeps_the_energy(rng: np.random.Generator) -> None:
    x = low_rank(rng, noise=0.1)
    moments = moments_of(x)
    values = np.sort(np.linalg.eigvalsh(moments.covariance()))[::-1]
    for energy in (0.3, 0.8, 0.95, 0.999):
        basis = fit_basis(moments.mean, moments.covariance(), SPACE, energy=energy)
        share = values.cumsum() / values.sum()
        assert share[basis.rank - 1] >= energy
        assert basis.rank == 1 or share[basis.rank - 2] < energy
        assert basis.energy_kept == pytest.approx(share[basis.rank - 1], abs=1e-6)


def test_all_of_the_energy_is_kept_without_channels_that_hold_rounding_alone(rng: np.random.Generator) -> None:
    vectors = np.linalg.qr(rng.normal(size=(24, 24)))[0]
    covariance = (vectors * np.r_[4, 2, 1, 0.1, 1e-6, np.full(19, 2e-8)]) @ vectors.T
    assert fit_basis(np.zeros(24), covariance, SPACE, energy=1.0).rank == 5


@pytest.mark.parametrize("channels", [7, 10, 24])
def test_of_equally_strong_directions_a_share_of_the_energy_takes_that_share(channels: int) -> None:
    """The share may be off by rounding either way, as 3 · 0.1 is."""
    space = FeatureSpace(name="s", channels=channels)
    for rank in range(1, channels + 1):
        for energy in (rank / channels, min(1.0, rank * (1 / channels)), min(1.0, (1 + 1e-15) * rank / channels)):
            basis = fit_basis(np.zeros(channels), np.eye(channels), space, energy=energy)
            assert basis.rank == rank
            assert basis.energy_kept == pytest.approx(rank / channels)


def test_components_are_orthonormal_and_the_same_on_a_rerun(rng: np.random.Generator) -> None:
    moments = moments_of(low_rank(rng, noise=0.2))
    basis = fit_basis(moments.mean, moments.covariance(), SPACE, energy=0.99)
    np.testing.assert_allclose(basis.components @ basis.components.T, np.eye(basis.rank), atol=1e-6)
    again = fit_basis(moments.mean, moments.covariance(), SPACE, energy=0.99)
    assert (basis.components == again.components).all()
    # The largest entry of each is positive.
    assert (basis.components.max(axis=1) == np.abs(basis.components).max(axis=1)).all()


def test_rendering_coordinates_then_decoding_equals_rendering_features(rng: np.random.Generator) -> None:
    """decode(B @ z) = (B @ z) @ components + alpha · mean, because rows of B sum to alpha."""
    x = low_rank(rng, n=200, mean=4.0)
    moments = moments_of(x)
    basis = fit_basis(moments.mean, moments.covariance(), SPACE, energy=1.0)
    b = blend(random_gaussians(200), front_camera(), patch=7)
    rendered = b.render(torch.from_numpy(basis.coordinates(x))).numpy()
    decoded = rendered @ basis.components + b.alpha.numpy()[:, None] * basis.mean
    np.testing.assert_allclose(decoded, b.render(torch.from_numpy(x)).numpy(), atol=1e-3)


@pytest.mark.parametrize("energy", [0.7, 0.999, 1.0])
def test_the_basis_of_a_table_of_few_rows_is_that_of_its_covariance(rng: np.random.Generator, energy: float) -> None:
    table = (rng.normal(size=(5, SPACE.channels)) * [[1], [2], [3], [0.1], [0]]).astype(np.float32)
    mean = table.mean(axis=0)
    centered = table.astype(np.float64) - mean
    plain = fit_basis(mean.astype(np.float64), centered.T @ centered / 5, SPACE, energy=energy)
    basis = table_basis(table, mean, SPACE, energy=energy)
    assert len(table) < SPACE.channels
    assert basis.rank == plain.rank
    np.testing.assert_allclose(basis.components, plain.components, atol=1e-6)
    assert basis.energy_kept == pytest.approx(plain.energy_kept, abs=1e-12)


def test_each_row_of_a_table_that_occurs_in_a_coded_map_is_taken_once() -> None:
    grid = {"grid_from_image": np.eye(2, 3), "space": SIDES, "table": TABLE}
    assert (
        distinct_rows(FeatureMap(codes=np.array([[-1, 0, 2, 2]], np.int32), **grid)).tolist() == TABLE[[0, 2]].tolist()
    )
    assert len(distinct_rows(FeatureMap(codes=np.full((2, 2), -1, np.int32), **grid))) == 0


def test_bad_vectors_are_refused() -> None:
    with pytest.raises(InputError, match="1 bad rows of 2"):
        Moments(2).add(np.array([[0, 1], [np.nan, 1]], np.float32))
    with pytest.raises(InputError, match="no view has any cell"):
        _ = Moments(2).mean


@pytest.mark.parametrize("most", [1, 2, 23, 24, 100])
def test_no_more_components_are_taken_than_allowed_and_it_is_told_what_they_keep(rng, most):
    moments = moments_of(low_rank(rng, noise=0.5))
    values = np.sort(np.linalg.eigvalsh(moments.covariance()))[::-1]
    basis = fit_basis(moments.mean, moments.covariance(), SPACE, energy=1.0, max_rank=most)
    assert basis.rank == min(most, 24)
    assert basis.energy_kept == pytest.approx(values[:most].sum() / values.sum())


@pytest.mark.parametrize("second", [True, False])
def test_nothing_added_changes_no_moment_and_nothing_bad_gets_in(rng: np.random.Generator, second: bool) -> None:
    x = low_rank(rng, noise=0.3, mean=-2.0)
    moments = Moments(24, second=second)
    for part in (x[:0], x[:100], x[:0], x[100:]):
        moments.add(part)
    assert moments.count == len(x)
    np.testing.assert_allclose(moments.mean, x.mean(axis=0, dtype=np.float64), atol=1e-5)
    with pytest.raises(InputError, match="1 bad rows of 3"):
        moments.add(np.where(np.arange(3)[:, None] == 1, np.float32(np.inf), x[:3]))
    np.testing.assert_allclose(moments.mean, x.mean(axis=0, dtype=np.float64), atol=1e-5)


WIDE = FeatureSpace(name="wide", channels=12)


def basis_of(vectors: np.ndarray, rank: int) -> FeatureBasis:
    mean = vectors.mean(axis=0, dtype=np.float64)
    return fit_basis(mean, np.cov(vectors.T.astype(np.float64), bias=True), WIDE, energy=1.0, max_rank=rank)


def vectors_of(rng: np.random.Generator, count: int = 5000) -> np.ndarray:
    return (rng.normal(size=(count, 12)) * np.linspace(2, 0.2, 12) + 3).astype(np.float32)


def test_figures_are_those_of_a_direct_computation(rng: np.random.Generator) -> None:
    basis, others = basis_of(vectors_of(rng), 4), vectors_of(rng)[:, ::-1].copy()
    centered = others - basis.mean
    projected = centered @ basis.components.T @ basis.components
    lengths = np.linalg.norm(centered, axis=1) * np.linalg.norm(projected, axis=1)
    cosines = (centered * projected).sum(axis=1) / lengths
    sums = ProjectionSums()
    sums.add(basis, others)
    fit = sums.fit()
    assert fit.energy == pytest.approx(np.square(projected).sum() / np.square(centered).sum(), rel=1e-4)
    assert fit.cosine == pytest.approx(cosines.mean(), abs=1e-4)
    assert fit.worst == pytest.approx(np.quantile(cosines, 0.05), abs=2e-3)
    assert fit.vectors == len(others)


def test_vectors_that_are_the_mean_are_left_out_and_short_ones_count_as_any(rng: np.random.Generator) -> None:
    basis, others = basis_of(vectors_of(rng), 4), vectors_of(rng, 200)
    plain, near = ProjectionSums(), ProjectionSums()
    plain.add(basis, others)
    near.add(basis, np.concatenate([basis.mean + (others - basis.mean) / 128, np.tile(basis.mean, (3, 1))]))
    expected, actual = plain.fit(), near.fit()
    assert actual.vectors == 200
    assert (actual.energy, actual.cosine, actual.worst) == pytest.approx(
        (expected.energy, expected.cosine, expected.worst), abs=1e-4
    )


def test_no_projection_counts_for_longer_than_its_vector(rng: np.random.Generator) -> None:
    basis = basis_of(vectors_of(rng), 12)
    for vector in vectors_of(rng, 50):
        sums = ProjectionSums()
        sums.add(basis, vector[None])
        fit = sums.fit()
        assert 1 - 1e-6 < fit.cosine <= 1
        assert 1 - 1e-6 < fit.energy <= 1
        # Quantiles are interpolated in the last of a thousand bins.
        assert fit.worst == pytest.approx(0.99905)


def test_coded_and_dense_maps_of_the_same_vectors_give_the_same_figures() -> None:
    basis = table_basis(TABLE, TABLE.mean(axis=0), SIDES, energy=0.6)
    views = scene(0).views
    coded, dense = (project_maps(basis, teacher(), views, (0, 1)).fit() for teacher in (SideTeacher, DenseSideTeacher))
    assert coded.vectors == 4 * dense.vectors
    assert (coded.energy, coded.cosine, coded.worst) == pytest.approx(
        (dense.energy, dense.cosine, dense.worst), abs=1e-6
    )


def test_nothing_to_compare_and_another_space_are_refused() -> None:
    with pytest.raises(InputError, match="nothing to compare"):
        ProjectionSums().fit()
    views = scene(0).views
    basis = basis_of(vectors_of(np.random.default_rng(0)), 2)
    with pytest.raises(InputError, match="is of \\(wide.*the maps of \\(sides"):
        project_maps(basis, SideTeacher(), views, (0,))
