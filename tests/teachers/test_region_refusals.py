"""Masks and captions of regions that do not belong together: what is refused, and what is counted in a warning."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from region_scenes import CAPTIONS, HEIGHT, WIDTH, WORDS, captioned_teacher, labels_of, region_scene, write_masks
from scene_files import save

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.images import read_integers
from gsencoder.teachers.base import MissingInput
from gsencoder.teachers.build import build_teacher
from gsencoder.teachers.regions import OnnxRegionOptions, RegionsConfig, read_captions


@pytest.mark.parametrize("rest", ["none", "mean"])
def test_regions_without_a_caption_are_counted_in_a_warning(tmp_path: Path, rest: Any) -> None:
    scene = region_scene()
    what = "no feature" if rest == "none" else "count as something else"
    with pytest.warns(
        SceneWarning, match=f"3 of 5 regions in 2 views have no caption and {what}; their labels are 7, 9"
    ):
        teacher = captioned_teacher(scene, write_masks(tmp_path), {"1": "mug"}, rest=rest)
    codes = teacher.feature_map(scene.views, 0).codes
    assert (codes[labels_of(0) != 1] == (-1 if rest == "none" else 0)).all()


def test_a_scene_lacks_what_is_named_relative_to_it_and_an_absolute_path_without_anything_is_wrong(
    tmp_path: Path,
) -> None:
    write_masks(tmp_path / "masks")
    scene = region_scene(tmp_path)
    for options, lacks in (
        ({"folder": "none"}, True),
        ({"folder": "masks", "captions": "none.json"}, True),
        ({"folder": str(tmp_path / "none")}, False),
        ({"folder": "masks", "captions": str(tmp_path / "none.json")}, False),
    ):
        with pytest.raises(InputError, match="nothing at .*none") as error:
            build_teacher(RegionsConfig(**options), scene, WORDS)  # type: ignore[arg-type]
        assert isinstance(error.value, MissingInput) == lacks


def test_missing_label_images_are_counted_and_the_first_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"2 of 2 views have no label image, first 'images/a.jpg'; expected images/a "):
        captioned_teacher(region_scene(), tmp_path)
    with pytest.raises(InputError, match="1 of 2 views have no label image, first 'images/b.jpg'"):
        captioned_teacher(region_scene(), write_masks(tmp_path, ("a",)))


@pytest.mark.parametrize(
    ("captions", "problem"),
    [
        ([], 'expected captions of regions, {"label": "caption"} for all views, or '),
        ({"1": "mug", "a": {"1": "mug"}}, "expected captions of regions"),
        ({"1": " "}, "label 1: expected a caption"),
        ({"1": "m" * 1001}, "label 1: expected a caption"),
        ({"a": {"1": ["mug"]}}, r"view 'a': label 1: expected a caption of .* got \"\['mug'\]\""),
        ({"mug": "1"}, "expected labels as numbers from 1, got 'mug'"),
        ({"9" * 30: "mug"}, "expected labels as numbers from 1"),
        ({"1": "mug", "01": "table"}, "label 1 has two captions"),
        ({"c": {"1": "mug"}}, "none of its 1 views is one of the scene, first 'c'; the scene's are 'images/a.jpg', …"),
        ({"a": {"1": "mug"}, "a.png": {}}, "view 'images/a.jpg' is listed twice"),
        ({"2": "mug"}, "none of its captions belongs to one of the 5 regions, whose labels are 1, 7, 9"),
    ],
)
def test_captions_that_do_not_fit_are_refused_in_one_line(tmp_path: Path, captions: Any, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        captioned_teacher(region_scene(), write_masks(tmp_path), captions)
    assert "captions.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_captions_of_labels_that_no_mask_has_are_counted_in_a_warning(tmp_path: Path) -> None:
    with pytest.warns(SceneWarning, match="captions.json: 2 labels occur in no mask: 2, 30"):
        captioned_teacher(region_scene(), write_masks(tmp_path), {**CAPTIONS, "2": "mug", "30": "lamp"})


def test_what_is_missing_is_said_in_one_line(tmp_path: Path) -> None:
    scene, masks = region_scene(), write_masks(tmp_path / "m")
    instances = RegionsConfig(masks="instances")
    with pytest.raises(InputError, match="captions need words: give a text tower"):
        captioned_teacher(scene, masks, words=None)
    with pytest.raises(InputError, match="teacher.folder= is missing"):
        build_teacher(RegionsConfig(), scene, WORDS)
    (masks / "captions.json").unlink()
    with pytest.raises(InputError, match=r"captions.json: no such file; vector=captions needs captions"):
        captioned_teacher(scene, masks, None)
    with pytest.raises(MissingInput, match="masks=instances: the scene has no instance maps"):
        build_teacher(instances, scene, WORDS)
    with pytest.raises(InputError, match="no object of the scene has a name"):
        build_teacher(instances, region_scene(instances=[labels_of(0).astype(np.int32)] * 2), WORDS)
    with pytest.raises(InputError, match="the scene has no views"):
        captioned_teacher(replace(scene, views=None), masks)
    for name in "ab":
        save(masks / f"{name}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match="the masks of all 2 views are empty: they have no label above 0"):
        captioned_teacher(scene, masks)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"masks": "sam"}, "masks=sam numbers its masks itself"),
        ({"masks": "instances", "folder": "x"}, "folder: is an option of masks=files, and masks is instances"),
        ({"sam": "x"}, "sam: is an option of masks=sam"),
        ({"model": "x.onnx"}, "model: is an option of vector=map and vector=crop"),
        ({"onnx": OnnxRegionOptions(patch=7)}, "onnx: is an option of vector=map and vector=crop"),
        ({"around": "nothing"}, "around: is an option of vector=crop"),
        ({"vector": "map", "captions": "x"}, "captions: is an option of vector=captions"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        RegionsConfig(**options)


def test_a_label_with_two_captions_is_refused(tmp_path: Path) -> None:
    folder = write_masks(tmp_path)
    (folder / "captions.json").write_text('{"1": "mug", "1": "cup"}')
    with pytest.raises(InputError, match=r"captions.json: the key '1' is there twice; expected each once"):
        read_captions(folder / "captions.json", ["images/a.jpg"])


def test_label_images_that_were_saved_with_loss_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(tmp_path / "a.png", format="JPEG")
    with pytest.raises(InputError, match="label image was saved as JPEG, which changes values; expected PNG"):
        read_integers(tmp_path / "a.png", "label image", wide=False)
