"""A fusion under way: cached maps and sums belong to this run, and a run that made nothing leaves nothing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import flip_bit
from splats import front_camera, random_gaussians
from training_scenes import SPACE, DenseSideTeacher, scene

from gsencoder.core.errors import InputError
from gsencoder.fusion.checkpoint import SETTINGS_FILE, SUMS_FILE, CachedTeacher, FusionCheckpoint, read_map, write_map
from gsencoder.fusion.lift import FeatureSums
from gsencoder.render import blend
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap, FeatureSpace, Views

CAMERA = front_camera(32, 24, 30.0)


class CountingTeacher(DenseSideTeacher):
    """Counts the maps that it makes."""

    cheap = False

    def __init__(self) -> None:
        self.calls = 0

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        self.calls += 1
        return super().feature_map(views, view)


def a_map(folder: Path, settings: dict[str, Any], teacher: Teacher | None = None, view: int = 0) -> FeatureMap:
    views = scene(0).views
    assert views is not None
    return FusionCheckpoint(folder, settings).cached(teacher or CountingTeacher()).feature_map(views, view)


def sums_of(gaussians: int = 5, views: int = 0) -> FeatureSums:
    """Sums over the maps of some views, of a mean that is computed on the way."""
    space = FeatureSpace(name="s", channels=3)
    sums, lit = FeatureSums(gaussians, space, None, None, with_mean=True), blend(random_gaussians(gaussians), CAMERA)
    for view in range(views):
        cells = np.full((*lit.shape, 3), view + 1, np.float32)
        sums.add(lit, FeatureMap(features=cells, grid_from_image=np.eye(2, 3), space=space), None)
    return sums


def save(checkpoint: FusionCheckpoint, sums: FeatureSums, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsencoder.fusion.checkpoint.SAVE_EVERY", 0.0)
    checkpoint.save_if_due(sums)


def test_maps_and_sums_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    teacher = CountingTeacher()
    first = a_map(tmp_path / "work", {"a": 1}, teacher)
    made, sums = sums_of(views=2), sums_of()
    save(FusionCheckpoint(tmp_path / "work", {"a": 1}), made, monkeypatch)
    again = FusionCheckpoint(tmp_path / "work", {"a": 1})
    np.testing.assert_array_equal(a_map(tmp_path / "work", {"a": 1}, teacher).features, first.features)
    assert teacher.calls == 1
    a_map(tmp_path / "work", {"a": 1}, teacher, view=1)
    assert teacher.calls == 2
    assert again.resume(sums) == sums.views == 2
    assert made.sums.any()
    for name, array in made.state().items():
        np.testing.assert_array_equal(sums.state()[name], array)
    np.testing.assert_array_equal(sums.mean, [1.5, 1.5, 1.5])


@pytest.mark.parametrize("name", [SUMS_FILE, "map_00000.safetensors"])
def test_maps_and_sums_whose_settings_a_kill_removed_are_not_used(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checkpoint of a finished fusion is being removed; the next one has other settings."""
    work = tmp_path / "work"
    a_map(work, {"a": 1})
    save(FusionCheckpoint(work, {"a": 1}), sums_of(views=2), monkeypatch)
    assert (work / name).is_file()
    (work / SETTINGS_FILE).unlink()
    again = FusionCheckpoint(work, {"a": 2})
    assert not (work / name).exists()
    assert again.resume(sums_of()) == 0


def test_a_run_that_kept_nothing_leaves_no_folder_to_refuse_the_next(tmp_path: Path) -> None:
    FusionCheckpoint(tmp_path / "work", {"patch": 13})
    assert not (tmp_path / "work").exists()
    a_map(tmp_path / "work", {"patch": 14})
    with pytest.raises(InputError, match="begun with patch=14, and this run asks patch=13; delete "):
        FusionCheckpoint(tmp_path / "work", {"patch": 13})


@pytest.mark.parametrize("content", [b"", b"[]"])
def test_settings_that_cannot_be_read_say_what_to_delete(tmp_path: Path, content: bytes) -> None:
    (tmp_path / SETTINGS_FILE).write_bytes(content)
    with pytest.raises(InputError, match=f"delete {tmp_path} to start again"):
        FusionCheckpoint(tmp_path, {})


