"""What a teacher is: a model that gives each view a map of features, and settings that build it. One file each."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

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


@dataclass(frozen=True, slots=True, kw_only=True)
class TeacherSettings(CheckedConfig):
    """The settings of a teacher, which answer for it: how it is built, and which words lead into its space.

    A subclass has a field `name: Literal["…"]`, the value of `teacher=`, and a line in `gsencoder.teachers.build`.

    Attributes:
        per_scene: whether the teacher is made of a scene's own labels or masks; any other is built once for all scenes.
        needs_labels: whether it needs labels of objects, which a bare splat does not have.
        has_heads: whether adapter heads lead from its space into others.
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
        """The words of the teacher's space without a text tower; None where none lead into it."""
        words: str = getattr(self, "words", "")
        return load_text_table(find_file(words, "teacher.words")) if words else None

    @property
    def stored_heads(self) -> tuple[str, ...]:
        """The names of the adapter heads that are stored with its features."""
        return ()

    def read_heads(self, names: Sequence[str]) -> list[Any]:
        """Adapter heads (`gsencoder.teachers.heads.Head`) by their names."""
        raise NotImplementedError

    def refuse_text(self) -> str:
        """Why its words cannot be those of a text tower (`text=`); empty where they can be, for which settings have an
        option `words`."""
        if not hasattr(self, "words"):
            return (
                f"text=: no text tower leads into the features of teacher={getattr(self, 'name', '')}; leave out text="
            )
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
