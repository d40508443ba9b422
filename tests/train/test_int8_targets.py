"""Targets of eight bits: within half a step of those of float16, and never mixed with them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import rewrite
from memory_scenes import PREPARE as MEMORY_PREPARE
from memory_scenes import BlendedTeacher
from safetensors.numpy import load_file
from training_scenes import PREPARE, SPACE, DenseSideTeacher, prepared, samples, scene

from gsencoder.core.errors import InputError
from gsencoder.core.files import plain
from gsencoder.train.memory import prepare_memory
from gsencoder.train.prepare import PrepareConfig, PreparedDataset, prepare_scene
from gsencoder.train.prepared_file import PreparedScene
from gsencoder.types import FeatureMap, Views

HALF_STEP = 0.5 / 127
"""The largest error of a value of eight bits, as a share of the largest one in its column."""
FLOAT16 = 2.0**-11
"""The largest relative error of a value that is rounded to float16."""


class NoiseTeacher(DenseSideTeacher):
    """Channels of very different size, with a vector of its own in each cell."""

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        noise = np.random.default_rng(view).normal(size=(20, 24, 4)) * [10, 1, 0.1, 0.01]
        grid = np.array([[0.5, 0, 0], [0, 0.5, 0]])
        return FeatureMap(features=noise.astype(np.float32), grid_from_image=grid, space=SPACE)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[PreparedScene, PreparedScene]:
    """A scene prepared with targets of float16, and the same with int8."""
    folder = tmp_path_factory.mktemp("both")
    dataset, (name,) = prepared(folder / "float16", count=1, teacher=NoiseTeacher())
    outputs, path = dataset.load_space()[0], folder / "wall_0.safetensors"
    config = replace(PREPARE, targets="int8")
    prepare_scene(path, scene(0), NoiseTeacher(), outputs, config, source=Path("wall_0"))
    return dataset.scenes([name])[0], PreparedScene(path)


def assert_within_half_a_step(rounded: np.ndarray, exact: np.ndarray) -> None:
    error, largest = np.abs(rounded.astype(np.float64) - exact), np.abs(exact).max(axis=0)
    allowed = HALF_STEP * largest + 2 * FLOAT16 * np.abs(exact).clip(1e-4)
    assert (error <= allowed).all()
    # It is not float16 after all.
    assert (error.max(axis=0) > HALF_STEP / 2 * largest).all()


def test_targets_and_the_vectors_of_rows_are_within_half_a_step_of_float16(
    both: tuple[PreparedScene, PreparedScene],
) -> None:
    wide, narrow = both
    assert (wide.precision, narrow.precision) == ("float16", "int8")
    rows = np.arange(len(wide))
    assert_within_half_a_step(narrow.targets(rows), wide.targets(rows))
    assert (narrow.targets(np.flatnonzero(wide.weights == 0)) == 0).all()
    assert narrow.float16_targets(rows).dtype == np.float16
    np.testing.assert_array_equal(narrow.float16_targets(rows[3:9]), narrow.targets(rows)[3:9].astype(np.float16))
    of_views = [np.concatenate([one.view(view).targets for view in range(2)]) for one in (narrow, wide)]
    assert_within_half_a_step(*of_views)


def test_all_else_is_the_same_and_targets_take_half_the_bytes(both: tuple[PreparedScene, PreparedScene]) -> None:
    wide, narrow = (load_file(one.path) for one in both)
    assert narrow.keys() - wide.keys() == {"target_scales", "row_target_scales"}
    for name, values in wide.items():
        if name in ("targets", "row_targets"):
            assert narrow[name].nbytes * 2 == values.nbytes
        else:
            np.testing.assert_array_equal(narrow[name], values)


def test_a_sample_of_such_targets_is_one_of_float16_otherwise(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=1, teacher=NoiseTeacher())
    wide = samples(dataset, names).make(5)
    path = dataset.scene_path(names[0])
    prepare_scene(path, scene(0), NoiseTeacher(), dataset.load_space()[0], replace(PREPARE, targets="int8"))
    narrow = samples(dataset, names).make(5)
    assert narrow.attributes.equal(wide.attributes)
    (one,), (other,) = narrow.teachers, wide.teachers
    assert one.targets.dtype == other.targets.dtype
    largest = PreparedScene(path).targets(np.arange(400)).max()
    assert 0 < (one.targets - other.targets).abs().max() <= 2 * HALF_STEP * largest


def dataset_of(folder: Path, config: PrepareConfig, **without: str) -> PreparedDataset:
    settings = {"prepare": plain(config)}
    for section, name in without.items():
        settings[section].pop(name)
    return PreparedDataset(folder, settings)


def test_a_folder_of_the_other_type_is_refused(tmp_path: Path) -> None:
    assert dataset_of(tmp_path, PREPARE).precision == "float16"
    problem = "prepare.targets=float16, and this run asks prepare.targets=int8; give another folder as prepared="
    with pytest.raises(InputError, match=problem):
        dataset_of(tmp_path, replace(PREPARE, targets="int8"))


def test_a_scene_of_the_other_type_in_a_folder_is_refused(
    both: tuple[PreparedScene, PreparedScene], tmp_path: Path
) -> None:
    for config, fits, other in ((PREPARE, *both), (replace(PREPARE, targets="int8"), *reversed(both))):
        dataset = dataset_of(tmp_path / config.targets, config)
        path = dataset.scene_path("wall_0")
        path.parent.mkdir()
        path.write_bytes(fits.path.read_bytes())
        assert dataset.has_scene(Path("wall_0"))
        path.write_bytes(other.path.read_bytes())
        with pytest.raises(InputError, match=f"{path}: expected targets of {fits.precision}, .*got {other.precision}"):
            dataset.has_scene(Path("wall_0"))


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_scales_that_no_preparation_writes_are_an_error_with_the_file_and_what_to_do(
    both: tuple[PreparedScene, PreparedScene], tmp_path: Path, value: float
) -> None:
    path = tmp_path / "wall_0.safetensors"
    path.write_bytes(both[1].path.read_bytes())
    arrays: dict[str, Any] = load_file(path)
    arrays["row_target_scales"][1] = value
    rewrite(path, arrays)
    with pytest.raises(InputError, match=rf"{path}: .*scales.*; remove the file to prepare the scene again$"):
        PreparedScene(path).view(0)


def test_a_memory_reads_its_features_from_its_targets_and_refuses_eight_bits(tmp_path: Path) -> None:
    config = replace(MEMORY_PREPARE, targets="int8")
    with pytest.raises(InputError, match=r"prepare\.targets: expected float16"):
        prepare_memory(scene(0), BlendedTeacher(scene(0)), tmp_path, prepare=config)
