"""Masks of SAM and SAM2: small random models of the true kinds beside direct calls of the library, and plain twins."""

import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import transformers
from region_scenes import HEIGHT, WIDTH, region_scene, save_colors
from torch.nn.functional import interpolate

from gsencoder.core.errors import InputError
from gsencoder.fusion.fuse import fuse
from gsencoder.teachers.masks import Proposal, SamMasks, SamOptions, grid_points, mask_iou, paint, stability, suppress
from gsencoder.teachers.regions import OnnxRegionOptions, RegionsConfig

SIDE = 64
POINTS = {"hidden_size": 16, "image_size": SIDE, "mask_input_channels": 4}
LAYERS = {"num_hidden_layers": 1, "num_attention_heads": 2}
DECODER = {"hidden_size": 16, "mlp_dim": 32, "iou_head_hidden_dim": 16, "iou_head_depth": 2, **LAYERS}
PARTS = ("vision_config", "prompt_encoder_config", "mask_decoder_config")


def sam() -> Any:
    vision = {"hidden_size": 16, "output_channels": 16, "mlp_dim": 32, "num_pos_feats": 8, **LAYERS}
    vision |= {"image_size": SIDE, "patch_size": 8, "window_size": 4, "global_attn_indexes": [0]}
    prompt = {**POINTS, "patch_size": 8, "image_embedding_size": 8}
    config = transformers.SamConfig(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=DECODER)
    return transformers.SamModel(config)


def sam2() -> Any:
    backbone = {"model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [SIDE, SIDE]}
    backbone |= {"blocks_per_stage": [1, 1, 2, 1], "embed_dim_per_stage": [8, 16, 32, 64]}
    backbone |= {"num_attention_heads_per_stage": [1, 1, 2, 2], "window_size_per_stage": [8, 4, 4, 2]}
    backbone |= {"window_positional_embedding_background_size": [4, 4], "global_attention_blocks": [3]}
    vision = {"backbone_config": backbone, "backbone_channel_list": [64, 32, 16, 8], "fpn_hidden_size": 32}
    vision["backbone_feature_sizes"] = [[16, 16], [8, 8], [4, 4]]
    decoder = {**DECODER, "hidden_size": 32}
    prompt = {**POINTS, "hidden_size": 32, "patch_size": 16}
    config = transformers.Sam2Config(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)
    return transformers.Sam2Model(config)


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[Callable[[], Any]], tuple[Path, Any]]:
    def save(make: Callable[[], Any]) -> tuple[Path, Any]:
        torch.manual_seed(3)
        model = make().eval()
        # Random masks are near 0 everywhere; these differ from place to place.
        for mlp in model.mask_decoder.output_hypernetworks_mlps:
            mlp.proj_out.weight.data *= 100
        model.save_pretrained(tmp_path / "sam")
        square = {"height": SIDE, "width": SIDE}
        transformers.SamImageProcessor(size={"longest_edge": SIDE}, pad_size=square).save_pretrained(tmp_path / "sam")
        return tmp_path / "sam", model

    return save


def masks_of(folder: Path, **options: Any) -> SamMasks:
    given = {"min_iou": 0.0, "min_stability": 0.0, "max_overlap": 1.0, "min_area": 1, "points": 3}
    return SamMasks(str(folder), SamOptions(**{**given, **options}), "cpu")


def photograph() -> np.ndarray:
    return region_scene().views.images[0]


def full(proposal: Proposal, size: tuple[int, int] = (HEIGHT, WIDTH)) -> np.ndarray:
    mask = np.zeros(size, bool)
    mask[proposal.box] = proposal.pixels
    return mask


