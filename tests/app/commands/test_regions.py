"""`teacher=regions` on the command line: fused, found, prepared for training, and refused in one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_runs import refusal
from named_rooms import write_words
from region_scenes import save_colors

from gsencoder.app import main as cli
from gsencoder.core.archive import open_archive
from gsencoder.data.scenes import load_scene
from gsencoder.data.synthetic import make_room, write_room
from gsencoder.text.table import load_text_table


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room, the words of what is in it, a folder of its instance maps as label images, and their captions."""
    folder = tmp_path_factory.mktemp("rooms") / "room"
    made = make_room(0, objects=4, views=4, width=64, height=48)
    write_room(made, folder)
    write_words(folder / "words.safetensors", made)
    views = load_scene(folder).views
    for name, labels in zip(views.names, views.instances, strict=True):
        (folder / "masks").mkdir(exist_ok=True)
        np.save(folder / "masks" / Path(name).with_suffix(".npy").name, labels)
    shown = {int(label) for labels in views.instances for label in np.unique(labels)}
    captions = {str(thing.id): thing.name for thing in made.objects if thing.name and thing.id in shown}
    (folder / "masks/captions.json").write_text(json.dumps(captions))
    return folder


def boxes(room: Path, out: Path, *options: str) -> list[dict[str, Any]]:
    words = room / "words.safetensors"
    assert cli.main(["fuse", str(room), f"teacher.words={words}", *options, f"out={out}", "quiet=true"]) == 0
    query = ",".join(load_text_table(words).names)
    assert cli.main(["localize", str(out), f"query={query}", f"out={out}/boxes", "pictures=0", "quiet=true"]) == 0
    rows: list[dict[str, Any]] = json.loads((out / "boxes/boxes.json").read_text())
    return rows


@pytest.mark.slow
def test_regions_are_found_where_labels_are(room: Path, tmp_path: Path) -> None:
    labels = boxes(room, tmp_path / "labels", "teacher=labels")
    assert labels
    for name, options in (("instances", ["teacher.masks=instances"]), ("files", ["teacher.folder=masks"])):
        regions = boxes(room, tmp_path / name, "teacher=regions", *options)
        assert [box["query"] for box in regions] == [box["query"] for box in labels]
        for ours, theirs in zip(regions, labels, strict=True):
            for key in ("aabb_min", "aabb_max", "score", "count"):
                np.testing.assert_allclose(ours[key], theirs[key], rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_scenes_are_prepared_for_training_from_regions(room: Path, tmp_path: Path) -> None:
    save_colors(tmp_path / "colors.onnx")
    teacher = ["teacher=regions", "teacher.masks=instances", "teacher.vector=map", "prepare_only=true", "quiet=true"]
    options = [f"teacher.model={tmp_path / 'colors.onnx'}", "teacher.onnx.layout=grid", "teacher.onnx.patch=4"]
    prepared = tmp_path / "prepared"
    assert cli.main(["train", str(room), *teacher, *options, f"prepared={prepared}", f"out={tmp_path / 'o'}"]) == 0
    with open_archive(prepared / "scenes/room.safetensors") as file:
        weights = file.array("weights", "float32", ("N",))
    assert (weights > 0).any()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["teacher.masks=instances"], "captions need words: give a text tower"),
        (["teacher.folder=nowhere", "teacher.words=words.safetensors"], "teacher.folder: nothing at"),
        (["teacher.masks=instances", "teacher.folder=masks"], "teacher.folder: is an option of masks=files"),
        (["teacher.onnx.size=-3"], "teacher.onnx.size: expected 0 to 8,192"),
        (["teacher.vector=map", "teacher.folder=masks"], "teacher.model= is missing: the image tower of vector=map"),
    ],
)
def test_what_is_wrong_is_one_line(room, tmp_path, capsys, monkeypatch, options, problem):
    monkeypatch.setenv("GSENCODER_MODELS", str(room))
    assert problem in refusal(capsys, "fuse", str(room), "teacher=regions", *options, f"out={tmp_path / 'o'}")
    assert not (tmp_path / "o").exists()
