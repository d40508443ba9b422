"""What `train`, `encode` and `evaluate weights=` refuse, and what they leave alone."""

import shutil

import pytest
from command_runs import QUICK, refusal

from gsencoder.text.table import load_text_table, make_text_table, save_text_table

pytestmark = pytest.mark.slow


@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["holdout=kitchen_*"], "holdout: no scene is called 'kitchen_*'"),
        (["holdout=room_*"], "matches every scene"),
        (["model.transformer.encoder_depths=[1,1]"], "encoder_channels: expected one entry per level"),
        (["teacher=radio"], "teacher.model= is missing"),
        (["device=cuda"], "no GPU"),
    ],
)
def test_a_training_that_cannot_be_is_refused_in_one_line(rooms, tmp_path, capsys, words, message):
    table = [] if "teacher=radio" in words else [f"teacher.words={rooms / 'words.safetensors'}"]
    assert message in refusal(
        capsys, "train", str(rooms / "room_0"), str(rooms / "room_1"), *table, f"out={tmp_path / 'out'}", *words
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("no_gpu")
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["weights=nowhere"], "weights: no file at nowhere"),
        (["encode.device=cuda"], "sees no GPU"),
    ],
)
def test_an_encoding_that_cannot_be_is_refused_in_one_line(rooms, trained, tmp_path, capsys, words, message):
    options = [] if any(word.startswith("weights=") for word in words) else [f"weights={trained}"]
    line = refusal(capsys, "encode", str(rooms / "room_2"), *options, f"out={tmp_path / 'out'}", *words)
    assert message in line
    assert not (tmp_path / "out").exists()


def test_features_of_another_space_are_not_judged_by_these_words(rooms, trained, tmp_path, capsys):
    other = tmp_path / "other.safetensors"
    table = load_text_table(rooms / "words.safetensors")
    save_text_table(other, make_text_table(table.names, table.embeddings, "other-words"))
    line = refusal(
        capsys,
        "evaluate",
        str(rooms / "room_2"),
        "protocol=naming",
        f"weights={trained}",
        f"teacher.words={other}",
        f"out={tmp_path / 'out'}",
    )
    assert "room-words" in line
    assert "other-words" in line


def test_two_scenes_of_one_name_and_one_scene_named_twice_are_refused(rooms, trained, tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(rooms / "room_0", tmp_path / name / "room")
    both = [str(tmp_path / "a" / "room"), str(tmp_path / "b" / "room")]
    problem = refusal(capsys, "encode", *both, f"weights={trained}", f"out={tmp_path / 'out'}")
    assert "are both called 'room'" in problem
    assert not (tmp_path / "out").exists()
    twice = [str(rooms / "room_0"), str(rooms / "." / ".." / rooms.name / "room_0")]
    problem = refusal(capsys, "encode", *twice, f"weights={trained}", f"out={tmp_path / 'out'}")
    assert "is the same as" in problem
    assert "give one of them" in problem
    assert not (tmp_path / "out").exists()


def test_weights_are_not_replaced_by_what_they_make(rooms, trained, tmp_path, capsys):
    own = tmp_path / "encoder"
    shutil.copytree(trained, own)
    problem = refusal(capsys, "encode", str(rooms / "room_0"), f"weights={own}", f"out={own}", "overwrite=true")
    assert "holds the input weights=" in problem
    assert (own / "encoder.safetensors").is_file()


def test_folders_that_a_training_did_not_make_are_left_alone(rooms, trained, tmp_path, capsys):
    scenes = [str(rooms / f"room_{number}") for number in range(2)]
    prepared = f"prepared={trained.with_name('encoder.prepared')}"
    common = ["train", *scenes, f"teacher.words={rooms / 'words.safetensors'}", *QUICK[1:], "tensorboard=false"]
    notes = tmp_path / "mine.training" / "notes.txt"
    notes.parent.mkdir()
    notes.touch()
    for more in ((), ("resume=false",)):
        assert "holds something else" in refusal(capsys, *common, prepared, f"out={tmp_path / 'mine'}", *more)
    assert notes.is_file()
    for inside in ("run", "run/prepared", "run.training", "run.training/prepared"):
        problem = refusal(capsys, *common, f"prepared={tmp_path / inside}", f"out={tmp_path / 'run'}")
        assert "give another folder" in problem
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").touch()
    problem = refusal(capsys, *common, f"prepared={foreign}", f"out={tmp_path / 'run'}")
    assert "something else than prepared scenes" in problem
    assert [path.name for path in foreign.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    "setting",
    [
        "model.transformer.encoder_depths=1,1,1,1,300000",
        "loss.cosine=0 loss.smooth_l1=0 loss.contrast_weight=0",
    ],
)
def test_sizes_that_nobody_means_are_refused_before_the_work(rooms, tmp_path, capsys, setting):
    problem = refusal(capsys, "train", str(rooms / "room_0"), *setting.split(), f"out={tmp_path / 'out'}")
    assert setting.partition("=")[0].rpartition(".")[2] in problem
    assert list(tmp_path.iterdir()) == []
