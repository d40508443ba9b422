"""The teacher where none is named, and which words belong to the space of which teacher."""

from copy import copy
from dataclasses import replace
from pathlib import Path

import pytest
from region_scenes import save_colors
from text_towers import save_graph, save_tokenizer

from gsencoder.app.commands.fuse import FuseCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.synthetic import make_room
from gsencoder.teachers.build import (
    SEGMENTER,
    SENTENCES,
    AutoConfig,
    TeacherConfig,
    choose_teacher,
    text_table_of,
    words_of,
)
from gsencoder.teachers.labels import LabelsConfig, PaletteConfig
from gsencoder.teachers.onnx import OnnxConfig
from gsencoder.teachers.radio import RadioConfig
from gsencoder.teachers.segmenter import SegmenterConfig, synonyms_of_classes
from gsencoder.text.models import OnnxTextConfig
from gsencoder.text.table import REFERENCE_NOUNS
from gsencoder.text.vocabulary import TableTextConfig, TextConfig, Words
from gsencoder.types import Scene

TABLE = text_table_of(LabelsConfig())
NO_TOWER = TableTextConfig()
OTHER = OnnxTextConfig(model="other")


@pytest.fixture(scope="module")
def room() -> Scene:
    return make_room(views=1, width=32, height=24, objects=4)


def installed(teacher: TeacherConfig, text: TextConfig) -> Words | None:
    """The installed table, whatever is asked: loading towers is tested elsewhere."""
    return TABLE


def chosen(scene: Scene, config: AutoConfig | TeacherConfig = AutoConfig(), text: TextConfig = NO_TOWER):
    return choose_teacher(config, text, scene, installed)


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
    # No table needs to know them where a tower is given.
    taken = chosen(renamed(room, "table", "a thing with legs"), text=OTHER)
    assert (taken.teacher, taken.text, taken.reason) == (LabelsConfig(), OTHER, "labels of 2 names")


def test_the_words_are_those_of_the_teacher_and_the_tower_that_were_chosen(room: Scene) -> None:
    words = dict[tuple[TeacherConfig, TextConfig], Words]()

    def read(teacher: TeacherConfig, text: TextConfig) -> Words | None:
        return words.setdefault((teacher, text), copy(TABLE))

    for scene in (room, renamed(room, "table", "a thing with legs"), replace(room, objects=())):
        for config in (AutoConfig(), AutoConfig(words="own.npz"), SEGMENTER):
            for text in (NO_TOWER, OTHER):
                taken = choose_teacher(config, text, scene, read)
                assert taken.words is words[taken.teacher, taken.text]


def test_a_table_that_is_given_means_labels_and_a_teacher_that_is_given_is_taken(room: Scene) -> None:
    bare = replace(room, objects=())
    assert chosen(bare, AutoConfig(words="own.npz")).teacher == LabelsConfig(words="own.npz")
    for scene in (room, bare):
        assert (chosen(scene, PaletteConfig()).teacher, chosen(scene, PaletteConfig()).reason) == (PaletteConfig(), "")


@pytest.mark.parametrize(
    ("teacher", "problem"),
    [
        (PaletteConfig(), "no text tower shares the space of teacher=palette"),
        (RadioConfig(), "no text tower speaks for the features of RADIO's backbone"),
        (OnnxConfig(classes="c.npz"), "have vectors of their own"),
        (OnnxConfig(), "if teacher.joint=true says that both belong to one joint model"),
        (OnnxConfig(joint=True, words="w.npz"), "both say what words are"),
        (SegmenterConfig(words="w.npz"), "both say what words are"),
    ],
)
def test_a_tower_is_refused_for_features_that_it_does_not_speak_for(teacher: TeacherConfig, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        words_of(teacher, OTHER)


def test_a_joint_model_needs_a_tower_of_its_width(tmp_path: Path) -> None:
    words = sorted(set(" ".join(REFERENCE_NOUNS).split()))
    save_tokenizer(tmp_path / "tokenizer.json", ("[PAD]", "[UNK]", "[CLS]", "[SEP]", *words))
    save_graph(tmp_path / "model.onnx", rows=1000)
    config = OnnxConfig(model=str(save_colors(tmp_path / "net.onnx")), layout="grid", patch=4, joint=True)
    vocabulary = words_of(config, OnnxTextConfig(model=str(tmp_path), pooling="mean"))
    with pytest.raises(InputError, match="its features have 3 channels and its words 6"):
        config.build(Scene(name="s"), vocabulary)


def test_classes_without_a_name_are_refused_and_doubled_ones_counted() -> None:
    with pytest.raises(InputError, match="class ', ,' has no name"):
        synonyms_of_classes(["wall", ", ,"], ["other"])
    with pytest.warns(SceneWarning, match="1 names stand for several classes: wall"):
        assert synonyms_of_classes(["wall", "wall", "other"], ["other"]) == [["wall"], ["wall"], []]


def test_reference_nouns_are_distinct() -> None:
    assert len(set(REFERENCE_NOUNS)) == len(REFERENCE_NOUNS)
