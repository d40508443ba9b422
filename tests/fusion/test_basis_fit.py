"""How well a basis represents other vectors, against direct computation."""

from dataclasses import asdict

import numpy as np
import pytest
from training_scenes import SPACE, TABLE, DenseSideTeacher, SideTeacher, scene

from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import fit_basis, table_basis
from gsencoder.fusion.errors import ProjectionSums, project_maps, total_fit
from gsencoder.types import FeatureBasis, FeatureSpace

WIDE = FeatureSpace(name="wide", channels=12)


def basis_of(vectors: np.ndarray, rank: int) -> FeatureBasis:
    mean = vectors.mean(axis=0, dtype=np.float64)
    return fit_basis(mean, np.cov(vectors.T.astype(np.float64), bias=True), WIDE, energy=1.0, max_rank=rank)


def vectors_of(rng: np.random.Generator, count: int = 5000) -> np.ndarray:
    return (rng.normal(size=(count, 12)) * np.linspace(2, 0.2, 12) + 3).astype(np.float32)


def test_of_the_vectors_that_it_was_fitted_to_a_basis_keeps_the_energy_that_it_states(rng: np.random.Generator) -> None:
    vectors = vectors_of(rng)
    for rank in (1, 4, 12):
        sums, basis = ProjectionSums(), basis_of(vectors, rank)
        sums.add(basis, vectors)
        assert sums.fit().energy == pytest.approx(basis.energy_kept, abs=1e-4)


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


def test_sums_of_parts_are_the_sums_of_the_whole_and_counts_repeat_vectors(rng: np.random.Generator) -> None:
    vectors = vectors_of(rng, 90)
    basis = basis_of(vectors, 3)
    parts = [ProjectionSums(), ProjectionSums()]
    parts[0].add(basis, vectors[:30])
    parts[1].add(basis, vectors[30:], np.full(60, 2.0))
    whole = ProjectionSums()
    whole.add(basis, np.concatenate((vectors, vectors[30:])))
    assert asdict(total_fit(parts)) == pytest.approx(asdict(whole.fit()))


def test_a_quantile_among_equal_cosines_is_where_the_vectors_are() -> None:
    basis = FeatureBasis(
        mean=np.zeros(12, np.float32), components=np.eye(1, 12, dtype=np.float32), energy_kept=1.0, space=WIDE
    )
    sums = ProjectionSums()
    sums.add(basis, np.eye(1, 12, dtype=np.float32))
    assert sums.fit().worst == pytest.approx(1.0, abs=1e-3)


def test_coded_and_dense_maps_of_the_same_vectors_give_the_same_figures() -> None:
    basis = table_basis(TABLE, TABLE.mean(axis=0), SPACE, energy=0.6)
    views = scene(0).views
    assert views is not None
    coded, dense = (project_maps(basis, teacher(), views, (0, 1)).fit() for teacher in (SideTeacher, DenseSideTeacher))
    assert coded.vectors == 4 * dense.vectors
    assert (coded.energy, coded.cosine, coded.worst) == pytest.approx(
        (dense.energy, dense.cosine, dense.worst), abs=1e-6
    )


def test_nothing_to_compare_and_another_space_are_refused() -> None:
    with pytest.raises(InputError, match="nothing to compare"):
        ProjectionSums().fit()
    views = scene(0).views
    assert views is not None
    basis = basis_of(vectors_of(np.random.default_rng(0)), 2)
    with pytest.raises(InputError, match="is of \\(wide.*the maps of \\(sides"):
        project_maps(basis, SideTeacher(), views, (0,))
