"""Regions with captions: which masks and captions belong together, and what is refused because they do not."""

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from region_scenes import HEIGHT, WIDTH, labels_of, region_scene, scene_object, toy_words, write_masks
from scene_files import save
from text_towers import save_graph, save_tokenizer

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.readers.image_file import read_integers
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.lift import map_rows
from gsencoder.fusion.teachers import MissingInput, Teacher
from gsencoder.fusion.teachers.build import build_teacher, text_table_of, words_beside, words_of
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.fusion.teachers.regions.captions import read_captions
from gsencoder.fusion.teachers.regions.config import OnnxRegionOptions, RegionsConfig
from gsencoder.fusion.teachers.regions.masks import label_paths
from gsencoder.text.onnx_tower import OnnxTextConfig
from gsencoder.text.open_vocabulary import OpenVocabulary
from gsencoder.text.reference_nouns import REFERENCE_NOUNS
from gsencoder.text.table import TextTable, save_text_table
from gsencoder.types import Scene

WORDS = toy_words("mug", "table", "lamp")
CAPTIONS: dict[str, Any] = {"1": "mug", "7": "table", "9": "lamp"}


def build(
    scene: Scene, masks: Path, captions: Any = CAPTIONS, words: TextTable | None = WORDS, **options: Any
) -> Teacher:
    if captions is not None:
        (masks / "captions.json").write_text(json.dumps(captions))
    return build_teacher(RegionsConfig(folder=str(masks), **options), scene, words)


def rows_of(teacher: Teacher, scene: Scene, view: int) -> np.ndarray:
    assert scene.views is not None
    return map_rows(teacher.feature_map(scene.views, view)).reshape(HEIGHT, WIDTH, -1)


def expected(view: int, captions: dict[str, str], rest: np.ndarray) -> np.ndarray:
    vectors = np.broadcast_to(rest, (HEIGHT, WIDTH, 8)).copy()
    for label, caption in captions.items():
        vectors[labels_of(view) == int(label)] = WORDS.encode([caption])[0]
    return vectors


@pytest.mark.parametrize("rest", ["none", "mean"])
def test_each_pixel_has_the_vector_of_its_regions_caption(tmp_path: Path, rest: Any) -> None:
    scene = region_scene()
    teacher = build(scene, write_masks(tmp_path), rest=rest)
    nothing = np.full(8, np.nan) if rest == "none" else WORDS.mean / np.linalg.norm(WORDS.mean)
    for view in range(2):
        np.testing.assert_allclose(rows_of(teacher, scene, view), expected(view, CAPTIONS, nothing), atol=1e-6)
    assert teacher.space.text_encoder == "toy"
    np.testing.assert_array_equal(teacher.mean, WORDS.mean)


def test_captions_may_differ_from_view_to_view(tmp_path: Path) -> None:
    scene = region_scene()
    by_view = {"images/a.jpg": {"1": "lamp", "7": "table", "9": "mug"}, "b": {"1": "table", "7": "mug"}}
    teacher = build(scene, write_masks(tmp_path), by_view, rest="none")
    for view, captions in enumerate(by_view.values()):
        np.testing.assert_allclose(
            rows_of(teacher, scene, view), expected(view, captions, np.full(8, np.nan)), atol=1e-6
        )


@pytest.mark.parametrize("rest", ["none", "mean"])
def test_regions_without_a_caption_are_counted_in_a_warning(tmp_path: Path, rest: Any) -> None:
    scene = region_scene()
    what = "no feature" if rest == "none" else "count as something else"
    with pytest.warns(
        SceneWarning, match=f"3 of 5 regions in 2 views have no caption and {what}; their labels are 7, 9"
    ):
        teacher = build(scene, write_masks(tmp_path), {"1": "mug"}, rest=rest)
    assert scene.views is not None
    codes = teacher.feature_map(scene.views, 0).codes
    assert codes is not None
    assert (codes[labels_of(0) != 1] == (-1 if rest == "none" else 0)).all()


def test_instances_with_the_names_of_objects_are_what_the_labels_teacher_gives() -> None:
    scene = replace(
        region_scene(instances=[labels_of(view).astype(np.int32) for view in range(2)]),
        objects=(scene_object(1, "mug"), scene_object(7, "lamp"), scene_object(9, None), scene_object(33, "table")),
    )
    with pytest.warns(SceneWarning, match="1 of 5 regions in 2 views have no caption"):
        regions = build_teacher(RegionsConfig(masks="instances"), scene, WORDS)
    labels = build_teacher(LabelsConfig(), scene, WORDS)
    for view in range(2):
        np.testing.assert_array_equal(rows_of(regions, scene, view), rows_of(labels, scene, view))
    ours, theirs = (fuse(scene, teacher, FuseConfig(narrow=0)).features for teacher in (regions, labels))
    assert ours.seen.any()
    np.testing.assert_array_equal(ours.seen, theirs.seen)
    np.testing.assert_allclose(ours.decode(), theirs.decode(), atol=1e-5)


