"""The interface of text encoders, and the check that words and features have the same space."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.types import FeatureSpace


@runtime_checkable
class TextEncoder(Protocol):
    """Encodes words as vectors of a feature space.

    Attributes:
        space: the feature space; its `text_encoder` is the name of this encoder.
        mean: the mean of text vectors, which centered cosines subtract from words.
    """

    @property
    def space(self) -> FeatureSpace: ...

    @property
    def mean(self) -> Float32[np.ndarray, " D"]: ...

    def encode(self, words: Sequence[str]) -> Float32[np.ndarray, "Q D"]:
        """A unit vector for each word; InputError for an unknown word."""
        ...


def check_space(features: FeatureSpace, text: FeatureSpace) -> None:
    """Checks that words and features have the same text encoder.

    Raises:
        InputError: the features have no text encoder, or another encoder or width; both spaces are named.
    """
    if not features.text_encoder:
        raise InputError(
            f"features of space ({features.describe()}) cannot be queried with words: it has no text encoder; "
            "fuse with a teacher that has one"
        )
    if features.text_encoder != text.text_encoder or features.channels != text.channels:
        raise InputError(
            f"features of space ({features.describe()}) cannot be compared with words of space ({text.describe()}): "
            f"use the text encoder {features.text_encoder!r}"
        )
