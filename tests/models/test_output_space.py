"""The output space of an encoder: with and without centering and scaling it is restored exactly, also from files."""

from pathlib import Path

import numpy as np
import pytest

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.models.output_space import (
    OutputSpace,
    OutputSpaces,
    output_space_parts,
    output_spaces_parts,
    read_output_space,
    read_output_spaces,
)
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


def test_coordinates_of_a_basis_are_always_about_the_mean() -> None:
    basis = FeatureBasis(
        mean=np.ones(6, np.float32), components=np.eye(2, 6, dtype=np.float32), energy_kept=0.9, space=SPACE
    )
    with pytest.raises(InputError, match="centered: expected true with a basis"):
        OutputSpace(space=SPACE, mean=basis.mean, scale=1.0, basis=basis, centered=False)


def two_spaces() -> OutputSpaces:
    other = FeatureSpace(name="t", channels=5)
    components = np.linalg.qr(np.random.default_rng(1).normal(size=(5, 2)))[0].T.astype(np.float32)
    basis = FeatureBasis(mean=np.arange(5, dtype=np.float32), components=components, energy_kept=0.9, space=other)
    second = OutputSpace(space=other, mean=basis.mean, scale=3.0, basis=basis, confidence=(0.1, 0.2, 0.3, 0.4, 0.5))
    return OutputSpaces(by_teacher={"first": space(), "second": second})


def test_several_spaces_lie_side_by_side_and_are_restored_each_by_itself() -> None:
    spaces = two_spaces()
    assert spaces.channels == 8
    assert spaces.columns == {"first": slice(0, 6), "second": slice(6, 8)}
    values = np.random.default_rng(2).normal(size=(10, 8)).astype(np.float32)
    restored = spaces.restore(values)
    for name, columns in spaces.columns.items():
        np.testing.assert_allclose(restored[:, columns], spaces[name].restore(values[:, columns]), rtol=1e-6)


def test_a_space_is_named_by_its_teacher_or_by_itself() -> None:
    spaces = two_spaces()
    assert spaces.resolve("second") == spaces.resolve("t") == "second"
    assert spaces.select("s") is spaces["first"]
    assert OutputSpaces(by_teacher={"only": space()}).resolve(None) == "only"
    with pytest.raises(InputError, match=r"features of first, second; name one of them"):
        spaces.resolve(None)
    with pytest.raises(InputError, match=r"features of first, second; got 'third'"):
        spaces.resolve("third")
    with pytest.raises(InputError, match="one output space or more"):
        OutputSpaces(by_teacher={})


def test_a_file_restores_several_spaces_in_their_order(tmp_path: Path) -> None:
    spaces = two_spaces()
    arrays, header = output_spaces_parts(spaces)
    write_archive(tmp_path / "spaces.safetensors", arrays, header)
    with open_archive(tmp_path / "spaces.safetensors") as file:
        again = read_output_spaces(file)
    assert list(again) == ["first", "second"]
    values = np.random.default_rng(3).normal(size=(4, 8)).astype(np.float32)
    np.testing.assert_array_equal(again.restore(values), spaces.restore(values))
    assert again["second"].basis is not None
    assert (again["first"].confidence, again["second"].confidence) == ((), (0.1, 0.2, 0.3, 0.4, 0.5))
    assert (again["first"].space, again["second"].space) == (spaces["first"].space, spaces["second"].space)


@pytest.mark.parametrize(
    ("outputs", "message"),
    [(["no space"], "expected an output space in the"), ([], "one output space or more"), ([{}], "expected teacher")],
)
def test_a_header_without_spaces_is_refused(tmp_path: Path, outputs: list[object], message: str) -> None:
    write_archive(tmp_path / "spaces.safetensors", {}, {"outputs": outputs})
    with open_archive(tmp_path / "spaces.safetensors") as file, pytest.raises(InputError, match=message):
        read_output_spaces(file)