def test_instances_may_have_captions_of_a_file(tmp_path: Path) -> None:
    scene = region_scene(tmp_path, instances=[labels_of(view).astype(np.int32) for view in range(2)])
    (tmp_path / "names.json").write_text(json.dumps(CAPTIONS))
    teacher = build_teacher(RegionsConfig(masks="instances", captions="names.json", rest="none"), scene, WORDS)
    np.testing.assert_allclose(rows_of(teacher, scene, 0), expected(0, CAPTIONS, np.full(8, np.nan)), atol=1e-6)


def test_the_words_beside_the_features_hold_the_captions(tmp_path: Path) -> None:
    save_tokenizer(
        tmp_path / "tokenizer.json",
        ("[PAD]", "[UNK]", "[CLS]", "[SEP]", *sorted(set(" ".join([*REFERENCE_NOUNS, "red on a"]).split()))),
    )
    save_graph(tmp_path / "model.onnx", rows=1000)
    config = RegionsConfig(folder=str(write_masks(tmp_path / "masks")))
    words = words_of(config, OnnxTextConfig(model=str(tmp_path), pooling="mean"))
    assert isinstance(words, OpenVocabulary)
    captions = {"1": "red mug on a table", "7": "table", "9": "lamp"}
    (tmp_path / "masks/captions.json").write_text(json.dumps(captions))
    teacher = build_teacher(config, region_scene(), words)
    table = words_beside(teacher, words)
    assert table is not None
    assert table.find("red mug on a table") is not None
    np.testing.assert_allclose(table.encode(["red mug on a table"]), words.encode(["red mug on a table"]), atol=1e-6)


def test_a_text_table_has_the_captions_where_there_is_no_tower(tmp_path: Path) -> None:
    save_text_table(tmp_path / "w.safetensors", WORDS)
    config = RegionsConfig(folder=str(write_masks(tmp_path / "m")), words=str(tmp_path / "w.safetensors"))
    table = text_table_of(config)
    assert table is not None
    assert build(region_scene(), tmp_path / "m", words=table).space.text_encoder == "toy"
    with pytest.raises(InputError, match="captions.*'sofa'"):
        build(region_scene(), tmp_path / "m", {**CAPTIONS, "1": "sofa"}, words=table)
    with pytest.raises(InputError, match="both say what words are"):
        words_of(config, OnnxTextConfig(model="nowhere"))


def test_masks_are_looked_for_in_the_scenes_folder_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_masks(tmp_path / "scene/masks")
    (tmp_path / "scene/masks/captions.json").write_text(json.dumps(CAPTIONS))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    scene, config = region_scene(tmp_path / "scene"), RegionsConfig(folder="masks")
    build_teacher(config, scene, WORDS)
    shutil.copytree(tmp_path / "scene/masks", tmp_path / "here/masks")
    with pytest.raises(InputError, match=r"teacher.folder=masks: stands for .*scene/masks and for .*here/masks"):
        build_teacher(config, scene, WORDS)
    shutil.rmtree(tmp_path / "scene/masks")
    build_teacher(config, scene, WORDS)
    shutil.rmtree(tmp_path / "here/masks")
    with pytest.raises(MissingInput, match="teacher.folder: nothing at .*scene/masks or masks"):
        build_teacher(config, scene, WORDS)


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


def test_label_images_are_called_like_their_views(tmp_path: Path) -> None:
    for name in ("x/1.png", "y/1.npy", "frame-07.color.PNG", "2.safetensors"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = ("x/1.jpg", "y/1.jpg", "frame-07.color.png", "images/2.JPG")
    expected = ["x/1.png", "y/1.npy", "frame-07.color.PNG", "2.safetensors"]
    assert label_paths(tmp_path, names) == [tmp_path / name for name in expected]
    (tmp_path / "2.png").touch()
    with pytest.raises(InputError, match="view 'images/2.JPG' has 2 label images, .*2.png and .*2.safetensors"):
        label_paths(tmp_path, names)
    (tmp_path / "1.png").touch()
    with pytest.raises(
        InputError, match="2 of 3 views have no label image, first 'u/1.jpg'; expected u/1 with the ending"
    ):
        label_paths(tmp_path, ("x/1.jpg", "u/1.jpg", "v/1.jpg"))
    with pytest.raises(InputError, match="would belong to 2 views"):
        label_paths(tmp_path, ("x/1.jpg", "x/1.png"))
    assert label_paths(tmp_path / "x", ("../../../1.png",)) == [tmp_path / "x/1.png"]


def test_missing_label_images_are_counted_and_the_first_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"2 of 2 views have no label image, first 'images/a.jpg'; expected images/a "):
        build(region_scene(), tmp_path)
    with pytest.raises(InputError, match="1 of 2 views have no label image, first 'images/b.jpg'"):
        build(region_scene(), write_masks(tmp_path, ("a",)))


