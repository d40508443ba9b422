"""The `transformers` teacher: its settings in its space, and large pictures."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from vision_towers import SIDE, WIDE, features, picture, rewrite, save_vision_tower, teacher, views

from gsencoder.teachers.tower import map_in_windows, window_starts

pytest.importorskip("transformers")


SIZE = 64
"""Twice the models' size: `WIDE` becomes 4 × 8 patches, two windows of theirs without an overlap."""


CHANGED = [{"size": 48}, {"dense": "summary"}, {"dense": "tokens"}, {"layer": -2}]
CHANGED += [{"large": "windows"}, {"large": "windows", "overlap": 0.0}]


@pytest.mark.parametrize("changed", CHANGED)
def test_settings_that_change_a_map_change_its_space_and_the_settings(models: Path, changed: dict[str, Any]) -> None:
    given = {"size": SIZE, "large": "windows"} if "overlap" in changed else {"size": SIZE}
    one, other = teacher(models / "clip", **given), teacher(models / "clip", **{**given, **changed})
    maps = [each.feature_map(views(picture(60, 60)), 0).features for each in (one, other)]
    assert maps[0].shape != maps[1].shape or not np.allclose(*maps, atol=1e-3)
    assert one.space != other.space
    assert one.settings() != other.settings()


@pytest.mark.parametrize("change", [{"resample": 0}, {"image_mean": [0.5, 0.5, 0.5]}, {"do_rescale": False}])
def test_preprocessing_that_changes_a_map_changes_its_space_and_the_settings(models, copied, change):
    other = copied("clip")
    rewrite(other / "preprocessor_config.json", **change)
    teachers = [teacher(folder) for folder in (models / "clip", other)]
    maps = [each.feature_map(views(WIDE), 0).features for each in teachers]
    assert not np.allclose(*maps, atol=1e-3)
    assert teachers[0].space.preprocessing != teachers[1].space.preprocessing
    assert teachers[0].settings() != teachers[1].settings()


def test_what_changes_no_map_changes_no_settings(models: Path, copied: Any) -> None:
    other = copied("clip")
    rewrite(other / "preprocessor_config.json", size={"shortest_edge": 999}, do_center_crop=False)
    assert teacher(other).settings() == teacher(models / "clip", overlap=0.2).settings()


def test_other_weights_have_another_space(models: Path, tmp_path: Path) -> None:
    save_vision_tower("clip", tmp_path / "clip", seed=1)
    one, other = teacher(models / "clip"), teacher(tmp_path / "clip")
    assert one.space.name == other.space.name == "clip"
    assert one.space != other.space
    assert one.settings() != other.settings()


def test_old_and_new_files_state_the_preprocessing(models: Path, copied: Any) -> None:
    other = copied("clip")
    path = other / "preprocessor_config.json"
    stated = json.loads(path.read_text())
    # As CLIP's files were written before there was an option to rescale, and as processors of several parts write it.
    old = ("resample", "image_mean", "image_std", "do_normalize")
    path.write_text(json.dumps({name: stated[name] for name in old}))
    np.testing.assert_array_equal(features(other), features(models / "clip"))
    # The section of a processor goes before a file of its own, as in the library.
    path.write_text(json.dumps({**stated, "image_mean": [0.1, 0.2, 0.3]}))
    (other / "processor_config.json").write_text(json.dumps({"image_processor": stated}))
    np.testing.assert_array_equal(features(other), features(models / "clip"))


@pytest.mark.parametrize("kind", ["dinov2", "sam"])
def test_windows_without_overlap_are_pictures_by_themselves(models: Path, kind: str) -> None:
    image = picture(SIDE, 2 * SIDE)
    windows = features(models / kind, image, size=2 * SIDE, large="windows", overlap=0.0)
    halves = [features(models / kind, half) for half in (image[:, :SIDE], image[:, SIDE:])]
    np.testing.assert_allclose(windows, np.concatenate(halves, axis=1), atol=1e-5)


def test_the_size_of_the_model_is_the_default(models: Path) -> None:
    assert features(models / "dinov2").shape == (2, 4, 16)
    assert features(models / "dinov2", size=SIZE).shape == (4, 8, 16)


