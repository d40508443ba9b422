"""Cached maps: everybody who asks a teacher for a map gets the same values, whatever their range."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from archives import flip_bit
from training_scenes import SPACE, DenseSideTeacher, prepared, scene

from gsencoder.core.errors import InputError
from gsencoder.fusion.checkpoint import CachedTeacher, read_map, write_map
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.types import FeatureMap, Views


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


def views() -> Views:
    source = scene(0).views
    assert source is not None
    return source


def test_each_channel_keeps_three_digits_whatever_its_magnitude(tmp_path: Path) -> None:
    made = ScaledTeacher().feature_map(views(), 0)
    write_map(tmp_path / "m", made)
    again = read_map(tmp_path / "m", SPACE)
    assert made.features is not None
    assert again.features is not None
    np.testing.assert_allclose(again.features, made.features, rtol=1e-3)
    np.testing.assert_array_equal(again.grid_from_image, made.grid_from_image)


def test_cells_without_a_vector_stay_without_one(tmp_path: Path) -> None:
    made = ScaledTeacher().feature_map(views(), 0)
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
    made = ScaledTeacher().feature_map(views(), 0)
    assert made.features is not None
    made.features[:] = value
    write_map(tmp_path / "m", made)
    np.testing.assert_allclose(read_map(tmp_path / "m", SPACE).features, made.features, rtol=1e-3, atol=1e-35)


def test_a_map_is_made_once(tmp_path: Path) -> None:
    teacher = ScaledTeacher()
    cached = CachedTeacher(teacher, tmp_path)
    first, second = (cached.feature_map(views(), 0).features for _ in range(2))
    assert teacher.calls == 1
    np.testing.assert_array_equal(first, second)


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
        first, second = (cached.feature_map(views(), 0) for _ in range(2))
        assert teacher.calls == 2
        assert (first.codes is None) == isinstance(teacher, Cheap)
        assert first is not second
    assert not list(tmp_path.iterdir())


def test_fusing_with_a_cache_and_preparing_see_the_same_maps(tmp_path: Path) -> None:
    class Recording(CachedTeacher):
        def feature_map(self, views: Views, view: int) -> FeatureMap:
            result = super().feature_map(views, view)
            maps.append(result.features)
            return result

    maps: list[np.ndarray | None] = []
    config = replace(FuseConfig(), basis=False)
    by_work = fuse(scene(0), ScaledTeacher(), config, work=tmp_path / "work").features
    by_cache = fuse(scene(0), Recording(ScaledTeacher(), tmp_path), config).features
    np.testing.assert_array_equal(by_work.features, by_cache.features)
    assert all(values is not None and np.isfinite(values).all() for values in maps)


def test_a_scene_with_channels_beyond_float16_is_prepared(tmp_path: Path) -> None:
    dataset, names = prepared(tmp_path, count=1, teacher=ScaledTeacher())
    outputs, _ = dataset.load_space()
    one = dataset.scenes(names)[0]
    fused = fuse(scene(0), ScaledTeacher(), FuseConfig(basis=False)).features
    rows = np.flatnonzero(fused.seen)
    assert np.isfinite(one.targets(rows)).all()
    largest = np.abs(fused.features[rows]).max()
    np.testing.assert_allclose(outputs.restore(one.targets(rows)), fused.features[rows], atol=5e-3 * largest)


def test_a_damaged_map_says_what_to_remove(tmp_path: Path) -> None:
    cached = CachedTeacher(ScaledTeacher(), tmp_path)
    cached.feature_map(views(), 0)
    (path,) = tmp_path.iterdir()
    flip_bit(path, 8 * (path.stat().st_size - 3))
    with pytest.raises(InputError, match=f"does not have the checksum.*; remove {path}, and it is made again"):
        cached.feature_map(views(), 0)
