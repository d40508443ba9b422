"""Preparation: one space for all scenes, whole files, and no mixing of two datasets."""

import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import rewrite
from joint_training import DenseTeacher
from memory_scenes import PREPARE as MEMORY_PREPARE
from memory_scenes import BlendedTeacher
from pretend_device import pretended_device
from safetensors.numpy import load_file
from training_scenes import PREPARE, TABLE, DenseSideTeacher, SideTeacher, prepared, samples, scene

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import plain
from gsencoder.core.process import ProcessRank
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.teachers.onnx import OnnxConfig
from gsencoder.train import prepare_scenes as prepare_module
from gsencoder.train.memory import prepare_memory
from gsencoder.train.prepare import PrepareConfig, add_scene, dataset_space, fit_space, prepare_scene, sampled_maps
from gsencoder.train.prepare_scenes import SceneReader, SourceConfig, prepare_scenes, split_scenes
from gsencoder.train.prepared import (
    CODEBOOK_FILE,
    SPACE_FILE,
    PreparedDataset,
    PreparedScene,
    cluster_targets,
    nearest_codes,
)
from gsencoder.train.samples import SamplingConfig, rarity_weights
from gsencoder.types import FeatureMap, FeatureSpace, Scene, Views


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
    rows = np.array([3, 1, 4])
    chosen = one.gaussians(rows)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(chosen, name), getattr(source.gaussians, name)[rows])
    np.testing.assert_array_equal(one.cameras.Ks, source.views.cameras.Ks)
    assert one.view_names == source.views.names
    assert one.metres_per_unit == 1.0
    assert one.up is None


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
    _, names = prepared(tmp_path, count=2, teacher=DenseSideTeacher())
    files = (tmp_path / SPACE_FILE, tmp_path / CODEBOOK_FILE)
    before = [path.read_bytes() for path in files]
    again = PreparedDataset(tmp_path, {"made": "for a test"})
    fit_space(again, [], lambda path: (scene(0), DenseSideTeacher()), PREPARE)
    again.cluster_classes([])
    assert [path.read_bytes() for path in files] == before
    assert again.has_scene(Path(names[0]))
    assert not again.has_scene(Path("wall_7"))
    with pytest.raises(InputError, match=r"prepared with made="):
        PreparedDataset(tmp_path, {"made": "otherwise"})


def test_a_scene_that_was_moved_is_recognized_by_its_files(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path / "prepared", count=1)
    source = tmp_path / "data" / "wall_0"
    (source / "color").mkdir(parents=True)
    for name, size in {"poses.txt": 5, "color/0.jpg": 9}.items():
        (source / name).write_bytes(bytes(size))
    dataset.scene_path("wall_0").unlink()
    add_scene(dataset, scene(0), SideTeacher(), PREPARE, source=source)
    moved = Path(shutil.move(source, tmp_path / "elsewhere" / "wall_0"))
    assert dataset.has_scene(moved)
    (moved / "color" / "0.jpg").write_bytes(bytes(10))
    with pytest.raises(InputError, match="was prepared from"):
        dataset.has_scene(moved)
    (moved / "color" / "0.jpg").write_bytes(bytes(9))
    (moved / "more.jpg").touch()
    with pytest.raises(InputError, match="was prepared from"):
        dataset.has_scene(moved)


def look_at_all(one: PreparedScene) -> None:
    for view in range(len(one.cameras)):
        one.view(view)


DAMAGES: dict[str, tuple[str, Callable[[np.ndarray], Any]]] = {
    "not finite": ("means", lambda array: array[3:].fill(np.nan)),
    "negative": ("weights", lambda array: array[3:].fill(-1)),
    "weights of B": ("weight", lambda array: array[3:].fill(np.nan)),
    "rows of B that go back": ("crow", lambda array: np.copyto(array, array[::-1].copy())),
    "columns of B": ("col", lambda array: array[3:].fill(10_000)),
    "vectors": ("row_targets", lambda array: array[3:].fill(np.nan)),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_values_that_no_preparation_writes_are_told_with_the_file_and_what_to_do(tmp_path: Path, damage: str) -> None:
    dataset, names = prepared(tmp_path, count=1)
    path, (name, change) = dataset.scene_path(names[0]), DAMAGES[damage]
    arrays = load_file(path)
    change(arrays[name])
    rewrite(path, arrays)
    with pytest.raises(InputError, match=rf"{path}: .*; remove the file to prepare the scene again$"):
        look_at_all(dataset.scenes(names)[0])
    arrays[name] = arrays[name][:-1].copy()
    rewrite(path, arrays)
    with pytest.raises(InputError, match=rf"{path}: its arrays do not fit together; remove the file"):
        len(dataset.scenes(names)[0])


def test_scenes_whose_space_is_gone_are_not_taken_for_new_ones(tmp_path: Path) -> None:
    prepared(tmp_path, count=1)
    path = tmp_path / SPACE_FILE
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=f"{path}: .*give another folder as prepared="):
        PreparedDataset(tmp_path, {"made": "for a test"})
    path.unlink()
    with pytest.raises(InputError, match=rf"something else than prepared scenes \(no {SPACE_FILE}\)"):
        PreparedDataset(tmp_path, {"made": "for a test"})


