"""Where the features that are judged come from: a teacher's fused maps, or an encoder."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.data.seeding.spacing import unit_of
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.teachers.build import TeacherConfig, build_teacher
from gsencoder.infer.encode.chunks import EncodeConfig
from gsencoder.infer.load_encoder import Encoder
from gsencoder.text.table import TextTable
from gsencoder.types import GaussianFeatures, Scene

Source = Callable[[Scene], tuple[GaussianFeatures, dict[str, float]]]
"""From a scene with Gaussians to their features, and the seconds of each step."""


def fused(teacher: TeacherConfig, words: TextTable | None, config: FuseConfig = FuseConfig()) -> Source:
    """Features that a teacher's maps are fused into."""

    def source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        found = fuse(scene, build_teacher(teacher, scene, words), config)
        return found.features, found.seconds

    return source


def encoded(encoder: Encoder, config: EncodeConfig = EncodeConfig()) -> Source:
    """Features that an encoder predicts."""

    def source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        assert scene.gaussians is not None
        start = time.perf_counter()
        features = encoder.encode(scene.gaussians, config, metres_per_unit=unit_of(scene, encoder.voxel))
        return features, {"encode": time.perf_counter() - start}

    return source


def opened(
    paths: Sequence[str | Path], data: SceneConfig = SceneConfig(), splat: str = "", track: Track = untracked
) -> Iterator[tuple[Scene, float]]:
    """Scenes one by one, each with the seconds that reading it took; one is in memory at a time.

    Args:
        paths: of the scenes.
        data: how they are read.
        splat: Gaussians of each, relative to its folder; empty = none but the scene's own.
        track: wraps the loop to show progress.

    Raises:
        InputError: whatever is wrong with a scene.
    """
    for path in track([Path(path) for path in paths], "scenes"):
        start = time.perf_counter()
        scene = load_scene(path, splat=splat or None, options=data)
        yield scene, time.perf_counter() - start


def with_features(scene: Scene, source: Source, seeds: SeedConfig) -> tuple[Scene, GaussianFeatures, dict[str, float]]:
    """A scene with Gaussians, seeds where it had none, their features, and the seconds of each step."""
    start = time.perf_counter()
    scene = with_gaussians(scene, seeds)
    seconds = {"seeds": time.perf_counter() - start}
    features, spent = source(scene)
    return scene, features, seconds | spent
