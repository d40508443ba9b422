"""`train teacher=[…]` and what follows it: encode, localize, pack, export and evaluate by the name of a teacher."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of
from named_rooms import write_words

from gsencoder.app import main as cli
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.fusion.folder import load_features
from gsencoder.infer.encode import Encoder
from gsencoder.models.encoder import load_weights

pytestmark = pytest.mark.slow

QUICK = (
    "quiet=true", "tensorboard=false", "train.steps=4", "train.warmup=2", "train.log_every=2",
    "sampling.gaussians=500", "sampling.smallest=200", "seeds.voxel=0.06",
    "model.transformer.encoder_channels=[32,32,32,32,32]", "model.transformer.decoder_channels=[32,32,32,32]",
)  # fmt: skip


@pytest.fixture(scope="module")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three rooms, of which the second has no labels, and the words of all that is in them."""
    folder = tmp_path_factory.mktemp("rooms")
    made = [make_room(number, objects=3, views=3, width=64, height=48) for number in range(3)]
    for number, room in enumerate(made):
        write_room(room, folder / f"room_{number}")
    (folder / "room_1" / "objects.json").unlink()
    write_words(folder / "words.safetensors", *made)
    return folder


@pytest.fixture(scope="module")
def trained(rooms: Path) -> Path:
    """An encoder of names and colors."""
    out = rooms.parent / "several_encoder"
    scenes = [str(rooms / f"room_{number}") for number in range(3)]
    words = ["teacher=[labels,palette]", f"teachers.labels.words={rooms / 'words.safetensors'}", "holdout=room_2"]
    assert cli.main(["train", *scenes, *words, f"out={out}", *QUICK]) == 0
    return out


@pytest.fixture(scope="module")
def encoded(rooms: Path, trained: Path) -> Path:
    out = rooms.parent / "several_features"
    assert cli.main(["encode", str(rooms / "room_2"), f"weights={trained}", f"out={out}", "quiet=true"]) == 0
    return out


def test_a_training_starts_from_weights_of_another_and_refuses_those_of_another_network(
    rooms, trained, tmp_path, capsys
):
    words = [
        str(rooms / "room_0"),
        "teacher=labels",
        f"teacher.words={rooms / 'words.safetensors'}",
        *QUICK[1:2],
        *QUICK[3:],
    ]
    still = ["train.steps=1", "train.learning_rate=1e-9", f"init={trained}", "quiet=true", f"out={tmp_path / 'out'}"]
    assert cli.main(["train", *words, *still]) == 0
    before, after = load_weights(trained)[0].state_dict(), load_weights(tmp_path / "out")[0].state_dict()
    for name in ("stem.weight", "head_norm.weight", "head.of_teacher.0.0.weight"):
        np.testing.assert_allclose(after[name], before[name], atol=1e-3)
    assert load_weights(tmp_path / "out")[2]["settings"]["init"] == str(trained)
    assert "init: house was made with model." in refusal(
        capsys, "train", *words, "init=house", f"out={tmp_path / 'other'}"
    )
    # Before anything is prepared.
    assert not (tmp_path / "other.prepared").exists()


def test_training_leaves_one_encoder_with_the_spaces_words_and_scores_of_both_teachers(rooms, trained):
    summary = json.loads((trained / "summary.json").read_text())
    assert any("teacher labels: 1 of 3 scenes lack" in str(warning) for warning in summary["warnings"])
    results = summary["results"]
    assert set(results["validation"]) == {
        f"{teacher}/{score}" for teacher in ("labels", "palette") for score in ("names", "cosine_named")
    }
    assert set(results["basis"]) == {"labels", "palette"}
    encoder, outputs, made_by = load_weights(trained)
    assert list(outputs) == ["labels", "palette"]
    assert encoder.channels == outputs["labels"].channels + outputs["palette"].channels
    assert list(made_by["settings"]["teachers"]) == ["labels", "palette"]
    assert {path.name for path in trained.glob("words*")} == {"words.labels.safetensors", "words.palette.safetensors"}
    assert {path.name for path in (trained / "validation").iterdir()} >= {"labels_features_000004.png"} or list(
        (trained / "validation").glob("labels_features*")
    )
    columns = (trained / "log.csv").read_text().splitlines()[0].split(",")
    assert {"labels/field", "labels/render", "palette/field", "palette/render"} <= set(columns)
    prepared = trained.with_name("several_encoder.prepared")
    assert sorted(path.name for path in prepared.iterdir()) == ["labels", "palette"]
    assert len(list((prepared / "labels" / "scenes").iterdir())) == 2
    assert len(list((prepared / "palette" / "scenes").iterdir())) == 3


