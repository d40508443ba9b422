"""The teachers by name, the words of their spaces, and the choice of one for a scene (`teacher=auto`)."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields
from typing import Literal

from gsencoder.core.errors import InputError, renamed_options
from gsencoder.core.settings import option
from gsencoder.teachers.base import Teacher, TeacherSettings
from gsencoder.teachers.labels import LabelsConfig, PaletteConfig
from gsencoder.teachers.onnx import OnnxConfig
from gsencoder.teachers.radio import RadioConfig
from gsencoder.teachers.regions import RegionsConfig
from gsencoder.teachers.segmenter import OnnxSegmenterOptions, SegmenterConfig
from gsencoder.teachers.tower import TransformersConfig
from gsencoder.text.models import OnnxTextConfig
from gsencoder.text.table import TextTable
from gsencoder.text.vocabulary import OpenVocabulary, TableTextConfig, TextConfig, Words, closed_table, vocabulary_of
from gsencoder.types import Scene

TeacherConfig = (
    LabelsConfig | PaletteConfig | OnnxConfig | RadioConfig | SegmenterConfig | TransformersConfig | RegionsConfig
)
"""The registry: `teacher=NAME` takes the one whose field `name` is NAME."""


def text_table_of(config: TeacherConfig) -> TextTable | None:
    """The words of the teacher's space without a text tower; None where there are none."""
    return config.text_table()


def words_of(config: TeacherConfig, text: TextConfig = TableTextConfig()) -> Words | None:
    """The words of the teacher's space: its text table, or the vocabulary of a text tower; None where there are none.

    Args:
        text: a tower whose vectors the teacher's features are, or are made to be; its own table is not read then.
    """
    if isinstance(text, TableTextConfig):
        table = config.text_table()
        return None if table is None else config.adapt(table)
    if refusal := config.refuse_text():
        raise InputError(refusal)
    return config.adapt(vocabulary_of(text))


def options_of_member(name: str, config: TeacherConfig) -> AbstractContextManager[None]:
    """Names options in errors by the keys of one of several teachers: teachers.NAME.model for teacher.model."""
    return renamed_options("teacher", f"teachers.{name}", [each.name for each in fields(config)])


def words_by_teacher(
    teachers: Mapping[str, TeacherConfig], text: TextConfig = TableTextConfig(), *, members: bool = False
) -> dict[str, Words]:
    """The words of each of several teachers that has any; a text tower is for those whose words it can be.

    Args:
        members: whether even a single teacher is given as one of `teachers=`, for errors.
    """
    several, has_tower = len(teachers) > 1, not isinstance(text, TableTextConfig)
    takes = {name: not several or (has_tower and config.takes_text()) for name, config in teachers.items()}
    if has_tower and not any(takes.values()):
        raise InputError(f"text=: the words of none of the teachers {', '.join(teachers)} can be those of a text tower")
    words: dict[str, Words] = {}
    for name, config in teachers.items():
        with options_of_member(name, config) if several or members else nullcontext():
            of_teacher = words_of(config, text if takes[name] else TableTextConfig())
        if of_teacher is not None:
            words[name] = of_teacher
    return words


def stored_words(teacher: Teacher, words: Words | None) -> TextTable | None:
    """The table that is stored with a teacher's features: of a tower, with the names that the teacher knows."""
    if words is None:
        return None
    if isinstance(words, OpenVocabulary):
        words = words.including(getattr(teacher, "kinds", ()))
    return closed_table(words)


NAMES_TABLE = LabelsConfig().words
SEGMENTER = SegmenterConfig(
    model="mosaic_ade31.onnx", onnx=OnnxSegmenterOptions(scale=1.0, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))
)
"""conf/teacher/mosaic.yaml, which the package has with it."""
SENTENCES = OnnxTextConfig(model="minilm_l6", pooling="mean")
"""conf/text/minilm.yaml, likewise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoConfig(TeacherSettings):
    """The labels of a scene that has some; else mosaic, with text=minilm unless another tower is given."""

    name: Literal["auto"] = "auto"
    words: str = option(NAMES_TABLE, "text table of the labels' names; another one means teacher=labels")


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenTeacher:
    """The settings and the words of the teacher of one scene, and the reason for the choice; empty where the user
    chose."""

    teacher: TeacherConfig
    text: TextConfig
    words: Words | None
    reason: str = ""

    def describe(self) -> str:
        """The options that stand for it."""
        tower = "minilm" if self.text == SENTENCES else self.text.name
        text = "" if isinstance(self.text, TableTextConfig) else f" text={tower}"
        return f"teacher={'mosaic' if self.teacher == SEGMENTER else self.teacher.name}{text}"


def choose_teacher(
    config: AutoConfig | TeacherConfig,
    text: TextConfig,
    scene: Scene,
    words_of: Callable[[TeacherConfig, TextConfig], Words | None] = words_of,
) -> ChosenTeacher:
    """The teacher of a scene: the one that is given, or with `teacher=auto` the one that fits the scene.

    A scene has labels if it has instance maps and objects with a name that the words know. Names that a table lacks
    are no error here, as they are for `teacher=labels`: the sentence encoder knows them.

    Args:
        text: a tower that is given, or none.
        scene: its objects and instance maps are looked at.
        words_of: reads words; of a cached one they are read once for many scenes.
    """

    def chosen(teacher: TeacherConfig, text: TextConfig, reason: str = "") -> ChosenTeacher:
        return ChosenTeacher(teacher=teacher, text=text, words=words_of(teacher, text), reason=reason)

    if config.name != "auto":
        return chosen(config, text)
    labels, has_tower = LabelsConfig(words=config.words), not isinstance(text, TableTextConfig)
    if config.words != NAMES_TABLE:
        return chosen(labels, text, "teacher.words is given")
    names = {each.name for each in scene.objects if each.name is not None}
    if names and scene.views is not None and scene.views.instances is not None:
        by_table = chosen(labels, text, f"labels of {len(names)} names")
        assert by_table.words is not None
        known = names if has_tower else names & set(closed_table(by_table.words).names)
        if known == names:
            return by_table
        if known:
            reason = f"labels of {len(names)} names, {len(names - known)} of them not in {NAMES_TABLE}"
            return chosen(labels, SENTENCES, reason)
    return chosen(SEGMENTER, text if has_tower else SENTENCES, "no labels")


def default_teacher(scene: Scene) -> tuple[Teacher, Words]:
    """The teacher that `gsencoder fuse` takes for a scene where none is named, and the words to ask its features
    with."""
    chosen = choose_teacher(AutoConfig(), TableTextConfig(), scene)
    assert chosen.words is not None
    return chosen.teacher.build(scene, chosen.words), chosen.words
