"""What a training gives its loop: weight and classes of each teacher, parts of each scene, and what is held out."""

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from joint_training import DenseTeacher
from textured_box import box_cameras
from torch import nn
from training_scenes import LOSSES, SMALL, SideTeacher, prepared

from gsencoder.core.errors import InputError
from gsencoder.core.process import ProcessRank
from gsencoder.fusion.basis import CellSample
from gsencoder.fusion.measured_heads import HeadSet, MeasuredHead, load_heads, save_heads
from gsencoder.models.output_space import HEADS_FILE, OutputSpace, OutputSpaces
from gsencoder.teachers.base import Head, MissingInput
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.teachers.radio import RadioConfig
from gsencoder.train import run
from gsencoder.train.loop import ValidationResult
from gsencoder.train.losses import FeatureDecoder, render_heads
from gsencoder.train.prepare import (
    dataset_heads,
    measure_dataset_heads,
    missing_heads,
    required_heads,
    sampled_maps,
    teacher_of_heads,
)
from gsencoder.train.prepared import PreparedDataset
from gsencoder.train.run import TrainConfig, fit
from gsencoder.train.samples import SampleDataset
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, Views

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
    parts = [[part.name if part else None for part in scene.parts] for scene in data.scenes]
    assert parts == [["wall_0", "wall_0"], ["wall_2", None]]
    assert validated == ["wall_1"]


def test_the_heads_of_the_render_loss_go_to_the_teacher_that_has_them(datasets, tmp_path, monkeypatch):
    assert begin(datasets, ["wall_0"], tmp_path, monkeypatch)[2] == {}
    own, path = measured("siglip.summary", 3, inputs=4), datasets["dense"].folder / HEADS_FILE
    save_heads(path, HeadSet(space=DenseTeacher.space, heads=(own,)))
    *_, heads = begin(datasets, ["wall_0"], tmp_path, monkeypatch, heads=("siglip.summary",))
    path.unlink()
    ((adapter, decode),) = heads["dense"]
    assert list(heads) == ["dense"]
    outputs, vectors = datasets["dense"].load_space()[0], torch.randn(5, 4)
    standard = torch.from_numpy(outputs.standardize(vectors.numpy()))
    expected = (own.head.body(vectors) - torch.arange(3)) / (2.0 / 3**0.5)
    torch.testing.assert_close(adapter(decode(standard)), expected, rtol=1e-4, atol=1e-4)


SPACE = FeatureSpace(name="s", channels=6)


def outputs(rank: int = 3) -> OutputSpace:
    rng = np.random.default_rng(0)
    components = np.linalg.qr(rng.normal(size=(6, 6)))[0][:rank].astype(np.float32)
    mean = rng.normal(size=6).astype(np.float32)
    basis = FeatureBasis(mean=mean, components=components, energy_kept=1.0, space=SPACE) if rank else None
    return OutputSpace(space=SPACE, mean=mean, scale=2.0, basis=basis)


def measured(name: str, channels: int, scale: float = 2.0, inputs: int = 6) -> MeasuredHead:
    torch.manual_seed(channels)
    body = nn.Sequential(nn.Linear(inputs, 8), nn.GELU(), nn.Linear(8, channels))
    mean = np.arange(channels, dtype=np.float32)
    return MeasuredHead(head=Head(name=name, body=body), mean=mean, scale=scale, cells=5, cosine=0.9, worst=0.5)


@pytest.mark.parametrize("rank", [0, 3])
def test_decoding_undoes_standard_units(rank: int) -> None:
    space = outputs(rank)
    standard = np.random.default_rng(1).normal(size=(5, space.channels)).astype(np.float32)
    restored = space.restore(standard)
    expected = restored if space.basis is None else restored @ space.basis.components + space.mean
    decoded = FeatureDecoder(space)(torch.from_numpy(standard)).numpy()
    np.testing.assert_allclose(decoded, expected, atol=1e-5)


def test_heads_of_the_loss_give_standard_units_of_their_space_and_have_no_gradient() -> None:
    one, other = measured("clip.summary", 4), measured("sam.features", 5, scale=1.0)
    (clip, decode), (sam, _) = render_heads(HeadSet(space=SPACE, heads=(one, other)), outputs())
    standard = torch.randn(7, 3)
    features = decode(standard)
    expected = (one.head.body(features) - torch.from_numpy(one.mean)) / (2.0 / 4**0.5)
    torch.testing.assert_close(clip(features), expected)
    assert sam(features).shape == (7, 5)
    assert not any(value.requires_grad for value in clip.parameters())
    assert render_heads(HeadSet(space=SPACE), outputs()) == []


def test_a_training_asks_for_the_heads_of_its_loss_and_for_those_that_are_stored_besides() -> None:
    teacher = RadioConfig(heads=("siglip", "clip"))
    assert required_heads(("sam", "siglip"), {"radio": teacher}) == ("sam", "siglip", "clip")
    assert required_heads((), {"palette": PaletteConfig()}) == ()
    assert required_heads((), {"palette": PaletteConfig(), "radio": teacher}) == ("siglip", "clip")


