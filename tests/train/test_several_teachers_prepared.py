"""Scenes prepared for several teachers: which of them a run takes, and what it reports or refuses."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from joint_training import Datasets, HeightTeacher
from training_scenes import PREPARE, SideTeacher, prepared, scene, small_encoder

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import untracked
from gsencoder.models.output_space import OutputSpaces
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.train.loop import (
    TRAINING_CHECKPOINT_FILE,
    TrainingState,
    check_same_teachers,
    load_checkpoint,
    save_checkpoint,
)
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.prepare_scenes import _check_teachers, teacher_folders
from gsencoder.train.run import TrainConfig, train
from gsencoder.train.samples import TrainingScene
from gsencoder.train.space import dataset_space


def test_other_teachers_than_those_of_a_checkpoint_are_refused_before_and_after_preparation(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.safetensors"
    check_same_teachers(path, ["a", "b", "c"])
    encoder = small_encoder()
    optimizer = torch.optim.AdamW(encoder.parameters())
    stored = {"teachers": ["a", "b"], "spaces": {"a": "1", "b": "2"}}
    save_checkpoint(path, encoder, optimizer, TrainingState(step=1), stored)
    check_same_teachers(path, ["a", "b"])
    for asked in (["a", "b", "c"], ["b", "a"], ["a"]):
        message = re.escape(f"was made with teachers=['a', 'b'], and this run asks teachers={asked};")
        with pytest.raises(InputError, match=f"{message}.*; give resume=false"):
            check_same_teachers(path, asked)
        with pytest.raises(InputError, match=message):
            load_checkpoint(path, encoder, optimizer, {"teachers": asked, "spaces": {}})


def test_a_run_with_another_list_of_teachers_is_refused_before_anything_is_prepared(tmp_path: Path) -> None:
    encoder = small_encoder()
    optimizer = torch.optim.AdamW(encoder.parameters())
    made_with = {"teachers": ["a", "b"]}
    save_checkpoint(tmp_path / TRAINING_CHECKPOINT_FILE, encoder, optimizer, TrainingState(step=1), made_with)
    config = TrainConfig(teachers={name: PaletteConfig() for name in "abc"})
    with pytest.raises(InputError, match="and this run asks teachers="):
        train([tmp_path / "nowhere"], config, work=tmp_path, device="cpu")
    assert not (tmp_path / "prepared").exists()


def test_names_that_a_scene_to_train_on_has_gained_need_other_prepared_scenes(datasets: Datasets) -> None:
    class Named(SideTeacher):
        kinds = ("mug", "teapot")

    class Dense(HeightTeacher):
        kinds = ("mug", "teapot")

    dataset = PreparedDataset(datasets["sides"][0].folder)
    dataset.load_kinds = lambda: ("mug",)  # type: ignore[method-assign]
    with pytest.raises(InputError, match="the classes of this dataset lack teapot, since the scene has changed"):
        dataset.check_kinds(Named())
    dataset.check_kinds(Dense())
    dataset.load_kinds = lambda: ("teapot", "mug")  # type: ignore[method-assign]
    dataset.check_kinds(Named())


def test_classes_are_counted_again_when_a_scene_gains_the_teacher(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=2)
    before = dataset.load_class_balance().counts.sum()
    dataset.count_classes(names, untracked)
    assert dataset.load_class_balance().counts.sum() == before
    dataset.prepare(scene(2), SideTeacher(), PREPARE, source=Path("wall_2"))
    dataset.count_classes([*names, "wall_2"], untracked)
    assert dataset.load_class_balance().counts.sum() > 1.3 * before


def test_files_of_other_gaussians_are_refused(datasets: Datasets, tmp_path: Path) -> None:
    other, _ = prepared(tmp_path / "other", count=1, teacher=HeightTeacher())
    moved = scene(0)
    assert moved.gaussians is not None
    other.scene_path("wall_0").unlink()
    shifted = replace(moved, gaussians=replace(moved.gaussians, means=moved.gaussians.means + np.float32(1e-3)))
    other.prepare(shifted, HeightTeacher(), PREPARE, source=Path("wall_0"))
    first = datasets["sides"][0].find_scene("wall_0")
    with pytest.raises(InputError, match="has other Gaussians or views than"):
        TrainingScene([first, other.find_scene("wall_0")]).check_consistent()
    with pytest.raises(InputError, match="a scene has no teacher"):
        TrainingScene([None, None])


def test_scenes_without_a_teacher_and_teachers_without_a_scene_are_reported(datasets: Datasets) -> None:
    opened = {name: dataset for name, (dataset, _) in datasets.items()}
    walls = [Path(f"wall_{number}") for number in range(3)]
    with pytest.warns(SceneWarning, match=r"teacher heights: 1 of 3 scenes lack what it needs \(wall_2\)"):
        _check_teachers(opened, walls, [])
    with pytest.raises(InputError, match="1 scenes have none of them, such as 'wall_3'"):
        _check_teachers(opened, [*walls, Path("wall_3")], [])
    with pytest.raises(InputError, match="teacher heights: no scene to train on has it"):
        _check_teachers(opened, walls[2:], walls[:2])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _check_teachers(opened, walls[:1], walls[1:2])


def test_the_space_is_that_of_the_scenes_that_have_the_teacher() -> None:
    def open_scene(path: Path) -> tuple[object, object]:
        if path.name == "bare":
            raise MissingInput("the scene has no labels")
        return scene(0), HeightTeacher()

    arguments = {"config": PREPARE.fusion, "views": 2}
    space = dataset_space([Path("bare"), Path("a")], open_scene, optional=True, **arguments)  # type: ignore[arg-type]
    expected = dataset_space([Path("a")], open_scene, **arguments)  # type: ignore[arg-type]
    np.testing.assert_allclose(space.outputs.mean, expected.outputs.mean, atol=1e-6)
    with pytest.raises(MissingInput, match="no scene to train on has what it needs; the first one: .* no labels"):
        dataset_space([Path("bare")], open_scene, optional=True, **arguments)  # type: ignore[arg-type]
    with pytest.raises(MissingInput, match="no labels"):
        dataset_space([Path("bare"), Path("a")], open_scene, **arguments)  # type: ignore[arg-type]


def test_the_names_of_a_dense_teacher_are_those_of_all_scenes_whose_maps_are_used() -> None:
    def open_scene(path: Path) -> tuple[object, object]:
        teacher = HeightTeacher()
        teacher.kinds = (path.name,)  # type: ignore[attr-defined]
        return scene(0), teacher

    space = dataset_space([Path("mug"), Path("cup")], open_scene, PREPARE.fusion, views=2)  # type: ignore[arg-type]
    assert space.kinds == ("mug", "cup")


def test_scenes_prepared_for_one_teacher_are_not_taken_for_those_of_several(datasets: Datasets) -> None:
    folder = datasets["sides"][0].folder
    assert teacher_folders(folder, ["sides"]) == {"sides": folder}
    with pytest.raises(InputError, match="was prepared for one teacher, and this run has several"):
        teacher_folders(folder, ["sides", "heights"])


def test_scenes_prepared_for_several_teachers_are_not_taken_for_those_of_one(datasets: Datasets) -> None:
    folder = datasets["sides"][0].folder.parent
    assert set(teacher_folders(folder, ["sides", "heights"])) == {"sides", "heights"}
    for name, own in (("sides", "sides"), ("colors", "heights")):
        message = rf"was prepared for several teachers \(heights, sides\), and this run has one; .*/{own}\)"
        with pytest.raises(InputError, match=message):
            teacher_folders(folder, [name])


def test_two_teachers_of_one_feature_space_are_refused(datasets: Datasets) -> None:
    outputs, _ = datasets["sides"][0].load_space()
    with pytest.raises(InputError, match=r"teachers: a and b have the same features \(sides · 4 channels\)"):
        OutputSpaces(by_teacher={"a": outputs, "b": outputs})
    # The same model at two sizes has two spaces of one name, which are named by their teachers.
    other = replace(outputs, space=replace(outputs.space, preprocessing="half size"))
    both = OutputSpaces(by_teacher={"a": outputs, "b": other})
    assert both.resolve("b") == "b"
    with pytest.raises(InputError, match="gives features of a, b; got 'sides'"):
        both.resolve("sides")