def test_encoding_writes_the_features_of_all_teachers_or_of_those_named(rooms, trained, encoded, tmp_path, capsys):
    scene = load_features(encoded)
    assert set(scene.features) == {"labels", "palette"}
    assert set(results_of(encoded)["teachers"]) == {"labels", "palette"}
    direct = Encoder.load(str(trained)).encode_spaces(scene.gaussians, metres_per_unit=1.0, up=scene.up)
    for name, features in direct.items():
        np.testing.assert_allclose(scene.features[name].features, features.features, atol=5e-3)
    words = ["encode", str(rooms / "room_2"), f"weights={trained}", "quiet=true"]
    assert cli.main([*words, "spaces=palette", f"out={tmp_path / 'one'}"]) == 0
    (only,) = load_features(tmp_path / "one").features.values()
    np.testing.assert_array_equal(only.features, scene.features["palette"].features)
    arguments = [
        "localize", str(tmp_path / "one"), "query=red", "space=palette", "localize.min_probability=0",
        "quiet=true",
    ]  # fmt: skip
    assert cli.main([*arguments, "pictures=0", f"out={tmp_path / 'red'}"]) == 0
    assert {path.name for path in (tmp_path / "one").iterdir()} >= {"features.safetensors", "words.safetensors"}
    assert "got 'depth'" in refusal(capsys, *words[:3], "spaces=[depth,labels]", f"out={tmp_path / 'none'}")
    (encoded / "words.labels.safetensors").rename(tmp_path / "lost")
    lost = refusal(capsys, "localize", str(encoded), "space=labels", "query=cat", f"out={tmp_path / 'none'}")
    (tmp_path / "lost").rename(encoded / "words.labels.safetensors")
    assert "holds words of room-words, the text encoder of these features" in lost


def test_words_are_asked_of_the_space_that_is_named(encoded, tmp_path, capsys):
    colors = ["localize", str(encoded), "query=red", "pictures=0", "localize.min_probability=0"]
    assert cli.main([*colors, "space=palette", f"out={tmp_path / 'red'}", "quiet=true"]) == 0
    line = refusal(capsys, *colors, f"out={tmp_path / 'any'}")
    assert "has features of labels, palette; name one with space=" in line
    assert "not among" in refusal(capsys, *colors, "space=labels", f"out={tmp_path / 'wrong'}")
    assert "none of 'depth'" in refusal(capsys, *colors, "space=depth", f"out={tmp_path / 'wrong'}")
    packed = ["pack", str(encoded), "quiet=true", f"out={tmp_path / 'packed'}"]
    assert cli.main([*packed, "space=palette"]) == 0
    (features,) = load_features(tmp_path / "packed").features.values()
    assert features.space.teacher == "palette"
    assert cli.main([colors[0], str(tmp_path / "packed"), *colors[2:], f"out={tmp_path / 'again'}", "quiet=true"]) == 0


def test_evaluation_takes_the_space_of_the_words(rooms: Path, trained: Path, tmp_path: Path) -> None:
    words = f"teacher.words={rooms / 'words.safetensors'}"
    command = ["evaluate", str(rooms / "room_2"), f"weights={trained}", words, "protocol=naming", "quiet=true"]
    assert cli.main([*command, f"out={tmp_path / 'scores'}"]) == 0
    assert results_of(tmp_path / "scores")["names"]
    # Without words, those beside the weights are meant.
    without = [word for word in command if word != words]
    assert cli.main([*without, f"out={tmp_path / 'again'}"]) == 0
    assert results_of(tmp_path / "again")["names"] == results_of(tmp_path / "scores")["names"]


def test_wrong_teachers_end_in_one_line(rooms: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    train = ["train", str(rooms / "room_0"), *QUICK[2:], f"out={tmp_path / 'out'}", f"prepared={tmp_path / 'prepared'}"]
    words = f"teachers.labels.words={rooms / 'words.safetensors'}"
    for more, message in (
        (["teacher=[labels,colors]"], "teachers: expected some of"),
        (["teacher=[palette,palette]"], "palette is given twice; give other names, such as palette_2:palette"),
        (["teacher=[palette,labels]", "teachers.radio.size=3"], "teachers.radio.size: there is no radio among"),
        (["teacher=[palette,labels]", words, "loss.teacher_weights=[1.0]"], "loss.teacher_weights: expected 2 numbers"),
        (["teacher=[palette,other:palette]"], "teachers: palette and other have the same features"),
        (["teacher=[palette,labels]", "teacher.words=x"], "teacher.words: is for a single teacher, and teachers="),
        (["teachers=palette,labels", "teacher=radio"], "teacher: is for a single teacher"),
        (["teacher=[palette,x:onnx]"], "teachers.x.model= is missing"),
    ):
        assert message in refusal(capsys, *train, *more), more
    alone = ["teacher=palette", "loss.contrast_weight=1", "loss.field_weight=0", "loss.render_weight=0"]
    assert "L_contrast has no classes" in refusal(capsys, *train[:-1], *alone, f"prepared={tmp_path / 'alone'}")
    fresh = [f"out={tmp_path / 'out'}", f"prepared={tmp_path / 'fresh'}"]
    line = refusal(capsys, "train", str(rooms / "room_1"), *QUICK[2:], "teacher=[labels,palette]", words, *fresh)
    assert "the scene lists no objects" in line
