"""Settings of `gsencoder evaluate`."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gsencoder.app.heads import words_of_head
from gsencoder.app.options import CommonConfig
from gsencoder.app.run import Progress
from gsencoder.app.scenes import folder_of, memory_of, queried_scene
from gsencoder.core.errors import InputError
from gsencoder.core.process import retain_freed_memory
from gsencoder.core.settings import option
from gsencoder.data.scenes import SceneConfig, find_scenes, load_scene
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.data.splats.files import READABLE
from gsencoder.evaluate.benchmarks.instances import InstancesProtocol
from gsencoder.evaluate.benchmarks.recognition import RecognitionProtocol
from gsencoder.evaluate.benchmarks.referring import ReferringProtocol
from gsencoder.evaluate.benchmarks.retrieval import RetrievalProtocol
from gsencoder.evaluate.benchmarks.semantics import SemanticsProtocol
from gsencoder.evaluate.protocols.absent import (
    AbsentProtocol,
)
from gsencoder.evaluate.protocols.grounding import (
    GroundingProtocol,
)
from gsencoder.evaluate.protocols.localization import (
    LocalizationProtocol,
)
from gsencoder.evaluate.protocols.naming import NamingProtocol
from gsencoder.evaluate.sources import (
    FeatureSource,
    encoder_source,
    fused_head_source,
    fusion_source,
    head_source,
    load_scenes,
    space_of_words,
    table_beside,
)
from gsencoder.fusion.folder import heads_beside, load_features
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.measured_heads import find_head, load_heads
from gsencoder.infer.chunks import EncodeConfig
from gsencoder.infer.load import file_of_encoder, load_encoder
from gsencoder.infer.localize import LocalizeConfig
from gsencoder.teachers.build import TeacherConfig, load_teacher_heads, words_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words, stating_trained, words_of_table
from gsencoder.types import QueryMemory, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateConfig(CommonConfig):
    """Settings of `evaluate`."""

    paths: tuple[str, ...] = option((), "labeled scenes, or folders of scenes", metavar="SCENE", required=True)
    weights: str = option(
        "", "encoder whose features are evaluated (see encode); empty = the fused features of the teacher"
    )
    features: str = option(
        "",
        "features that are evaluated in place of those: a folder written by fuse, encode, pack or memory, "
        "or one with such a folder for each scene",
    )
    space: str = option(
        "", "of an encoder or features of several teachers, the one that is evaluated; empty = that of the words"
    )
    head: str = option(
        "",
        "adapter head whose outputs are evaluated, such as siglip, with the words of text=; empty = the "
        "features themselves",
    )
    protocol: (
        LocalizationProtocol
        | NamingProtocol
        | AbsentProtocol
        | GroundingProtocol
        | RecognitionProtocol
        | InstancesProtocol
        | SemanticsProtocol
        | ReferringProtocol
        | RetrievalProtocol
    ) = field(default_factory=LocalizationProtocol)
    classes: str = option(
        "",
        "of recognition, instances and semantics: scannet20, scannet200, a CSV file with the columns id, "
        "name and group, or ScanNet++'s top100.txt; empty = the names of the scenes' objects",
    )
    label_map: str = option(
        "",
        "scannetv2-labels.combined.tsv, or ScanNet++'s map_benchmark.csv, which gives the raw names of "
        "objects a class of classes=, and of referring tells unique from multiple",
    )
    splat: str = option("", f"Gaussians of the scenes; empty = seeds. {READABLE}")
    report: bool = option(False, "write report.html, a page with pictures and figures")
    data: SceneConfig = field(default_factory=SceneConfig)
    seeds: SeedConfig = field(default_factory=SeedConfig)
    fusion: FuseConfig = field(default_factory=FuseConfig)
    teacher: TeacherConfig = field(default_factory=LabelsConfig)
    text: TextConfig = field(default_factory=TableTextConfig)
    encode: EncodeConfig = field(default_factory=EncodeConfig)
    localize: LocalizeConfig = field(default_factory=LocalizeConfig)


def teacher_or_encoder(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """The source of the features, and the words that they are compared with: those of teacher= and text=, or where
    neither is given, those beside the weights."""
    if config.weights:
        retain_freed_memory()
        encoder = load_encoder(config.weights, config.encode.device)
        table = table_beside(encoder, config.space)
        if table is not None and config.teacher == LabelsConfig() and config.text == TableTextConfig():
            words: Words = words_of_table(table)
        else:
            words = _given_words(config)
        space = config.space or space_of_words(encoder, words)
        words = stating_trained(words, table_beside(encoder, space))
        return encoder_source(encoder, config.encode, space), words
    words = _given_words(config)
    return fusion_source(config.teacher, words, config.fusion), words


def stored_features(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """The source of features of a folder, and the words that they are compared with."""
    if config.weights or config.splat or config.teacher != LabelsConfig():
        raise InputError("features: a folder has its own Gaussians and words; leave out weights=, splat= and teacher=")
    first = next(iter(find_scenes(config.paths)))
    scene = load_scene(first, options=config.data)
    folder = folder_of(config.features, scene.name)
    _, words = queried_scene(load_features(folder), folder, head=config.head, space=config.space, text=config.text)
    return lambda scene: (next(iter(scene.features.values())), {}), words


def _given_words(config: EvaluateConfig) -> Words:
    words = words_of(config.teacher, config.text)
    if words is None:
        raise InputError(
            f"evaluate: no words lead into the space of teacher {config.teacher.name}; give teacher.words= or text="
        )
    return words


def source_of_head(config: EvaluateConfig) -> tuple[FeatureSource, Words]:
    """The source of the outputs of an adapter head, and the words that they are compared with."""
    table = getattr(config.teacher, "words", "") if isinstance(config.text, TableTextConfig) else ""
    if config.weights:
        path = heads_beside(file_of_encoder(config.weights))
        if path is None:
            raise InputError(
                f"head={config.head}: no adapter heads lie beside the weights {config.weights}; train with "
                f"heads=[{config.head}]"
            )
        heads = load_heads(path)
        head = find_head(heads, config.head)
        words = words_of_head(head.head, table, config.text)
        retain_freed_memory()
        encoder = load_encoder(config.weights, config.encode.device)
        source = encoder_source(encoder, config.encode, config.space or heads.space.name)
        return head_source(source, heads, head, words.space.text_encoder), words
    (measured_head,) = load_teacher_heads(config.teacher, [config.head], "head")
    words = words_of_head(measured_head, table, config.text)
    return fused_head_source(config.teacher, measured_head, words.space.text_encoder, config.fusion), words


def scenes_of(config: EvaluateConfig, *, part: tuple[int, int] = (0, 1)) -> Iterator[tuple[Scene, float]]:
    """The scenes with their features where these are stored, and the seconds of loading.

    Args:
        part: of the scenes every n-th from the k-th on, as (k, n).
    """
    first, step = part
    track = Progress(quiet=config.quiet or first > 0)
    scenes = load_scenes(find_scenes(config.paths)[first::step], config.data, config.splat, track)
    if config.features:
        options = {"head": config.head, "space": config.space}
        return with_stored_features(scenes, config.features, text=config.text, **options)
    return scenes


def method_name(config: EvaluateConfig) -> str:
    """What the row of the table is called."""
    if config.features:
        return Path(config.features).resolve().name
    return "encoded" if config.weights else "fused"


def with_stored_features(
    scenes: Iterable[tuple[Scene, float]],
    features: str,
    *,
    head: str = "",
    space: str = "",
    text: TextConfig = TableTextConfig(),
) -> Iterator[tuple[Scene, float]]:
    """Labeled scenes with the Gaussians and features of a folder, as `load_scenes` yields scenes.

    The features may have been made from other views of the scene, such as all but those that are evaluated; the origin,
    which is the mean of the cameras, is then another one.
    """
    for scene, seconds in scenes:
        folder = folder_of(features, scene.name)
        stored = load_features(folder)
        if stored.name != scene.name:
            raise InputError(
                f"features: {folder} holds those of scene {stored.name}, and {scene.name} is evaluated; give a folder "
                f"that has the features of each scene in a folder of its name"
            )
        queried, _ = queried_scene(stored, folder, head=head, space=space, text=text)
        assert queried.gaussians is not None
        means = (queried.gaussians.means + (stored.origin - scene.origin)).astype(np.float32)
        gaussians = replace(queried.gaussians, means=means)
        yield replace(scene, gaussians=gaussians, features=queried.features), seconds


def stored_memory(features: str, scene: Scene) -> QueryMemory | None:
    """The memory that the features of a scene were read from; None where features are stored themselves."""
    return memory_of(folder_of(features, scene.name), scene)
