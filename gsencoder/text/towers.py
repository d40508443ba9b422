"""Text towers: models that turn any phrase into a vector of their space, and the record by which one is recognized."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError, about

KINDS = ("onnx", "transformers")
SLOT = "{}"
"""Where a template takes the phrase."""
NO_TEMPLATES = (SLOT,)
MAX_TEMPLATES = 1000
MAX_PHRASE = 1000
"""Largest number of characters of a phrase: longer than any description of a thing, and quickly tokenized."""


@runtime_checkable
class TextTower(Protocol):
    """Embeds phrases as they are, one at a time: the vector of a phrase does not depend on the others.

    Attributes:
        name: for people; the name of the folder that it was read from.
        identity: kind and digest of all files and settings that its vectors depend on, and never where they lie.
        pooling: how it makes one vector of those of the tokens.
        lower: whether it lower-cases phrases and removes their punctuation before they are tokenized.
        channels: D.
    """

    @property
    def name(self) -> str: ...

    @property
    def identity(self) -> str: ...

    @property
    def pooling(self) -> str: ...

    @property
    def lower(self) -> bool: ...

    @property
    def channels(self) -> int: ...

    def embed(self, phrases: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """A unit vector for each phrase; InputError for a phrase that the tower cannot read completely."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TowerRecord:
    """Which tower made a table of names, as it is stored with the table.

    Attributes:
        kind: of tower.
        name: of the folder that it was read from then.
        identity, pooling: see `TextTower`.
        templates: the sentences that each name was put into; their vectors were averaged.
        lower: whether phrases are lower-cased and lose their punctuation before they are tokenized.
    """

    kind: str
    name: str
    identity: str
    pooling: str
    templates: tuple[str, ...] = NO_TEMPLATES
    lower: bool = False

    def __post_init__(self) -> None:
        texts = (self.kind, self.name, self.identity, self.pooling)
        if not all(isinstance(text, str) and 0 < len(text) <= MAX_PHRASE for text in texts) or self.kind not in KINDS:
            raise InputError(f"text tower: expected a kind among {', '.join(KINDS)}, a name, an identity and a pooling")
        check_templates(self.templates)

    def describe(self) -> str:
        """The tower in words, for messages."""
        return f"{self.name!r} ({self.identity})"


def check_templates(templates: Sequence[str]) -> None:
    """Checks that each template has one slot for a phrase.

    Raises:
        InputError: none or too many templates, or one without its slot.
    """
    if not 1 <= len(templates) <= MAX_TEMPLATES:
        raise InputError(f"templates: expected 1 to {MAX_TEMPLATES} sentences, got {len(templates)}")
    for template in templates:
        if not isinstance(template, str) or template.count(SLOT) != 1 or len(template) > MAX_PHRASE:
            raise InputError(
                f"templates: expected sentences with one {SLOT} each, such as 'a photo of a {SLOT}', got "
                f"{str(template)[:80]!r}"
            )


def check_phrase(phrase: str) -> str:
    """The phrase with single blanks between its words, which no tokenizer reads otherwise.

    Raises:
        InputError: it is empty, too long, or holds no letter and no digit.
    """
    if len(phrase) > MAX_PHRASE:
        raise InputError(f"query {phrase[:40]!r}…: has {len(phrase):,} characters; expected at most {MAX_PHRASE:,}")
    text = re.sub(r"\s+", " ", phrase).strip()
    if not text:
        raise InputError(f"query {phrase!r}: is empty; expected a word or a phrase")
    if not any(character.isalnum() for character in text):
        raise InputError(f"query {text[:40]!r}: holds no letter and no digit; expected a word or a phrase")
    return text


def check_known(phrase: str, tokens: Sequence[int], unknown: int | None) -> None:
    """Checks that a tokenizer knows all of a phrase; with a part of it unknown another phrase would be embedded.

    Args:
        phrase: for the message.
        tokens: of the phrase, without special ones at its ends.
        unknown: the token for what is not known; None where there is none.

    Raises:
        InputError: nothing, or not all of it, is known.
    """
    if not tokens or all(token == unknown for token in tokens):
        raise InputError(f"query {phrase[:60]!r}: holds no word that its tokenizer knows")
    if unknown in tokens:
        raise InputError(
            f"query {phrase[:60]!r}: its tokenizer does not know {tokens.count(unknown)} of its {len(tokens)} parts; "
            "leave these out"
        )


def embed_in_templates(
    tower: TextTower, phrases: Sequence[str], templates: Sequence[str]
) -> Float32[np.ndarray, "Q D"]:
    """The mean of a phrase's vectors over templates, of unit length.

    Args:
        tower: to embed with.
        phrases: words or descriptions.
        templates: sentences with a slot.

    Raises:
        InputError: a phrase is empty, too long, or not readable for the tower; or vectors are not finite.
    """
    total = np.zeros((len(phrases), tower.channels))
    for template in templates:
        with about(f"text tower {tower.name}"):
            vectors = tower.embed([template.replace(SLOT, check_phrase(phrase)) for phrase in phrases])
        if not np.isfinite(vectors).all():
            raise InputError(f"text tower {tower.name}: its vectors are not finite; check the model")
        total += vectors
    return unit(total)


def unit(vectors: np.ndarray) -> Float32[np.ndarray, "Q D"]:
    """Rows of unit length, computed in float64.

    Raises:
        InputError: a row has no direction.
    """
    values = np.asarray(vectors, np.float64)
    norms = np.sqrt((values**2).sum(axis=1, keepdims=True))
    if not (norms > 1e-12).all():
        raise InputError("a vector of a phrase has no length; check the model and the templates")
    return (values / norms).astype(np.float32)
