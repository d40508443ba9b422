"""Regions with captions: which masks and captions belong together, what is refused, and what a warning counts."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from region_scenes import (
    CAPTIONS,
    HEIGHT,
    WIDTH,
    WORDS,
    captioned_teacher,
    labels_of,
    region_scene,
    scene_object,
    write_masks,
)
from scene_files import save
from text_towers import save_graph, save_tokenizer

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.images import read_integers
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.teachers.base import MissingInput, Teacher
from gsencoder.teachers.build import stored_words, text_table_of, words_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.teachers.masks import label_paths
from gsencoder.teachers.regions import RegionsConfig, read_captions
from gsencoder.text.models import OnnxTextConfig
from gsencoder.text.table import REFERENCE_NOUNS, save_text_table
from gsencoder.text.vocabulary import OpenVocabulary
from gsencoder.types import Scene


def rows_of(teacher: Teacher, scene: Scene, view: int) -> np.ndarray:
    return teacher.feature_map(scene.views, view).rows().reshape(HEIGHT, WIDTH, -1)


def expected(view: int, captions: dict[str, str], rest: np.ndarray) -> np.ndarray:
    vectors = np.broadcast_to(rest, (HEIGHT, WIDTH, 8)).copy()
    for label, caption in captions.items():
        vectors[labels_of(view) == int(label)] = WORDS.encode([caption])[0]
    return vectors


@pytest.mark.parametrize("rest", ["none", "mean"])
def test_each_pixel_has_the_vector_of_its_regions_caption(tmp_path: Path, rest: Any) -> None:
    scene = region_scene()
    teacher = captioned_teacher(scene, write_masks(tmp_path), rest=rest)
    nothing = np.full(8, np.nan) if rest == "none" else WORDS.mean / np.linalg.norm(WORDS.mean)
    for view in range(2):
        np.testing.assert_allclose(rows_of(teacher, scene, view), expected(view, CAPTIONS, nothing), atol=1e-6)
    assert teacher.space.text_encoder == "toy"
    np.testing.assert_array_equal(teacher.mean, WORDS.mean)


def test_captions_may_differ_from_view_to_view(tmp_path: Path) -> None:
    scene = region_scene()
    by_view = {"images/a.jpg": {"1": "lamp", "7": "table", "9": "mug"}, "b": {"1": "table", "7": "mug"}}
    teacher = captioned_teacher(scene, write_masks(tmp_path), by_view, rest="none")
    for view, captions in enumerate(by_view.values()):
        vectors = expected(view, captions, np.full(8, np.nan))
        np.testing.assert_allclose(rows_of(teacher, scene, view), vectors, atol=1e-6)


def test_instances_with_the_names_of_objects_are_what_the_labels_teacher_gives() -> None:
    scene = replace(
        region_scene(instances=[labels_of(view).astype(np.int32) for view in range(2)]),
        objects=(scene_object(1, "mug"), scene_object(7, "lamp"), scene_object(9, None), scene_object(33, "table")),
    )
    with pytest.warns(SceneWarning, match="1 of 5 regions in 2 views have no caption"):
        regions = RegionsConfig(masks="instances").build(scene, WORDS)
    labels = LabelsConfig().build(scene, WORDS)
    for view in range(2):
        np.testing.assert_array_equal(rows_of(regions, scene, view), rows_of(labels, scene, view))
    ours, theirs = (fuse(scene, teacher, FuseConfig()).features for teacher in (regions, labels))
    assert ours.seen.any()
    np.testing.assert_array_equal(ours.seen, theirs.seen)
    np.testing.assert_allclose(ours.decode(), theirs.decode(), atol=1e-5)


def test_the_words_beside_the_features_hold_the_captions(tmp_path: Path) -> None:
    letters = sorted(set(" ".join([*REFERENCE_NOUNS, "red on a"]).split()))
    save_tokenizer(tmp_path / "tokenizer.json", ("[PAD]", "[UNK]", "[CLS]", "[SEP]", *letters))
    save_graph(tmp_path / "model.onnx", rows=1000)
    config = RegionsConfig(folder=str(write_masks(tmp_path / "masks")))
    words = words_of(config, OnnxTextConfig(model=str(tmp_path), pooling="mean"))
    assert isinstance(words, OpenVocabulary)
    captions = {"1": "red mug on a table", "7": "table", "9": "lamp"}
    (tmp_path / "masks/captions.json").write_text(json.dumps(captions))
    teacher = config.build(region_scene(), words)
    table = stored_words(teacher, words)
    assert table.find("red mug on a table") is not None
    np.testing.assert_allclose(table.encode(["red mug on a table"]), words.encode(["red mug on a table"]), atol=1e-6)


def test_a_text_table_has_the_captions_where_there_is_no_tower(tmp_path: Path) -> None:
    save_text_table(tmp_path / "w.safetensors", WORDS)
    config = RegionsConfig(folder=str(write_masks(tmp_path / "m")), words=str(tmp_path / "w.safetensors"))
    table = text_table_of(config)
    assert captioned_teacher(region_scene(), tmp_path / "m", words=table).space.text_encoder == "toy"
    with pytest.raises(InputError, match="captions.*'sofa'"):
        captioned_teacher(region_scene(), tmp_path / "m", {**CAPTIONS, "1": "sofa"}, words=table)
    with pytest.raises(InputError, match="both say what words are"):
        words_of(config, OnnxTextConfig(model="nowhere"))


def test_masks_are_looked_for_in_the_scenes_folder_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_masks(tmp_path / "scene/masks")
    (tmp_path / "scene/masks/captions.json").write_text(json.dumps(CAPTIONS))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    scene, config = region_scene(tmp_path / "scene"), RegionsConfig(folder="masks")
    config.build(scene, WORDS)
    shutil.copytree(tmp_path / "scene/masks", tmp_path / "here/masks")
    with pytest.raises(InputError, match=r"teacher.folder=masks: stands for .*scene/masks and for .*here/masks"):
        config.build(scene, WORDS)
    shutil.rmtree(tmp_path / "scene/masks")
    config.build(scene, WORDS)
    shutil.rmtree(tmp_path / "here/masks")
    with pytest.raises(MissingInput, match="teacher.folder: nothing at .*scene/masks or masks"):
        config.build(scene, WORDS)


def test_label_images_are_called_like_their_views(tmp_path: Path) -> None:
    for name in ("x/1.png", "y/1.npy", "frame-07.color.png", "2.safetensors"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = ("x/1.jpg", "y/1.jpg", "frame-07.color.png", "images/2.JPG")
    expected = ["x/1.png", "y/1.npy", "frame-07.color.png", "2.safetensors"]
    assert label_paths(tmp_path, names) == [tmp_path / name for name in expected]
    (tmp_path / "2.png").touch()
    with pytest.raises(InputError, match="view 'images/2.JPG' has 2 label images, .*2.png and .*2.safetensors"):
        label_paths(tmp_path, names)
    (tmp_path / "1.png").touch()
    with pytest.raises(InputError, match="2 of 3 views have no label image, first 'u/1.jpg'; expected u/1 with the"):
        label_paths(tmp_path, ("x/1.jpg", "u/1.jpg", "v/1.jpg"))
    with pytest.raises(InputError, match="would belong to 2 views"):
        label_paths(tmp_path, ("x/1.jpg", "x/1.png"))
    assert label_paths(tmp_path / "x", ("../../../1.png",)) == [tmp_path / "x/1.png"]


def test_settings_follow_masks_and_captions(tmp_path: Path) -> None:
    scene, masks = region_scene(), write_masks(tmp_path)
    first = captioned_teacher(scene, masks).settings()
    assert captioned_teacher(scene, masks).settings() == first
    assert captioned_teacher(scene, masks, {**CAPTIONS, "1": "lamp"}).settings() != first
    assert captioned_teacher(scene, masks, {"1": "table", "7": "mug", "9": "lamp"}).settings() != first
    assert captioned_teacher(scene, masks, rest="none").settings() != first
    save(masks / "b.png", labels_of(0))
    assert captioned_teacher(scene, masks).settings() != first
    maps = [labels_of(view).astype(np.int32) for view in (0, 1)]
    options = RegionsConfig(masks="instances", captions=str(tmp_path / "captions.json"))
    one, other = (options.build(region_scene(instances=m), WORDS).settings() for m in (maps, maps[::-1]))
    assert one != other


def test_captions_of_a_view_are_never_those_of_another_that_ends_alike(tmp_path: Path) -> None:
    path = tmp_path / "captions.json"
    path.write_text('{"1": {"1": "mug"}}')
    captions = read_captions(path, ["1.jpg", "x/1.jpg"])
    assert captions["1.jpg"] == {1: "mug"}
    assert "x/1.jpg" not in captions
    alone = read_captions(path, ["x/1.jpg", "x/2.jpg"])
    assert alone["x/1.jpg"] == {1: "mug"}
    path.write_text('{"1": {"1": "mug"}, "x/1": {"1": "lamp"}}')
    with pytest.raises(InputError, match="view 'x/1.jpg' is listed twice"):
        read_captions(path, ["x/1.jpg", "x/2.jpg"])
    path.write_text('{"1": {"1": "mug"}}')
    with pytest.raises(InputError, match="'1' stands for 2 views; write their whole names"):
        read_captions(path, ("x/1.jpg", "y/1.jpg"))


@pytest.mark.parametrize("rest", ["none", "mean"])
def test_regions_without_a_caption_are_counted_in_a_warning(tmp_path: Path, rest: Any) -> None:
    scene = region_scene()
    what = "no feature" if rest == "none" else "count as something else"
    with pytest.warns(SceneWarning, match=f"3 of 5 regions in 2 views have no caption and {what}; .* labels are 7, 9"):
        teacher = captioned_teacher(scene, write_masks(tmp_path), {"1": "mug"}, rest=rest)
    codes = teacher.feature_map(scene.views, 0).codes
    assert (codes[labels_of(0) != 1] == (-1 if rest == "none" else 0)).all()


def test_a_scene_lacks_what_is_named_relative_to_it_and_an_absolute_path_without_anything_is_wrong(tmp_path):
    write_masks(tmp_path / "masks")
    scene = region_scene(tmp_path)
    for options, lacks in (
        ({"folder": "none"}, True),
        ({"folder": "masks", "captions": "none.json"}, True),
        ({"folder": str(tmp_path / "none")}, False),
        ({"folder": "masks", "captions": str(tmp_path / "none.json")}, False),
    ):
        with pytest.raises(InputError, match="nothing at .*none") as error:
            RegionsConfig(**options).build(scene, WORDS)  # type: ignore[arg-type]
        assert isinstance(error.value, MissingInput) == lacks


@pytest.mark.parametrize(
    ("captions", "problem"),
    [
        ([], 'expected captions of regions, {"label": "caption"} for all views, or '),
        ({"1": " "}, "label 1: expected a caption"),
        ({"a": {"1": ["mug"]}}, r"view 'a': label 1: expected a caption of .* got \"\['mug'\]\""),
        ({"mug": "1"}, "expected labels as numbers from 1, got 'mug'"),
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
        RegionsConfig().build(scene, WORDS)
    (masks / "captions.json").unlink()
    with pytest.raises(InputError, match=r"captions.json: no such file; vector=captions needs captions"):
        captioned_teacher(scene, masks, None)
    with pytest.raises(MissingInput, match="masks=instances: the scene has no instance maps"):
        instances.build(scene, WORDS)
    with pytest.raises(InputError, match="no object of the scene has a name"):
        instances.build(region_scene(instances=[labels_of(0).astype(np.int32)] * 2), WORDS)
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
        ({"model": "x.onnx"}, "model: is an option of vector=map and vector=crop"),
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
