"""What `gsencoder evaluate` evaluates: scenes, the source of their features, and words."""

from collections.abc import Iterator
from pathlib import Path

from gsencoder.app.commands.evaluate_settings import EvaluateConfig
from gsencoder.app.commands.evaluated_features import stored_source, stored_words, with_stored_features
from gsencoder.app.commands.through_head import words_of_head
from gsencoder.app.runs.progress import Progress
from gsencoder.core.errors import InputError
from gsencoder.core.process import retain_freed_memory
from gsencoder.data.scenes import find_scenes, load_scene
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
from gsencoder.fusion.folder import heads_beside
from gsencoder.fusion.measured_heads import find_head, heads_of, load_heads
from gsencoder.infer.load import file_of_encoder, load_encoder
from gsencoder.teachers.build import words_of
from gsencoder.teachers.labels import LabelsConfig
from gsencoder.text.vocabulary import TableTextConfig, Words, stating_trained, words_of_table
from gsencoder.types import Scene


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
    options = {"head": config.head, "space": config.space}
    return stored_source, stored_words(config.features, scene.name, text=config.text, **options)


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
    (measured_head,) = heads_of(config.teacher, [config.head], "head")
    words = words_of_head(measured_head, table, config.text)
    return fused_head_source(config.teacher, measured_head, words.space.text_encoder, config.fusion), words


def scenes_of(config: EvaluateConfig, *, part: tuple[int, int] = (0, 1)) -> Iterator[tuple[Scene, float]]:
    """The scenes with their features where these are stored, and the seconds of loading.

    Args:
        config: settings of the command.
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
