"""Segmenters as teachers: posteriors as shares of class names, from small ONNX graphs; their settings."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
import transformers
from onnx import TensorProto, helper, numpy_helper
from splats import front_camera, random_gaussians
from text_towers import save_tokenizer

from gsencoder.core.errors import InputError
from gsencoder.fusion.checkpoint import read_map, write_map
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.teachers import segmenter
from gsencoder.teachers.build import stored_words, words_of
from gsencoder.teachers.labels import COLOR_NAMES, LabelsConfig, PaletteConfig
from gsencoder.teachers.segmenter import (
    OnnxSegmenterOptions,
    SegmenterConfig,
    SegmenterTeacher,
    read_classes,
    softmax,
    synonyms_of_classes,
)
from gsencoder.text.table import TextTable, make_text_table, save_text_table, unit
from gsencoder.text.vocabulary import OpenVocabulary, make_vocabulary
from gsencoder.types import FeatureMap, Scene, SceneObject, Views

NAMES = ("other", "wall", "chair, seat", "table")


def words(rng: np.random.Generator, names: Sequence[str] = ("wall", "chair", "seat", "table", "lamp")) -> TextTable:
    return make_text_table(names, unit(rng.normal(size=(len(names), 8))), "toy")


def views_of(image: np.ndarray) -> Views:
    return Views(cameras=front_camera(image.shape[1], image.shape[0]), names=("a",), images=[image])


PLAIN = OnnxSegmenterOptions(scale=1.0, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))


def save_graph(
    path: Path,
    *,
    input_type: int = TensorProto.FLOAT,
    shape: Sequence[Any] = (1, 3, 8, 12),
    last: bool = False,
    fourth: float = 1.5,
) -> None:
    """A graph that gives for class c the mean of channel c of cells of 2×2 pixels; the fourth class is constant."""
    pick = np.zeros((4, 3, 2, 2), np.float32)
    for channel in range(3):
        pick[channel, channel] = 0.25
    nodes = [helper.make_node("Cast", ["image"], ["float"], to=TensorProto.FLOAT)]
    nodes += [helper.make_node("Transpose", ["float"], ["first"], perm=[0, 3, 1, 2])] * last
    nodes += [helper.make_node("Conv", ["first" if last else "float", "pick", "bias"], ["scores"], strides=[2, 2])]
    output = helper.make_tensor_value_info("scores", TensorProto.FLOAT, None)
    bias = np.array([0, 0, 0, fourth], np.float32)
    weights = [numpy_helper.from_array(pick, "pick"), numpy_helper.from_array(bias, "bias")]
    image = helper.make_tensor_value_info("image", input_type, shape)
    graph = helper.make_graph(nodes, "net", [image], [output], weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), path)


def teacher_of(
    path: Path, table: TextTable | OpenVocabulary, options: OnnxSegmenterOptions = PLAIN
) -> SegmenterTeacher:
    classes = path.with_name("classes.json")
    if not path.exists():
        save_graph(path)
    if not classes.exists():
        classes.write_text(json.dumps(NAMES))
    return SegmenterTeacher(SegmenterConfig(model=str(path), classes=str(classes), onnx=options), table)


@pytest.fixture
def image(rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 4, (8, 12, 3)).astype(np.uint8)


class HashTower:
    """A vector of normal noise for each phrase, drawn by its letters."""

    name, identity, pooling, channels = "t", "onnx:0", "mean", 8
    lower = False

    def embed(self, phrases: Sequence[str]) -> np.ndarray:
        return unit(np.stack([np.random.default_rng(list(p.encode())).normal(size=8) for p in phrases]))


def expected_shares(image: np.ndarray) -> np.ndarray:
    cells = image.reshape(4, 2, 6, 2, 3).mean(axis=(1, 3))
    logits = np.concatenate([cells, np.full((4, 6, 1), 1.5)], axis=-1)
    return np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)


@pytest.mark.parametrize(
    ("input_type", "shape", "last"),
    [
        (TensorProto.FLOAT, (1, 3, 8, 12), False),
        (TensorProto.FLOAT, ("n", 3, "h", "w"), False),
        (TensorProto.UINT8, (1, 8, 12, 3), True),
        (TensorProto.UINT8, (1, 3, 8, 12), False),
    ],
)
def test_shares_are_the_posteriors_in_every_layout(tmp_path, rng, image, monkeypatch, input_type, shape, last):
    monkeypatch.setattr(segmenter, "MULTIPLE", 4)
    save_graph(tmp_path / "net.onnx", input_type=input_type, shape=shape, last=last)
    teacher = teacher_of(tmp_path / "net.onnx", words(rng), replace(PLAIN, size=12))
    made = teacher.feature_map(views_of(image), 0)
    np.testing.assert_allclose(made.shares, expected_shares(image), atol=1e-5)
    np.testing.assert_allclose(made.grid_from_image, [[0.5, 0, 0], [0, 0.5, 0]])


def test_a_picture_of_another_size_is_squeezed_into_a_fixed_one(tmp_path: Path, rng: np.random.Generator) -> None:
    made = teacher_of(tmp_path / "net.onnx", words(rng)).feature_map(views_of(np.zeros((20, 24, 3), np.uint8)), 0)
    np.testing.assert_allclose(made.grid_from_image, [[6 / 24, 0, 0], [0, 4 / 20, 0]])


def test_classes_are_means_of_their_synonyms_and_nothing_is_the_mean_direction(tmp_path, rng):
    table = words(rng)
    teacher = teacher_of(tmp_path / "net.onnx", table)
    row = dict(zip(table.names, table.embeddings, strict=True))
    expected = [table.mean, row["wall"], row["chair"] + row["seat"], row["table"]]
    np.testing.assert_allclose(teacher.table, unit(np.stack(expected)), atol=1e-6)
    assert teacher.kinds == ("wall", "chair", "seat", "table")
    synonyms = synonyms_of_classes(["door;double door", "side_walk", "Void "], ["void"])
    assert synonyms == [["door", "double door"], ["side walk"], []]


def test_fusing_shares_equals_fusing_the_vectors_that_they_stand_for(tmp_path, rng, image):
    teacher = teacher_of(tmp_path / "net.onnx", words(rng))
    scene = Scene(name="s", gaussians=random_gaussians(200), views=views_of(image))

    class Dense:
        table, mean, needs_images, cheap, space = None, teacher.mean, True, True, teacher.space

        def feature_map(self, views: Views, view: int) -> FeatureMap:
            made = teacher.feature_map(views, view)
            vectors = made.rows().reshape(made.height, made.width, -1)
            return FeatureMap(features=vectors, grid_from_image=made.grid_from_image, space=made.space)

        def settings(self) -> dict[str, Any]:
            return {}

    mixed, dense = (fuse(scene, each, FuseConfig()).features for each in (teacher, Dense()))
    np.testing.assert_allclose(mixed.weights, dense.weights, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(mixed.decode(), dense.decode(), atol=1e-5)


def test_a_mixed_map_comes_back_from_its_file(tmp_path: Path, rng: np.random.Generator, image: np.ndarray) -> None:
    made = teacher_of(tmp_path / "net.onnx", words(rng)).feature_map(views_of(image), 0)
    write_map(tmp_path / "map.safetensors", made)
    again = read_map(tmp_path / "map.safetensors", made.space, made.table)
    np.testing.assert_allclose(again.shares, made.shares, atol=1e-3)
    np.testing.assert_array_equal(again.grid_from_image, made.grid_from_image)


def test_words_beside_the_features_hold_the_classes(tmp_path: Path) -> None:
    vocabulary = make_vocabulary(HashTower(), "onnx", templates=("{}",))
    (tmp_path / "classes.json").write_text(json.dumps(["other", "wall", "zebra crossing", "table"]))
    beside = stored_words(teacher_of(tmp_path / "net.onnx", vocabulary), vocabulary)
    assert beside.find("zebra crossing") is not None
    assert beside.find("other") is None


def test_words_beside_labels_hold_the_names_of_all_objects(tmp_path: Path) -> None:
    vocabulary = make_vocabulary(HashTower(), "onnx", templates=("{}",))
    assert vocabulary.table.find("abacus") is vocabulary.table.find("other") is None
    corners = {"aabb_min": np.zeros(3), "aabb_max": np.ones(3)}
    things = enumerate(("abacus", "zebra crossing"))
    scene = Scene(name="s", objects=tuple(SceneObject(id=row, name=name, **corners) for row, name in things))
    teacher = LabelsConfig().build(scene, vocabulary)
    beside = stored_words(teacher, vocabulary)
    assert beside.find("other") is None
    for name in ("abacus", "zebra crossing"):
        row = beside.find(name)
        np.testing.assert_allclose(beside.embeddings[row], HashTower().embed([name])[0], atol=1e-6)


def test_a_segmenter_needs_a_model_words_and_pictures(tmp_path: Path, rng: np.random.Generator) -> None:
    with pytest.raises(InputError, match="its classes need words"):
        SegmenterConfig(model="net.onnx").build(Scene(name="s"), None)
    with pytest.raises(InputError, match="teacher.model= is missing"):
        SegmenterConfig().build(Scene(name="s"), words(rng))


def test_words_are_those_of_a_table_or_of_the_colors_or_none(tmp_path: Path, rng: np.random.Generator) -> None:
    table = words(rng)
    save_text_table(tmp_path / "words.safetensors", table)
    read = words_of(SegmenterConfig(words=str(tmp_path / "words.safetensors")))
    assert isinstance(read, TextTable)
    assert read.names == table.names
    np.testing.assert_array_equal(read.embeddings, table.embeddings)
    assert words_of(SegmenterConfig()) is None
    colors = words_of(PaletteConfig())
    assert isinstance(colors, TextTable)
    assert colors.names == COLOR_NAMES
    np.testing.assert_array_equal(colors.encode(["red"])[0], np.eye(11)[COLOR_NAMES.index("red")])


@pytest.mark.parametrize(("fourth", "probable"), [(0.509, True), (0.52, False), (0.48, False)])
def test_outputs_that_are_probabilities_already_are_taken_as_they_are(tmp_path, rng, fourth, probable):
    """Rounded ones may differ from a sum of 1 by a hundredth."""
    save_graph(tmp_path / "net.onnx", fourth=fourth)
    image = np.broadcast_to(np.uint8([3, 6, 9]), (8, 12, 3)).copy()
    made = teacher_of(tmp_path / "net.onnx", words(rng), replace(PLAIN, scale=36.0)).feature_map(views_of(image), 0)
    scores = np.float32([3 / 36, 6 / 36, 9 / 36, fourth])
    expected = scores if probable else softmax(scores[None, None], 1.0)[0, 0]
    np.testing.assert_allclose(made.shares[1, 2], expected, atol=1e-6)


def test_pictures_are_normalized_as_those_of_imagenet_unless_stated() -> None:
    from transformers.image_utils import IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD

    usual = OnnxSegmenterOptions()
    assert (usual.scale, [*usual.mean], [*usual.std]) == (255, IMAGENET_DEFAULT_MEAN, IMAGENET_DEFAULT_STD)


@pytest.mark.parametrize("byte", [False, True])
def test_settings_tell_how_pictures_are_given_to_the_network(tmp_path, rng, byte):
    """Maps that were made otherwise are not taken up; a network of bytes is not given normalized ones."""
    save_graph(
        tmp_path / "net.onnx", input_type=TensorProto.UINT8 if byte else TensorProto.FLOAT, shape=("n", 3, "h", "w")
    )
    table = words(rng)

    def settings(**options: Any) -> dict[str, Any]:
        return teacher_of(tmp_path / "net.onnx", table, replace(PLAIN, **options)).settings()

    for options in ({"scale": 2.0}, {"mean": (0.0, 0.5, 0.0)}, {"std": (1.0, 1.0, 2.0)}):
        assert (settings(**options) == settings()) is byte
    assert settings(size=64) != settings()


def test_softmax_holds_at_the_extremes() -> None:
    logits = np.array([[[1e30, 0.0, -1e30]], [[-3e38, -3e38, -3e38]]], np.float32)
    np.testing.assert_allclose(softmax(logits, 1e-3), [[[1, 0, 0]], [[1 / 3] * 3]], atol=1e-6)


def test_what_does_not_fit_is_one_line(tmp_path: Path, rng: np.random.Generator, image: np.ndarray) -> None:
    path, table = tmp_path / "net.onnx", words(rng)
    with pytest.raises(InputError, match="1 of 96 values are not finite"):
        _nan_teacher(path, table).feature_map(views_of(image), 0)
    (tmp_path / "classes.json").write_text('["wall", "chair"]')
    with pytest.raises(InputError, match="gives 4 classes, and there are 2 names for them"):
        teacher_of(path, table).feature_map(views_of(image), 0)
    (tmp_path / "classes.json").write_text('["wall", "zeppelin", "chair", "table"]')
    with pytest.raises(InputError, match="'zeppelin'"):
        teacher_of(path, table)
    (tmp_path / "classes.json").write_text('{"0": "wall", "2": "chair"}')
    with pytest.raises(InputError, match="expected a list of names, in the order of the network's classes"):
        teacher_of(path, table)
    with pytest.raises(InputError, match="no file says what its classes are called"):
        SegmenterTeacher(SegmenterConfig(model=str(path)), table)


def _nan_teacher(path: Path, table: TextTable) -> SegmenterTeacher:
    teacher = teacher_of(path, table)
    network = teacher._network
    scores_of = network.scores

    def broken(image: np.ndarray, num_classes: int) -> Any:
        scores, probable, affine = scores_of(image, num_classes)
        scores[0, 0, 0] = np.nan
        return scores, probable, affine

    network.scores = broken  # type: ignore[method-assign]
    return teacher


def test_names_are_read_from_lists_objects_and_lines(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"1": "b", "0": "a"}')
    (tmp_path / "b.txt").write_bytes(b"\xef\xbb\xbfa\r\nb\r\n\r\n")
    assert read_classes(tmp_path / "a.json") == read_classes(tmp_path / "b.txt") == ("a", "b")


LABELS = {"id2label": dict(enumerate(NAMES)), "label2id": {name: row for row, name in enumerate(NAMES)}}
QUERIES = {"num_queries": 5, "hidden_dim": 32, "encoder_layers": 1, "decoder_layers": 2, "num_attention_heads": 2}
QUERIES |= {"encoder_feedforward_dim": 16, "dim_feedforward": 16, **LABELS}


def small_segformer() -> Any:
    ones = {"depths": [1] * 4, "num_attention_heads": [1] * 4}
    config = transformers.SegformerConfig(hidden_sizes=[8] * 4, decoder_hidden_size=8, **ones, **LABELS)
    return transformers.SegformerForSemanticSegmentation(config)


def small_mask2former() -> Any:
    shape = {"embed_dim": 8, "depths": [1] * 4, "num_heads": [1] * 4, "window_size": 4, "image_size": 64}
    backbone = transformers.SwinConfig(**shape, out_features=["stage1", "stage2", "stage3", "stage4"])
    sizes = {"feature_size": 32, "mask_feature_size": 32}
    config = transformers.Mask2FormerConfig(backbone_config=backbone, **sizes, **QUERIES)
    return transformers.Mask2FormerForUniversalSegmentation(config)


def save_oneformer(folder: Path) -> tuple[Any, Any]:
    """A small OneFormer; its preprocessing names a list of classes in another repository, as published ones do."""
    text = {"width": 16, "num_layers": 1, "vocab_size": 30, "n_ctx": 4}
    text = {f"text_encoder_{name}": value for name, value in text.items()}
    sizes = {"conv_dim": 32, "mask_dim": 32, "query_dec_layers": 1, "task_seq_len": 12}
    backbone = small_mask2former().config.backbone_config
    config = transformers.OneFormerConfig(backbone_config=backbone, **sizes, **text, **QUERIES)
    model = transformers.OneFormerForUniversalSegmentation(config).eval()
    model.save_pretrained(folder)
    save_tokenizer(folder / "tokenizer.json", ("[PAD]", "[UNK]", "[CLS]", "[SEP]", "the", "task", "is", "semantic"))
    tokens = {"tokenizer_class": "PreTrainedTokenizerFast", "pad_token": "[PAD]", "unk_token": "[UNK]"}
    (folder / "tokenizer_config.json").write_text(json.dumps(tokens))
    images = transformers.OneFormerImageProcessorPil(size={"shortest_edge": 40, "longest_edge": 80})
    images.save_pretrained(folder)
    written = folder / "preprocessor_config.json"
    named = {"repo_path": "shi-labs/oneformer_demo", "class_info_file": "ade20k_panoptic.json"}
    written.write_text(json.dumps({**json.loads(written.read_text()), **named}))
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder)
    return model, transformers.OneFormerProcessor(images, tokenizer, task_seq_length=12)


def semantic_shares(outputs: Any) -> np.ndarray:
    """The shares [rows, columns, classes] that queries with masks stand for, of one picture."""
    classes = outputs.class_queries_logits[0].softmax(-1)[:, :-1]
    semantic = torch.einsum("qc,qhw->hwc", classes, outputs.masks_queries_logits[0].sigmoid())
    return np.asarray(semantic / semantic.sum(-1, keepdim=True).clamp(min=1))


@pytest.mark.slow
@pytest.mark.usefixtures("no_gpu")
def test_a_oneformer_gives_the_semantic_map_of_its_library_and_fetches_no_list_of_classes(tmp_path, rng):
    torch.manual_seed(0)
    model, processor = save_oneformer(tmp_path)
    image = rng.integers(0, 256, (64, 48, 3)).astype(np.uint8)
    made = SegmenterTeacher(SegmenterConfig(model=str(tmp_path)), words(rng)).feature_map(views_of(image), 0)
    inputs = processor(images=image, task_inputs=["semantic"], return_tensors="pt")
    assert (inputs["task_inputs"] > 0).sum() >= 4
    with torch.inference_mode():
        outputs = model(**inputs)
    np.testing.assert_allclose(made.shares, semantic_shares(outputs), atol=1e-5)


@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize("size", [(40, 64), (64, 48)])
def test_a_segformer_equals_a_direct_call_of_its_library(tmp_path, rng, size):
    torch.manual_seed(0)
    model = small_segformer().eval()
    model.save_pretrained(tmp_path)
    processor = transformers.SegformerImageProcessorPil(size={"height": 64, "width": 96})
    processor.save_pretrained(tmp_path)
    image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    teacher = SegmenterTeacher(SegmenterConfig(model=str(tmp_path)), words(rng))
    made = teacher.feature_map(views_of(image), 0)
    with torch.inference_mode():
        logits = model(**processor(images=image, return_tensors="pt")).logits[0]
    np.testing.assert_allclose(made.shares, logits.softmax(0).permute(1, 2, 0).numpy(), atol=1e-5)
    rows, columns = logits.shape[1:]
    np.testing.assert_allclose(made.grid_from_image, [[columns / size[1], 0, 0], [0, rows / size[0], 0]])


@pytest.mark.slow
@pytest.mark.usefixtures("no_gpu")
def test_a_mask2former_gives_the_semantic_map_of_its_library_without_the_padding(tmp_path, rng):
    torch.manual_seed(0)
    model = small_mask2former().eval()
    model.save_pretrained(tmp_path)
    processor = transformers.Mask2FormerImageProcessorPil(size={"shortest_edge": 40, "longest_edge": 80})
    processor.save_pretrained(tmp_path)
    image = rng.integers(0, 256, (64, 48, 3)).astype(np.uint8)
    made = SegmenterTeacher(SegmenterConfig(model=str(tmp_path)), words(rng)).feature_map(views_of(image), 0)
    inputs = processor(images=image, return_tensors="pt")
    with torch.inference_mode():
        outputs = model(**inputs)
    np.testing.assert_allclose(made.shares, semantic_shares(outputs), atol=1e-5)
    mask = inputs["pixel_mask"][0]
    height, width = int(mask[:, 0].sum()), int(mask[0].sum())
    end = [width / mask.shape[1] * made.width, height / mask.shape[0] * made.height]
    np.testing.assert_allclose(made.grid_from_image @ [48, 64, 1], end, rtol=1e-6)
