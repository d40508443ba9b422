"""Words without end: a table of names, and the tower that made it for every other phrase."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError, about
from gsencoder.text.embedding_cache import cached_vectors
from gsencoder.text.reference_nouns import REFERENCE_NOUNS
from gsencoder.text.table import MAX_SHOWN, TextTable, normalize
from gsencoder.text.towers import TextTower, TowerRecord, check_phrase, embed_in_templates
from gsencoder.types import FeatureSpace

OpenTower = Callable[[], TextTower]
"""Loads a tower; InputError where it cannot be had."""


class OpenVocabulary:
    """A text encoder that knows the names of a table at once, and loads its tower for any other phrase.

    Attributes:
        table: names with their vectors; its mean and its space are those of the encoder.
        record: which tower made the table.
    """

    def __init__(self, table: TextTable, open_tower: OpenTower) -> None:
        """Args:
        table: with the record of a tower.
        open_tower: loads that tower; called when a phrase needs it, once.

        Raises:
            InputError: no tower made the table.
        """
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
        """The tower, loaded when this is first read.

        Raises:
            InputError: it cannot be had, or is another than the table's.
        """
        tower = self._open()
        if tower.identity != self.record.identity:
            raise InputError(
                f"the words were made by the text tower {self.record.describe()}, and this one is {tower.name!r} "
                f"({tower.identity}); give that one (text.model=)"
            )
        return tower

    def encode(self, words: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """Unit vectors: of names from the table, of other phrases from the tower.

        Raises:
            InputError: a phrase is empty, too long, or cannot be tokenized; or the tower is needed and cannot be had.
        """
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
            shown = ", ".join(repr(phrase[:MAX_SHOWN]) for phrase in phrases[:3])
            near = [name for phrase in phrases[:3] for name in self.table.near(phrase[:MAX_SHOWN], 3)]
            among = f"; known without it: {', '.join(near or self.table.names[:5])}, …"
            raise InputError(
                f"{shown}: not among the {len(self.table)} words stored with these features, and the text tower that "
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

    Args:
        tower: embeds the names.
        kind: of the tower.
        names: that are known beside the reference nouns.
        templates: sentences that names are put into.

    Raises:
        InputError: a name cannot be embedded.
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
    with about(f"text tower {tower.name} cannot embed everyday words, so its tokenizer may be that of another model"):
        vectors = cached_vectors(
            record.identity, templates, REFERENCE_NOUNS, lambda missing: embed_in_templates(tower, missing, templates)
        )
    mean = vectors.mean(axis=0, dtype=np.float64).astype(np.float32)
    table = TextTable(names=REFERENCE_NOUNS, embeddings=vectors, space=space, mean=mean, tower=record)
    return OpenVocabulary(table, lambda: tower).including(names)
