"""Preparation: one space for all scenes, whole files, and no mixing of two datasets."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from archives import rewrite
from safetensors.numpy import load_file
from training_scenes import PREPARE, SPACE, TABLE, DenseSideTeacher, SideTeacher, prepared, scene

from gsencoder.core.archive import write_archive
from gsencoder.core.errors import InputError
from gsencoder.core.process import untracked
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.train.prepare import (
    CLASS_BALANCE_FILE,
    DATASET_SETTINGS_FILE,
    SPACE_FILE,
    ClassBalance,
    PrepareConfig,
    PreparedDataset,
    cluster_targets,
    count_targets,
    nearest_codes,
    prepare_scene,
)
from gsencoder.train.prepared_file import PreparedScene
from gsencoder.train.space import dataset_space, fit_space
from gsencoder.types import FeatureMap, FeatureSpace, Views


@pytest.mark.parametrize("name", ["render_cell", "basis_views"])
def test_cells_and_views_are_one_or_more(name: str) -> None:
    assert getattr(PrepareConfig(**{name: 1}), name) == 1
    with pytest.raises(InputError, match=f"{name}: expected 1 or more, got 0"):
        PrepareConfig(**{name: 0})


def test_targets_are_the_fused_features_in_standard_units(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=1)
    outputs, codebook = dataset.load_space()
    one = dataset.scenes(names)[0]
    fused = fuse(scene(0), SideTeacher(), FuseConfig(basis=False)).features
    rows = np.flatnonzero(fused.seen)
    np.testing.assert_array_equal(np.flatnonzero(one.weights), rows)
    np.testing.assert_allclose(outputs.restore(one.targets(rows)), fused.features[rows], atol=5e-3)
    assert codebook is not None
    kinds = {tuple(row) for row in np.round(outputs.restore(codebook), 4).tolist()}
    assert kinds == {tuple(row) for row in TABLE.tolist()}


def test_a_prepared_scene_gives_back_its_gaussians_and_cameras(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=1)
    one, source = dataset.scenes(names)[0], scene(0)
    assert source.gaussians is not None
    assert source.views is not None
    rows = np.array([3, 1, 4])
    chosen = one.gaussians(rows)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(chosen, name), getattr(source.gaussians, name)[rows])
    np.testing.assert_array_equal(one.cameras.Ks, source.views.cameras.Ks)
    assert one.view_names == source.views.names
    assert one.metres_per_unit == 1.0
    assert one.up is None


def test_cells_of_the_render_loss_hold_the_mean_of_their_pixels(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=1)
    outputs, _ = dataset.load_space()
    view = dataset.scenes(names)[0].view(0)
    assert len(view.valid) == 12 * 10
    assert view.valid.all()
    vectors = outputs.restore(view.targets).reshape(10, 12, 4)
    np.testing.assert_allclose(vectors[:, :6], np.broadcast_to(TABLE[1], (10, 6, 4)), atol=5e-3)
    np.testing.assert_allclose(vectors[:, 6:], np.broadcast_to(TABLE[2], (10, 6, 4)), atol=5e-3)


def test_rows_of_some_views_are_stored_as_those_of_all_would_be_and_targets_are_of_all(tmp_path: Path) -> None:
    of_all, (name,) = prepared(tmp_path / "all", count=1)
    whole = of_all.scenes([name])[0]
    path = tmp_path / "some.safetensors"
    prepare_scene(path, scene(0), SideTeacher(), of_all.load_space()[0], replace(PREPARE, render_views=1))
    some = PreparedScene(path)
    assert (some.view_names, len(whole.view_names)) == (whole.view_names[:1], 2)
    rows = np.arange(len(whole))
    np.testing.assert_array_equal(some.targets(rows), whole.targets(rows))
    for field in ("crow", "col", "weight", "targets", "valid"):
        np.testing.assert_array_equal(getattr(some.view(0), field), getattr(whole.view(0), field))
    assert len(some.cameras) == 1
    np.testing.assert_array_equal(some.cameras.Ks[0], whole.cameras.Ks[0])
    with pytest.raises(InputError, match=r"render_views: expected 0 or more, got -1"):
        PrepareConfig(render_views=-1)


def test_what_is_prepared_is_not_prepared_again(tmp_path: Path) -> None:
    _, names = prepared(tmp_path, count=2)
    files = (tmp_path / SPACE_FILE, tmp_path / CLASS_BALANCE_FILE)
    before = [path.read_bytes() for path in files]
    again = PreparedDataset(tmp_path, {"made": "for a test"})
    fit_space(again, [], lambda path: (scene(0), SideTeacher()), PREPARE)
    again.count_classes([], untracked)
    assert [path.read_bytes() for path in files] == before
    assert again.has_scene(Path(names[0]))
    assert not again.has_scene(Path("wall_7"))


def test_another_scene_of_a_prepared_name_is_refused(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path / "prepared", count=1)
    with pytest.raises(InputError, match=f"was prepared from .*{names[0]}, but this run uses .*elsewhere.*{names[0]}"):
        dataset.has_scene(tmp_path / "elsewhere" / names[0])


def test_a_scene_that_was_moved_is_recognized_by_its_files(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path / "prepared", count=1)
    source = tmp_path / "data" / "wall_0"
    (source / "color").mkdir(parents=True)
    for name, size in {"poses.txt": 5, "color/0.jpg": 9}.items():
        (source / name).write_bytes(bytes(size))
    dataset.scene_path("wall_0").unlink()
    dataset.prepare(scene(0), SideTeacher(), PREPARE, source=source)
    moved = Path(shutil.move(source, tmp_path / "elsewhere" / "wall_0"))
    assert dataset.has_scene(moved)
    (moved / "color" / "0.jpg").write_bytes(bytes(10))
    with pytest.raises(InputError, match="was prepared from"):
        dataset.has_scene(moved)
    (moved / "color" / "0.jpg").write_bytes(bytes(9))
    (moved / "more.jpg").touch()
    with pytest.raises(InputError, match="was prepared from"):
        dataset.has_scene(moved)


def test_what_is_there_is_opened_without_settings_and_nothing_is_made(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path / "prepared", count=1)
    assert PreparedDataset(tmp_path / "prepared").settings == dataset.settings
    with pytest.raises(InputError, match=f"expected prepared scenes, found no {DATASET_SETTINGS_FILE}"):
        PreparedDataset(tmp_path / "nothing")
    assert not (tmp_path / "nothing").exists()


def test_a_folder_of_another_dataset_is_refused_and_the_setting_named(tmp_path: Path) -> None:
    prepared(tmp_path, count=1)
    with pytest.raises(InputError, match=r"prepared with made="):
        PreparedDataset(tmp_path, {"made": "otherwise"})


def test_settings_that_cannot_be_read_are_an_error_with_the_folder(tmp_path: Path) -> None:
    (tmp_path / DATASET_SETTINGS_FILE).write_text("{")
    with pytest.raises(InputError, match=str(tmp_path)):
        PreparedDataset(tmp_path, {})


def test_a_damaged_scene_is_told_with_its_file(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=1)
    path = dataset.scene_path(names[0])
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=str(path)):
        len(dataset.scenes(names)[0])


def set_nan(array: np.ndarray) -> None:
    array[3] = np.nan


def set_negative(array: np.ndarray) -> None:
    array[3] = -1


def set_too_large(array: np.ndarray) -> None:
    array[3] = 10_000


def clear(array: np.ndarray) -> None:
    array[:] = 0


def turn_round(array: np.ndarray) -> None:
    array[:] = array[::-1].copy()


def look_at_all(one: PreparedScene) -> None:
    for view in range(len(one.cameras)):
        one.view(view)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("means", set_nan),
        ("weights", set_nan),
        ("weights", set_negative),
        ("weight", set_nan),
        ("weight", set_negative),
        ("crow", clear),
        ("crow", turn_round),
        ("rows", clear),
        ("rows", turn_round),
        ("col", set_negative),
        ("col", set_too_large),
        ("row_targets", set_nan),
    ],
)
def test_values_that_no_preparation_writes_are_told_with_the_file_and_what_to_do(
    tmp_path: Path, name: str, change: Callable[[np.ndarray], None]
) -> None:
    dataset, names = prepared(tmp_path, count=1)
    path = dataset.scene_path(names[0])
    arrays = load_file(path)
    change(arrays[name])
    rewrite(path, arrays)
    with pytest.raises(InputError, match=rf"{path}: .*; remove the file to prepare the scene again$"):
        look_at_all(dataset.scenes(names)[0])


@pytest.mark.parametrize("name", ["quats", "targets", "weights", "crow", "col", "row_valid", "means"])
def test_arrays_that_do_not_fit_together_are_told_with_the_file(tmp_path: Path, name: str) -> None:
    dataset, names = prepared(tmp_path, count=1)
    path = dataset.scene_path(names[0])
    arrays = load_file(path)
    rewrite(path, {**arrays, name: arrays[name][:-1].copy()})
    with pytest.raises(InputError, match=rf"{path}: its arrays do not fit together; remove the file"):
        len(dataset.scenes(names)[0])


@pytest.mark.parametrize("text", ["null", "[]", "3", '"x"', "[" * 100_000])
def test_settings_that_are_none_are_refused(tmp_path: Path, text: str) -> None:
    prepared(tmp_path, count=1)
    (tmp_path / DATASET_SETTINGS_FILE).write_text(text)
    with pytest.raises(InputError, match=rf"{DATASET_SETTINGS_FILE}: .*give another folder as prepared="):
        PreparedDataset(tmp_path, {"made": "for a test"})


def test_scenes_whose_settings_or_space_are_gone_are_not_taken_for_new_ones(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path, count=1)
    (tmp_path / SPACE_FILE).unlink()
    with pytest.raises(InputError, match="not the space that they were prepared for"):
        fit_space(dataset, [Path("wall_0")], lambda path: (scene(0), SideTeacher()), PREPARE)
    (tmp_path / DATASET_SETTINGS_FILE).unlink()
    with pytest.raises(InputError, match=rf"something else than prepared scenes \(no {DATASET_SETTINGS_FILE}\)"):
        PreparedDataset(tmp_path, {"made": "for a test"})


@pytest.mark.parametrize("columns", [3, 5])
def test_kinds_of_another_width_are_refused(tmp_path: Path, columns: int) -> None:
    dataset, _ = prepared(tmp_path, count=1)
    arrays = {"codebook": np.zeros((2, columns), np.float32), "counts": np.ones(2)}
    write_archive(tmp_path / CLASS_BALANCE_FILE, arrays, {})
    with pytest.raises(InputError, match="remove the file to count targets again"):
        dataset.load_class_balance()


def test_scenes_of_two_spaces_are_refused() -> None:
    class Other(SideTeacher):
        space = FeatureSpace(name="other", channels=4)

    teachers = iter([SideTeacher(), Other()])
    with pytest.raises(InputError, match="several feature spaces"):
        dataset_space([Path("a"), Path("b")], lambda path: (scene(0), next(teachers)), FuseConfig(), views=2)
    with pytest.raises(InputError, match="no scenes"):
        dataset_space([], lambda path: (scene(0), SideTeacher()), FuseConfig(), views=2)


def test_the_space_of_a_dense_teacher_has_the_moments_of_its_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_module("gsencoder.fusion.fuse"), "NARROW", 0)
    space = dataset_space([Path("a"), Path("b")], lambda path: (scene(0), DenseSideTeacher()), FuseConfig(), views=4)
    assert space.codebook is None
    outputs = space.outputs
    np.testing.assert_allclose(outputs.mean, (TABLE[1] + TABLE[2]) / 2, atol=1e-5)
    assert outputs.scale == pytest.approx(np.sqrt(0.5), rel=1e-4)
    assert outputs.basis is not None
    assert outputs.basis.rank == 1  # Two vectors lie on one line.
    assert outputs.space == SPACE


def test_a_teacher_that_says_the_same_everywhere_is_refused() -> None:
    class Blind(DenseSideTeacher):
        def feature_map(self, views: Views, view: int) -> FeatureMap:
            seen = super().feature_map(views, view)
            assert seen.features is not None
            return replace(seen, features=np.ones_like(seen.features))

    with pytest.raises(InputError, match="gives the same features everywhere"):
        dataset_space([Path("a")], lambda path: (scene(0), Blind()), FuseConfig(), views=2)


def test_rarity_gives_each_kind_its_power_of_the_count_and_a_mean_of_one() -> None:
    balance = ClassBalance(codebook=np.eye(3, dtype=np.float32), counts=np.array([100.0, 25.0, 0.0]))
    weights = balance.class_weights(0.5)
    assert weights[1] / weights[0] == pytest.approx(2.0, rel=1e-5)
    assert (weights * balance.counts).sum() / 125 == pytest.approx(1.0, rel=1e-5)
    assert weights[2] == weights[0]  # A cell between kinds may be nearest to one that no Gaussian has.
    assert (balance.class_weights(0.0) == 1).all()


def test_targets_are_counted_by_the_nearest_vector() -> None:
    codebook = np.array([[0, 0], [10, 0]], np.float32)
    targets = np.array([[1, 5], [9, -3], [6, 0]], np.float32)
    assert nearest_codes(codebook, targets).tolist() == [0, 1, 1]
    assert count_targets([targets, targets[:1]], codebook).counts.tolist() == [2, 2]
    assert nearest_codes(codebook, targets[:0]).shape == (0,)


def test_clusters_stand_for_names_where_there_are_none() -> None:
    rng = np.random.default_rng(0)
    sample = np.concatenate([rng.normal(center, 0.01, (50, 2)) for center in (0, 5, 10)]).astype(np.float32)
    book = cluster_targets(sample)
    assert np.abs(book[nearest_codes(book, sample)] - sample).max() < 0.1


def test_settings_are_kept_as_json(tmp_path: Path) -> None:
    PreparedDataset(tmp_path / "new", {"a": (1, 2)})
    assert json.loads((tmp_path / "new" / DATASET_SETTINGS_FILE).read_text()) == {"a": [1, 2]}
    PreparedDataset(tmp_path / "new", {"a": (1, 2)})
