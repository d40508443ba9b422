"""Vectors of regions: means of dense maps, and crops through image towers."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import transformers
from onnx import helper
from PIL import Image
from region_scenes import (
    HEIGHT,
    PLAIN,
    SMALL,
    VISION,
    WIDTH,
    build,
    labels_of,
    made,
    region_scene,
    save_colors,
    save_net,
    save_pool,
    toy_words,
    write_masks,
)
from scene_files import save
from vision_towers import JOINT_CHANNELS, save_preprocessing, save_vision_tower
from vision_towers import VISION as TOWER_VISION

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.teachers.build import words_of
from gsencoder.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.teachers.regions import (
    MapVectors,
    OnnxRegionOptions,
    RegionsConfig,
    TransformersImageTower,
    region_means,
    square_crop,
)
from gsencoder.text.models import OnnxTextConfig
from gsencoder.types import FeatureMap, FeatureSpace


def test_means_over_regions_weight_cells_by_their_pixels(rng: np.random.Generator) -> None:
    labels = rng.integers(0, 4, (13, 17)).astype(np.int32)
    cells = rng.normal(size=(3, 5, 6)).astype(np.float32)
    affine = np.array([[5 / 17, 0, 0], [0, 3 / 13, 0]])
    dense = FeatureMap(features=cells, grid_from_image=affine, space=FeatureSpace(name="s", channels=6))
    for label, mean in zip((3, 1), region_means(dense, labels, (3, 1)), strict=True):
        pixels = [cells[int((y + 0.5) * 3 / 13), int((x + 0.5) * 5 / 17)] for y, x in np.argwhere(labels == label)]
        np.testing.assert_allclose(mean, np.mean(pixels, axis=0), rtol=1e-5)


def test_pixels_beyond_the_grid_take_the_nearest_cell() -> None:
    cells = np.arange(4, dtype=np.float32).reshape(2, 2, 1)
    # The grid covers the middle of the picture.
    affine = np.array([[0.5, 0, -1], [0, 0.5, -1]])
    dense = FeatureMap(features=cells, grid_from_image=affine, space=FeatureSpace(name="s", channels=1))
    labels = np.zeros((8, 8), np.int32)
    labels[0, 0], labels[7, 7], labels[2, 4] = 1, 2, 3
    np.testing.assert_array_equal(region_means(dense, labels, (1, 2, 3))[:, 0], [0, 3, 1])


def test_each_region_has_the_mean_of_the_dense_teachers_map(tmp_path: Path) -> None:
    model = save_colors(tmp_path / "net.onnx")
    teacher = build(write_masks(tmp_path / "m"), model, "map", min_area=1)
    scene = region_scene()
    dense = OnnxTeacher(OnnxConfig(model=str(model), layout="grid", patch=4, size=WIDTH, **PLAIN))
    for view in range(2):
        one, regions = made(teacher, view), np.unique(labels_of(view))[1:]
        np.testing.assert_array_equal(one.codes, np.searchsorted(np.r_[0, regions], labels_of(view)) - 1)
        means = region_means(dense.feature_map(scene.views, view), labels_of(view).astype(np.int32), regions.tolist())
        np.testing.assert_allclose(one.table, means, rtol=1e-6)
    fused = fuse(scene, teacher, FuseConfig(energy=1.0)).features
    tables = np.concatenate([np.asarray(made(teacher, view).table) for view in range(2)])
    seen = fused.decode()[fused.seen]
    assert len(seen)
    assert (seen >= tables.min(axis=0) - 1e-2).all()
    assert (seen <= tables.max(axis=0) + 1e-2).all()


def test_small_regions_have_no_vector_and_are_counted(tmp_path: Path) -> None:
    model, masks = save_colors(tmp_path / "net.onnx"), write_masks(tmp_path / "m")
    with pytest.warns(SceneWarning, match="1 of 5 regions in 2 views have less than 20 pixels and no feature"):
        teacher = build(masks, model, "map", min_area=20)
    one = made(teacher, 0)
    assert (one.codes[labels_of(0) == 9] == -1).all()
    assert len(one.table) == 2
    exact = made(build(masks, model, "map", min_area=12), 0)
    assert len(exact.table) == 3
    with pytest.raises(InputError, match="all 5 regions in 2 views have less than 5000 pixels"):
        build(masks, model, "map", min_area=5000)
    for name in "ab":
        save(masks / f"{name}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(InputError, match="the masks of all 2 views are empty"):
        build(masks, model, "map")


def test_vectors_that_are_not_finite_are_refused_with_view_and_label(tmp_path: Path) -> None:
    broken = save_net(
        tmp_path / "net.onnx",
        helper.make_node("Sub", ["image", "image"], ["zero"]),
        helper.make_node("Div", ["zero", "zero"], ["nan"]),
        helper.make_node("GlobalAveragePool", ["nan"], ["out"]),
    )
    teacher = build(write_masks(tmp_path / "m"), broken, "crop", min_area=1)
    with pytest.raises(InputError, match="view 'images/a.jpg', label 1: the vector of net is not finite"):
        made(teacher, 0)

    class NanTeacher(OnnxTeacher):
        def feature_map(self, views: Any, view: int) -> FeatureMap:
            dense = super().feature_map(views, view)
            dense.features[0, -1] = np.nan
            return dense

    options = OnnxConfig(model=str(save_colors(tmp_path / "c.onnx")), layout="grid", patch=4, size=WIDTH, **PLAIN)
    scene = region_scene()
    with pytest.raises(InputError, match="view 'images/a.jpg': 1 of 2 regions have no finite vector, first label 9;"):
        MapVectors(NanTeacher(options)).vectors(scene.views, 0, labels_of(0).astype(np.int32), [1, 9])


def test_folders_of_radio_and_of_vision_towers_give_dense_maps_and_others_are_refused(tmp_path: Path) -> None:
    small = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2, "patch_size": 8, "image_size": 32}
    transformers.RadioModel(transformers.RadioConfig(**small, max_img_size=64)).save_pretrained(tmp_path / "radio")
    save_vision_tower("dinov2", tmp_path / "dinov2")
    save_preprocessing("dinov2", tmp_path / "dinov2")
    transformers.ViTModel(transformers.ViTConfig(**VISION)).save_pretrained(tmp_path / "vit")
    masks = write_masks(tmp_path / "m")
    for name in ("radio", "dinov2"):
        one = made(build(masks, tmp_path / name, "map", min_area=1, device="cpu"), 0)
        assert one.space.name.endswith(name)
        assert np.isfinite(one.table).all()
    with pytest.raises(InputError, match="vit"):
        build(masks, tmp_path / "vit", "map", device="cpu")


def test_settings_follow_what_changes_the_vectors(tmp_path: Path) -> None:
    model, masks = save_pool(tmp_path / "net.onnx"), write_masks(tmp_path / "m")
    variants = [
        build(masks, model, "crop", min_area=1).settings(),
        build(masks, model, "crop", min_area=2).settings(),
        build(masks, model, "crop", min_area=1, around="nothing").settings(),
        build(masks, save_colors(tmp_path / "c.onnx"), "map", min_area=1).settings(),
        build(masks, model, "crop", min_area=1, onnx=OnnxRegionOptions(size=17, **PLAIN)).settings(),
    ]
    assert all(first != second for index, first in enumerate(variants) for second in variants[:index])


TEXT = {**SMALL, "vocab_size": 8, "max_position_embeddings": 12, "eos_token_id": 3, "bos_token_id": 2}


@pytest.mark.parametrize("around", ["picture", "nothing"])
def test_a_crop_is_the_box_of_the_region_in_a_gray_square(rng: np.random.Generator, around: str) -> None:
    image = rng.integers(0, 256, (9, 12, 3), dtype=np.uint8)
    mask = np.zeros((9, 12), bool)
    mask[2:5, 1:8] = True
    mask[3, 4] = False
    crop = square_crop(image, mask, (1, 2, 3), masked=around == "nothing")
    expected = np.full((7, 7, 3), (1, 2, 3), np.uint8)
    expected[2:5] = image[2:5, 1:8]
    if around == "nothing":
        expected[3, 3] = (1, 2, 3)
    np.testing.assert_array_equal(crop, expected)


@pytest.mark.parametrize("around", ["picture", "nothing"])
def test_crops_through_an_onnx_tower_are_its_pooled_output(tmp_path: Path, around: Any) -> None:
    masks, model = write_masks(tmp_path / "m"), save_pool(tmp_path / "net.onnx")
    options = {"min_area": 1, "around": around, "onnx": OnnxRegionOptions(size=16, **PLAIN)}
    teacher = build(masks, model, "crop", **options)
    scene = region_scene()
    table = made(teacher, 1).table
    for row, label in enumerate((1, 7)):
        square = square_crop(scene.views.images[1], labels_of(1) == label, (0, 0, 0), masked=around == "nothing")
        mean = np.asarray(Image.fromarray(square).resize((16, 16), Image.Resampling.BICUBIC)).mean(axis=(0, 1))
        np.testing.assert_allclose(table[row], mean / np.linalg.norm(mean), rtol=1e-5)


SQUARE = {"height": 8, "width": 8}


def joint_clip() -> Any:
    text, vision = ({**config, "projection_dim": 8} for config in (TEXT, VISION))
    config = transformers.CLIPConfig(text_config=text, vision_config=vision, projection_dim=8)
    return transformers.CLIPModel(config), transformers.CLIPImageProcessor(size={"shortest_edge": 8}, crop_size=SQUARE)


def joint_siglip() -> Any:
    config = transformers.SiglipConfig(text_config={**TEXT, "projection_size": 16}, vision_config=VISION)
    return transformers.SiglipModel(config), transformers.SiglipImageProcessor(size=SQUARE)


def plain_vit() -> Any:
    return transformers.ViTModel(transformers.ViTConfig(**VISION)), transformers.ViTImageProcessor(size=SQUARE)


@pytest.mark.parametrize(("make", "joint"), [(joint_clip, True), (joint_siglip, True), (plain_vit, False)])
def test_crops_through_a_tower_of_transformers_equal_a_direct_call_of_the_library(tmp_path, make, joint):
    torch.manual_seed(0)
    model, processor = make()
    model = model.eval()
    model.save_pretrained(tmp_path / "model")
    processor.save_pretrained(tmp_path / "model")
    masks = write_masks(tmp_path / "m")
    words = toy_words("mug", "table", channels=8 if make is joint_clip else 16)
    config = RegionsConfig(vector="crop", model=str(tmp_path / "model"))
    assert (not config.refuse_text()) == joint
    teacher = build(masks, tmp_path / "model", "crop", words, min_area=1, joint=not joint, device="cpu")
    assert teacher.space.text_encoder == "toy"
    scene = region_scene()
    gray = tuple(round(255 * value) for value in processor.image_mean)
    square = square_crop(scene.views.images[0], labels_of(0) == 7, gray, masked=False)
    inputs = processor(images=Image.fromarray(square), return_tensors="pt")
    with torch.inference_mode():
        outputs = model.get_image_features(**inputs) if joint else model(**inputs)
    vector = outputs.pooler_output[0].numpy()
    table = made(teacher, 0).table
    np.testing.assert_allclose(table[1], vector / np.linalg.norm(vector), atol=1e-5)
    with pytest.raises(InputError, match="channels and its words 5"):
        build(masks, tmp_path / "model", "crop", toy_words("mug", channels=5), joint=True, device="cpu")


def test_models_without_a_pooled_output_are_refused(tmp_path: Path) -> None:
    masks = write_masks(tmp_path / "m")
    with pytest.raises(InputError, match=r"gave 'out' of shape \[1, 3, 8, 8\], expected a pooled"):
        build(masks, save_colors(tmp_path / "net.onnx"), "crop")
    with pytest.raises(InputError, match="teacher.model= is missing: the image tower of vector=map"):
        RegionsConfig(folder=str(masks), vector="map").build(region_scene(), None)
    config = RegionsConfig(folder=str(masks), vector="crop", model=str(save_pool(tmp_path / "p.onnx")))
    with pytest.raises(InputError, match="no pictures to make vectors of regions from"):
        config.build(region_scene(images=None), None)


def test_a_text_tower_needs_a_joint_model(tmp_path: Path) -> None:
    tower = OnnxTextConfig(model="nowhere")
    for vector in ("map", "crop"):
        with pytest.raises(InputError, match="if teacher.joint=true says that teacher.model= and text= belong to one"):
            words_of(RegionsConfig(vector=vector, model="x.onnx"), tower)  # type: ignore[arg-type]
    model, masks = save_pool(tmp_path / "net.onnx"), write_masks(tmp_path / "m")
    joint = build(masks, model, "crop", toy_words("mug", channels=3), joint=True, min_area=1)
    assert joint.space.text_encoder == "toy"


def clip_folder(folder: Path, **preprocessing: Any) -> Path:
    """A CLIP folder that states the width of its joint space at the top alone, as releases do."""
    torch.manual_seed(0)
    text = {key: value for key, value in TEXT.items() if key != "projection_dim"}
    config = transformers.CLIPConfig(text_config=text, vision_config=TOWER_VISION, projection_dim=JOINT_CHANNELS)
    transformers.CLIPModel(config).save_pretrained(folder)
    save_preprocessing("clip", folder)
    if preprocessing:
        path = folder / "preprocessor_config.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), **preprocessing}))
    return folder


def test_a_clip_folder_may_state_its_joint_space_at_the_top_alone(tmp_path: Path) -> None:
    tower = TransformersImageTower(clip_folder(tmp_path / "clip"), "cpu")
    assert tower.channels == JOINT_CHANNELS
    picture = np.random.default_rng(0).integers(0, 256, (40, 40, 3), dtype=np.uint8)
    model = transformers.CLIPModel.from_pretrained(tmp_path / "clip").eval()
    processor = transformers.CLIPImageProcessorPil.from_pretrained(tmp_path / "clip")
    with torch.inference_mode():
        inputs = processor(images=Image.fromarray(picture), return_tensors="pt")
        vision = model.vision_model(**inputs).pooler_output
        expected = model.visual_projection(vision)[0].numpy()
    np.testing.assert_allclose(tower.embed(picture), expected, atol=1e-5)


def test_a_preprocessing_of_another_size_than_the_model_is_one_line(tmp_path: Path) -> None:
    folder = clip_folder(tmp_path / "clip", crop_size={"height": 64, "width": 64}, size={"shortest_edge": 64})
    with pytest.raises(InputError, match="clip does not run on what its preprocessing makes of a picture"):
        TransformersImageTower(folder, "cpu")


def test_no_end_of_a_square_is_cut_off_by_a_tower_that_crops(tmp_path: Path) -> None:
    """As released DINOv2 folders do, which resize to 256 pixels and take the middle 224."""
    masks, vectors = write_masks(tmp_path / "m"), []
    for edge in (8, 10):
        torch.manual_seed(0)
        model, _ = joint_clip()
        model.eval().save_pretrained(tmp_path / f"model{edge}")
        processor = transformers.CLIPImageProcessor(size={"shortest_edge": edge}, crop_size=SQUARE, resample=2)
        processor.save_pretrained(tmp_path / f"model{edge}")
        words = toy_words("mug", "table", channels=8)
        teacher = build(masks, tmp_path / f"model{edge}", "crop", words, min_area=1, device="cpu")
        vectors.append(made(teacher, 0).table)
    np.testing.assert_allclose(vectors[0], vectors[1], atol=1e-6)


def test_a_crop_teacher_without_a_joint_space_takes_no_words_beside_one_that_has_some(tmp_path: Path) -> None:
    for name, make in (("clip", joint_clip), ("vit", plain_vit)):
        make()[0].save_pretrained(tmp_path / name)
    config = RegionsConfig(masks="instances", vector="crop", model=str(tmp_path / "vit"))
    assert not config.takes_text()
    assert replace(config, joint=True).takes_text()
    assert replace(config, model=str(tmp_path / "clip")).takes_text()
