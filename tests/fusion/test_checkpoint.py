"""A fusion under way: what is taken up belongs to this run, and a run that made nothing leaves nothing."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training_scenes import DenseSideTeacher, scene

from gsencoder.core.errors import InputError
from gsencoder.fusion.checkpoint import SETTINGS_FILE, SUMS_FILE, FusionCheckpoint
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap, Views


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


def test_maps_and_sums_come_back(tmp_path: Path) -> None:
    teacher = CountingTeacher()
    first = a_map(tmp_path / "work", {"a": 1}, teacher)
    FusionCheckpoint(tmp_path / "work", {"a": 1}).save_sums(2, np.ones((5, 3), np.float32), np.full(5, 2, np.float32))
    again = FusionCheckpoint(tmp_path / "work", {"a": 1})
    np.testing.assert_array_equal(a_map(tmp_path / "work", {"a": 1}, teacher).features, first.features)
    assert teacher.calls == 1
    a_map(tmp_path / "work", {"a": 1}, teacher, view=1)
    assert teacher.calls == 2
    sums = again.load_sums(5, 3)
    assert sums is not None
    assert sums[0] == 2
    assert (sums[2] == 2).all()


@pytest.mark.parametrize("name", [SUMS_FILE, "map_00000.safetensors"])
def test_maps_and_sums_whose_settings_a_kill_removed_are_not_used(name: str, tmp_path: Path) -> None:
    """The checkpoint of a finished fusion is being removed; the next one has other settings."""
    work = tmp_path / "work"
    a_map(work, {"a": 1})
    FusionCheckpoint(work, {"a": 1}).save_sums(2, np.ones((5, 3), np.float32), np.full(5, 2, np.float32))
    assert (work / name).is_file()
    (work / SETTINGS_FILE).unlink()
    again = FusionCheckpoint(work, {"a": 2})
    assert not (work / name).exists()
    assert again.load_sums(5, 3) is None


def test_a_run_that_kept_nothing_leaves_no_folder_to_refuse_the_next(tmp_path: Path) -> None:
    FusionCheckpoint(tmp_path / "work", {"patch": 13})
    assert not (tmp_path / "work").exists()
    a_map(tmp_path / "work", {"patch": 14})
    with pytest.raises(InputError, match="begun with patch=14, and this run asks patch=13; delete it"):
        FusionCheckpoint(tmp_path / "work", {"patch": 13})


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff", b"[" * 100_000])
def test_settings_that_cannot_be_read_say_what_to_delete(tmp_path: Path, content: bytes) -> None:
    (tmp_path / SETTINGS_FILE).write_bytes(content)
    with pytest.raises(InputError, match=f"delete {tmp_path} to start anew"):
        FusionCheckpoint(tmp_path, {})


@pytest.mark.parametrize("kept_bytes", [0, 7, 100, 200])
def test_damaged_maps_and_sums_are_named(tmp_path: Path, kept_bytes: int) -> None:
    checkpoint = FusionCheckpoint(tmp_path, {})
    a_map(tmp_path, {})
    checkpoint.save_sums(1, np.ones((5, 3), np.float32), np.ones(5, np.float32))
    for file in ("map_00000.safetensors", SUMS_FILE):
        (tmp_path / file).write_bytes((tmp_path / file).read_bytes()[:kept_bytes])
    with pytest.raises(InputError, match=r"map_00000\.safetensors.*delete .* to start anew"):
        a_map(tmp_path, {})
    with pytest.raises(InputError, match=r"sums\.safetensors.*delete .* to start anew"):
        checkpoint.load_sums(5, 3)


def test_sums_of_another_size_are_refused(tmp_path: Path) -> None:
    FusionCheckpoint(tmp_path, {}).save_sums(1, np.ones((5, 3), np.float32), np.ones(5, np.float32))
    with pytest.raises(InputError, match=r"expected sums float32\[6, 3\], got float32\[5, 3\]"):
        FusionCheckpoint(tmp_path, {}).load_sums(6, 3)
