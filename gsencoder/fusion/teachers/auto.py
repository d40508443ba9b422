"""The teacher of a scene where none is named: its labels where it has some, else a segmenter that looks at pictures."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.teachers.build import TeacherConfig, build_teacher, words_of
from gsencoder.fusion.teachers.labels import LabelsConfig
from gsencoder.fusion.teachers.segmenter import SegmenterConfig
from gsencoder.fusion.teachers.segmenter_onnx import OnnxSegmenterOptions
from gsencoder.text.models import OnnxTextConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words, closed_table
from gsencoder.types import Scene

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
