"""Teachers, and their text tables, from settings."""

import numpy as np

from gsencoder.core.files.model_files import find_file
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.teachers.labels import LabelsConfig, LabelsTeacher
from gsencoder.fusion.teachers.onnx import OnnxConfig, OnnxTeacher
from gsencoder.fusion.teachers.palette import COLOR_NAMES, PaletteConfig, PaletteTeacher
from gsencoder.fusion.teachers.radio import RadioConfig, RadioTeacher
from gsencoder.text.table import TextTable, load_text_table, make_text_table
from gsencoder.types import Scene

TeacherConfig = LabelsConfig | PaletteConfig | OnnxConfig | RadioConfig


def text_table_of(config: TeacherConfig) -> TextTable | None:
    """The words of the teacher's space, or None where no words lead into it.

    Raises:
        InputError: the table cannot be found or read.
    """
    if isinstance(config, PaletteConfig):
        names = np.eye(len(COLOR_NAMES), dtype=np.float32)
        return make_text_table(COLOR_NAMES, names, PaletteTeacher(config).space.text_encoder)
    return load_text_table(find_file(config.words, "teacher.words")) if config.words else None


def build_teacher(config: TeacherConfig, scene: Scene, words: TextTable | None) -> Teacher:
    """The teacher of a scene.

    Args:
        config: which teacher and its settings.
        scene: the labels teacher reads its objects.
        words: from `text_table_of(config)`, which is read once for many scenes.

    Raises:
        InputError: the teacher lacks something it needs.
    """
    if isinstance(config, PaletteConfig):
        return PaletteTeacher(config)
    if isinstance(config, OnnxConfig):
        return OnnxTeacher(config, text_encoder=words.space.text_encoder if words is not None else "")
    if isinstance(config, RadioConfig):
        return RadioTeacher(config, text_encoder=words.space.text_encoder if words is not None else "")
    assert words is not None
    return LabelsTeacher(
        scene.objects, words.names, words.embeddings, text_encoder=words.space.text_encoder, cell=config.cell
    )
