"""What each teacher gives for pictures whose answer is known."""

from pathlib import Path

import numpy as np
import pytest
from splats import front_camera

from gsencoder.core.errors import InputError
from gsencoder.teachers.build import build_teacher
from gsencoder.teachers.labels import (
    _PROTOTYPES,
    COLOR_NAMES,
    SOFTNESS,
    LabelsConfig,
    LabelsTeacher,
    PaletteTeacher,
    lab_from_rgb,
)
from gsencoder.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.text.table import make_text_table
from gsencoder.types import Scene, SceneObject, Views


def views_of(image: np.ndarray | None = None, instances: np.ndarray | None = None) -> Views:
    array = image if image is not None else instances
    assert array is not None
    cameras = front_camera(array.shape[1], array.shape[0])
    return Views(
        cameras=cameras,
        names=("a",),
        images=None if image is None else [image],
        instances=None if instances is None else [instances],
    )


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
    assert features is not None
    assert features.shape == (3, 4, 11)
    assert COLOR_NAMES[int(features[0, 0].argmax())] == name
    np.testing.assert_allclose(features.sum(axis=-1), 1, rtol=1e-5)


def test_shares_of_color_names_fall_with_the_squared_distance_to_the_nearest_color_of_each_name(
    rng: np.random.Generator,
) -> None:
    rgb, teacher = rng.integers(0, 256, (500, 3)).astype(np.uint8), PaletteTeacher()
    for row, shares in zip(lab_from_rgb(rgb), teacher.name_shares(rgb), strict=True):
        squares = [
            min(float(((lab_from_rgb(np.uint8(color)) - row) ** 2).sum()) for color in colors)
            for colors in _PROTOTYPES.values()
        ]
        weights = np.exp(-np.array(squares) / (2 * SOFTNESS**2))
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
    teacher = LabelsTeacher(label_objects(), ("ball", "cup", "mug", "pen"), embeddings, text_encoder="t")
    instances = np.array([[0, 3, 5], [9, 9, 77]], np.int32)
    feature_map = teacher.feature_map(views_of(instances=instances), 0)
    assert feature_map.codes is not None
    vectors = teacher.table[feature_map.codes]
    np.testing.assert_allclose(vectors[0, 1], embeddings[2])
    np.testing.assert_allclose(vectors[1, 0], embeddings[0])
    other = embeddings.mean(axis=0) / np.linalg.norm(embeddings.mean(axis=0))
    for at in ((0, 0), (0, 2), (1, 2)):
        np.testing.assert_allclose(vectors[at], other, rtol=1e-6)


def test_labels_without_objects_names_or_maps_say_so() -> None:
    embeddings = np.eye(4, 8, dtype=np.float32)
    with pytest.raises(InputError, match="lists no objects"):
        LabelsTeacher((), ("a",), embeddings[:1], text_encoder="t")
    with pytest.raises(InputError, match="not among the 2 words of t, first 'mug'"):
        LabelsTeacher(label_objects(), ("ball", "cup"), embeddings[:2], text_encoder="t")
    teacher = LabelsTeacher(label_objects(), ("ball", "cup", "mug", "pen"), embeddings, text_encoder="t")
    with pytest.raises(InputError, match="no instance maps"):
        teacher.feature_map(views_of(np.zeros((4, 4, 3), np.uint8)), 0)


def write_mean_model(path: Path, patch: int = 4) -> None:
    """A backbone whose features are each patch's mean color, as tokens after one CLS token of zeros."""
    onnx = pytest.importorskip("onnx")
    helper, numpy_helper = onnx.helper, onnx.numpy_helper
    F = onnx.TensorProto.FLOAT
    nodes = [
        helper.make_node("AveragePool", ["image"], ["pooled"], kernel_shape=[patch, patch], strides=[patch, patch]),
        helper.make_node("Reshape", ["pooled", "flat"], ["grid"]),
        helper.make_node("Transpose", ["grid"], ["tokens"], perm=[0, 2, 1]),
        helper.make_node("Concat", ["cls", "tokens"], ["out"], axis=1),
    ]
    constants = [
        numpy_helper.from_array(np.array([1, 3, -1], np.int64), "flat"),
        numpy_helper.from_array(np.zeros((1, 1, 3), np.float32), "cls"),
    ]
    graph = helper.make_graph(
        nodes,
        "mean",
        [helper.make_tensor_value_info("image", F, [1, 3, "H", "W"])],
        [helper.make_tensor_value_info("out", F, [1, "T", 3])],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, path)


def onnx_config(path: Path, **options: object) -> OnnxConfig:
    values = {
        "model": str(path),
        "patch": 4,
        "size": 32,
        "skip_tokens": 1,
        "mean": (0.0, 0.0, 0.0),
        "std": (1.0, 1.0, 1.0),
    }
    return OnnxConfig(**{**values, **options})  # type: ignore[arg-type]


def test_an_onnx_backbone_sees_each_patch_where_it_is(tmp_path: Path) -> None:
    write_mean_model(tmp_path / "m.onnx")
    teacher = OnnxTeacher(onnx_config(tmp_path / "m.onnx"))
    image = np.zeros((24, 32, 3), np.uint8)
    image[8:12, 20:24, 1] = 255
    feature_map = teacher.feature_map(views_of(image), 0)
    assert feature_map.features is not None
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
    assert features is not None
    odds = np.exp(200 / 255)
    np.testing.assert_allclose(features[0, 0], np.array([1, odds, 0, 0, 0]) / np.hypot(1, odds), atol=1e-6)


