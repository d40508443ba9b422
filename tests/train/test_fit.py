"""What a training gives its loop: weight and classes of each teacher, parts of each scene, and what is held out."""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from joint_training import DenseTeacher
from training_scenes import LOSSES, SMALL, SideTeacher, prepared

from gsencoder.core.errors import InputError
from gsencoder.core.process import ProcessRank
from gsencoder.fusion.measured_heads import HeadSet, MeasuredHead, save_heads
from gsencoder.models.output_space import HEADS_FILE, OutputSpaces
from gsencoder.teachers.base import Head
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.teachers.radio import RadioConfig
from gsencoder.train import run
from gsencoder.train.loop import ValidationResult
from gsencoder.train.prepared import PreparedDataset
from gsencoder.train.run import TrainConfig, fit
from gsencoder.train.samples import SampleDataset

Datasets = Mapping[str, PreparedDataset]


class Begun(Exception):
    """Raised instead of the training loop."""


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> Datasets:
    """Three walls with a coded teacher, of which the last lacks the dense one."""
    folder = tmp_path_factory.mktemp("prepared")
    coded, _ = prepared(folder / "coded", teacher=SideTeacher())
    dense, _ = prepared(folder / "dense", count=2, teacher=DenseTeacher())
    return {"coded": coded, "dense": dense}


def begin(
    datasets: Datasets,
    training: Sequence[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    heads: tuple[str, ...] = (),
    warned: list[str] | None = None,
    **losses: Any,
) -> tuple[SampleDataset, list[str], dict[str, Any]]:
    """The samples and heads that `fit` gives the loop, and the scenes that its validation is given."""
    arguments: dict[str, Any] = {}

    def trainer(encoder: torch.nn.Module, dataset: SampleDataset, *others: object, **named: Any) -> None:
        arguments.update(dataset=dataset, heads=named["heads"])
        named["validate"](encoder)
        raise Begun

    def validate(scenes: Sequence[Any], encoder: object, outputs: OutputSpaces, codebooks: object) -> ValidationResult:
        arguments.update(validated=[scene.name for scene in scenes])
        return ValidationResult({})

    monkeypatch.setattr(run, "encoder_trainer", trainer)
    # Nothing of the teachers is read here but which of them has heads.
    teachers = {name: RadioConfig() if name == "dense" else PaletteConfig() for name in datasets}
    config = TrainConfig(teachers=teachers, model=SMALL, loss=replace(LOSSES, **losses), heads=heads)
    around = {"work": tmp_path, "process": ProcessRank(), "device": torch.device("cpu")}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with pytest.raises(Begun):
            fit(datasets, [Path(name) for name in training], [Path("wall_1")], {}, config, validate=validate, **around)  # type: ignore[arg-type]
    if warned is not None:
        warned += [str(each.message) for each in caught]
    return arguments["dataset"], arguments["validated"], arguments["heads"]


@pytest.mark.parametrize(
    ("losses", "untrained"),
    [
        ({"teacher_weights": (1.0, 0.0)}, r"teacher dense: .*weights=\[1\.0, 0\.0\]"),
        ({"teacher_weights": (0.0, 1.0)}, "teacher coded: "),
        # The dense teacher has no classes.
        ({"field_weight": 0.0, "render_weight": 0.0, "contrast_weight": 1.0}, "teacher dense: "),
        ({"field_weight": 0.0, "contrast_weight": 1.0}, None),
        ({"teacher_weights": (0.1, 1.0)}, None),
    ],
)
def test_a_teacher_that_no_loss_is_computed_on_is_named_in_a_warning(
    losses: dict[str, Any], untrained: str | None, datasets: Datasets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    warned: list[str] = []
    begin(datasets, ["wall_0"], tmp_path, monkeypatch, warned=warned, **losses)
    messages = [each for each in warned if "never trained" in each]
    assert len(messages) == (untrained is not None)
    assert untrained is None or re.match(untrained, messages[0])


def test_a_training_without_a_loss_on_any_teacher_is_refused(datasets, tmp_path, monkeypatch):
    only_contrast = {"field_weight": 0.0, "render_weight": 0.0, "contrast_weight": 1.0}
    with pytest.raises(InputError, match=r"the losses of every teacher have the weight 0 .*weights=\[0\.0, 1\.0\]"):
        begin(datasets, ["wall_0"], tmp_path, monkeypatch, teacher_weights=(0.0, 1.0), **only_contrast)


@pytest.mark.parametrize(("clusters", "expected"), [(False, [True, False]), (True, [True, True])])
def test_each_teacher_with_classes_has_a_contrast(clusters, expected, datasets, tmp_path, monkeypatch):
    data, *_ = begin(datasets, ["wall_0"], tmp_path, monkeypatch, contrast_clusters=clusters)
    assert [teacher.classes for teacher in data.recipe.teachers] == expected
    # The order of teachers does not matter.
    reversed_order = {name: datasets[name] for name in reversed(datasets)}
    data, *_ = begin(reversed_order, ["wall_0"], tmp_path, monkeypatch, contrast_clusters=clusters)
    assert [teacher.classes for teacher in data.recipe.teachers] == expected[::-1]


def test_scenes_are_numbered_by_name_each_with_its_own_parts_and_others_are_validated(datasets, tmp_path, monkeypatch):
    data, validated, _ = begin(datasets, ["wall_2", "wall_0"], tmp_path, monkeypatch)
    assert [scene.name for scene in data.scenes] == ["wall_0", "wall_2"]
    assert [[part.name if part else None for part in scene.parts] for scene in data.scenes] == [
        ["wall_0", "wall_0"],
        ["wall_2", None],
    ]
    assert validated == ["wall_1"]


def test_the_heads_of_the_render_loss_go_to_the_teacher_that_has_them(datasets, tmp_path, monkeypatch):
    assert begin(datasets, ["wall_0"], tmp_path, monkeypatch)[2] == {}
    head = Head(name="siglip.summary", body=torch.nn.Sequential(torch.nn.Linear(4, 3)))
    measured = MeasuredHead(head=head, mean=np.arange(3, dtype=np.float32), scale=2.0, cells=5, cosine=0.9, worst=0.5)
    path = datasets["dense"].folder / HEADS_FILE
    save_heads(path, HeadSet(space=DenseTeacher.space, heads=(measured,)))
    *_, heads = begin(datasets, ["wall_0"], tmp_path, monkeypatch, heads=("siglip.summary",))
    path.unlink()
    ((adapter, decode),) = heads["dense"]
    assert list(heads) == ["dense"]
    outputs, vectors = datasets["dense"].load_space()[0], torch.randn(5, 4)
    standard = torch.from_numpy(outputs.standardize(vectors.numpy()))
    expected = (head.body(vectors) - torch.arange(3)) / (2.0 / 3**0.5)
    torch.testing.assert_close(adapter(decode(standard)), expected, rtol=1e-4, atol=1e-4)
