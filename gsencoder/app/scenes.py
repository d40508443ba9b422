"""Scenes and words that commands read without torch: features, which way is up, and what is asked for."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.files import read_foreign_text
from gsencoder.core.pretrained import find_file
from gsencoder.data.scenes import SceneConfig, load_scene
from gsencoder.fusion.folder import MEMORY_FILE, load_features, load_memories
from gsencoder.infer.localize import select_features
from gsencoder.infer.views.photographs import with_photographs
from gsencoder.text.table import WORDS_FILE, TextTable, load_text_table, table_path, teachers_in
from gsencoder.text.vocabulary import (
    TableTextConfig,
    TextConfig,
    Words,
    vocabulary_of,
    with_training_names,
    words_of_table,
)
from gsencoder.types import FeatureSpace, QueryMemory, Scene

MAX_QUERIES_BYTES = 1 << 20
"""Largest size of a file of queries, bytes."""


def query_words(query: Sequence[str], queries: str) -> list[str]:
    """The words of query= and of the file queries=, stripped, without repetitions, in order."""
    lines = list(query)
    if queries:
        lines += _lines_of(Path(queries))
    words = list(dict.fromkeys(line.strip() for line in lines if line.strip()))
    if not words:
        raise InputError("query= is missing: one or several words, separated by commas (or queries=FILE)")
    return words


def _lines_of(file: Path) -> list[str]:
    """The lines of a text file, which may begin with a byte order mark."""
    try:
        return read_foreign_text(file, MAX_QUERIES_BYTES).splitlines()
    except InputError as error:
        raise InputError(f"queries: {error}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"queries: {file} cannot be read as text: {error}") from error


def load_query(
    scene: Scene,
    folder: Path,
    *,
    head: str = "",
    space: str = "",
    words_file: str = "",
    text: TextConfig = TableTextConfig(),
) -> tuple[Scene, Words]:
    """A scene with the one feature set that words are compared with, and the words: those of a file, or those in the
    folder of the features; for an adapter head those of `text`."""
    if head:
        # Heads need torch, which finding boxes does without.
        from gsencoder.app.heads import queried_through_head

        return queried_through_head(scene, folder, head, space=space, words_file=words_file, text=text)
    _, features = select_features(scene, space or None)
    words = load_words(folder, features.space, words_file, text)
    return replace(scene, features={features.space.name: features}), words


def load_feature_scene(folder: Path, photos: str, options: SceneConfig) -> Scene:
    """Loads a folder of features, with the photographs of the scene `photos` if one is given."""
    scene = load_features(folder)
    return with_photographs(scene, load_scene(photos, options=options)) if photos else scene


def memory_of(folder: Path, scene: Scene) -> QueryMemory | None:
    """The memory that the one feature set of a scene was decoded from; None where features are stored themselves."""
    if not (folder / MEMORY_FILE).is_file() and not teachers_in(folder, MEMORY_FILE):
        return None
    (features,) = scene.features.values()
    return next((memory for memory in load_memories(folder).values() if memory.space == features.space), None)


def load_words(folder: Path, space: FeatureSpace, words_file: str, text: TextConfig = TableTextConfig()) -> Words:
    """The text table that was given, or the one in the folder of the features, with the tower that made it; a tower
    that is not given is searched for when a phrase needs it."""
    if words_file:
        words = words_of_table(load_text_table(find_file(words_file, "words")), text)
        return with_training_names(words, _find_table(folder, space))
    if not isinstance(text, TableTextConfig):
        table = _find_table(folder, space)
        return vocabulary_of(text) if table is None else words_of_table(table, text)
    path = table_path(folder, space.text_encoder)
    if path is None:
        raise InputError(
            f"{folder}: there is no {WORDS_FILE} next to these features: their teacher has no words, or the file was "
            "lost; fuse with a teacher that has words, or give words= or text="
        )
    return words_of_table(load_text_table(path))


def _find_table(folder: Path, space: FeatureSpace) -> TextTable | None:
    """The table of a space in a folder of features; None where it is lost, damaged or of another space."""
    try:
        path = table_path(folder, space.text_encoder)
        table = None if path is None else load_text_table(path)
    except InputError:
        return None
    return table if table is not None and table.space.text_encoder == space.text_encoder else None


def folder_of(features: str, scene: str) -> Path:
    """The folder of a scene's features: the one of its name in a folder of several, else the folder itself."""
    inner = Path(features) / scene
    return inner if inner.is_dir() else Path(features)
