"""Features and words through an adapter head (`head=`), for the commands that read a folder of features."""

import warnings
from dataclasses import replace
from pathlib import Path

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.fusion.measured_heads import HeadSet, MeasuredHead, find_head, head_features, load_heads
from gsencoder.infer.localize import select_features
from gsencoder.models.output_space import HEADS_FILE
from gsencoder.teachers.base import TEXT_KINDS, Head, text_kind
from gsencoder.text.models import TransformersTower
from gsencoder.text.table import TextTable, TextTower, load_text_table
from gsencoder.text.vocabulary import (
    OpenVocabulary,
    TableTextConfig,
    TextConfig,
    Words,
    closed_table,
    vocabulary_of,
    words_of_table,
)
from gsencoder.types import GaussianFeatures, Scene


def queried_through_head(
    scene: Scene, folder: Path, head: str, *, space: str, words_file: str, text: TextConfig
) -> tuple[Scene, Words]:
    """A scene with the outputs of a head as its only features, and the words that they are compared with; arguments and
    errors are those of `gsencoder.app.scenes.load_query`."""
    heads = heads_of_folder(folder, head)
    measured_head = find_head(heads, head)
    words = words_of_head(measured_head.head, words_file, text)
    return scene_through_head(scene, heads, measured_head, space=space, text_encoder=words.space.text_encoder), words


def packed_through_head(
    scene: Scene, folder: Path, head: str, text: TextConfig, *, space: str = ""
) -> tuple[Scene, TextTable | None]:
    """A scene with the outputs of a head as its only features, and the words to store with them, of a given tower."""
    heads = heads_of_folder(folder, head)
    measured_head = find_head(heads, head)
    if isinstance(text, TableTextConfig):
        return scene_through_head(scene, heads, measured_head, space=space), None
    words = closed_table(words_of_head(measured_head.head, "", text))
    return scene_through_head(scene, heads, measured_head, space=space, text_encoder=words.space.text_encoder), words


def heads_of_folder(folder: Path, name: str, option: str = "head") -> HeadSet:
    """The adapter heads in a folder of features or weights; `option=name` asks for one, for the error."""
    path = folder / HEADS_FILE
    if not path.is_file():
        raise InputError(
            f"{option}={name}: there is no {HEADS_FILE} in {folder}; fuse with teacher.heads=[{name}], or train with "
            f"heads=[{name}] and encode with these weights"
        )
    return load_heads(path)


def scene_through_head(
    scene: Scene, heads: HeadSet, head: MeasuredHead, *, space: str = "", text_encoder: str = ""
) -> Scene:
    """The scene with the outputs of a head as its only features."""
    features = features_for_heads(scene, heads, space)
    outputs = head_features(features, head, heads.space, text_encoder=text_encoder)
    return replace(scene, features={outputs.space.name: outputs})


def features_for_heads(scene: Scene, heads: HeadSet, space: str = "") -> GaussianFeatures:
    """The features that heads take: those of `space`, or of several teachers' those of the heads' backbone."""
    if not space and len(scene.features) > 1:
        of_backbone = [features for features in scene.features.values() if features.space == heads.space]
        if of_backbone:
            return of_backbone[0]
    return select_features(scene, space or None)[1]


def words_of_head(head: Head, words_file: str, text: TextConfig) -> Words:
    """The words that a summary head's outputs are compared with: those of a file, or the vocabulary of `text`, the text
    tower of the model to whose space the head leads."""
    if not head.text:
        raise InputError(
            f"head {head.describe()}: leads to no model with a text side ({', '.join(TEXT_KINDS)}), so words cannot be "
            "compared with its outputs; give the head of one that has"
        )
    if head.part != "summary":
        raise InputError(
            f"head={head.name}: words are compared with summary heads, since outputs of feature heads are not aligned "
            f"with text; give head={head.name.rpartition('.')[0]}.summary"
        )
    if words_file:
        words = words_of_table(load_text_table(words_file), text)
    elif isinstance(text, TableTextConfig):
        raise InputError(
            f"head={head.name}: no text table of its space was given; give text=transformers text.model=FOLDER, the "
            f"text side of {head.model or f'its {head.text} model'}, or words=FILE"
        )
    else:
        words = vocabulary_of(text)
    tower = None
    if isinstance(words, OpenVocabulary) and not isinstance(text, TableTextConfig):
        tower = words.tower
    check_head_words(head, words, tower)
    return words


def check_head_words(head: Head, words: Words, tower: TextTower | None) -> None:
    """Checks that words fit a summary head: its channels, and the kind of its model where that is known."""
    name = f"head {head.describe()}"
    described = f"the words of {tower.name!r}" if tower is not None else f"the words of {words.space.text_encoder!r}"
    if words.space.channels != head.channels:
        raise InputError(
            f"{name} gives vectors of {head.channels} channels, and {described} have {words.space.channels}; give the "
            "text side of the model that the head leads to"
        )
    if not isinstance(tower, TransformersTower):
        return
    kind = text_kind(tower.model_type)
    # SigLIP2 models of one resolution are SigLIP models for transformers, but no SigLIP model is one of SigLIP2.
    if kind != head.text and (head.text, kind) != ("siglip2", "siglip"):
        raise InputError(
            f"{name} leads to a {head.text} model, and {described} are those of a {tower.model_type} model; give the "
            "text side of the model that the head leads to"
        )
    if head.text == "siglip2" and not tower.lower:
        warnings.warn(
            f"{name}: SigLIP2 was trained on phrases in lower case without punctuation, and transformers takes "
            f"{tower.name!r} for a SigLIP model, which was not; give text.lower=yes",
            SceneWarning,
            stacklevel=2,
        )
