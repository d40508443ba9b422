"""Words without end: a table of names, and the tower that made it for every other phrase."""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError, error_prefix
from gsencoder.core.pretrained import MODELS_VARIABLE, SENTENCE_ENCODER
from gsencoder.text.models import OnnxTextConfig, OnnxTower, TransformersTextConfig, TransformersTower
from gsencoder.text.table import (
    MAX_SHOWN,
    REFERENCE_NOUNS,
    TextTable,
    TextTower,
    TowerRecord,
    cached_vectors,
    check_phrase,
    embed_in_templates,
    normalize,
)
from gsencoder.types import FeatureSpace


class OpenVocabulary:
    """A text encoder that knows the names of a table at once, and loads its tower for any other phrase.

    Attributes:
        table: names with their vectors; its mean and its space are those of the encoder.
    """

    def __init__(self, table: TextTable, open_tower: Callable[[], TextTower]) -> None:
        if table.tower is None:
            raise InputError(f"words of {table.space.text_encoder}: a closed table; no text tower belongs to it")
        self.table, self.record, self._open = table, table.tower, open_tower

    @property
    def space(self) -> FeatureSpace:
        return self.table.space

    @property
    def mean(self) -> Float32[np.ndarray, " D"]:
        return self.table.mean

    @cached_property
    def tower(self) -> TextTower:
        """The tower, loaded when this is first read."""
        tower = self._open()
        if tower.identity != self.record.identity:
            raise InputError(
                f"the words were made by the text tower {self.record.describe()}, and this one is {tower.name!r} "
                f"({tower.identity}); give that one (text.model=)"
            )
        return tower

    def encode(self, words: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """Unit vectors: of names from the table, of other phrases from the tower."""
        rows = [self.table.find(check_phrase(word)) for word in words]
        unknown = [word for word, row in zip(words, rows, strict=True) if row is None]
        vectors = np.zeros((len(words), self.space.channels), np.float32)
        known = np.array([row is not None for row in rows], bool)
        vectors[known] = self.table.embeddings[[row for row in rows if row is not None]]
        if unknown:
            vectors[~known] = self._embed(unknown)
        return vectors

    def including(self, names: Iterable[str]) -> "OpenVocabulary":
        """The vocabulary with further names in its table."""
        new = {normalize(name): name for name in names if self.table.find(name) is None}
        if not new:
            return self
        added = list(new.values())
        table = replace(
            self.table,
            names=(*self.table.names, *added),
            embeddings=np.concatenate([self.table.embeddings, self._embed(added)]),
        )
        return OpenVocabulary(table, lambda: self.tower)

    def trained_on(self, names: Sequence[str]) -> "OpenVocabulary":
        """The vocabulary, stating that the encoder of the features was trained on these names."""
        vocabulary = self.including(names)
        return OpenVocabulary(vocabulary.table.trained_on(names), lambda: vocabulary.tower)

    def _embed(self, phrases: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        try:
            return cached_vectors(
                self.record.identity,
                self.record.templates,
                [check_phrase(phrase) for phrase in phrases],
                lambda missing: embed_in_templates(self.tower, missing, self.record.templates),
            )
        except TowerMissing as error:
            first = ", ".join(repr(phrase[:MAX_SHOWN]) for phrase in phrases[:3])
            near = [name for phrase in phrases[:3] for name in self.table.near(phrase[:MAX_SHOWN], 3)]
            among = f"; known without it: {', '.join(near or self.table.names[:5])}, …"
            raise InputError(
                f"{first}: not among the {len(self.table)} words stored with these features, and the text tower that "
                f"made them is missing: {self.record.describe()}; put its folder into GSENCODER_MODELS or give "
                f"text={self.record.kind} text.model=FOLDER ({error}){among}"
            ) from error


class TowerMissing(InputError):
    """The folder of a tower is not where it was looked for."""


def make_vocabulary(
    tower: TextTower, kind: str, names: Iterable[str] = (), *, templates: Sequence[str]
) -> OpenVocabulary:
    """The vocabulary of a tower: the reference nouns, and further names.

    The mean is that of the reference nouns alone, so that it is the same whatever the other names are.
    """
    record = TowerRecord(
        kind=kind,
        name=tower.name,
        identity=tower.identity,
        pooling=tower.pooling,
        templates=tuple(templates),
        lower=tower.lower,
    )
    space = FeatureSpace(name=tower.identity, channels=tower.channels, text_encoder=tower.identity)
    with error_prefix(
        f"text tower {tower.name} cannot embed everyday words, so its tokenizer may be that of another model"
    ):
        vectors = cached_vectors(
            record.identity, templates, REFERENCE_NOUNS, lambda missing: embed_in_templates(tower, missing, templates)
        )
    mean = vectors.mean(axis=0, dtype=np.float64).astype(np.float32)
    table = TextTable(names=REFERENCE_NOUNS, embeddings=vectors, space=space, mean=mean, tower=record)
    return OpenVocabulary(table, lambda: tower).including(names)


@dataclass(frozen=True, slots=True, kw_only=True)
class TableTextConfig:
    """No tower is named: words are those of a text table, and of the tower that made it, where it can be had."""

    name: Literal["table"] = "table"


TextConfig = TableTextConfig | OnnxTextConfig | TransformersTextConfig
TowerConfig = OnnxTextConfig | TransformersTextConfig
Words = TextTable | OpenVocabulary
"""What turns words into vectors: a closed table, or a table with its tower."""


def closed_table(words: Words) -> TextTable:
    """The names that are known without a tower."""
    return words.table if isinstance(words, OpenVocabulary) else words


def check_known(words: Words, names: Sequence[str]) -> None:
    """Checks that words know names, before there is work with them; with a tower they know all."""
    if not isinstance(words, OpenVocabulary):
        words.encode(names)


def load_tower(config: TowerConfig) -> TextTower:
    """The tower of a folder."""
    return OnnxTower(config) if isinstance(config, OnnxTextConfig) else TransformersTower(config)


def vocabulary_of(config: TowerConfig, names: Sequence[str] = ()) -> OpenVocabulary:
    """The vocabulary of a tower, with some names in its table, and the reference nouns."""
    return make_vocabulary(load_tower(config), config.name, names, templates=config.templates)


def words_of_table(table: TextTable, config: TextConfig = TableTextConfig()) -> Words:
    """A table as a text encoder: with its tower, where one made it.

    Args:
        table: from a folder of features, or a file.
        config: a tower that is given; it must be the one that made the table. Without one the folder of models is
            searched for it, once a phrase needs it.
    """
    if isinstance(config, TableTextConfig):
        record = table.tower
        return table if record is None else OpenVocabulary(table, lambda: find_tower(record))
    tower = load_tower(config)
    if table.tower is None or table.tower.identity != tower.identity:
        made_by = table.tower.describe() if table.tower is not None else repr(table.space.text_encoder)
        raise InputError(
            f"text.model={config.model}: the words were made by {made_by}, and this is {tower.name!r} "
            f"({tower.identity}); give that one: its model, tokenizer, text.pooling= and text.lower= must be the same"
        )
    return OpenVocabulary(table, lambda: tower)


def with_training_names(words: Words, stored: TextTable | None) -> Words:
    """Words that state the names on which an encoder was trained, where the table stored with its features does.

    Args:
        words: that are asked. Names that they state themselves stay; a closed table states the names that it has.
        stored: the table that was written with the encoder or its features.
    """
    if stored is None or stored.trained is None or closed_table(words).trained is not None:
        return words
    return words.trained_on(stored.trained)


def find_tower(record: TowerRecord) -> TextTower:
    """Looks for a tower in the folder of models and among those installed, first in folders of its name."""
    models = os.environ.get(MODELS_VARIABLE, "")
    try:
        folders = sorted(path for path in Path(models).iterdir() if path.is_dir()) if models else []
    except OSError as error:
        raise TowerMissing(f"{MODELS_VARIABLE}={models} cannot be read: {error.strerror or error}") from error
    problem = f"none of {len(folders)} folders in {models} holds it" if models else f"{MODELS_VARIABLE} is not set"
    for folder in sorted([*folders, SENTENCE_ENCODER], key=lambda path: path.name != record.name):
        try:
            tower = _open_as(record, folder)
        except InputError as error:
            if folder.name == record.name:
                problem = str(error)
            continue  # The folder of another model, or of none.
        if tower.identity == record.identity:
            return tower
    raise TowerMissing(problem)


def _open_as(record: TowerRecord, folder: Path) -> TextTower:
    options: dict[str, Any] = {"model": str(folder), "pooling": record.pooling}
    if record.kind == "transformers":
        return TransformersTower(TransformersTextConfig(**options, lower="yes" if record.lower else "no"))
    return OnnxTower(OnnxTextConfig(**options))