def test_maps_of_a_killed_run_are_neither_used_nor_left(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=1, teacher=DenseSideTeacher())
    path = dataset.scene_path(names[0])
    before = path.read_bytes()
    path.unlink()
    maps = tmp_path / f".maps.{names[0]}"
    maps.mkdir()
    (maps / "map_00000.safetensors").write_bytes(b"of another scene")
    add_scene(dataset, scene(0), DenseSideTeacher(), PREPARE, source=Path(names[0]))
    assert path.read_bytes() == before
    assert not maps.exists()


def test_scenes_of_two_spaces_none_and_a_teacher_that_says_the_same_everywhere_are_refused() -> None:
    class Other(SideTeacher):
        space = FeatureSpace(name="other", channels=4)

    class Blind(DenseSideTeacher):
        def feature_map(self, views: Views, view: int) -> FeatureMap:
            seen = super().feature_map(views, view)
            return replace(seen, features=np.ones_like(seen.features))

    teachers = iter([SideTeacher(), Other()])
    with pytest.raises(InputError, match="several feature spaces"):
        dataset_space([Path("a"), Path("b")], lambda path: (scene(0), next(teachers)), PREPARE)
    with pytest.raises(InputError, match="no scenes"):
        dataset_space([], lambda path: (scene(0), SideTeacher()), PREPARE)
    with pytest.raises(InputError, match="gives the same features everywhere"):
        dataset_space([Path("a")], lambda path: (scene(0), Blind()), PREPARE)


def test_rarity_gives_each_class_its_power_of_the_count_and_a_mean_of_one() -> None:
    codes = np.repeat([0, 1, -1, 4], [100, 25, 10, 1])
    weights = rarity_weights(codes, 0.5)
    assert weights[100] / weights[0] == pytest.approx(2.0, rel=1e-5)
    assert weights[-1] / weights[0] == pytest.approx(10.0, rel=1e-5)
    assert (weights[codes < 0] == 0).all()
    assert weights[codes >= 0].mean() == pytest.approx(1.0, rel=1e-5)
    np.testing.assert_array_equal(rarity_weights(codes, 0.0), codes >= 0)
    assert (rarity_weights(np.full(3, -1), 1.0) == 0).all()
    assert rarity_weights(codes[:0], 1.0).shape == (0,)


def test_a_target_has_the_class_of_the_nearest_vector() -> None:
    codebook = np.array([[0, 0], [10, 0]], np.float32)
    targets = np.array([[1, 5], [9, -3], [6, 0]], np.float32)
    assert nearest_codes(codebook, targets).tolist() == [0, 1, 1]
    assert nearest_codes(codebook, targets[:0]).shape == (0,)


def test_clusters_stand_for_names_where_there_are_none() -> None:
    rng = np.random.default_rng(0)
    sample = np.concatenate([rng.normal(center, 0.01, (50, 2)) for center in (0, 5, 10)]).astype(np.float32)
    book = cluster_targets(sample)
    assert np.abs(book[nearest_codes(book, sample)] - sample).max() < 0.1


@pytest.mark.parametrize("teacher", [SideTeacher(), DenseSideTeacher()], ids=["coded", "dense"])
@pytest.mark.parametrize(("center", "scale"), [(True, True), (True, False), (False, True), (False, False)])
def test_targets_are_centered_and_scaled_only_where_that_is_asked(teacher, center, scale):
    config = replace(PREPARE, basis_views=2, center=center, scale=scale)
    outputs, codebook, _ = dataset_space([Path("a")], lambda path: (scene(0), teacher), config)
    expected = (TABLE - (outputs.mean if center else 0)) / (outputs.scale / 2 if scale else 1)
    np.testing.assert_allclose(outputs.standardize(TABLE), expected, atol=1e-5)
    if codebook is not None:
        order = np.lexsort(TABLE.T[::-1])
        np.testing.assert_allclose(codebook, expected[order], atol=1e-5)


