"""Teachers, and the words that lead into their spaces, from settings."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np

from gsencoder.core.errors import InputError, renamed_options
from gsencoder.core.pretrained import find_file
from gsencoder.teachers.base import Teacher
from gsencoder.teachers.captions import CaptionedRegions
from gsencoder.teachers.labels import COLOR_NAMES, LabelsConfig, LabelsTeacher, PaletteConfig, PaletteTeacher
from gsencoder.teachers.masks import RegionsConfig
from gsencoder.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.teachers.radio import RadioConfig, RadioTeacher
from gsencoder.teachers.regions import build_regions, is_joint
from gsencoder.teachers.segmenter import OnnxSegmenterOptions, SegmenterConfig, SegmenterTeacher
from gsencoder.teachers.tower import TransformersConfig, TransformersTeacher
from gsencoder.text.models import OnnxTextConfig
from gsencoder.text.table import TextTable, load_text_table, make_text_table
from gsencoder.text.vocabulary import OpenVocabulary, TableTextConfig, TextConfig, Words, closed_table, vocabulary_of
from gsencoder.types import Scene

TeacherConfig = (
    LabelsConfig | PaletteConfig | OnnxConfig | RadioConfig | SegmenterConfig | TransformersConfig | RegionsConfig
)


def text_table_of(config: TeacherConfig) -> TextTable | None:
    """The words of the teacher's space, or None where no words lead into it.

    Raises:
        InputError: the table cannot be found or read.
    """
    if isinstance(config, PaletteConfig):
        names = np.eye(len(COLOR_NAMES), dtype=np.float32)
        return make_text_table(COLOR_NAMES, names, PaletteTeacher(config).space.text_encoder)
    return load_text_table(find_file(config.words, "teacher.words")) if config.words else None


def words_of(config: TeacherConfig, text: TextConfig = TableTextConfig()) -> Words | None:
    """The words of the teacher's space: its text table, or the vocabulary of a text tower; None where there are none.

    Args:
        config: of the teacher.
        text: a tower whose vectors the teacher's features are, or are made to be; its own table is not read then.

    Raises:
        InputError: a table or tower cannot be found or read, or the teacher's space has words of its own.
    """
    if isinstance(text, TableTextConfig):
        return text_table_of(config)
    if isinstance(config, PaletteConfig):
        raise InputError("text=: teacher=palette has the words of its eleven colors; leave out text=")
    if isinstance(config, RadioConfig):
        raise InputError(
            "text=: no text tower speaks for the features of RADIO's backbone; leave out text= here, and give it "
            "where an adapter head is asked: localize head=siglip text=…"
        )
    if isinstance(config, OnnxConfig) and config.classes:
        raise InputError("text=: the classes of teacher.classes= have vectors of their own; leave out one of the two")
    if isinstance(config, OnnxConfig) and not config.joint:
        raise InputError(
            "text=: the features of teacher=onnx are taken for those of the text tower if teacher.joint=true says that "
            "both belong to one joint model, such as CLIP; other backbones have no words"
        )
    if isinstance(config, TransformersConfig) and (config.dense == "tokens" or config.layer is not None):
        raise InputError(
            "text=: no words lead into hidden states (teacher.dense=tokens, teacher.layer=); give teacher.dense=values "
            "or summary with a text-aligned model, or leave out text="
        )
    if isinstance(config, RegionsConfig) and config.vector == "map" and not config.joint:
        raise InputError(
            "text=: means over regions are taken for vectors of the text tower if teacher.joint=true says that "
            "teacher.model= and text= belong to one joint model, such as CLIP; other backbones have no words"
        )
    if isinstance(config, (OnnxConfig, SegmenterConfig, TransformersConfig, RegionsConfig)) and config.words:
        raise InputError("text= and teacher.words= both say what words are; leave out one of them")
    return vocabulary_of(text)


def takes_text(config: TeacherConfig) -> bool:
    """Whether the words of a teacher may be those of a text tower."""
    if isinstance(config, TransformersConfig):
        return config.dense in ("values", "summary")
    if isinstance(config, RegionsConfig):
        crop = config.vector == "crop" and bool(config.model)
        return config.vector == "captions" or config.joint or (crop and is_joint(config.model))
    return isinstance(config, (LabelsConfig, SegmenterConfig)) or (isinstance(config, OnnxConfig) and config.joint)


def options_of_member(name: str, config: TeacherConfig) -> AbstractContextManager[None]:
    """Names options in errors by the keys of one of several teachers: teachers.NAME.model for teacher.model."""
    return renamed_options("teacher", f"teachers.{name}", [each.name for each in fields(config)])


def words_by_teacher(
    teachers: Mapping[str, TeacherConfig], text: TextConfig = TableTextConfig(), *, members: bool = False
) -> dict[str, Words]:
    """The words of each of several teachers that has any; a text tower is for those whose words it can be.

    Args:
        teachers: by name.
        text: see `words_of`.
        members: whether even a single teacher is given as one of `teachers=`, for errors.

    Raises:
        InputError: see `words_of`; or a tower is given that is for none of several teachers.
    """
    several, has_tower = len(teachers) > 1, not isinstance(text, TableTextConfig)
    if several and has_tower and not any(map(takes_text, teachers.values())):
        raise InputError(f"text=: the words of none of the teachers {', '.join(teachers)} can be those of a text tower")
    words: dict[str, Words] = {}
    for name, config in teachers.items():
        with options_of_member(name, config) if several or members else nullcontext():
            teacher_words = words_of(config, text if not several or takes_text(config) else TableTextConfig())
        if teacher_words is not None:
            words[name] = teacher_words
    return words


def words_beside(teacher: Teacher, words: Words | None) -> TextTable | None:
    """The table that is stored with a teacher's features: of a tower, with the names that the teacher knows."""
    if isinstance(words, OpenVocabulary) and isinstance(teacher, (LabelsTeacher, SegmenterTeacher, CaptionedRegions)):
        words = words.including(teacher.kinds)
    return closed_table(words) if words is not None else None


