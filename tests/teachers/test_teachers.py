"""What each teacher gives for pictures whose answer is known."""

from pathlib import Path

import numpy as np
import pytest
from onnx import helper, numpy_helper
from region_scenes import save_colors, save_net
from splats import front_camera

from gsencoder.core.errors import InputError
from gsencoder.teachers.labels import (
    _PROTOTYPES,
    COLOR_NAMES,
    SOFTNESS,
    LabelsConfig,
    LabelsTeacher,
    PaletteTeacher,
    lab_from_rgb,
    with_kinds,
)
from gsencoder.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.text.table import make_text_table
from gsencoder.text.vocabulary import closed_table
from gsencoder.types import Scene, SceneObject, Views


def views_of(image: np.ndarray | None = None, instances: np.ndarray | None = None) -> Views:
    array = image if image is not None else instances
    images, maps = (None if each is None else [each] for each in (image, instances))
    return Views(cameras=front_camera(array.shape[1], array.shape[0]), names=("a",), images=images, instances=maps)


@pytest.mark.parametrize(
    ("rgb", "name"),
    [
        ((255, 0, 0), "red"), ((0, 0, 255), "blue"), ((0, 128, 0), "green"), ((255, 255, 0), "yellow"),
        ((255, 255, 255), "white"), ((0, 0, 0), "black"), ((128, 128, 128), "grey"), ((255, 165, 0), "orange"),
        ((255, 192, 203), "pink"), ((128, 0, 128), "purple"), ((139, 69, 19), "brown"),
    ],
)  # fmt: skip
def test_the_palette_calls_css_colors_by_their_names(rgb: tuple[int, int, int], name: str) -> None:
    image = np.broadcast_to(np.array(rgb, np.uint8), (6, 8, 3)).copy()
    teacher = PaletteTeacher()
    features = teacher.feature_map(views_of(image), 0).features
    assert features.shape == (3, 4, 11)
    assert COLOR_NAMES[int(features[0, 0].argmax())] == name
    np.testing.assert_allclose(features.sum(axis=-1), 1, rtol=1e-5)


def test_shares_of_color_names_fall_with_the_squared_distance_to_the_nearest_color_of_each_name(rng):
    rgb, teacher = rng.integers(0, 256, (500, 3)).astype(np.uint8), PaletteTeacher()
    for row, shares in zip(lab_from_rgb(rgb), teacher.name_shares(rgb), strict=True):
        away = [((lab_from_rgb(np.uint8(colors)) - row) ** 2).sum(axis=-1).min() for colors in _PROTOTYPES.values()]
        weights = np.exp(-np.array(away, float) / (2 * SOFTNESS**2))
        np.testing.assert_allclose(shares, weights / weights.sum(), atol=1e-5)


def test_lab_of_white_black_and_grey_is_neutral() -> None:
    lab = lab_from_rgb(np.array([[255, 255, 255], [0, 0, 0], [119, 119, 119]], np.uint8))
    np.testing.assert_allclose(lab[:, 0], [100, 0, 50], atol=0.1)
    np.testing.assert_allclose(lab[:, 1:], 0, atol=1e-2)


def label_objects() -> tuple[SceneObject, ...]:
    corner = np.zeros(3)
    return tuple(
        SceneObject(id=i, name=name, aabb_min=corner, aabb_max=corner + 1)
        for i, name in ((3, "mug"), (5, None), (9, "ball"))
    )


def test_labels_give_each_pixel_its_name_and_the_rest_the_mean_direction() -> None:
    embeddings = np.eye(4, 8, dtype=np.float32)
    teacher = LabelsTeacher(label_objects(), make_text_table(("ball", "cup", "mug", "pen"), embeddings, "t"))
    instances = np.array([[0, 3, 5], [9, 9, 77]], np.int32)
    feature_map = teacher.feature_map(views_of(instances=instances), 0)
    vectors = teacher.table[feature_map.codes]
    np.testing.assert_allclose(vectors[0, 1], embeddings[2])
    np.testing.assert_allclose(vectors[1, 0], embeddings[0])
    other = embeddings.mean(axis=0) / np.linalg.norm(embeddings.mean(axis=0))
    for at in ((0, 0), (0, 2), (1, 2)):
        np.testing.assert_allclose(vectors[at], other, rtol=1e-6)


@pytest.mark.parametrize("cell", [1, 2])
def test_without_others_pixels_without_a_name_have_no_vector(cell: int) -> None:
    words = make_text_table(("ball", "mug"), np.eye(2, 8, dtype=np.float32), "t")
    teacher = LabelsTeacher(label_objects(), words, cell=cell, others=False)
    instances = np.array([[3, 3, 3, 5], [3, 3, 9, 9]], np.int32)
    feature_map = teacher.feature_map(views_of(instances=instances), 0)
    if cell == 1:
        assert feature_map.codes is not None
        np.testing.assert_array_equal(feature_map.codes < 0, instances == 5)
    else:
        np.testing.assert_array_equal(np.isnan(feature_map.rows()).all(axis=1), [False, True])