@pytest.mark.parametrize("teacher", [SideTeacher(), DenseSideTeacher()], ids=["coded", "dense"])
def test_a_scene_that_is_prepared_on_another_device_is_the_same_within_rounding(tmp_path, teacher):
    dataset, _ = prepared(tmp_path, count=1)
    outputs = dataset.load_space()[0]
    prepare_scene(tmp_path / "cpu.safetensors", scene(0), teacher, outputs, PREPARE)
    with pretended_device() as device:
        prepare_scene(tmp_path / "device.safetensors", scene(0), teacher, outputs, PREPARE, device=device)
    here, there = PreparedScene(tmp_path / "cpu.safetensors"), PreparedScene(tmp_path / "device.safetensors")
    rows = np.arange(len(here))
    np.testing.assert_allclose(there.weights, here.weights, rtol=1e-4, atol=1e-4)
    seen = np.asarray(here.weights) > 1e-3
    np.testing.assert_allclose(there.targets(rows)[seen], here.targets(rows)[seen], atol=2e-3)
    for view in range(2):
        one, other = here.view(view), there.view(view)
        np.testing.assert_array_equal(other.crow, one.crow)
        np.testing.assert_array_equal(other.col, one.col)
        np.testing.assert_allclose(other.weight, one.weight, atol=2e-4)  # They are stored as float16.


def test_cells_of_the_render_loss_that_a_mask_cuts_are_not_valid(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path, count=1)
    masked = scene(0)
    # Of 48 × 40 pixels in cells of 4, the first two columns of cells and half of the third are masked.
    mask = np.broadcast_to(np.arange(48) >= 10, (40, 48)).copy()
    masked = replace(masked, views=replace(masked.views, masks=[mask, np.ones((40, 48), bool)]))
    path = tmp_path / "masked.safetensors"
    prepare_scene(path, masked, SideTeacher(), dataset.load_space()[0], PREPARE)
    np.testing.assert_array_equal(PreparedScene(path).view(0).valid.reshape(10, 12).sum(axis=0), [0] * 3 + [10] * 9)
    assert PreparedScene(path).view(1).valid.all()