def masks_of_library(folder: Path, model: Any, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Logits [points, 3, H, W] at the resolution of the picture and predicted IoUs, by the library's own processor."""
    processor = transformers.SamProcessor(transformers.SamImageProcessor.from_pretrained(folder))
    inputs = processor(photograph(), input_points=[[[point.tolist()] for point in points]], return_tensors="pt")
    with torch.inference_mode():
        outputs = model(
            pixel_values=inputs["pixel_values"], input_points=inputs["input_points"].float(), multimask_output=True
        )
    sizes = inputs["original_sizes"], inputs["reshaped_input_sizes"]
    logits = processor.image_processor.post_process_masks(outputs.pred_masks, *sizes, binarize=False)[0]
    return logits.numpy(), outputs.iou_scores[0].numpy()


def test_proposals_are_the_masks_that_the_library_gives_for_the_points(saved: Any) -> None:
    side, (folder, model) = 6, saved(sam)
    made = list(masks_of(folder, points=side).proposals(photograph()))
    points = grid_points(side) * (WIDTH, HEIGHT)
    logits, scores = masks_of_library(folder, model, points)
    expected = [
        (logits[point, one] > 0, scores[point, one])
        for point in range(side**2)
        for one in range(3)
        if scores[point, one] >= 0 and (logits[point, one] > 0).any()
    ]
    assert 3 < len(expected) == len(made)
    assert [each.score for each in made] == sorted((each.score for each in made), reverse=True)
    expected.sort(key=lambda each: -each[1])
    for proposal, (mask, score) in zip(made, expected, strict=True):
        assert (full(proposal) == mask).mean() > 0.995
        assert proposal.score == pytest.approx(score, abs=1e-4)
        assert proposal.area == proposal.pixels.sum() == full(proposal).sum()


def test_sam2_sees_the_picture_squeezed_into_its_square(saved: Any) -> None:
    folder, model = saved(sam2)
    made = list(masks_of(folder).proposals(photograph()))
    from PIL import Image

    squeezed = np.asarray(Image.fromarray(photograph()).resize((SIDE, SIDE), Image.Resampling.BILINEAR)) / 255
    pixels = torch.from_numpy((squeezed - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]).float().permute(2, 0, 1)[None]
    with torch.inference_mode():
        outputs = model(
            pixel_values=pixels,
            input_points=torch.from_numpy(grid_points(3) * SIDE)[None, :, None],
            input_labels=torch.ones(1, 9, 1, dtype=torch.long),
        )
    logits = interpolate(outputs.pred_masks[0], (HEIGHT, WIDTH), mode="bilinear", align_corners=False).flatten(0, 1)
    order = (-outputs.iou_scores[0].flatten()).argsort(stable=True)
    expected = [mask.numpy() for mask in logits[order] > 0 if mask.any()]
    assert 3 < len(expected) == len(made)
    for proposal, mask in zip(made, expected, strict=True):
        assert (full(proposal) == mask).mean() > 0.995


@pytest.mark.parametrize("make", [sam, sam2])
def test_thresholds_leave_the_proposals_that_reach_them(saved: Any, make: Any) -> None:
    folder, _ = saved(make)
    every = list(masks_of(folder).proposals(photograph()))
    scores, areas = sorted(each.score for each in every), sorted(each.area for each in every)
    middle = scores[len(scores) // 2] - 1e-6
    fewer = list(masks_of(folder, min_iou=middle).proposals(photograph()))
    assert len(fewer) == sum(score >= middle for score in scores) < len(every)
    large = masks_of(folder, min_area=areas[-1]).proposals(photograph())
    assert [each.area for each in large] == [areas[-1]] * areas.count(areas[-1])
    steady = list(masks_of(folder, min_stability=1.0).proposals(photograph()))
    assert len(steady) < len(every)


def test_masks_of_a_large_photograph_are_made_one_at_a_time(saved: Any) -> None:
    folder, _ = saved(sam)
    masks, large = masks_of(folder, points=4), np.repeat(np.repeat(photograph(), 20, axis=0), 20, axis=1)
    tracemalloc.start()
    count = sum(1 for _ in masks.proposals(large))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    pixels = large.shape[0] * large.shape[1]
    assert count > 16
    assert peak < 8 * pixels


def test_stability_is_the_iou_of_two_thresholds() -> None:
    assert stability(np.array([[-2, -0.5, 0.5, 2, 3]], np.float32)) == 2 / 4
    assert stability(np.array([[-2, -3]], np.float32)) == 0
    assert stability(np.array([[2, -3]], np.float32)) == 1


def test_points_are_in_the_middle_of_the_cells_of_a_grid() -> None:
    np.testing.assert_allclose(grid_points(2), [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])


def random_proposals(rng: np.random.Generator, count: int = 40) -> list[Proposal]:
    proposals = []
    for _ in range(count):
        (top, left), (height, width) = rng.integers(0, (12, 18)).tolist(), rng.integers(2, 12, 2).tolist()
        pixels = rng.random((height, width)) < 0.9
        pixels[0, 0] = True
        score = float(rng.random())
        proposals.append(Proposal(top=top, left=left, pixels=pixels, area=int(pixels.sum()), score=score))
    return proposals


def test_iou_of_boxed_masks_is_that_of_whole_masks(rng: np.random.Generator) -> None:
    proposals = random_proposals(rng, 20)
    for a in proposals:
        for b in proposals:
            one, other = full(a), full(b)
            assert mask_iou(a, b) == pytest.approx((one & other).sum() / (one | other).sum())


@pytest.mark.parametrize("most", [0.0, 0.3, 1.0])
def test_of_masks_that_overlap_too_much_the_best_stays(rng: np.random.Generator, most: float) -> None:
    proposals = random_proposals(rng)
    staying = suppress(sorted(proposals, key=lambda each: -each.score), most)
    assert [each.score for each in staying] == sorted((each.score for each in staying), reverse=True)
    for index, one in enumerate(staying):
        assert all(mask_iou(one, better) <= most for better in staying[:index])
    gone = [each for each in proposals if all(each is not one for one in staying)]
    assert all(any(one.score >= each.score and mask_iou(one, each) > most for one in staying) for each in gone)
    assert (not gone) == (most == 1.0)


def test_the_smaller_of_two_masks_is_painted_on_top(rng: np.random.Generator) -> None:
    proposals = random_proposals(rng, 8)
    labels = paint(proposals, (HEIGHT, WIDTH))
    ordered = sorted(proposals, key=lambda each: -each.area)
    for y, x in np.ndindex(HEIGHT, WIDTH):
        covering = [number for number, each in enumerate(ordered, start=1) if full(each)[y, x]]
        assert labels[y, x] == (covering[-1] if covering else 0)


def test_a_teacher_with_masks_of_sam_gives_each_region_a_vector(saved: Any, tmp_path: Path) -> None:
    folder, _ = saved(sam)
    scene = region_scene()
    onnx = OnnxRegionOptions(layout="grid", patch=4, size=WIDTH, scale=1.0, mean=(0.0,) * 3, std=(1.0,) * 3)
    thresholds = {"points": 3, "min_iou": 0.0, "min_stability": 0.0, "max_overlap": 0.5}
    tower = {"model": str(save_colors(tmp_path / "net.onnx")), "onnx": onnx, "device": "cpu"}
    config = RegionsConfig(masks="sam", vector="map", sam=str(folder), **tower, **thresholds)
    teacher = config.build(scene, None)
    made = teacher.feature_map(scene.views, 0)
    options = SamOptions(**thresholds)
    masks = SamMasks(str(folder), options, "cpu")
    labels = masks.labels(scene.views, 0)
    assert made.codes.max() >= 0
    large = [label for label, size in zip(*np.unique(labels, return_counts=True), strict=True) if label and size >= 64]
    assert len(made.table) == len(large)
    np.testing.assert_array_equal(made.codes >= 0, np.isin(labels, large))
    assert teacher.settings()["masks"] == "sam"
    for change in ({"points": 4}, {"min_iou": 0.1}, {"min_stability": 0.1}, {"max_overlap": 0.6}):
        assert SamMasks(str(folder), replace(options, **change), "cpu").settings() != masks.settings()
    empty = replace(config, min_iou=1.0).build(scene, None)
    with pytest.raises(InputError, match="none of 2 views"):
        fuse(scene, empty)
    bare = region_scene(images=None).views
    with pytest.raises(InputError, match="masks=sam: the scene has no pictures"):
        masks.labels(bare, 0)


def test_the_published_form_of_sam2_a_model_of_videos_makes_masks_of_pictures(saved: Any) -> None:
    folder, model = saved(sam2)
    parts = {name: getattr(model.config, name).to_dict() for name in PARTS}
    wide = ("attention_hidden_size", "attention_feed_forward_hidden_size", "encoder_hidden_size", "fuser_embed_dim")
    sizes = {f"memory_{name}": 32 for name in (*wide, "fuser_intermediate_dim")}
    sizes |= {"memory_attention_num_layers": 1, "memory_encoder_output_channels": 16}
    sizes["memory_attention_rope_feat_sizes"] = [4, 4]
    of_pictures = list(masks_of(folder).proposals(photograph()))
    video = transformers.Sam2VideoModel(transformers.Sam2VideoConfig(**parts, **sizes))
    assert not video.load_state_dict(model.state_dict(), strict=False).unexpected_keys
    video.save_pretrained(folder)
    of_videos = list(masks_of(folder).proposals(photograph()))
    assert len(of_videos) == len(of_pictures) > 3
    for one, other in zip(of_videos, of_pictures, strict=True):
        np.testing.assert_array_equal(full(one), full(other))


def test_folders_of_other_models_are_refused(saved: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="teacher.sam= is missing: the folder of a SAM model"):
        SamMasks("", SamOptions())
    vision = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    transformers.ViTModel(transformers.ViTConfig(**vision)).save_pretrained(tmp_path / "vit")
    with pytest.raises(InputError, match="holds a vit model, expected sam or sam2"):
        masks_of(tmp_path / "vit")
    folder, _ = saved(sam2)
    preprocessing = folder / "preprocessor_config.json"
    preprocessing.write_text(json.dumps({"image_mean": [0.5]}))
    with pytest.raises(InputError, match="expected a filter of Pillow as resample"):
        masks_of(folder)
    preprocessing.write_text(json.dumps({"image_mean": [0.5] * 3, "image_std": [0.5] * 3, "resample": 2}))
    views = region_scene().views
    masks = masks_of(folder)
    masks._model.mask_decoder.iou_prediction_head.proj_out.bias.data[:] = torch.nan
    with pytest.raises(InputError, match="view 'images/a.jpg': masks or scores of SAM are not finite"):
        masks.labels(views, 0)
