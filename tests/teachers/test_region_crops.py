"""Vectors of regions as crops through image towers."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import transformers
from PIL import Image
from region_scenes import labels_of, region_scene, save_colors, save_pool, toy_words, write_masks
from region_teachers import PLAIN, SMALL, VISION, build, made
from vision_towers import JOINT_CHANNELS, save_preprocessing
from vision_towers import VISION as TOWER_VISION

from gsencoder.core.errors import InputError
from gsencoder.teachers.build import build_teacher, words_of
from gsencoder.teachers.regions import OnnxRegionOptions, RegionsConfig, TransformersImageTower, square_crop
from gsencoder.text.models import OnnxTextConfig

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
    teacher = build(
        write_masks(tmp_path / "m"),
        save_pool(tmp_path / "net.onnx"),
        "crop",
        min_area=1,
        around=around,
        onnx=OnnxRegionOptions(size=16, **PLAIN),
    )
    scene = region_scene()
    table = made(teacher, 1).table
    for row, label in enumerate((1, 7)):
        square = square_crop(scene.views.images[1], labels_of(1) == label, (0, 0, 0), masked=around == "nothing")
        mean = np.asarray(Image.fromarray(square).resize((16, 16), Image.Resampling.BICUBIC)).mean(axis=(0, 1))
        np.testing.assert_allclose(table[row], mean / np.linalg.norm(mean), rtol=1e-5)


def joint_clip() -> Any:
    config = transformers.CLIPConfig(
        text_config={**TEXT, "projection_dim": 8}, vision_config={**VISION, "projection_dim": 8}, projection_dim=8
    )
    return transformers.CLIPModel(config), transformers.CLIPImageProcessor(
        size={"shortest_edge": 8}, crop_size={"height": 8, "width": 8}
    )


def joint_siglip() -> Any:
    config = transformers.SiglipConfig(text_config={**TEXT, "projection_size": 16}, vision_config=VISION)
    return transformers.SiglipModel(config), transformers.SiglipImageProcessor(size={"height": 8, "width": 8})


def plain_vit() -> Any:
    return transformers.ViTModel(transformers.ViTConfig(**VISION)), transformers.ViTImageProcessor(
        size={"height": 8, "width": 8}
    )


@pytest.mark.parametrize(("make", "joint"), [(joint_clip, True), (joint_siglip, True), (plain_vit, False)])
def test_crops_through_a_tower_of_transformers_equal_a_direct_call_of_the_library(
    tmp_path: Path, make: Any, joint: bool
) -> None:
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
        build_teacher(RegionsConfig(folder=str(masks), vector="map"), region_scene(), None)
    config = RegionsConfig(folder=str(masks), vector="crop", model=str(save_pool(tmp_path / "p.onnx")))
    with pytest.raises(InputError, match="no pictures to make vectors of regions from"):
        build_teacher(config, region_scene(images=None), None)


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
        processor = transformers.CLIPImageProcessor(
            size={"shortest_edge": edge}, crop_size={"height": 8, "width": 8}, resample=2
        )
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
