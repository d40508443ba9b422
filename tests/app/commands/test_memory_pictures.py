"""Pictures that `gsencoder memory` writes: of scenes with photographs, with labels alone, and of bare splats."""

import json
import shutil
from pathlib import Path

import pytest
from command_runs import refusal
from PIL import Image

from gsencoder.app import cli
from gsencoder.data.synthetic.room import make_room
from gsencoder.data.synthetic.write import write_room

pytestmark = pytest.mark.slow

QUICK = ("quiet=true", "train.steps=5", "train.warmup=2", "memory.channels=6", "prepare.fusion.views=0")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rooms") / "room"
    write_room(make_room(0, objects=3, views=3, width=100, height=75), folder)
    return folder


def pictures_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.png"))}


def test_pictures_of_each_teacher_are_written_and_come_again_the_same(room: Path, tmp_path: Path) -> None:
    words = ["memory", str(room), "teacher=[palette,labels]", "pictures=2", *QUICK]
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

    monkeypatch.setattr("gsencoder.train.memory_scene.draw_sample", unused)
    out = tmp_path / "memory"
    assert cli.main(["memory", str(room), "teacher=palette", "pictures=0", f"out={out}", *QUICK]) == 0
    assert pictures_in(out) == {}
    assert (out / "memory.safetensors").is_file()


def test_labels_without_photographs_and_bare_splats_are_drawn(room: Path, tmp_path: Path) -> None:
    labels = tmp_path / "labels"
    shutil.copytree(room, labels)
    listed = json.loads((labels / "transforms.json").read_text())
    for frame in listed["frames"]:
        (labels / frame.pop("file_path")).unlink()
    (labels / "transforms.json").write_text(json.dumps(listed))
    out = f"out={tmp_path / 'of_labels'}"
    assert cli.main(["memory", str(labels), "teacher=labels", "pictures=1", out, *QUICK]) == 0
    assert list(pictures_in(tmp_path / "of_labels")) == ["attention.labels.view000.png", "components.labels.png"]
    out = f"out={tmp_path / 'of_splat'}"
    splat = [str(room / "splat.ply"), "teacher=palette", "orbits=4", "pictures=2"]
    assert cli.main(["memory", *splat, out, *QUICK]) == 0
    drawn = list(pictures_in(tmp_path / "of_splat"))
    assert "components.palette.png" in drawn
    assert len(drawn) > 1


def test_options_of_pictures_that_cannot_be_are_refused(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["memory", str(room), "teacher=palette", f"out={tmp_path / 'out'}"]
    assert "pictures: expected 0 or more, got -1" in refusal(capsys, *words, "pictures=-1")
    assert "umap: expected pictures=1 or more" in refusal(capsys, *words, "umap=true", "pictures=0")
    monkeypatch.setattr("gsencoder.infer.draw.component_scatter.find_spec", lambda name: None)
    assert "pip install 'gsencoder[umap]'" in refusal(capsys, *words, "umap=true")
    assert not (tmp_path / "out").exists()