def test_words_of_a_kind_share_the_mean_of_their_vectors_and_broader_words_that_of_their_kinds() -> None:
    names = ("couch", "sofa", "chair", "seat", "zebra")
    vectors = np.random.default_rng(0).normal(size=(5, 8)).astype(np.float32)
    table = make_text_table(names, vectors / np.linalg.norm(vectors, axis=1, keepdims=True), "test")
    merged = closed_table(with_kinds(table))
    couch, sofa, chair, seat, zebra = merged.embeddings
    mean = table.embeddings[:2].mean(axis=0)
    np.testing.assert_array_equal(couch, sofa)
    np.testing.assert_allclose(couch, mean / np.linalg.norm(mean), atol=1e-6)
    np.testing.assert_array_equal(chair, table.embeddings[2])
    np.testing.assert_array_equal(zebra, table.embeddings[4])
    np.testing.assert_allclose(seat, (couch + chair) / np.linalg.norm(couch + chair), atol=1e-6)
    objects = (SceneObject(id=1, name="sofa", aabb_min=np.zeros(3), aabb_max=np.ones(3)),)
    assert LabelsTeacher(objects, merged).kinds == ("couch", "sofa")
    assert LabelsTeacher(objects, table).kinds == ("sofa",)


def test_labels_without_objects_names_or_maps_say_so() -> None:
    words = make_text_table(("ball", "mug"), np.eye(2, 8), "t")
    with pytest.raises(InputError, match="lists no objects"):
        LabelsTeacher((), words)
    with pytest.raises(InputError, match="not among the 2 words of t, first 'mug'"):
        LabelsTeacher(label_objects(), make_text_table(("ball", "cup"), np.eye(2, 8), "t"))
    teacher = LabelsTeacher(label_objects(), words)
    with pytest.raises(InputError, match="no instance maps"):
        teacher.feature_map(views_of(np.zeros((4, 4, 3), np.uint8)), 0)


def write_mean_model(path: Path, patch: int = 4) -> None:
    """A backbone whose features are each patch's mean color, as tokens after one CLS token of zeros."""
    constants = {"flat": np.array([1, 3, -1]), "cls": np.zeros((1, 1, 3), np.float32)}
    save_net(
        path,
        *(helper.make_node("Constant", [], [name], value=numpy_helper.from_array(v)) for name, v in constants.items()),
        helper.make_node("AveragePool", ["image"], ["pooled"], kernel_shape=[patch, patch], strides=[patch, patch]),
        helper.make_node("Reshape", ["pooled", "flat"], ["grid"]),
        helper.make_node("Transpose", ["grid"], ["tokens"], perm=[0, 2, 1]),
        helper.make_node("Concat", ["cls", "tokens"], ["out"], axis=1),
    )


def onnx_config(path: Path, **options: object) -> OnnxConfig:
    values = {"model": str(path), "patch": 4, "size": 32, "skip_tokens": 1, "mean": (0.0,) * 3, "std": (1.0,) * 3}
    return OnnxConfig(**{**values, **options})  # type: ignore[arg-type]


def test_an_onnx_backbone_sees_each_patch_where_it_is(tmp_path: Path) -> None:
    write_mean_model(tmp_path / "m.onnx")
    teacher = OnnxTeacher(onnx_config(tmp_path / "m.onnx"))
    image = np.zeros((24, 32, 3), np.uint8)
    image[8:12, 20:24, 1] = 255
    feature_map = teacher.feature_map(views_of(image), 0)
    assert feature_map.features.shape == (6, 8, 3)
    assert teacher.space.channels == 3
    row, column = np.unravel_index(feature_map.features[..., 1].argmax(), (6, 8))
    assert (int(row), int(column)) == (2, 5)
    assert feature_map.features[2, 5, 1] == pytest.approx(1)
    np.testing.assert_allclose(feature_map.grid_from_image, [[0.25, 0, 0], [0, 0.25, 0]])


def test_a_classifier_becomes_a_mixture_of_the_known_classes_words(tmp_path: Path) -> None:
    write_mean_model(tmp_path / "m.onnx")
    vectors = np.eye(3, 5, dtype=np.float16)
    np.savez(tmp_path / "classes.npz", embeddings=vectors, known=np.array([True, True, False]))
    teacher = OnnxTeacher(onnx_config(tmp_path / "m.onnx", classes=str(tmp_path / "classes.npz")))
    image = np.zeros((24, 32, 3), np.uint8)
    image[..., 1] = 200
    image[..., 2] = 255
    features = teacher.feature_map(views_of(image), 0).features
    odds = np.exp(200 / 255)
    np.testing.assert_allclose(features[0, 0], np.array([1, odds, 0, 0, 0]) / np.hypot(1, odds), atol=1e-6)


