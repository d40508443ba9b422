"""Where the features that are judged come from: a teacher's fused maps, or an encoder."""

import time
from collections.abc import Callable

from gsencoder.data.spacing import unit_of
from gsencoder.data.text_table import TextTable
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.teachers.build import TeacherConfig, build_teacher
from gsencoder.infer.encode import EncodeConfig, encode
from gsencoder.models.encoder import GaussianEncoder
from gsencoder.models.output_space import OutputSpace
from gsencoder.types import GaussianFeatures, Scene

Source = Callable[[Scene], tuple[GaussianFeatures, dict[str, float]]]
"""From a scene with Gaussians to their features, and the seconds of each step."""


def fused(teacher: TeacherConfig, words: TextTable | None, config: FuseConfig = FuseConfig()) -> Source:
    """Features that a teacher's maps are fused into."""

    def source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        found = fuse(scene, build_teacher(teacher, scene, words), config)
        return found.features, found.seconds

    return source


def encoded(encoder: GaussianEncoder, outputs: OutputSpace, config: EncodeConfig = EncodeConfig()) -> Source:
    """Features that an encoder predicts."""

    def source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        assert scene.gaussians is not None
        start = time.perf_counter()
        unit = unit_of(scene, encoder.config.voxel)
        features = encode(scene.gaussians, encoder, outputs, config, metres_per_unit=unit)
        return features, {"encode": time.perf_counter() - start}

    return source
