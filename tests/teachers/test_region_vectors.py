"""Vectors of regions as means of dense maps, and settings of their teachers."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import transformers
from onnx import helper
from region_scenes import HEIGHT, WIDTH, labels_of, region_scene, save_colors, save_net, save_pool, write_masks
from region_teachers import PLAIN, VISION, build, made
from scene_files import save
from vision_towers import save_preprocessing, save_vision_tower

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.teachers.regions import MapVectors, OnnxRegionOptions, region_means
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
