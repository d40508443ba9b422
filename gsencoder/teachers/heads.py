"""An adapter head: layers that lead from a backbone's features into the space of another model."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from jaxtyping import Float
from torch import Tensor, nn

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
    """The adapter that a head's name stands for, and its part if the name says which. The name of an adapter may itself
    end in a part's name."""
    adapter, _, last = name.rpartition(".")
    for part in PARTS:
        if last == part and adapter and name not in adapters:
            return adapter, part
    return name, None


def default_part(kind: str) -> Part:
    """The part that an adapter's name alone stands for, by the kind of its model with a text side."""
    return "summary" if kind else "features"


class Residual(nn.Sequential):
    """A residual block: x + f(x), where f applies the layers in sequence."""

    def forward(self, x: Float[Tensor, "n C"]) -> Float[Tensor, "n C"]:
        out: Tensor = x + super().forward(x)
        return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Head:
    """An adapter head.

    Attributes:
        body: its layers, from features [n, D] of the backbone to vectors [n, E].
        text: the kind of model with a text side to whose space the adapter leads (clip, siglip, siglip2); else empty.
        model: the model to whose space it leads, as the configuration states it; else empty.
    """

    name: str
    body: nn.Sequential
    text: str = ""
    model: str = ""

    @property
    def part(self) -> str:
        """The part of the adapter: summary or features."""
        return self.name.rpartition(".")[2]

    @property
    def channels(self) -> int:
        """E: the number of channels of its outputs."""
        return next(layer.out_features for layer in reversed(self.body) if isinstance(layer, nn.Linear))

    def describe(self) -> str:
        """The head and the model to whose space it leads, for messages."""
        kind = self.model or self.text
        return f"{self.name} ({kind})" if kind else self.name
