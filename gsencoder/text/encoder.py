"""What turns words into vectors of a feature space, and whether two spaces may be compared."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.types import FeatureSpace


@runtime_checkable
class TextEncoder(Protocol):
    """Turns words into vectors of a feature space.

    Attributes:
        space: the space, whose `text_encoder` names what encodes.
        mean: the mean of the text side, which centered cosines remove from words.
    """

    @property
    def space(self) -> FeatureSpace: ...

    @property
    def mean(self) -> Float32[np.ndarray, " D"]: ...

    def encode(self, words: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """A unit vector for each word; InputError for a word that it does not know."""
        ...


def check_space(features: FeatureSpace, text: FeatureSpace) -> None:
    """Words may be compared with features only if the same text encoder speaks for both.

    Raises:
        InputError: features that no words lead into, or another encoder or width; both spaces are named.
    """
    if not features.text_encoder:
        raise InputError(
            f"features of space ({features.describe()}) cannot be asked with words: no text encoder leads into it; "
            "fuse with a teacher that has one"
        )
    if features.text_encoder != text.text_encoder or features.channels != text.channels:
        raise InputError(
            f"features of space ({features.describe()}) cannot be compared with words of space ({text.describe()}): "
            f"use the text encoder {features.text_encoder!r}"
        )
