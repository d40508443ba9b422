"""An encoder with several teachers: what each of them contributes is what it contributes alone."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from joint_training import Datasets, HeightTeacher, batch_of, joint
from training_scenes import LOSSES, PREPARE, SHORT, SideTeacher, made, prepared, samples, scene, small_encoder

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.core.settings import first_difference
from gsencoder.models.output_space import OutputSpaces
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.train.loop import (
    TRAINING_CHECKPOINT_FILE,
    TrainingState,
    check_same_teachers,
    load_checkpoint,
    save_checkpoint,
)
from gsencoder.train.losses import Distillation
from gsencoder.train.prepare import add_scene
from gsencoder.train.prepare_scenes import _check_teachers, teacher_folders
from gsencoder.train.prepared import PreparedDataset
from gsencoder.train.run import TrainConfig, encoder_trainer, resume_settings, train
from gsencoder.train.samples import SampleDataset, TrainingScene


def test_terms_and_gradients_of_each_teacher_are_those_of_a_training_with_it_alone(datasets: Datasets) -> None:
    data = joint(datasets)
    batch = batch_of(data, range(6))
    widths = [teacher.channels for teacher in data.recipe.teachers]
    predicted = torch.randn(len(batch.attributes), sum(widths), requires_grad=True)
    both = Distillation(small_encoder(), LOSSES, data.recipe.teachers)
    terms, divisors = both.terms(predicted, batch), both.divisors(batch)
    sum(terms[name] for name in terms).backward()
    for number, name in enumerate(datasets):
        alone = Distillation(small_encoder(), LOSSES, data.recipe.teachers[number : number + 1])
        own = batch._replace(teachers=batch.teachers[number : number + 1])
        part = predicted.detach().split(widths, dim=1)[number].clone().requires_grad_()
        expected = alone.terms(part, own)
        sum(expected.values()).backward()
        assert set(expected) == {"field", "render", "contrast"}
        for term, value in expected.items():
            torch.testing.assert_close(terms[f"{name}/{term}"], value)
            assert divisors[f"{name}/{term}"] == alone.divisors(own)[term]
        assert divisors[f"{name}/render"] == pytest.approx(own.teachers[0].rows.row_weights.sum().item(), rel=1e-6)
        assert divisors[f"{name}/field"] == pytest.approx(own.teachers[0].loss_weights.sum().item(), rel=1e-6)
        torch.testing.assert_close(predicted.grad.split(widths, dim=1)[number], part.grad)
    half = Distillation(small_encoder(8), LOSSES, joint(datasets, {"heights": 0.25}).recipe.teachers).lambdas
    assert half == {name: weight * (0.25 if "heights" in name else 1) for name, weight in both.lambdas.items()}
    first, second = data.recipe.teachers
    without_classes = Distillation(small_encoder(8), LOSSES, (first, replace(second, classes=False))).lambdas
    assert without_classes == {name: weight for name, weight in both.lambdas.items() if name != "heights/contrast"}


def test_samples_have_the_targets_of_each_teacher_for_the_same_gaussians(datasets: Datasets) -> None:
    data = joint(datasets)
    for number, (name, (dataset, names)) in enumerate(datasets.items()):
        # A teacher alone draws other centers, by its own classes, unless all Gaussians are in each sample.
        everything = {"sampling": replace(data.recipe.sampling, gaussians=0)}
        together = SampleDataset(data.scenes[:2], replace(data.recipe, **everything))
        alone = samples(dataset, names[:2], **everything)
        assert together[0].name == alone[0].name
        theirs, (ours,) = together[0].teachers[number], alone[0].teachers
        torch.testing.assert_close(theirs.targets, ours.targets)
        torch.testing.assert_close(theirs.loss_weights, ours.loss_weights)
        torch.testing.assert_close(theirs.codes, ours.codes)
        for one, other in zip(theirs.rows, ours.rows, strict=True):
            torch.testing.assert_close(one, other)
        assert name in datasets


def test_a_scene_that_lacks_a_teacher_has_no_weight_in_its_terms(datasets: Datasets) -> None:
    data = joint(datasets)
    lacking = SampleDataset(data.scenes[2:], data.recipe)
    batch = batch_of(lacking, range(2))
    distillation = Distillation(small_encoder(), LOSSES, data.recipe.teachers)
    divisors = distillation.divisors(batch)
    assert divisors["heights/field"] == divisors["heights/render"] == divisors["heights/contrast"] == 0
    assert (batch.teachers[1].codes == -1).all()
    predicted = torch.randn(len(batch.attributes), 8, requires_grad=True)
    terms = distillation.terms(predicted, batch)
    sum(terms.values()).backward()
    assert terms["heights/field"].item() == terms["heights/render"].item() == terms["heights/contrast"].item() == 0
    assert (predicted.grad[:, 4:] == 0).all()
    assert (predicted.grad[:, :4] != 0).any()


def test_the_log_averages_a_teachers_losses_over_the_steps_that_have_it(datasets: Datasets, tmp_path: Path) -> None:
    config, data = replace(SHORT, steps=6), joint(datasets)
    for every in (1, 3):
        settings = {"folder": made(tmp_path / str(every)), "settings": {}}
        encoder_trainer(small_encoder(8), data, LOSSES, replace(config, log_every=every), **settings).run()
    single, rows = (read_log(tmp_path / every / LOG_FILE) for every in ("1", "3"))
    lacking = [row for row in single if not row.get("heights/field")]
    assert len(lacking) == 2  # One wall of three.
    assert len(rows) == 2
    for row, group in zip(rows, (single[:3], single[3:]), strict=True):
        for name in ("heights/field", "sides/render", "loss"):
            values = [float(one[name]) for one in group if one.get(name)]
            assert float(row[name]) == pytest.approx(np.mean(values), rel=1e-5)


def test_a_teacher_of_weight_zero_changes_nothing_but_its_own_columns(datasets: Datasets, tmp_path: Path) -> None:
    weightless = joint(datasets, {"heights": 0.0})
    names = Distillation(small_encoder(8), LOSSES, weightless.recipe.teachers).lambdas
    assert all(name.startswith("sides/") for name in names)
    encoder = small_encoder([4, 4])
    own = encoder.head.of_teacher[1]  # type: ignore[index, union-attr]
    before = [parameter.detach().clone() for parameter in own.parameters()]
    config = replace(SHORT, steps=2)
    encoder_trainer(encoder, weightless, LOSSES, config, folder=tmp_path, settings={}, weight_decay=0.0).run()
    assert all(torch.equal(old, new) for old, new in zip(before, own.parameters(), strict=True))


def test_a_run_goes_on_only_with_its_teachers_in_their_order(datasets: Datasets) -> None:
    config = TrainConfig(teachers={"sides": PaletteConfig(), "heights": PaletteConfig()})
    opened = {name: dataset for name, (dataset, _) in datasets.items()}
    turned = {name: opened[name] for name in reversed(opened)}
    first, second = (resume_settings(config, each, ["wall_0"], "") for each in (opened, turned))
    assert first != second
    assert first_difference(first, second).startswith("teachers=['sides', 'heights'], and this run asks teachers=['hei")
    assert first != resume_settings(config, opened, ["wall_0", "wall_1"], "")


def test_other_teachers_than_those_of_a_checkpoint_are_refused_before_and_after_preparation(tmp_path: Path) -> None:
    path = tmp_path / TRAINING_CHECKPOINT_FILE
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


def test_files_of_other_gaussians_are_refused(datasets: Datasets, tmp_path: Path) -> None:
    other, _ = prepared(tmp_path / "other", count=1, teacher=HeightTeacher())
    moved = scene(0)
    other.scene_path("wall_0").unlink()
    shifted = replace(moved, gaussians=replace(moved.gaussians, means=moved.gaussians.means + np.float32(1e-3)))
    add_scene(other, shifted, HeightTeacher(), PREPARE, source=Path("wall_0"))
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


def test_scenes_prepared_for_one_teacher_are_not_taken_for_those_of_several_or_the_other_way_around(datasets):
    folder = datasets["sides"][0].folder
    assert teacher_folders(folder, ["sides"]) == {"sides": folder}
    with pytest.raises(InputError, match="was prepared for one teacher, and this run has several"):
        teacher_folders(folder, ["sides", "heights"])
    folder = folder.parent
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
    with pytest.raises(InputError, match="there are features of a, b; got 'sides'"):
        both.resolve("sides")
