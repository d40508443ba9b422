"""What a teacher is: a model that gives each view a map of features, and settings that build it. One file each.

An adapter head of a teacher is layers that lead from its features into the space of another model.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import find_file
from gsencoder.core.settings import CheckedConfig
from gsencoder.text.table import TextTable, load_text_table
from gsencoder.text.vocabulary import Words
from gsencoder.types import FeatureSpace, Scene
from gsencoder.types import Teacher as Teacher


class MissingInput(InputError):
    """A scene does not have what a teacher needs of every scene, such as labels. A training with several teachers
    leaves the teacher out in such a scene."""


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


@dataclass(frozen=True, slots=True, kw_only=True)
class TeacherSettings(CheckedConfig):
    """The settings of a teacher, which answer for it: how it is built, and which words are in its space.

    A subclass has a field `name: Literal["…"]`, the value of `teacher=`, and a line in `gsencoder.teachers.build`.

    Attributes:
        per_scene: whether the teacher is made of a scene's own labels or masks; any other is built once for all scenes.
        needs_labels: whether it needs labels of objects, which a bare splat does not have.
        has_heads: whether adapter heads map its space to others.
    """

    per_scene: ClassVar[bool] = False
    needs_labels: ClassVar[bool] = False
    has_heads: ClassVar[bool] = False

    def build(self, scene: Scene, words: Words | None) -> Teacher:
        """The teacher of a scene.

        Args:
            words: from `gsencoder.teachers.build.words_of`, which is called once for many scenes.
        """
        raise NotImplementedError

    def text_table(self) -> TextTable | None:
        """The words of the teacher's space without a text tower; None where there are none."""
        words: str = getattr(self, "words", "")
        return load_text_table(find_file(words, "teacher.words")) if words else None

    def adapt(self, words: Words) -> Words:
        """The words of its space as this teacher has them."""
        return words

    @property
    def stored_heads(self) -> tuple[str, ...]:
        """The names of the adapter heads that are stored with its features."""
        return ()

    def read_heads(self, names: Sequence[str], option: str = "heads") -> list[Head]:
        """Adapter heads, by names that `option` gives."""
        if names:
            teacher = getattr(self, "name", "")
            raise InputError(f"{option}={names[0]}: teacher={teacher} has no adapter heads; teacher=radio has some")
        return []

    def refuse_text(self) -> str:
        """Why its words cannot be those of a text tower (`text=`); empty where they can be, for which settings have an
        option `words`."""
        if not hasattr(self, "words"):
            return f"text=: no text tower shares the space of teacher={getattr(self, 'name', '')}; leave out text="
        if self.words:
            return "text= and teacher.words= both say what words are; leave out one of them"
        return ""

    def takes_text(self) -> bool:
        """Whether a text tower that is given for several teachers is for this one."""
        return not self.refuse_text()


def text_encoder_of(words: Words | None) -> str:
    """What turns words into a teacher's space; empty if nothing does."""
    return "" if words is None else words.space.text_encoder


def settings_of(space: FeatureSpace) -> dict[str, Any]:
    """The settings of a teacher whose feature space states all that its maps depend on."""
    return {
        "name": space.teacher,
        "model": space.weights,
        "layer": space.layer,
        "preprocessing": space.preprocessing,
    }


def check_channels(space: FeatureSpace, words: Words | None) -> None:
    """Refuses words of another width than a teacher's features."""
    if words is not None and words.space.channels != space.channels:
        raise InputError(
            f"teacher {space.teacher}: its features have {space.channels} channels and its words "
            f"{words.space.channels} ({words.space.text_encoder}); expected both of one joint model"
        )
