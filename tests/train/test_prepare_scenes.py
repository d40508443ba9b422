"""Preparation for several teachers: scenes for each teacher that they have, and classes of training scenes alone."""

import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from joint_training import DenseTeacher
from training_scenes import PREPARE, SideTeacher, scene

from gsencoder.core.errors import InputError, SceneWarning, renamed_options
from gsencoder.core.process import ProcessRank
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.build import words_by_teacher
from gsencoder.teachers.labels import LabelsConfig, PaletteConfig
from gsencoder.teachers.onnx import OnnxConfig
from gsencoder.train import prepare_scenes as module
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.prepare_scenes import SceneReader, SourceConfig, prepare_scenes
from gsencoder.types import Scene

LACKING = {"coded": {"wall_1"}, "dense": {"wall_0", "wall_3"}}
WALLS = [Path(f"wall_{number}") for number in range(4)]


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


@pytest.fixture(autouse=True)
def _reader(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SceneReader", Reader)
    for each in TEACHERS.values():
        monkeypatch.setattr(type(each), "needs_images", False)


def prepare(folder: Path) -> dict[str, PreparedDataset]:
    config = SourceConfig(teachers={name: PaletteConfig() for name in TEACHERS}, prepare=PREPARE)
    with pytest.warns(SceneWarning, match="scenes lack what it needs"):
        return prepare_scenes(WALLS[:3], WALLS[3:], {}, config, folder, voxel=0.1)


def test_a_scene_is_prepared_for_each_teacher_that_it_has_and_again_where_its_file_was_removed(
    tmp_path: Path,
) -> None:
    datasets = prepare(tmp_path)
    paths = {}
    for name, dataset in datasets.items():
        assert dataset.load_space()[0].space == TEACHERS[name].space
        files = {path.stem: path for path in (dataset.folder / "scenes").iterdir()}
        assert set(files) == {wall.name for wall in WALLS} - LACKING[name]
        paths |= {(name, wall): path for wall, path in files.items()}
        # Classes are counted over the scenes to train on, and not over those held out.
        seen = [np.count_nonzero(each.weights) for each in dataset.scenes([wall.name for wall in WALLS[:3]])]
        assert dataset.load_class_balance().counts.sum() == sum(seen)
    for removed in paths.values():
        content = removed.read_bytes()
        before = {path: path.stat().st_mtime_ns for path in paths.values() if path != removed}
        removed.unlink()
        prepare(tmp_path)
        assert removed.read_bytes() == content
        assert {path: path.stat().st_mtime_ns for path in before} == before


class PathOfModel(Reader):
    """Names options as the errors of a single teacher do."""

    def teacher(self, name: str, of: Scene) -> Any:
        raise InputError("teacher.model: no file at teacher.onnx or a/teacher.model; lower teacher.size= or more")


@pytest.mark.parametrize("name", ["palette", "clip"])
def test_errors_name_the_options_of_one_of_several_teachers_as_they_are_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(module, "SceneReader", PathOfModel)
    typed = rf"teachers\.{name}\.model: no file at teacher\.onnx or a/teacher\.model; lower teachers\.{name}\.size="
    config = SourceConfig(teachers={name: OnnxConfig(), "dense": PaletteConfig()}, prepare=PREPARE)
    with pytest.raises(InputError, match=typed):
        prepare_scenes(WALLS[:1], [], {}, config, tmp_path / "several", voxel=0.1)
    with pytest.raises(InputError, match=typed):
        prepare_scenes(WALLS[:1], [], {}, SourceConfig(teachers={name: OnnxConfig()}), tmp_path / "one", voxel=0.1)
    with pytest.raises(InputError, match="^teacher.model: no file"):
        prepare_scenes(WALLS[:1], [], {}, SourceConfig(teacher=OnnxConfig()), tmp_path / "single", voxel=0.1)


def test_errors_of_words_name_the_options_of_one_of_several_teachers_as_they_are_typed() -> None:
    config = LabelsConfig(words="none.safetensors")
    for teachers, members, option in (
        ({"labels": config, "palette": PaletteConfig()}, False, "teachers.labels.words"),
        ({"things": config}, True, "teachers.things.words"),
        ({"labels": config}, False, "teacher.words"),
    ):
        with pytest.raises(InputError, match=f"^{option}: no file"):
            words_by_teacher(teachers, members=members)


def test_options_are_renamed_at_the_beginning_of_words_in_errors_of_the_same_kind() -> None:
    renamed = "^teachers.x.words=, teacher.cell or teacher. Not ateacher.words$"
    with pytest.raises(MissingInput, match=renamed), renamed_options("teacher", "teachers.x", ["words"]):
        raise MissingInput("teacher.words=, teacher.cell or teacher. Not ateacher.words")
    unchanged = InputError("teachers.x.words: no file")
    with pytest.raises(InputError) as error, renamed_options("teacher", "teachers.x", ["words"]):
        raise unchanged
    assert error.value is unchanged


def test_names_of_teachers_that_differ_only_in_case_are_refused() -> None:
    with pytest.raises(InputError, match="teachers: labels and LABELS differ only in case"):
        SourceConfig(teachers={name: PaletteConfig() for name in ("labels", "colors", "LABELS")})


@pytest.mark.parametrize("world", [1, 2])
def test_a_process_among_several_says_at_once_why_it_stops(
    world: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise InputError("its own")

    monkeypatch.setattr(module, "_prepare_scene", fails)
    monkeypatch.setattr(Reader, "weights_of_teachers", lambda *_: {})
    config = SourceConfig(teacher=PaletteConfig(), prepare=PREPARE)
    monkeypatch.setattr(Reader, "teacher", lambda *_: TEACHERS["coded"])
    with warnings.catch_warnings(record=True, action="always") as said, pytest.raises(InputError, match="its own"):
        prepare_scenes(WALLS[:1], [], {}, config, tmp_path, voxel=0.1, process=ProcessRank(world_size=world))
    assert [str(each.message) for each in said] == ["process 0 stops: its own"] * (world - 1)


def test_a_preparation_that_is_refused_at_once_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(*_: object, **__: object) -> None:
        raise InputError("no scene")

    monkeypatch.setattr(module, "fit_space", refuses)
    folder = tmp_path / "out.prepared"

    def refused() -> list[str]:
        with pytest.raises(InputError, match="no scene"):
            prepare_scenes(WALLS, [], {}, SourceConfig(prepare=PREPARE), folder, voxel=0.1)
        return [path.name for path in tmp_path.rglob("*")]

    assert refused() == []
    # A folder that was there stays, and so do the settings of an earlier preparation.
    folder.mkdir()
    assert refused() == ["out.prepared"]
    with monkeypatch.context() as patch:
        patch.setattr(module, "_without_remains", lambda _: nullcontext())
        refused()
    assert sorted(refused()) == ["out.prepared", "settings.json"]