@pytest.mark.parametrize(
    ("captions", "problem"),
    [
        ([], 'expected captions of regions, {"label": "caption"} for all views, or .*; got list'),
        ({}, "got an empty object"),
        ("mug", "got str"),
        ({"1": "mug", "a": {"1": "mug"}}, "got a mixture of both, see '1'"),
        ({"1": 3}, "label 1: expected a caption as text, got '3'"),
        ({"1": None}, "label 1: expected a caption as text, got 'None'"),
        ({"1": " "}, "label 1: expected a caption as text"),
        ({"a": {"1": ["mug"]}}, r"view 'a': label 1: expected a caption as text, got \"\['mug'\]\""),
        ({"mug": "1"}, "expected labels as numbers from 1, got 'mug'"),
        ({"0": "mug"}, "expected labels as numbers from 1, got '0'"),
        ({"-1": "mug"}, "expected labels as numbers from 1, got '-1'"),
        ({"9" * 30: "mug"}, "expected labels as numbers from 1"),
        ({"1": "mug", "01": "table"}, "label 1 has two captions"),
        ({"1": "m" * 1001}, "has 1,001 characters, expected at most 1,000"),
        ({"c": {"1": "mug"}}, "none of its 1 views is one of the scene, first 'c'; the scene's are 'images/a.jpg', …"),
        ({"a": {"1": "mug"}, "a.png": {}}, "a view is listed twice"),
        ({"2": "mug"}, "none of its captions belongs to one of the 5 regions, whose labels are 1, 7, 9"),
        ({"a": {"2": "lamp"}}, "none of its captions belongs to one of the"),
    ],
)
def test_captions_that_do_not_fit_are_refused_in_one_line(tmp_path: Path, captions: Any, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        build(region_scene(), write_masks(tmp_path), captions)
    assert "captions.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_last_part_of_several_views_is_no_name(tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text(json.dumps({"1": {"1": "mug"}}))
    with pytest.raises(InputError, match="'1' stands for 2 views; write their whole names"):
        read_captions(tmp_path / "c.json", ("x/1.jpg", "y/1.jpg"))


def test_captions_of_labels_that_no_mask_has_are_counted_in_a_warning(tmp_path: Path) -> None:
    with pytest.warns(SceneWarning, match="captions.json: 2 of 5 labels occur in no mask: 2, 30"):
        build(region_scene(), write_masks(tmp_path), {**CAPTIONS, "2": "mug", "30": "lamp"})


def test_complete_captions_warn_of_nothing(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        build(region_scene(), write_masks(tmp_path))


def test_what_is_missing_is_said_in_one_line(tmp_path: Path) -> None:
    scene, masks = region_scene(), write_masks(tmp_path / "m")
    instances = RegionsConfig(masks="instances")
    with pytest.raises(InputError, match="captions need words: give a text tower"):
        build(scene, masks, words=None)
    with pytest.raises(InputError, match="teacher.folder= is missing"):
        build_teacher(RegionsConfig(), scene, WORDS)
    (masks / "captions.json").unlink()
    with pytest.raises(InputError, match=r"captions.json: no such file; vector=captions needs captions"):
        build(scene, masks, None)
    with pytest.raises(InputError, match="masks=instances: the scene has no instance maps"):
        build_teacher(instances, scene, WORDS)
    with pytest.raises(InputError, match="no object of the scene has a name"):
        build_teacher(instances, region_scene(instances=[labels_of(0).astype(np.int32)] * 2), WORDS)
    with pytest.raises(InputError, match="the scene has no views"):
        build(replace(scene, views=None), masks)
    for name in "ab":
        save(masks / f"{name}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match="the masks of all 2 views are empty: they have no label above 0"):
        build(scene, masks)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"masks": "sam"}, "masks=sam numbers its masks anew"),
        ({"masks": "instances", "folder": "x"}, "holds label images of masks=files"),
        ({"sam": "x"}, "makes the masks of masks=sam"),
        ({"model": "x.onnx"}, "belong to vector=map and vector=crop"),
        ({"vector": "map", "captions": "x"}, "captions: are the vectors of vector=captions"),
        ({"min_area": 0}, "min_area"),
        ({"points": 0}, "points"),
        ({"min_iou": 1.5}, "min_iou"),
        ({"min_stability": -0.1}, "min_stability"),
        ({"max_overlap": 2.0}, "max_overlap"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        RegionsConfig(**options)


def test_settings_follow_masks_and_captions(tmp_path: Path) -> None:
    scene, masks = region_scene(), write_masks(tmp_path)
    first = build(scene, masks).settings()
    assert build(scene, masks).settings() == first
    assert build(scene, masks, {**CAPTIONS, "1": "lamp"}).settings() != first
    assert build(scene, masks, rest="none").settings() != first
    save(masks / "b.png", labels_of(0))
    assert build(scene, masks).settings() != first


def test_a_label_that_its_view_does_not_show_is_reported(tmp_path: Path) -> None:
    with pytest.warns(SceneWarning) as caught:
        build(region_scene(), write_masks(tmp_path), {"a": {"1": "mug", "2": "lamp"}})
    said = [str(each.message) for each in caught]
    assert any("1 labels are in no pixel of the masks of their views: images/a.jpg: 2" in line for line in said)


def test_a_label_with_two_captions_is_refused(tmp_path: Path) -> None:
    folder = write_masks(tmp_path)
    (folder / "captions.json").write_text('{"1": "mug", "1": "cup"}')
    with pytest.raises(InputError, match=r"captions.json: the key '1' is there twice; expected each once"):
        read_captions(folder / "captions.json", ["images/a.jpg"])


def test_label_images_that_were_saved_with_loss_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(tmp_path / "a.png", format="JPEG")
    with pytest.raises(InputError, match="label image was saved as JPEG, which changes values; expected PNG"):
        read_integers(tmp_path / "a.png", "label image", wide=False)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"onnx": OnnxRegionOptions(patch=7)}, "onnx: says how an image tower is run"),
        ({"around": "nothing"}, "around: says what crops show"),
        ({"vector": "map", "rest": "none"}, "rest: is what has no caption"),
    ],
)
def test_options_that_would_change_nothing_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        RegionsConfig(**options)