def test_models_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file at"):
        OnnxTeacher(onnx_config(tmp_path / "none.onnx"))
    (tmp_path / "bad.onnx").write_bytes(b"not a model")
    with pytest.raises(InputError, match="no model that onnxruntime reads"):
        OnnxTeacher(onnx_config(tmp_path / "bad.onnx"))
    write_mean_model(tmp_path / "m.onnx")
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
    assert features is not None
    assert features.shape == (8, 8, 384)
    assert np.isfinite(features).all()


def test_labels_on_cells_are_the_means_of_their_pixels() -> None:
    rng = np.random.default_rng(0)
    instances = rng.choice(np.array([0, 3, 9]), (7, 10)).astype(np.int32)
    table = np.eye(4, dtype=np.float32)
    names = ("mug", "ball", "cup", "fork")
    fine = LabelsTeacher(label_objects(), names, table, text_encoder="t").feature_map(views_of(instances=instances), 0)
    teacher = LabelsTeacher(label_objects(), names, table, text_encoder="t", cell=3)
    coarse = teacher.feature_map(views_of(instances=instances), 0)
    assert fine.table is not None
    assert fine.codes is not None
    pixels = fine.table[fine.codes][:6, :9].reshape(2, 3, 3, 3, 4)
    np.testing.assert_allclose(coarse.features, pixels.mean(axis=(1, 3)), atol=1e-6)
    assert coarse.grid_from_image[0, 0] == pytest.approx(1 / 3)
    with pytest.raises(InputError, match="smaller than a cell of 3"):
        teacher.feature_map(views_of(instances=instances[:2]), 0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("patch", 0), ("patch", -14), ("size", 0), ("size", 10**9), ("skip_tokens", -1), ("scale", 0.0),
        ("scale", float("nan")), ("temperature", 0.0), ("temperature", -1.0),
        ("mean", (0.0, 0.0, float("nan"))), ("std", (1.0, 0.0, 1.0)),
    ],
)  # fmt: skip
def test_settings_that_no_backbone_can_have_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(InputError, match=f"^{name}: expected"):
        onnx_config(Path("m.onnx"), **{name: value})


def write_pooling_model(path: Path, factor: float, inputs: tuple[int | str, ...], outputs: tuple[str, ...]) -> None:
    """A grid backbone: each patch's mean color times `factor`."""
    onnx = pytest.importorskip("onnx")
    helper, F = onnx.helper, onnx.TensorProto.FLOAT
    nodes = [
        helper.make_node("AveragePool", ["image"], ["pooled"], kernel_shape=[4, 4], strides=[4, 4]),
        helper.make_node("Mul", ["pooled", "factor"], ["out"]),
    ]
    graph = helper.make_graph(
        nodes,
        "pool",
        [helper.make_tensor_value_info("image", F, list(inputs))],
        [helper.make_tensor_value_info("out", F, list(outputs))],
        [onnx.numpy_helper.from_array(np.array(factor, np.float32), "factor")],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), path)


def test_values_that_are_not_finite_are_told_with_model_and_view(tmp_path: Path) -> None:
    write_pooling_model(tmp_path / "m.onnx", float("nan"), (1, 3, "H", "W"), ("B", "D", "h", "w"))
    teacher = OnnxTeacher(onnx_config(tmp_path / "m.onnx", layout="grid"))
    with pytest.raises(InputError, match=r"m\.onnx: view 'a': 144 of 144 values are not finite"):
        teacher.feature_map(views_of(np.ones((24, 32, 3), np.uint8)), 0)


def test_a_model_that_cannot_take_a_picture_is_told_with_the_pictures_size(tmp_path: Path) -> None:
    write_pooling_model(tmp_path / "m.onnx", 1.0, (1, 3, 99, 99), ("B", "D", "h", "w"))
    teacher = OnnxTeacher(onnx_config(tmp_path / "m.onnx", layout="grid"))
    with pytest.raises(InputError, match=r"m\.onnx does not run on a picture \[1, 3, 24, 32\]"):
        teacher.feature_map(views_of(np.ones((24, 32, 3), np.uint8)), 0)


def test_an_output_with_other_axes_than_the_layouts_is_refused(tmp_path: Path) -> None:
    write_pooling_model(tmp_path / "m.onnx", 1.0, (1, 3, "H", "W"), ("B", "D", "h", "w"))
    with pytest.raises(InputError, match=r"of shape \[1, 3, 2, 2\], expected \[1, tokens, channels\]"):
        OnnxTeacher(onnx_config(tmp_path / "m.onnx", layout="tokens"))


@pytest.mark.parametrize("content", [b"", b"PK\3\4 and no more", b"\x93NUMPY"])
def test_class_vectors_from_a_damaged_file_are_refused(tmp_path: Path, content: bytes) -> None:
    write_mean_model(tmp_path / "m.onnx")
    (tmp_path / "classes.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"classes\.npz: cannot be read as \.npz"):
        OnnxTeacher(onnx_config(tmp_path / "m.onnx", classes=str(tmp_path / "classes.npz")))


def test_labels_are_built_with_the_cells_that_are_asked_for() -> None:
    words = make_text_table(("mug", "cup"), np.eye(2, dtype=np.float32), "w")
    labeled = Scene(name="s", objects=(SceneObject(id=1, name="mug", aabb_min=np.zeros(3), aabb_max=np.ones(3)),))
    for cell in (1, 3):
        teacher = build_teacher(LabelsConfig(cell=cell), labeled, words)
        assert isinstance(teacher, LabelsTeacher)
        assert (teacher.cell, teacher.table is None) == (cell, cell > 1)
