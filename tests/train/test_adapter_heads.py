"""Adapter heads in a training: what the render loss does behind them, and how they are measured over a dataset."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from textured_box import box_cameras
from torch import nn

from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import CellSample
from gsencoder.fusion.measured_heads import HeadSet, MeasuredHead, load_heads, save_heads
from gsencoder.models.output_space import HEADS_FILE, OutputSpace
from gsencoder.teachers.base import Head, MissingInput
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.teachers.radio import RadioConfig
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
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, Views

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
