"""The output space of an encoder: with and without centering and scaling it is restored exactly, also from files."""

from pathlib import Path

import numpy as np
import pytest

from gsencoder.core.errors import InputError
from gsencoder.core.files.archive import open_archive, write_archive
from gsencoder.models.output_space import OutputSpace, output_space_parts, read_output_space
from gsencoder.types import FeatureBasis, FeatureSpace

SPACE = FeatureSpace(name="s", channels=6)
SWITCHES = [(True, True), (True, False), (False, True), (False, False)]


def vectors(count: int = 200) -> np.ndarray:
    return (np.random.default_rng(0).normal(size=(count, 6)) * 3 + 5).astype(np.float32)


def space(centered: bool = True, scaled: bool = True) -> OutputSpace:
    values = vectors()
    mean = values.mean(axis=0)
    scale = float(np.sqrt(np.square(values - mean).sum(axis=1).mean()))
    return OutputSpace(space=SPACE, mean=mean, scale=scale, centered=centered, scaled=scaled)


@pytest.mark.parametrize(("centered", "scaled"), SWITCHES)
def test_restoring_undoes_standardizing(centered: bool, scaled: bool) -> None:
    outputs, values = space(centered, scaled), vectors()
    np.testing.assert_allclose(outputs.restore(outputs.standardize(values)), values, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("centered", "scaled"), SWITCHES)
def test_standard_units_are_the_same_whatever_units_outputs_have(centered: bool, scaled: bool) -> None:
    outputs, values = space(centered, scaled), vectors()
    standard = outputs.standard_units(outputs.standardize(values))
    np.testing.assert_allclose(standard, space().standardize(values), rtol=1e-4, atol=1e-5)
    assert np.square(standard).mean() == pytest.approx(1, abs=1e-4)


def test_without_centering_and_scaling_outputs_are_the_vectors_of_the_teacher() -> None:
    outputs, values = space(centered=False, scaled=False), vectors()
    np.testing.assert_array_equal(outputs.standardize(values), values)
    np.testing.assert_array_equal(outputs.restore(values), values)
    # Queries are still compared about the mean of the space.
    np.testing.assert_array_equal(outputs.features(values).mean, outputs.mean)


@pytest.mark.parametrize(("centered", "scaled"), SWITCHES)
def test_a_file_restores_the_space(tmp_path: Path, centered: bool, scaled: bool) -> None:
    outputs = space(centered, scaled)
    arrays, header = output_space_parts(outputs)
    write_archive(tmp_path / "space.safetensors", arrays, header)
    with open_archive(tmp_path / "space.safetensors") as file:
        again = read_output_space(file)
    assert (again.centered, again.scaled) == (centered, scaled)
    np.testing.assert_array_equal(again.standardize(vectors()), outputs.standardize(vectors()))


def test_files_of_standardized_spaces_have_no_new_entries() -> None:
    _, header = output_space_parts(space())
    assert header.keys() == {"space", "scale"}


def test_coordinates_of_a_basis_are_always_about_the_mean() -> None:
    basis = FeatureBasis(
        mean=np.ones(6, np.float32), components=np.eye(2, 6, dtype=np.float32), energy_kept=0.9, space=SPACE
    )
    with pytest.raises(InputError, match="centered: expected true with a basis"):
        OutputSpace(space=SPACE, mean=basis.mean, scale=1.0, basis=basis, centered=False)