@pytest.mark.parametrize("kept_bytes", [7, 200])
def test_damaged_maps_and_sums_are_named(tmp_path: Path, kept_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoint = FusionCheckpoint(tmp_path, {})
    a_map(tmp_path, {})
    save(checkpoint, sums_of(views=1), monkeypatch)
    with pytest.raises(InputError, match=r"expected sums float32\[6, 3\], got float32\[5, 3\]"):
        checkpoint.resume(sums_of(6))
    for file in ("map_00000.safetensors", SUMS_FILE):
        (tmp_path / file).write_bytes((tmp_path / file).read_bytes()[:kept_bytes])
    with pytest.raises(InputError, match=r"map_00000\.safetensors.*delete .* to start again"):
        a_map(tmp_path, {})
    with pytest.raises(InputError, match=r"sums\.safetensors.*delete .* to start again"):
        checkpoint.resume(sums_of())


class ScaledTeacher(DenseSideTeacher):
    """Channels of very different magnitudes, and as many calls as maps were asked for."""

    cheap = False
    scales = np.float32([1e6, 1, 1e-6, 7e4])

    def __init__(self) -> None:
        self.calls = 0

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        self.calls += 1
        plain = super().feature_map(views, view)
        assert plain.features is not None
        return replace(plain, features=plain.features * self.scales)


def maps_views() -> Views:
    source = scene(0).views
    assert source is not None
    return source


def test_each_channel_keeps_three_digits_whatever_its_magnitude(tmp_path: Path) -> None:
    made = ScaledTeacher().feature_map(maps_views(), 0)
    write_map(tmp_path / "m", made)
    again = read_map(tmp_path / "m", SPACE)
    assert made.features is not None
    assert again.features is not None
    np.testing.assert_allclose(again.features, made.features, rtol=1e-3)
    np.testing.assert_array_equal(again.grid_from_image, made.grid_from_image)


def test_cells_without_a_vector_stay_without_one(tmp_path: Path) -> None:
    made = ScaledTeacher().feature_map(maps_views(), 0)
    assert made.features is not None
    made.features[1, 2, 3] = np.nan
    made.features[0, 0, 0] = np.inf
    write_map(tmp_path / "m", made)
    again = read_map(tmp_path / "m", SPACE).features
    assert again is not None
    missing = np.isnan(again)
    assert missing[1, 2].all()
    assert missing[0, 0].all()
    assert missing.sum() == 8
    np.testing.assert_allclose(again[~missing], made.features[~missing], rtol=1e-3)


@pytest.mark.parametrize("value", [0.0, 1e-38, 3e38])
def test_the_ends_of_the_range_are_kept(tmp_path: Path, value: float) -> None:
    made = ScaledTeacher().feature_map(maps_views(), 0)
    assert made.features is not None
    made.features[:] = value
    write_map(tmp_path / "m", made)
    np.testing.assert_allclose(read_map(tmp_path / "m", SPACE).features, made.features, rtol=1e-3, atol=1e-35)


def test_coded_maps_and_those_of_cheap_teachers_are_made_each_time(tmp_path: Path) -> None:
    class Coded(ScaledTeacher):
        table = np.eye(3, 4, dtype=np.float32)

        def feature_map(self, views: Views, view: int) -> FeatureMap:
            self.calls += 1
            codes = np.full((3, 4), view, np.int32)
            return FeatureMap(codes=codes, table=self.table, grid_from_image=np.eye(2, 3), space=SPACE)

    class Cheap(ScaledTeacher):
        cheap = True

    for teacher in (Coded(), Cheap()):
        cached = CachedTeacher(teacher, tmp_path, before_write=lambda: pytest.fail("written"))
        first, second = (cached.feature_map(maps_views(), 0) for _ in range(2))
        assert teacher.calls == 2
        assert (first.codes is None) == isinstance(teacher, Cheap)
        assert first is not second
    assert not list(tmp_path.iterdir())


def test_a_damaged_map_says_what_to_remove(tmp_path: Path) -> None:
    cached = CachedTeacher(ScaledTeacher(), tmp_path)
    cached.feature_map(maps_views(), 0)
    (path,) = tmp_path.iterdir()
    flip_bit(path, 8 * (path.stat().st_size - 3))
    with pytest.raises(InputError, match=f"does not have the checksum.*; remove {path}, and it is made again"):
        cached.feature_map(maps_views(), 0)