def build_teacher(config: TeacherConfig, scene: Scene, words: Words | None) -> Teacher:
    """The teacher of a scene.

    Args:
        config: which teacher and its settings.
        scene: the labels teacher reads its objects.
        words: from `words_of(config)`, which is read once for many scenes.

    Raises:
        InputError: the teacher lacks something it needs.
    """
    if isinstance(config, PaletteConfig):
        return PaletteTeacher(config)
    if isinstance(config, OnnxConfig):
        backbone = OnnxTeacher(config, text_encoder=words.space.text_encoder if words is not None else "")
        _check_channels(backbone, words)
        return backbone
    if isinstance(config, TransformersConfig):
        tower = TransformersTeacher(config, text_encoder=words.space.text_encoder if words is not None else "")
        if isinstance(words, OpenVocabulary) and not tower.joint:
            raise InputError(
                f"text=: no words lead into {tower.space.layer} of {tower.space.name}; leave out text=, or give a "
                "text-aligned model (CLIP, SigLIP, SigLIP2) with its head"
            )
        _check_channels(tower, words)
        return tower
    if isinstance(config, RadioConfig):
        radio = RadioTeacher(config, text_encoder=words.space.text_encoder if words is not None else "")
        _check_channels(radio, words)
        return radio
    if isinstance(config, SegmenterConfig):
        if words is None:
            raise InputError(
                "teacher segmenter: its classes need words: give a text tower (text=onnx text.model=FOLDER), or a text "
                "table that has their names (teacher.words=)"
            )
        return SegmenterTeacher(config, words)
    if isinstance(config, RegionsConfig):
        return build_regions(config, scene, words)
    assert words is not None
    if isinstance(words, OpenVocabulary):
        words = words.including(sorted({o.name for o in scene.objects if o.name is not None}))
    table = closed_table(words)
    return LabelsTeacher(
        scene.objects,
        table.names,
        table.embeddings,
        text_encoder=table.space.text_encoder,
        mean=table.mean,
        cell=config.cell,
    )


def _check_channels(teacher: Teacher, words: Words | None) -> None:
    if words is not None and words.space.channels != teacher.space.channels:
        raise InputError(
            f"teacher {teacher.space.teacher}: its features have {teacher.space.channels} channels and its words "
            f"{words.space.channels} ({words.space.text_encoder}); expected both of one joint model"
        )


NAMES_TABLE = LabelsConfig().words
SEGMENTER = SegmenterConfig(
    model="mosaic_ade31.onnx", onnx=OnnxSegmenterOptions(scale=1.0, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))
)
"""conf/teacher/mosaic.yaml, which the package has with it."""
SENTENCES = OnnxTextConfig(model="minilm_l6", pooling="mean")
"""conf/text/minilm.yaml, likewise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AutoConfig:
    """The labels of a scene that has some; else mosaic, with text=minilm unless another tower is given."""

    name: Literal["auto"] = "auto"
    words: str = field(
        default=NAMES_TABLE, metadata={"help": "text table of the labels' names; another one means teacher=labels"}
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenTeacher:
    """The teacher and the words of one scene.

    Attributes:
        teacher, text: their settings.
        words: that lead into the teacher's features.
        reason: why, for people; empty where the user chose.
    """

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
        config: of the teacher.
        text: a tower that is given, or none.
        scene: its objects and instance maps are looked at.
        words_of: reads words; of a cached one they are read once for many scenes.

    Raises:
        InputError: the words cannot be found or read.
    """
    if not isinstance(config, AutoConfig):
        return ChosenTeacher(teacher=config, text=text, words=words_of(config, text))
    labels, has_tower = LabelsConfig(words=config.words), not isinstance(text, TableTextConfig)
    names = {each.name for each in scene.objects if each.name is not None}
    if config.words != NAMES_TABLE:
        return ChosenTeacher(teacher=labels, text=text, words=words_of(labels, text), reason="teacher.words is given")
    if names and scene.views is not None and scene.views.instances is not None:
        words = words_of(labels, text)
        assert words is not None
        known = names if has_tower else names & set(closed_table(words).names)
        if known == names:
            return ChosenTeacher(teacher=labels, text=text, words=words, reason=f"labels of {len(names)} names")
        if known:
            reason = f"labels of {len(names)} names, {len(names - known)} of them not in {NAMES_TABLE}"
            return ChosenTeacher(teacher=labels, text=SENTENCES, words=words_of(labels, SENTENCES), reason=reason)
    text = text if has_tower else SENTENCES
    return ChosenTeacher(teacher=SEGMENTER, text=text, words=words_of(SEGMENTER, text), reason="no labels")


def default_teacher(scene: Scene) -> tuple[Teacher, Words]:
    """The teacher that `gsencoder fuse` takes for a scene where none is named, and the words to ask its features with.

    Raises:
        InputError: a file that is installed with the package is missing or damaged.
    """
    chosen = choose_teacher(AutoConfig(), TableTextConfig(), scene)
    assert chosen.words is not None
    return build_teacher(chosen.teacher, scene, chosen.words), chosen.words
