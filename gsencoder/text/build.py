"""Text encoders from settings, and from the record that lies with features."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import MODELS_VARIABLE, SENTENCE_ENCODER
from gsencoder.text.onnx_tower import OnnxTextConfig, OnnxTower
from gsencoder.text.open_vocabulary import OpenVocabulary, TowerMissing, make_vocabulary
from gsencoder.text.table import TextTable
from gsencoder.text.towers import TextTower, TowerRecord
from gsencoder.text.transformers_tower import TransformersTextConfig, TransformersTower


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
    """Checks that words know names, before there is work with them; with a tower they know all.

    Raises:
        InputError: names that are not in a table without a tower.
    """
    if not isinstance(words, OpenVocabulary):
        words.encode(names)


def load_tower(config: TowerConfig) -> TextTower:
    """The tower of a folder.

    Raises:
        InputError: the folder holds none that can be used.
    """
    return OnnxTower(config) if isinstance(config, OnnxTextConfig) else TransformersTower(config)


def vocabulary_of(config: TowerConfig, names: Sequence[str] = ()) -> OpenVocabulary:
    """The vocabulary of a tower, with some names in its table beside the reference nouns.

    Raises:
        InputError: the tower cannot be used, or a name cannot be embedded.
    """
    return make_vocabulary(load_tower(config), config.name, names, templates=config.templates)


def words_of_table(table: TextTable, config: TextConfig = TableTextConfig()) -> Words:
    """A table as a text encoder: with its tower, where one made it.

    Args:
        table: from a folder of features, or a file.
        config: a tower that is given; it must be the one that made the table. Without one the folder of models is
            searched for it, once a phrase needs it.

    Raises:
        InputError: a tower is given, and the table was not made by it.
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


def stating_trained(words: Words, beside: TextTable | None) -> Words:
    """Words that state the names on which an encoder was trained, where the table beside its features does.

    Args:
        words: that are asked. Names that they state themselves stay; a closed table states those that it has.
        beside: the table that was written with the encoder or its features.
    """
    if beside is None or beside.trained is None or closed_table(words).trained is not None:
        return words
    return words.trained_on(beside.trained)


def find_tower(record: TowerRecord) -> TextTower:
    """Looks for a tower in the folder of models and among those installed, first in folders of its name.

    Raises:
        TowerMissing: it is in none of them.
    """
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