class CornerTeacher(SideTeacher):
    """Says of the lower third of the left half of a picture that it is one thing, and of the rest another."""

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        height, width = int(views.cameras.heights[view]), int(views.cameras.widths[view])
        codes = np.full((height, width), 2, np.int32)
        codes[height - 12 :, : width // 2] = 1
        return replace(super().feature_map(views, view), codes=codes)


def test_cells_of_the_render_loss_lie_where_their_pixels_do(tmp_path: Path) -> None:
    dataset, _ = prepared(tmp_path, count=1)
    outputs, path = dataset.load_space()[0], tmp_path / "corner.safetensors"
    prepare_scene(path, scene(0), CornerTeacher(), outputs, PREPARE)
    vectors = outputs.restore(PreparedScene(path).view(0).targets).reshape(10, 12, 4)
    expected = np.broadcast_to(TABLE[2], (10, 12, 4)).copy()
    expected[7:, :6] = TABLE[1]
    np.testing.assert_allclose(vectors, expected, atol=5e-3)


def test_gaussians_that_are_left_after_dropping_keep_their_own_targets(tmp_path, monkeypatch):
    dataset, names = prepared(tmp_path, count=1)
    monkeypatch.setattr("gsencoder.train.samples.drop_random", lambda rows, share, rng: rows[1::3])
    data = samples(dataset, names, sampling=SamplingConfig(views=2, gaussians=0))
    (part,) = dataset.scenes(names)
    rows, sample = np.arange(len(part))[1::3], data[0]
    (own,) = sample.teachers
    assert len(sample.attributes) == len(rows)
    targets, codebook = part.targets(rows), data.recipe.teachers[0].codebook
    np.testing.assert_array_equal(own.targets.numpy(), targets)
    codes = np.where(part.weights[rows] > 0, nearest_codes(codebook, targets), -1)
    weights = rarity_weights(codes, data.recipe.losses.rarity)
    np.testing.assert_allclose(own.loss_weights.numpy(), weights, rtol=1e-6)
    # The side of the wall that a Gaussian is on shows in its color, and in its target.
    far = np.abs(part.means[rows, 0]) > 0.3
    red = part.gaussians(rows).sh[:, 0, 0] > 0
    np.testing.assert_array_equal(own.targets.numpy()[far, 0] > own.targets.numpy()[far, 1], red[far])


HALF_STEP = 0.5 / 127
"""The largest error of a value of eight bits, as a share of the largest one in its column."""
FLOAT16 = 2.0**-11
"""The largest relative error of a value that is rounded to float16."""


class UnevenTeacher(DenseSideTeacher):
    """Channels of very different size, with a vector of its own in each cell."""

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        noise = np.random.default_rng(view).normal(size=(20, 24, 4)) * [10, 1, 0.1, 0.01]
        return replace(super().feature_map(views, view), features=noise.astype(np.float32))


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[PreparedScene, PreparedScene]:
    """A scene prepared with targets of float16, and the same with int8."""
    folder = tmp_path_factory.mktemp("both")
    dataset, (name,) = prepared(folder / "float16", count=1, teacher=UnevenTeacher())
    outputs, path = dataset.load_space()[0], folder / "wall_0.safetensors"
    config = replace(PREPARE, targets="int8")
    prepare_scene(path, scene(0), UnevenTeacher(), outputs, config, source=Path("wall_0"))
    return dataset.scenes([name])[0], PreparedScene(path)


def assert_within_half_a_step(rounded: np.ndarray, exact: np.ndarray) -> None:
    error, largest = np.abs(rounded.astype(np.float64) - exact), np.abs(exact).max(axis=0)
    allowed = HALF_STEP * largest + 2 * FLOAT16 * np.abs(exact).clip(1e-4)
    assert (error <= allowed).all()
    # It is not float16 after all.
    assert (error.max(axis=0) > HALF_STEP / 2 * largest).all()


def test_targets_and_the_vectors_of_rows_are_within_half_a_step_of_float16(both):
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


def test_a_scene_of_the_other_type_in_a_folder_is_refused(both, tmp_path):
    for config, fits, other in ((PREPARE, *both), (replace(PREPARE, targets="int8"), *reversed(both))):
        dataset = PreparedDataset(tmp_path / config.targets, {"prepare": plain(config)})
        path = dataset.scene_path("wall_0")
        path.parent.mkdir(parents=True)
        path.write_bytes(fits.path.read_bytes())
        assert dataset.has_scene(Path("wall_0"))
        path.write_bytes(other.path.read_bytes())
        with pytest.raises(InputError, match=f"{path}: expected targets of {fits.precision}, .*got {other.precision}"):
            dataset.has_scene(Path("wall_0"))


def test_a_memory_reads_its_features_from_its_targets_and_refuses_eight_bits(tmp_path: Path) -> None:
    config = replace(MEMORY_PREPARE, targets="int8")
    with pytest.raises(InputError, match=r"prepare\.targets: expected float16"):
        prepare_memory(scene(0), BlendedTeacher(scene(0)), tmp_path, prepare=config)


CHANNELS = 24
NOISE = FeatureSpace(name="noise", channels=CHANNELS, weights="1a2b")
WALLS = [Path(f"wall_{number}") for number in range(5)]


class NoiseTeacher(DenseSideTeacher):
    """Vectors about a mean that is long against their spread, others in each scene; counts the maps that it makes."""

    space = NOISE

    def __init__(self, number: int, made: list[int] | None = None) -> None:
        self.number, self.made = number, made

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        if self.made is not None:
            self.made.append(self.number)
        rng = np.random.default_rng([self.number, view])
        features = (50 + self.number + rng.normal(size=(20, 24, CHANNELS)) @ np.diag(np.arange(CHANNELS) + 1)) / 10
        return replace(super().feature_map(views, view), features=features.astype(np.float32), space=self.space)


class NamedTeacher(SideTeacher):
    """A coded teacher with a name, and a vector, of its own in each scene."""

    def __init__(self, number: int) -> None:
        self.kinds = ("wall", f"poster {number}")
        self.table = np.vstack((SideTeacher.table, np.full(4, number, np.float32)))
        self.mean = None  # type: ignore[assignment]


def opener(teacher: Callable[[int], Any]) -> Callable[[Path], tuple[Scene, Any]]:
    def open_scene(path: Path) -> tuple[Scene, Any]:
        number = int(path.name[5:])
        return scene(number, 50), teacher(number)

    return open_scene


def test_the_space_of_a_coded_teacher_has_the_names_of_all_scenes() -> None:
    _, codebook, kinds = dataset_space(WALLS, opener(NamedTeacher), PREPARE)
    assert kinds == ("wall", *(f"poster {number}" for number in range(5)))
    assert codebook is not None
    assert len(codebook) == len(SideTeacher.table) + 5


def test_the_basis_is_of_the_maps_of_the_scenes_that_have_the_teacher(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_module("gsencoder.fusion.fuse"), "NARROW", 0)

    def open_scene(path: Path) -> tuple[Scene, Any]:
        if path.name in ("wall_0", "wall_3"):
            raise MissingInput("no labels")
        return opener(NoiseTeacher)(path)

    config = PrepareConfig(basis_views=6)
    maps = [each.features.reshape(-1, CHANNELS) for _, _, each in sampled_maps(WALLS, open_scene, 6, optional=True)]
    assert len(maps) == 6
    every = np.concatenate(maps).astype(np.float64)
    outputs, _, _ = dataset_space(WALLS, open_scene, config, optional=True)
    np.testing.assert_allclose(outputs.mean, every.mean(axis=0), rtol=1e-6)
    assert outputs.scale**2 == pytest.approx(np.trace(np.cov(every.T, bias=True)), rel=1e-5)
    values, vectors = np.linalg.eigh(np.cov(every.T, bias=True))
    np.testing.assert_allclose(np.abs(outputs.basis.components[0] @ vectors[:, values.argmax()]), 1, atol=1e-4)
    with pytest.raises(MissingInput, match="no scene to train on has what it needs; the first one: .*no labels"):
        dataset_space(WALLS[:1], open_scene, config, optional=True)
    with pytest.raises(MissingInput, match="no labels"):
        dataset_space(WALLS, open_scene, config)


LACKING = {"coded": {"wall_1"}, "dense": {"wall_0", "wall_3"}}


TEACHERS: dict[str, Any] = {"coded": SideTeacher(), "dense": DenseTeacher()}


class Reader(SceneReader):
    """Makes scenes instead of reading them; some lack what a teacher needs."""

    def __init__(self, *_: object) -> None: ...

    def load(self, path: Path) -> Scene:
        return scene(int(path.name[5:]), 200)

    def teacher(self, name: str, of: Scene) -> Any:
        if of.name in LACKING[name]:
            raise MissingInput(f"{of.name} has none")
        return TEACHERS[name]

    def with_views(self, name: str, path: Path) -> tuple[Scene, Any]:
        return self.load(path), self.teacher(name, self.load(path))

    def with_gaussians(self, of: Scene, _: Path) -> Scene:
        return of


@pytest.fixture
def reader(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prepare_module, "SceneReader", Reader)
    for each in TEACHERS.values():
        monkeypatch.setattr(type(each), "needs_images", False)


def prepare_both(folder: Path) -> dict[str, PreparedDataset]:
    config = SourceConfig(teachers={name: PaletteConfig() for name in TEACHERS}, prepare=PREPARE)
    with pytest.warns(SceneWarning, match="scenes lack what it needs"):
        return prepare_scenes(WALLS[:3], WALLS[3:4], {}, config, folder)


@pytest.mark.usefixtures("reader")
def test_a_scene_is_prepared_for_each_teacher_that_it_has_and_again_where_its_file_was_removed(tmp_path):
    datasets = prepare_both(tmp_path)
    paths = {}
    for name, dataset in datasets.items():
        assert dataset.load_space()[0].space == TEACHERS[name].space
        files = {path.stem: path for path in (dataset.folder / "scenes").iterdir()}
        assert set(files) == {wall.name for wall in WALLS[:4]} - LACKING[name]
        paths |= {(name, wall): path for wall, path in files.items()}
    for removed in paths.values():
        content = removed.read_bytes()
        before = {path: path.stat().st_mtime_ns for path in paths.values() if path != removed}
        removed.unlink()
        prepare_both(tmp_path)
        assert removed.read_bytes() == content
        assert {path: path.stat().st_mtime_ns for path in before} == before


class PathOfModel(Reader):
    """Names options as the errors of a single teacher do."""

    def teacher(self, name: str, of: Scene) -> Any:
        raise InputError("teacher.model: no file at teacher.onnx or a/teacher.model; lower teacher.size= or more")


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("name", ["palette", "clip"])
def test_errors_name_the_options_of_one_of_several_teachers_as_they_are_typed(tmp_path, monkeypatch, name):
    monkeypatch.setattr(prepare_module, "SceneReader", PathOfModel)
    typed = rf"teachers\.{name}\.model: no file at teacher\.onnx or a/teacher\.model; lower teachers\.{name}\.size="
    config = SourceConfig(teachers={name: OnnxConfig(), "dense": PaletteConfig()}, prepare=PREPARE)
    with pytest.raises(InputError, match=typed):
        prepare_scenes(WALLS[:1], [], {}, config, tmp_path / "several")
    with pytest.raises(InputError, match=typed):
        prepare_scenes(WALLS[:1], [], {}, SourceConfig(teachers={name: OnnxConfig()}), tmp_path / "one")
    with pytest.raises(InputError, match="^teacher.model: no file"):
        prepare_scenes(WALLS[:1], [], {}, SourceConfig(teacher=OnnxConfig()), tmp_path / "single")


def test_names_of_teachers_that_differ_only_in_case_are_refused() -> None:
    with pytest.raises(InputError, match="teachers: labels and LABELS differ only in case"):
        SourceConfig(teachers={name: PaletteConfig() for name in ("labels", "colors", "LABELS")})


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("world", [1, 2])
def test_a_process_among_several_says_at_once_why_it_stops(world, tmp_path, monkeypatch):
    def fails(*_: object, **__: object) -> None:
        raise InputError("its own")

    monkeypatch.setattr(prepare_module, "_prepare_scene", fails)
    monkeypatch.setattr(Reader, "weights_of_teachers", lambda *_: {})
    config = SourceConfig(teacher=PaletteConfig(), prepare=PREPARE)
    monkeypatch.setattr(Reader, "teacher", lambda *_: TEACHERS["coded"])
    with warnings.catch_warnings(record=True, action="always") as said, pytest.raises(InputError, match="its own"):
        prepare_scenes(WALLS[:1], [], {}, config, tmp_path, process=ProcessRank(world_size=world))
    assert [str(each.message) for each in said] == ["process 0 stops: its own"] * (world - 1)


SCANS = [Path("data") / f"scene{number:04d}_00" for number in range(6)]


def split_file(path: Path, *numbers: int) -> Path:
    path.write_text("".join(f"scene{number:04d}_00\n" for number in numbers))
    return path


def numbers(scenes: list[Path]) -> list[int]:
    return [SCANS.index(scene) for scene in scenes]


def test_files_name_the_scenes_to_train_on_and_to_hold_out_and_others_are_left_out(tmp_path: Path) -> None:
    train, val = split_file(tmp_path / "train.txt", 4, 1), split_file(tmp_path / "val.txt", 3)
    assert tuple(map(numbers, split_scenes(SCANS, (), train, val))) == ([4, 1], [3])
    assert tuple(map(numbers, split_scenes(SCANS, (), None, val))) == ([0, 1, 2, 4, 5], [3])
    assert tuple(map(numbers, split_scenes(SCANS, (), train))) == ([4, 1], [])
    # Patterns hold out of what a file names to train on.
    assert tuple(map(numbers, split_scenes(SCANS, ("*4_00",), train))) == ([1], [4])


def test_what_splits_contradict_is_refused(tmp_path: Path) -> None:
    train, val = split_file(tmp_path / "train.txt", 0, 9, 8), split_file(tmp_path / "val.txt", 1, 2)
    with pytest.raises(InputError, match=r"split=.*train.txt: 2 of its 3 scenes are not among .* 'scene0009_00'"):
        split_scenes(SCANS, (), train, val)
    with pytest.raises(InputError, match=r"holdout_split=.*val.txt: 1 of its scenes are in split= too, .*0001_00"):
        split_scenes(SCANS, (), split_file(train, 0, 1), val)
    with pytest.raises(InputError, match=r"expected holdout= or holdout_split=, got both"):
        split_scenes(SCANS, ("*",), None, val)
    with pytest.raises(InputError, match="at least one must remain"):
        split_scenes(SCANS, (), None, split_file(val, *range(6)))
    with pytest.raises(InputError, match="two scenes are called 'scene0000_00'"):
        split_scenes([*SCANS, Path("other") / "scene0000_00"], ())
