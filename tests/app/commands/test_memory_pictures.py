"""Pictures that `gsencoder memory` writes: of scenes with photographs and of bare splats."""

import json
from pathlib import Path

import pytest
from command_runs import refusal
from named_rooms import write_words
from PIL import Image

from gsencoder.app import main as cli
from gsencoder.core.errors import InputError
from gsencoder.data.splats.files import save_splat
from gsencoder.data.synthetic import make_room, write_room

pytestmark = pytest.mark.slow

QUICK = ("quiet=true", "train.steps=5", "train.warmup=2", "memory.channels=6", "prepare.fusion.views=0")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms") / "room"
    made = make_room(0, objects=3, views=3, width=64, height=48)
    write_room(made, folder)
    write_words(folder.parent / "words.safetensors", made)
    return folder


def pictures_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.png"))}


def test_pictures_of_each_teacher_are_written_and_come_again_the_same(room: Path, tmp_path: Path) -> None:
    labels = f"teachers.labels.words={room.parent / 'words.safetensors'}"
    words = ["memory", str(room), "teacher=[palette,labels]", labels, "pictures=2", *QUICK]
    for name in ("one", "other"):
        assert cli.main([*words, f"out={tmp_path / name}"]) == 0
    pictures = pictures_in(tmp_path / "one")
    assert list(pictures) == sorted(
        f"{name}.png"
        for teacher in ("labels", "palette")
        for name in (f"attention.{teacher}.view000", f"attention.{teacher}.view002", f"components.{teacher}")
    )
    assert pictures == pictures_in(tmp_path / "other")
    for name in pictures:
        with Image.open(tmp_path / "one" / name) as picture:
            picture.load()
            assert picture.mode == "RGB"
    timings = json.loads((tmp_path / "one" / "summary.json").read_text())["timings"]
    assert timings["pictures"] > 0


def test_without_pictures_no_raw_features_are_kept_and_nothing_is_drawn(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unused(*arguments: object, **settings: object) -> None:
        raise AssertionError

    monkeypatch.setattr("gsencoder.train.memory.draw_sample", unused)
    out = tmp_path / "memory"
    assert cli.main(["memory", str(room), "teacher=palette", "pictures=0", f"out={out}", *QUICK]) == 0
    assert pictures_in(out) == {}
    assert (out / "memory.safetensors").is_file()


def test_a_bare_splat_is_drawn_by_its_renders(tmp_path: Path) -> None:
    gaussians = make_room(0, objects=2, views=1, width=8, height=6, spacing=0.15).gaussians
    save_splat(tmp_path / "room.ply", gaussians)
    out = f"out={tmp_path / 'of_splat'}"
    splat = [str(tmp_path / "room.ply"), "teacher=palette", "orbits=3", "pictures=2", "data.up=[0,0,1]"]
    assert cli.main(["memory", *splat, out, *QUICK]) == 0
    assert list(pictures_in(tmp_path / "of_splat")) == [
        "attention.palette.view000.png",
        "attention.palette.view002.png",
        "components.palette.png",
    ]


def test_a_run_whose_pictures_cannot_be_drawn_says_how_to_go_on(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(*arguments: object, **settings: object) -> None:
        raise InputError("000.png: cannot be decoded")

    words = ["memory", str(room), "teacher=palette", f"out={tmp_path / 'out'}", *QUICK[1:]]
    monkeypatch.setattr("gsencoder.infer.memory_pictures.attention_picture", damaged)
    line = refusal(capsys, *words)
    assert line == "error: 000.png: cannot be decoded; give pictures=0 to write the memory without pictures"
    monkeypatch.setattr("gsencoder.train.memory.fuse", damaged)
    assert cli.main([*words, "pictures=0", "quiet=true"]) == 0
    assert (tmp_path / "out" / "memory.safetensors").is_file()


def test_options_of_pictures_that_cannot_be_are_refused(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["memory", str(room), "teacher=palette", f"out={tmp_path / 'out'}"]
    assert "pictures: expected 0 or more, got -1" in refusal(capsys, *words, "pictures=-1")
    assert "umap: expected pictures=1 or more" in refusal(capsys, *words, "umap=true", "pictures=0")
    monkeypatch.setattr("gsencoder.infer.memory_pictures.find_spec", lambda name: None)
    assert "pip install 'gsencoder[umap]'" in refusal(capsys, *words, "umap=true")
    assert not (tmp_path / "out").exists()