def test_of_a_vision_language_model_the_files_of_its_tower_alone_are_read(copied: Any) -> None:
    from safetensors.torch import load_file, save_file

    folder = copied("llava")
    expected = features(folder)
    weights = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    for name, part in (("model-1.safetensors", True), ("model-2.safetensors", False)):
        chosen = {key: value for key, value in weights.items() if ("vision_tower" in key) == part}
        save_file(chosen, folder / name, {"format": "pt"})
    one = teacher(folder).settings()
    save_file({"lm_head.weight": torch.zeros(3)}, folder / "model-2.safetensors", {"format": "pt"})
    np.testing.assert_array_equal(features(folder), expected)
    assert teacher(folder).settings() == one


def test_pictures_that_are_not_normalized_have_their_values_as_they_are(copied: Any) -> None:
    plain = copied("clip")
    rewrite(plain / "preprocessor_config.json", do_normalize=False)
    first = features(plain)
    rewrite(plain / "preprocessor_config.json", do_normalize=True, image_mean=[0.0] * 3, image_std=[1.0] * 3)
    neutral = features(plain)
    np.testing.assert_array_equal(first, neutral)


PATCH = 4


def pixels(rows: int, columns: int) -> torch.Tensor:
    values = np.random.default_rng(0).normal(size=(1, 3, rows * PATCH, columns * PATCH))
    return torch.from_numpy(values.astype(np.float32))


def means_of_patches(picture: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(picture, PATCH)[0].permute(1, 2, 0)


def means_of_neighborhoods(picture: torch.Tensor) -> torch.Tensor:
    """Translation-equivariant: each cell is the mean of 3 × 3 patches, zeros beyond the border."""
    cells = torch.nn.functional.avg_pool2d(picture, PATCH)
    return torch.nn.functional.avg_pool2d(cells, 3, stride=1, padding=1)[0].permute(1, 2, 0)


@given(st.integers(1, 60), st.integers(1, 30), st.floats(0, 0.9))
def test_windows_cover_a_side_and_overlap_by_at_least_their_share(count: int, window: int, overlap: float) -> None:
    starts = window_starts(count, window, overlap)
    inside = min(window, count)
    assert starts[0] == 0
    assert starts[-1] + inside == count
    steps = np.diff(starts)
    assert (steps >= 1).all()
    assert (steps <= max(1, int(window * (1 - overlap)))).all()
    assert len(starts) == 1 or count > window


@pytest.mark.parametrize(("rows", "columns"), [(4, 4), (3, 4), (2, 1)])
def test_a_picture_of_one_window_has_the_map_of_a_single_pass(rows: int, columns: int) -> None:
    picture = pixels(rows, columns)
    windows = map_in_windows(means_of_neighborhoods, picture, PATCH, 4 * PATCH, 0.5)
    assert torch.equal(windows, means_of_neighborhoods(picture))


@pytest.mark.parametrize("overlap", [0.0, 0.5, 0.9])
@pytest.mark.parametrize(("rows", "columns"), [(3, 11), (10, 7)])
def test_a_network_of_patches_does_not_see_the_windows(rows: int, columns: int, overlap: float) -> None:
    picture = pixels(rows, columns)
    windows = map_in_windows(means_of_patches, picture, PATCH, 4 * PATCH, overlap)
    torch.testing.assert_close(windows, means_of_patches(picture))


def test_a_translation_equivariant_network_gives_the_same_inside_of_a_window() -> None:
    picture = pixels(8, 8)
    windows = map_in_windows(means_of_neighborhoods, picture, PATCH, 6 * PATCH, 0.5)
    whole = means_of_neighborhoods(picture)
    # Windows begin at 0 and 2; cells 1 … 4 of each see all of their neighbors.
    same = (windows - whole).abs().amax(dim=-1) < 1e-6
    assert same[3:5, 3:5].all()
    assert not same[2, 2]  # a border of the second window


def test_where_windows_overlap_their_mean_counts() -> None:
    calls: list[float] = []

    def number_of_call(picture: torch.Tensor) -> torch.Tensor:
        calls.append(float(len(calls)))
        return torch.full((picture.shape[2] // PATCH, picture.shape[3] // PATCH, 1), calls[-1])

    made = map_in_windows(number_of_call, pixels(2, 4), PATCH, 2 * PATCH, 0.5)
    np.testing.assert_allclose(made[..., 0], [[0, 0.5, 1.5, 2], [0, 0.5, 1.5, 2]])
