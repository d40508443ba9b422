"""A fusion under way: cached maps and sums belong to this run, and a run that made nothing leaves nothing."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import flip_bit
from training_scenes import SPACE, DenseSideTeacher, scene

from gsencoder.core.errors import InputError
from gsencoder.fusion.checkpoint import SETTINGS_FILE, CachedTeacher, read_map, write_map
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap, Scene, Views


class CountingTeacher(DenseSideTeacher):
    """Counts the maps that it makes."""

    cheap = False

    def __init__(self) -> None:
        self.calls = 0

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        self.calls += 1
        return super().feature_map(views, view)


def a_map(folder: Path, settings: dict[str, Any], teacher: Teacher | None = None, view: int = 0) -> FeatureMap:
    return CachedTeacher(teacher or CountingTeacher(), folder, settings).feature_map(views_of(scene(0)), view)


def views_of(made: Scene) -> Views:
    return made.views


def test_maps_come_back(tmp_path: Path) -> None:
    teacher = CountingTeacher()
    first = a_map(tmp_path / "work", {"a": 1}, teacher)
    np.testing.assert_array_equal(a_map(tmp_path / "work", {"a": 1}, teacher).features, first.features)
    assert teacher.calls == 1
    a_map(tmp_path / "work", {"a": 1}, teacher, view=1)
    assert teacher.calls == 2


def test_maps_whose_settings_a_kill_removed_are_not_used(tmp_path: Path) -> None:
    """The cache of a finished fusion is being removed; the next one has other settings."""
    a_map(tmp_path / "work", {"a": 1})
    (tmp_path / "work" / SETTINGS_FILE).unlink()
    CachedTeacher(CountingTeacher(), tmp_path / "work", {"a": 2})
    assert not list((tmp_path / "work").iterdir())


def test_a_run_that_kept_nothing_leaves_no_folder_to_refuse_the_next(tmp_path: Path) -> None:
    CachedTeacher(CountingTeacher(), tmp_path / "work", {"patch": 13})
    assert not (tmp_path / "work").exists()
    a_map(tmp_path / "work", {"patch": 14})
    with pytest.raises(InputError, match="begun with patch=14, and this run asks patch=13; delete "):
        CachedTeacher(CountingTeacher(), tmp_path / "work", {"patch": 13})


@pytest.mark.parametrize("content", [b"", b"[]"])
def test_settings_that_cannot_be_read_say_what_to_delete(tmp_path: Path, content: bytes) -> None:
    (tmp_path / SETTINGS_FILE).write_bytes(content)
    with pytest.raises(InputError, match=f"delete {tmp_path} to start again"):
        CachedTeacher(CountingTeacher(), tmp_path, {"a": 1})


@pytest.mark.parametrize("settings", [{}, None])
def test_a_damaged_map_is_named(tmp_path: Path, settings: dict[str, Any] | None) -> None:
    cached = CachedTeacher(CountingTeacher(), tmp_path, settings)
    cached.feature_map(views_of(scene(0)), 0)
    path = tmp_path / "map_00000.safetensors"
    flip_bit(path, 8 * (path.stat().st_size - 3))
    advice = f"delete {tmp_path} to start again" if settings is not None else f"remove {path}, and it is made again"
    with pytest.raises(InputError, match=f"map_00000.safetensors.*does not have the checksum.*; {advice}"):
        cached.feature_map(views_of(scene(0)), 0)


class ScaledTeacher(DenseSideTeacher):
    """Channels of very different magnitudes, and as many calls as maps were asked for."""

    cheap = False
    scales = np.float32([1e6, 1, 1e-6, 7e4])

    def __init__(self) -> None:
        self.calls = 0

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        self.calls += 1
        plain = super().feature_map(views, view)
        return replace(plain, features=plain.features * self.scales)


def test_each_channel_keeps_three_digits_whatever_its_magnitude(tmp_path: Path) -> None:
    made = ScaledTeacher().feature_map(views_of(scene(0)), 0)
    write_map(tmp_path / "m", made)
    again = read_map(tmp_path / "m", SPACE)
    np.testing.assert_allclose(again.features, made.features, rtol=1e-3)
    np.testing.assert_array_equal(again.grid_from_image, made.grid_from_image)


def test_cells_without_a_vector_stay_without_one(tmp_path: Path) -> None:
    made = ScaledTeacher().feature_map(views_of(scene(0)), 0)
    made.features[1, 2, 3] = np.nan
    made.features[0, 0, 0] = np.inf
    write_map(tmp_path / "m", made)
    again = read_map(tmp_path / "m", SPACE).features
    missing = np.isnan(again)
    assert missing[1, 2].all()
    assert missing[0, 0].all()
    assert missing.sum() == 8
    np.testing.assert_allclose(again[~missing], made.features[~missing], rtol=1e-3)


@pytest.mark.parametrize("value", [0.0, 1e-38, 3e38])
def test_the_ends_of_the_range_are_kept(tmp_path: Path, value: float) -> None:
    made = ScaledTeacher().feature_map(views_of(scene(0)), 0)
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
        cached = CachedTeacher(teacher, tmp_path, {"a": 1})
        first, second = (cached.feature_map(views_of(scene(0)), 0) for _ in range(2))
        assert teacher.calls == 2
        assert (first.codes is None) == isinstance(teacher, Cheap)
        assert first is not second
    assert not list(tmp_path.iterdir())