def test_models_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file at"):
        OnnxTeacher(onnx_config(tmp_path / "none.onnx"))
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(InputError, match="no model that onnxruntime reads"):
        OnnxTeacher(onnx_config(tmp_path / "bad.onnx"))
    write_mean_model(tmp_path / "m.onnx")
    (tmp_path / "classes.npz").write_bytes(b"PK\3\4 and no more")
    with pytest.raises(InputError, match=r"classes\.npz: cannot be read as \.npz"):
        OnnxTeacher(onnx_config(tmp_path / "m.onnx", classes=str(tmp_path / "classes.npz")))
    with pytest.raises(InputError, match="has outputs"):
        OnnxTeacher(onnx_config(tmp_path / "m.onnx", output="nope"))
    teacher = OnnxTeacher(onnx_config(tmp_path / "m.onnx", skip_tokens=0))
    with pytest.raises(InputError, match="expected 48 patch tokens, the model gave 49"):
        teacher.feature_map(views_of(np.zeros((24, 32, 3), np.uint8)), 0)


@pytest.mark.shared
def test_real_backbones_give_finite_features_of_their_stated_width(shared: Path) -> None:
    image = np.random.default_rng(0).integers(0, 255, (112, 112, 3)).astype(np.uint8)
    dino = OnnxTeacher(
        OnnxConfig(model=str(shared / "models/dinov2_s14_dense_int8.onnx"), patch=14, size=112, skip_tokens=1)
    )
    features = dino.feature_map(views_of(image), 0).features
    assert features.shape == (8, 8, 384)
    assert np.isfinite(features).all()


def test_labels_on_cells_are_the_means_of_their_pixels() -> None:
    rng = np.random.default_rng(0)
    instances = rng.choice(np.array([0, 3, 9]), (7, 10)).astype(np.int32)
    words = make_text_table(("mug", "ball", "cup", "fork"), np.eye(4), "t")
    scene = Scene(name="s", objects=label_objects())
    fine = LabelsConfig().build(scene, words).feature_map(views_of(instances=instances), 0)
    teacher = LabelsConfig(cell=3).build(scene, words)
    coarse = teacher.feature_map(views_of(instances=instances), 0)
    pixels = fine.table[fine.codes][:6, :9].reshape(2, 3, 3, 3, 4)
    np.testing.assert_allclose(coarse.features, pixels.mean(axis=(1, 3)), atol=1e-6)
    assert coarse.grid_from_image[0, 0] == pytest.approx(1 / 3)
    with pytest.raises(InputError, match="smaller than a cell of 3"):
        teacher.feature_map(views_of(instances=instances[:2]), 0)


def test_values_that_are_not_finite_are_told_with_model_and_view(tmp_path: Path) -> None:
    save_net(
        tmp_path / "m.onnx",
        helper.make_node("AveragePool", ["image"], ["cells"], kernel_shape=[4, 4], strides=[4, 4]),
        helper.make_node("Sub", ["cells", "cells"], ["zero"]),
        helper.make_node("Div", ["zero", "zero"], ["out"]),
    )
    teacher = OnnxTeacher(onnx_config(tmp_path / "m.onnx", layout="grid"))
    with pytest.raises(InputError, match=r"m\.onnx: view 'a': 144 of 144 values are not finite"):
        teacher.feature_map(views_of(np.ones((24, 32, 3), np.uint8)), 0)


def test_a_model_that_cannot_take_a_picture_is_told_with_the_pictures_size(tmp_path: Path) -> None:
    weight = helper.make_node("Constant", [], ["w"], value=numpy_helper.from_array(np.ones((1, 3, 99, 99), np.float32)))
    save_net(tmp_path / "m.onnx", weight, helper.make_node("Conv", ["image", "w"], ["out"]))
    teacher = OnnxTeacher(onnx_config(tmp_path / "m.onnx", layout="grid"))
    with pytest.raises(InputError, match=r"m\.onnx does not run on a picture \[1, 3, 24, 32\]"):
        teacher.feature_map(views_of(np.ones((24, 32, 3), np.uint8)), 0)


def test_an_output_with_other_axes_than_the_layouts_is_refused(tmp_path: Path) -> None:
    save_colors(tmp_path / "m.onnx")
    with pytest.raises(InputError, match=r"of shape \[1, 3, 2, 2\], expected \[1, tokens, channels\]"):
        OnnxTeacher(onnx_config(tmp_path / "m.onnx", layout="tokens"))
