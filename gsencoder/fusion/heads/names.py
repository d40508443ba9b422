"""Names of adapter heads: an adapter NAME has a summary head and a feature head.

NAME.summary and NAME.features say which. NAME alone is the head that is meant most often: the summary head of adapters
whose model has a text side (CLIP, SigLIP, SigLIP2), since its outputs are compared with words, else the feature head.
"""

from collections.abc import Iterable
from typing import Literal

Part = Literal["summary", "features"]
PARTS: tuple[Part, Part] = ("summary", "features")
TEXT_KINDS = ("siglip2", "siglip", "clip")
"""Kinds of models with a text side, the more special ones first."""


def text_kind(*descriptions: str) -> str:
    """The kind of model with a text side that a description names, such as "open_clip ViT-SO400M-14-SigLIP-384"; empty
    if none does. The first description that names one decides."""
    for description in descriptions:
        for kind in TEXT_KINDS:
            if kind in description.lower():
                return kind
    return ""


def split_name(name: str, adapters: Iterable[str]) -> tuple[str, Part | None]:
    """The adapter that a head's name stands for, and its part if the name says which.

    Args:
        name: NAME, NAME.summary or NAME.features.
        adapters: names of adapters, one of which may itself end in a part's name.
    """
    adapter, _, last = name.rpartition(".")
    for part in PARTS:
        if last == part and adapter and name not in adapters:
            return adapter, part
    return name, None


def default_part(kind: str) -> Part:
    """The part that an adapter's name alone stands for, by the kind of its model with a text side."""
    return "summary" if kind else "features"