def test_captions_that_change_their_labels_and_instances_that_change_have_other_settings(tmp_path: Path) -> None:
    masks = write_masks(tmp_path)
    first = build(region_scene(), masks).settings()
    assert build(region_scene(), masks, {"1": "table", "7": "mug", "9": "lamp"}).settings() != first
    maps = [labels_of(view).astype(np.int32) for view in (0, 1)]
    (tmp_path / "captions.json").write_text(json.dumps(CAPTIONS))
    options = RegionsConfig(masks="instances", captions=str(tmp_path / "captions.json"))
    first_settings = build_teacher(options, region_scene(instances=maps), WORDS).settings()
    assert build_teacher(options, region_scene(instances=maps), WORDS).settings() == first_settings
    changed = [np.where(maps[0] == 9, 7, maps[0]).astype(np.int32), maps[1]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        assert build_teacher(options, region_scene(instances=changed), WORDS).settings() != first_settings


def test_captions_of_a_view_are_never_those_of_another_that_ends_alike(tmp_path: Path) -> None:
    path = tmp_path / "captions.json"
    path.write_text('{"1": {"1": "mug"}}')
    captions = read_captions(path, ["1.jpg", "x/1.jpg"])
    assert captions.of_view("1.jpg") == {1: "mug"}
    assert captions.of_view("x/1.jpg") == {}
    alone = read_captions(path, ["x/1.jpg", "x/2.jpg"])
    assert alone.of_view("x/1.jpg") == {1: "mug"}
    path.write_text('{"1": {"1": "mug"}, "x/1": {"1": "lamp"}}')
    with pytest.raises(InputError, match="'1' and 'x/1' are one view, which is listed twice"):
        read_captions(path, ["x/1.jpg", "x/2.jpg"])


def test_a_view_whose_only_region_was_lost_is_reported_and_the_others_are_used(tmp_path: Path) -> None:
    with pytest.warns(SceneWarning) as caught:
        teacher = build(region_scene(), write_masks(tmp_path), {"a": CAPTIONS, "b": {"5": "mug"}})
    assert any("labels are in no pixel" in str(each.message) for each in caught)
    assert set(teacher.kinds) == {"mug", "table", "lamp"}  # type: ignore[attr-defined]


def test_a_scene_without_instance_maps_lacks_an_input() -> None:
    with pytest.raises(MissingInput, match="the scene has no instance maps"):
        build_teacher(RegionsConfig(masks="instances"), region_scene(), WORDS)
