"""Which words lead into the space of which teacher, and what is refused because none do."""

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from text_towers import save_graph, save_tokenizer

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.teachers.build import TeacherConfig, build_teacher, words_of
from gsencoder.teachers.labels import PaletteConfig
from gsencoder.teachers.onnx import OnnxConfig
from gsencoder.teachers.radio import RadioConfig
from gsencoder.teachers.segmenter import SegmenterConfig, synonyms_of_classes
from gsencoder.text.models import OnnxTextConfig
from gsencoder.text.table import REFERENCE_NOUNS
from gsencoder.types import Scene

TOWER = OnnxTextConfig(model="nowhere")


@pytest.mark.parametrize(
    ("teacher", "problem"),
    [
        (PaletteConfig(), "has the words of its eleven colors"),
        (RadioConfig(), "no text tower speaks for the features of RADIO's backbone"),
        (OnnxConfig(classes="c.npz"), "have vectors of their own"),
        (OnnxConfig(), "if teacher.joint=true says that both belong to one joint model"),
        (OnnxConfig(joint=True, words="w.npz"), "both say what words are"),
        (SegmenterConfig(words="w.npz"), "both say what words are"),
    ],
)
def test_a_tower_is_refused_for_features_that_it_does_not_speak_for(teacher: TeacherConfig, problem: str) -> None:
    with pytest.raises(InputError, match=problem):
        words_of(teacher, TOWER)


def test_a_joint_model_needs_a_tower_of_its_width(tmp_path: Path) -> None:
    words = sorted(set(" ".join(REFERENCE_NOUNS).split()))
    save_tokenizer(tmp_path / "tokenizer.json", ("[PAD]", "[UNK]", "[CLS]", "[SEP]", *words))
    save_graph(tmp_path / "model.onnx", rows=1000)
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, "h", "w"])
    features = helper.make_tensor_value_info("features", TensorProto.FLOAT, [1, 3, "h", "w"])
    graph = helper.make_graph([helper.make_node("Identity", ["image"], ["features"])], "net", [image], [features])
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10), tmp_path / "net.onnx"
    )
    config = OnnxConfig(model=str(tmp_path / "net.onnx"), layout="grid", patch=1, joint=True)
    vocabulary = words_of(config, OnnxTextConfig(model=str(tmp_path), pooling="mean"))
    with pytest.raises(InputError, match="its features have 3 channels and its words 6"):
        build_teacher(config, Scene(name="s"), vocabulary)


def test_classes_without_a_name_are_refused_and_doubled_ones_counted() -> None:
    with pytest.raises(InputError, match="class ', ,' has no name"):
        synonyms_of_classes(["wall", ", ,"], ["other"])
    with pytest.warns(SceneWarning, match="1 names stand for several classes: wall"):
        assert synonyms_of_classes(["wall", "wall", "other"], ["other"]) == [["wall"], ["wall"], []]


def test_reference_nouns_are_distinct() -> None:
    assert len(set(REFERENCE_NOUNS)) == len(REFERENCE_NOUNS) == len(np.unique(REFERENCE_NOUNS))
