"""Teachers of regions by name, and the map of a view."""

from pathlib import Path
from typing import Any

from region_scenes import WIDTH, region_scene

from gsencoder.teachers.base import Teacher
from gsencoder.teachers.build import build_teacher
from gsencoder.teachers.regions import OnnxRegionOptions, RegionsConfig
from gsencoder.text.table import TextTable
from gsencoder.types import FeatureMap

PLAIN = {"scale": 1.0, "mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
SMALL: dict[str, Any] = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
VISION = {**SMALL, "image_size": 8, "patch_size": 4}


def build(masks: Path, model: Path, vector: str, words: TextTable | None = None, **options: Any) -> Teacher:
    plain = OnnxRegionOptions(layout="grid", patch=4, size=WIDTH, **PLAIN)
    config = RegionsConfig(folder=str(masks), vector=vector, model=str(model), **{"onnx": plain, **options})  # type: ignore[arg-type]
    return build_teacher(config, region_scene(), words)


def made(teacher: Teacher, view: int) -> FeatureMap:
    scene = region_scene()
    assert scene.views is not None
    return teacher.feature_map(scene.views, view)
