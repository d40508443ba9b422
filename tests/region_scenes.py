"""A small scene with label images in a folder, that tests of `teacher=regions` stand on."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper
from scene_files import save
from splats import front_camera, random_gaussians

from gsencoder.teachers.base import Teacher
from gsencoder.teachers.regions import OnnxRegionOptions, RegionsConfig
from gsencoder.text.table import TextTable, make_text_table, unit
from gsencoder.types import FeatureMap, Scene, SceneObject, Views

HEIGHT, WIDTH = 24, 32
NAMES = ("images/a.jpg", "images/b.jpg")


def labels_of(view: int) -> np.ndarray:
    """Label 1 on the left, 7 on the right, 9 in a corner of the first view, 0 between them."""
    labels = np.zeros((HEIGHT, WIDTH), np.uint16)
    labels[:, : 12 + view] = 1
    labels[4:, 16:] = 7
    if view == 0:
        labels[:3, -4:] = 9
    return labels


def write_masks(folder: Path) -> Path:
    for view, name in enumerate("ab"):
        save(folder / f"{name}.png", labels_of(view))
    return folder


def region_scene(folder: Path | None = None, **views: Any) -> Scene:
    """Two views of a ball of Gaussians, with random photographs."""
    cameras, rng = front_camera(WIDTH, HEIGHT, 30.0).select([0, 0]), np.random.default_rng(0)
    images = [rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(2)]
    fields = {"images": images, **views}
    return Scene(
        name="s", gaussians=random_gaussians(150), views=Views(cameras=cameras, names=NAMES, **fields),
        folder=folder,
    )  # fmt: skip


def scene_object(label: int, name: str | None) -> SceneObject:
    return SceneObject(id=label, name=name, aabb_min=np.zeros(3), aabb_max=np.ones(3))


def toy_words(*names: str, channels: int = 8) -> TextTable:
    rows = [np.random.default_rng(list(name.encode())).normal(size=channels) for name in names]
    return make_text_table(names, unit(np.stack(rows)), "toy")


def save_net(path: Path, *nodes: Any) -> Path:
    """A graph from `image` [1, 3, h, w] to `out`."""
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])
    output = helper.make_tensor_value_info("out", TensorProto.FLOAT, None)
    graph = helper.make_graph(list(nodes), "net", [image], [output])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), path)
    return path


def save_colors(path: Path) -> Path:
    """Cells of 4×4 pixels with their mean color."""
    return save_net(path, helper.make_node("AveragePool", ["image"], ["out"], kernel_shape=[4, 4], strides=[4, 4]))


def save_pool(path: Path) -> Path:
    """The mean color of a picture."""
    return save_net(path, helper.make_node("GlobalAveragePool", ["image"], ["out"]))


WORDS = toy_words("mug", "table", "lamp")
CAPTIONS: dict[str, Any] = {"1": "mug", "7": "table", "9": "lamp"}


def captioned_teacher(
    scene: Scene, masks: Path, captions: Any = CAPTIONS, words: TextTable | None = WORDS, **options: Any
) -> Teacher:
    if captions is not None:
        (masks / "captions.json").write_text(json.dumps(captions))
    return RegionsConfig(folder=str(masks), **options).build(scene, words)


PLAIN = {"scale": 1.0, "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
SMALL: dict[str, Any] = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
VISION = {**SMALL, "image_size": 8, "patch_size": 4}


def build(masks: Path, model: Path, vector: str, words: TextTable | None = None, **options: Any) -> Teacher:
    plain = OnnxRegionOptions(layout="grid", patch=4, size=WIDTH, **PLAIN)
    config = RegionsConfig(folder=str(masks), vector=vector, model=str(model), **{"onnx": plain, **options})  # type: ignore[arg-type]
    return config.build(region_scene(), words)


def made(teacher: Teacher, view: int) -> FeatureMap:
    return teacher.feature_map(region_scene().views, view)
