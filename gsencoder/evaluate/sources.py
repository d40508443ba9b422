"""Sources of the features to evaluate: fusion of a teacher's maps, or an encoder."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.data.seeding.points import unit_of
from gsencoder.data.seeding.seed import SeedConfig, with_gaussians
from gsencoder.fusion.adapter_heads import Head
from gsencoder.fusion.fit import with_fitting_splat
from gsencoder.fusion.fuse import FuseConfig, fuse
from gsencoder.fusion.measured_heads import HeadSet, MeasuredHead, head_features, measure_heads
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.load import Encoder
from gsencoder.teachers.build import TeacherConfig, build_teacher
from gsencoder.text.table import TextTable
from gsencoder.text.vocabulary import Words
from gsencoder.types import GaussianFeatures, Scene

FeatureSource = Callable[[Scene], tuple[GaussianFeatures, dict[str, float]]]
"""A function from a scene with Gaussians to their features and the seconds of each step."""


def fusion_source(teacher: TeacherConfig, words: Words | None, config: FuseConfig = FuseConfig()) -> FeatureSource:
    """A source that fuses a teacher's maps.

    Args:
        teacher: configuration of the teacher.
        words: text table of the teacher; None if it has none.
        config: settings of fusion.
    """

    def source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        fusion = fuse(scene, build_teacher(teacher, scene, words), config)
        return fusion.features, fusion.seconds

    return source


def encoder_source(encoder: Encoder, config: EncodeConfig = EncodeConfig(), space: str | None = None) -> FeatureSource:
    """A source that runs an encoder.

    Args:
        encoder: the encoder.
        config: settings of encoding.
        space: of an encoder with several teachers, the one whose features are evaluated; None = the only one.
    """

    def source(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        assert scene.gaussians is not None
        start = time.perf_counter()
        unit = unit_of(scene, encoder.voxel)
        features = encoder.encode(scene.gaussians, config, space=space, metres_per_unit=unit)
        return features, {"encode": time.perf_counter() - start}

    return source


def space_of_words(encoder: Encoder, words: Words) -> str | None:
    """The teacher of an encoder in whose space words are; None if it has one teacher.

    Raises:
        InputError: of several teachers, none or more than one has this text encoder.
    """
    if len(encoder.spaces) == 1:
        return None
    text_encoder = words.space.text_encoder
    fitting = [name for name, space in encoder.spaces.items() if space.text_encoder == text_encoder]
    if not fitting:
        raise InputError(
            f"no teacher of the encoder has the text encoder {text_encoder} ({', '.join(encoder.spaces)}); give the "
            "words of one (teacher.words= or text=), or name it with space="
        )
    if len(fitting) > 1:
        listing = "; ".join(f"{name}: {space.describe()}" for name, space in encoder.spaces.items())
        raise InputError(
            f"the words of {text_encoder} are those of {len(fitting)} of the encoder's teachers ({listing}); expected "
            "those of one: give its words (teacher.words= or text=), or name it with space="
        )
    return fitting[0]


def table_beside(encoder: Encoder, space: str | None) -> TextTable | None:
    """The text table beside an encoder: that of a teacher, or without a name that of the first that has one."""
    return encoder.tables.get(space) if space else encoder.words


def head_source(source: FeatureSource, heads: HeadSet, head: MeasuredHead, text_encoder: str) -> FeatureSource:
    """A source that applies an adapter head to the features of another one.

    Args:
        source: features of the backbone that the head takes.
        heads: of which the head is one.
        head: which.
        text_encoder: what turns words into the head's space.
    """

    def outputs(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        features, seconds = source(scene)
        start = time.perf_counter()
        through = head_features(features, head, heads.space, text_encoder=text_encoder)
        return through, {**seconds, "head": time.perf_counter() - start}

    return outputs


def fused_head_source(
    teacher: TeacherConfig, head: Head, text_encoder: str, config: FuseConfig = FuseConfig()
) -> FeatureSource:
    """A source that fuses a teacher's maps, measures an adapter head over them, and applies it.

    Args:
        teacher: configuration of the teacher.
        head: of its backbone.
        text_encoder: what turns words into the head's space.
        config: settings of fusion.
    """

    def outputs(scene: Scene) -> tuple[GaussianFeatures, dict[str, float]]:
        fusion = fuse(scene, build_teacher(teacher, scene, None), config, sample_cells=True)
        assert fusion.sample is not None
        start = time.perf_counter()
        heads = measure_heads([head], fusion.sample, fusion.features.space, fusion.features.basis)
        through = head_features(fusion.features, heads.heads[0], heads.space, text_encoder=text_encoder)
        return through, {**fusion.seconds, "head": time.perf_counter() - start}

    return outputs


def load_scenes(
    paths: Sequence[str | Path], data: SceneConfig = SceneConfig(), splat: str = "", track: Track = untracked
) -> Iterator[tuple[Scene, float]]:
    """Loads scenes one by one, so that one is in memory at a time.

    Args:
        paths: folders or files of the scenes.
        data: how scenes are read.
        splat: file of the Gaussians of each scene, relative to its folder; empty = those that the scene has.
        track: wraps the loop to show progress.

    Yields:
        Each scene, and the seconds that loading took.

    Raises:
        InputError: a scene cannot be read.
    """
    for path in track([Path(path) for path in paths], "scenes"):
        start = time.perf_counter()
        scene = with_fitting_splat(load_scene(path, splat=splat or None, options=data), splat, data)
        yield scene, time.perf_counter() - start


def with_features(
    scene: Scene, source: FeatureSource, seeds: SeedConfig
) -> tuple[Scene, GaussianFeatures, dict[str, float]]:
    """Computes the features of a scene, after making seeds if it has no Gaussians.

    Returns:
        The scene with Gaussians, their features, and the seconds of each step.
    """
    start = time.perf_counter()
    scene = with_gaussians(scene, seeds)
    seconds = {"seeds": time.perf_counter() - start}
    features, source_seconds = source(scene)
    return scene, features, seconds | source_seconds
