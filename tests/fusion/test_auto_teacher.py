"""The teacher where none is named: labels of a scene that has some, else what is installed."""

from copy import copy
from dataclasses import replace

import pytest
from field_scenes import FieldRoom

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.data.scenes import load_scene
from gsencoder.teachers.build import SEGMENTER, SENTENCES, AutoConfig, TeacherConfig, choose_teacher, text_table_of
from gsencoder.teachers.labels import LabelsConfig, PaletteConfig
from gsencoder.text.models import OnnxTextConfig
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words
from gsencoder.types import Scene

TABLE = text_table_of(LabelsConfig())
NO_TOWER = TableTextConfig()
OTHER = OnnxTextConfig(model="other")


@pytest.fixture(scope="module")
def room(field_room: FieldRoom) -> Scene:
    return load_scene(field_room.room)


def words_of(teacher: TeacherConfig, text: TextConfig) -> Words | None:
    """The installed table, whatever is asked: loading towers is tested elsewhere."""
    return TABLE


def chosen(scene: Scene, config: AutoConfig | TeacherConfig = AutoConfig(), text: TextConfig = NO_TOWER):
    return choose_teacher(config, text, scene, words_of)


def renamed(scene: Scene, *names: str | None) -> Scene:
    """The scene with other names of its objects, repeated."""
    return replace(
        scene, objects=tuple(replace(each, name=names[i % len(names)]) for i, each in enumerate(scene.objects))
    )


def test_the_settings_are_those_of_their_yaml_files() -> None:
    config = compose("fuse", FuseCommandConfig, ["ROOM", "teacher=mosaic", "text=minilm"])
    assert (config.teacher, config.text) == (SEGMENTER, SENTENCES)
    default = compose("fuse", FuseCommandConfig, ["ROOM"])
    assert (default.teacher, default.text) == (AutoConfig(), NO_TOWER)


def test_labels_are_taken_where_a_scene_has_some(room: Scene) -> None:
    taken = chosen(room)
    assert (taken.teacher, taken.text, taken.words) == (LabelsConfig(), NO_TOWER, TABLE)
    assert taken.describe() == "teacher=labels"
    assert chosen(room, text=OTHER).describe() == "teacher=labels text=onnx"


def test_a_segmenter_is_taken_where_a_scene_has_no_labels(room: Scene) -> None:
    assert room.views is not None
    no_maps = replace(room, views=replace(room.views, instances=None))
    for scene in (replace(room, objects=()), no_maps, renamed(room, None), renamed(room, "thing_17", None)):
        taken = chosen(scene)
        assert (taken.teacher, taken.text, taken.reason) == (SEGMENTER, SENTENCES, "no labels")
        assert taken.describe() == "teacher=mosaic text=minilm"
        assert chosen(replace(scene, objects=()), text=OTHER).text == OTHER


def test_labels_of_which_the_table_lacks_some_are_those_of_the_sentence_encoder(room: Scene) -> None:
    taken = chosen(renamed(room, "table", "a thing with legs"))
    assert (taken.teacher, taken.text) == (LabelsConfig(), SENTENCES)
    assert taken.reason == "labels of 2 names, 1 of them not in clip_vitb32_names.npz"


def test_names_that_no_table_needs_to_know_are_those_of_the_tower_that_is_given(room: Scene) -> None:
    taken = chosen(renamed(room, "table", "a thing with legs"), text=OTHER)
    assert (taken.teacher, taken.text, taken.reason) == (LabelsConfig(), OTHER, "labels of 2 names")


def test_the_words_are_those_of_the_teacher_and_the_tower_that_were_chosen(room: Scene) -> None:
    words = dict[tuple[TeacherConfig, TextConfig], Words]()

    def words_of(teacher: TeacherConfig, text: TextConfig) -> Words | None:
        return words.setdefault((teacher, text), copy(TABLE))

    for scene in (room, renamed(room, "table", "a thing with legs"), replace(room, objects=())):
        for config in (AutoConfig(), AutoConfig(words="own.npz"), SEGMENTER):
            for text in (NO_TOWER, OTHER):
                taken = choose_teacher(config, text, scene, words_of)
                assert taken.words is words[taken.teacher, taken.text]


def test_a_table_that_is_given_means_labels_and_a_teacher_that_is_given_is_taken(room: Scene) -> None:
    bare = replace(room, objects=())
    assert chosen(bare, AutoConfig(words="own.npz")).teacher == LabelsConfig(words="own.npz")
    for scene in (room, bare):
        assert (chosen(scene, PaletteConfig()).teacher, chosen(scene, PaletteConfig()).reason) == (PaletteConfig(), "")