def test_heads_belong_to_the_one_teacher_that_has_some() -> None:
    radio, palette = RadioConfig(), PaletteConfig()
    assert teacher_of_heads({"palette": palette, "radio": radio}, ["sam"]) == "radio"
    assert teacher_of_heads({"palette": palette}, []) == "palette"
    assert teacher_of_heads({"a": radio, "b": radio}, []) == "a"
    with pytest.raises(InputError, match="heads=sam: a and b have adapter heads; expected one such teacher"):
        teacher_of_heads({"a": radio, "b": radio}, ["sam"])


def test_scenes_that_lack_the_teacher_leave_their_maps_to_the_others() -> None:
    scenes = [Path(str(number)) for number in range(40)]

    def open_scene(path: Path) -> Any:
        if int(path.name) % 10 != 3:
            raise MissingInput("no labels")
        return ThreeViews(), MapTeacher()

    listed = [path.name for path, _, _ in sampled_maps(scenes, open_scene, 8, optional=True)]
    assert sorted(listed) == sorted(["3", "13", "23", "33"] * 2)
    # Maps are spread evenly; scenes may have none, and the first has one.
    listed = [path.name for path, _, _ in sampled_maps(scenes[3::10], open_scene, 2)]
    assert listed == ["3", "13", "23"]
    # Four scenes have three views each.
    assert len(list(sampled_maps(scenes, open_scene, 30, optional=True))) == 12
    with pytest.raises(MissingInput):
        list(sampled_maps(scenes, open_scene, 8))
    with pytest.raises(MissingInput, match="no labels"):
        list(sampled_maps(scenes[:3], open_scene, 8, optional=True))


class Dataset(PreparedDataset):
    """A folder with an output space, as `measure_dataset_heads` uses a prepared dataset."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def load_space(self) -> tuple[OutputSpace, None]:
        return outputs(), None


class MapTeacher:
    """Maps of random vectors, which counts how often it is asked."""

    space = SPACE
    asked = 0
    table = mean = None
    needs_images = cheap = False

    def settings(self) -> dict[str, Any]:
        return {}

    def feature_map(self, views: Any, view: int) -> FeatureMap:
        MapTeacher.asked += 1
        features = np.random.default_rng(view).normal(size=(4, 5, 6)).astype(np.float32)
        features[0, 0] = np.nan
        return FeatureMap(features=features, grid_from_image=np.array([[1.0, 0, 0], [0, 1, 0]]), space=self.space)


class ThreeViews:
    """A scene with three views, of which nothing is looked at."""

    views = Views(cameras=box_cameras(3, width=8, height=6, focal=5.0), names=("0", "1", "2"))


@pytest.fixture
def of_teacher(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    heads = {name: measured(name, 4).head for name in ("clip.summary", "sam.features")}

    def read(teacher: Any, names: Any) -> list[Head]:
        return [heads[name] for name in names]

    monkeypatch.setattr(RadioConfig, "read_heads", read)
    return read


def test_a_head_is_measured_once_over_the_maps_of_the_output_space(tmp_path: Path, of_teacher: Any) -> None:
    dataset = Dataset(tmp_path)

    def measure(*names: str) -> None:
        scenes = [Path("a"), Path("b")]
        missing = missing_heads(dataset, names, RadioConfig())
        measure_dataset_heads(dataset, missing, scenes, lambda path: (ThreeViews(), MapTeacher()), 4)  # type: ignore[arg-type, return-value]

    MapTeacher.asked = 0
    measure("clip.summary")
    assert MapTeacher.asked == 4
    sample = CellSample(4)
    for view in (0, 2, 0, 2):
        sample.add(MapTeacher().feature_map(None, view))
    vectors = sample.vectors()
    assert len(vectors) == 4 * 19
    stored = load_heads(tmp_path / HEADS_FILE)
    (head,) = stored.heads
    full = head.head.body(torch.from_numpy(vectors)).detach().numpy()
    np.testing.assert_allclose(head.mean, full.mean(axis=0), atol=1e-5)
    assert head.scale == pytest.approx(np.sqrt(((full - full.mean(axis=0)) ** 2).sum(axis=1).mean()), rel=1e-5)
    assert head.cells == len(vectors)
    assert -1 <= head.worst < head.cosine < 1
    MapTeacher.asked = 0
    measure("clip.summary")
    assert MapTeacher.asked == 0
    measure("clip.summary", "sam.features")
    assert load_heads(tmp_path / HEADS_FILE).names == ("clip.summary", "sam.features")
    assert dataset_heads(dataset, ["sam"]).names == ("sam.features",)
    assert dataset_heads(dataset, []).names == ()
    with pytest.raises(InputError, match="heads=dino: not among the heads at hand: clip.summary, sam.features"):
        dataset_heads(dataset, ["dino"])


def test_heads_of_another_backbone_in_the_folder_of_a_dataset_are_refused(tmp_path: Path, of_teacher: Any) -> None:
    dataset = Dataset(tmp_path)
    other = HeadSet(space=FeatureSpace(name="s", channels=6, weights="other"), heads=(measured("clip.summary", 4),))
    save_heads(tmp_path / HEADS_FILE, other)
    missing = missing_heads(dataset, ["sam.features"], RadioConfig())
    assert [head.name for head in missing] == ["sam.features"]
    with pytest.raises(InputError, match=r"heads take features of \(s · 6 channels · other\)"):
        measure_dataset_heads(dataset, missing, [], lambda path: None, 4)  # type: ignore[arg-type, return-value]
