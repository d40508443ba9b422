"""Teachers, and the words that lead into their spaces, from settings."""

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.core.files.model_files import find_file
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.fusion.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.fusion.teachers.palette import COLOR_NAMES, PaletteConfig, PaletteTeacher
from gsencoder.fusion.teachers.radio import RadioConfig, RadioTeacher
from gsencoder.fusion.teachers.regions.build import build_regions
from gsencoder.fusion.teachers.regions.captioned import CaptionedRegions
from gsencoder.fusion.teachers.regions.config import RegionsConfig
from gsencoder.fusion.teachers.segmenter import SegmenterConfig, SegmenterTeacher
from gsencoder.text.build import TableTextConfig, TextConfig, Words, closed_table, vocabulary_of
from gsencoder.text.open_vocabulary import OpenVocabulary
from gsencoder.text.table import TextTable, load_text_table, make_text_table
from gsencoder.types import Scene

TeacherConfig = LabelsConfig | PaletteConfig | OnnxConfig | RadioConfig | SegmenterConfig | RegionsConfig


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
        raise InputError("text=: no text tower speaks for the features of RADIO's backbone; leave out text=")
    if isinstance(config, OnnxConfig) and config.classes:
        raise InputError("text=: the classes of teacher.classes= have vectors of their own; leave out one of the two")
    if isinstance(config, OnnxConfig) and not config.joint:
        raise InputError(
            "text=: the features of teacher=onnx are taken for those of the text tower if teacher.joint=true says that "
            "both belong to one joint model, such as CLIP; other backbones have no words"
        )
    if isinstance(config, RegionsConfig) and config.vector == "map" and not config.joint:
        raise InputError(
            "text=: means over regions are taken for vectors of the text tower if teacher.joint=true says that "
            "teacher.model= and text= belong to one joint model, such as CLIP; other backbones have no words"
        )
    if isinstance(config, (OnnxConfig, SegmenterConfig, RegionsConfig)) and config.words:
        raise InputError("text= and teacher.words= both say what words are; leave out one of them")
    return vocabulary_of(text)


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
        if words is not None and words.space.channels != backbone.space.channels:
            raise InputError(
                f"teacher onnx: its features have {backbone.space.channels} channels and its words "
                f"{words.space.channels} ({words.space.text_encoder}); expected both of one joint model"
            )
        return backbone
    if isinstance(config, RadioConfig):
        return RadioTeacher(config, text_encoder=words.space.text_encoder if words is not None else "")
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
