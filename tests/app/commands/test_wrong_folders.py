"""A folder of another kind than an option takes: the error says what was given, what was expected, and which command
makes that."""

import json
from pathlib import Path

import pytest
from textured_box import box_cameras, box_views, write_box

from gsencoder.app.commands.ask import scene_folders
from gsencoder.app.output import WorkFolder
from gsencoder.core.errors import InputError
from gsencoder.data.scenes import find_scenes
from gsencoder.data.splats.files import read_raw
from gsencoder.fusion.folder import FEATURES_FILE, MEMORY_FILE, SCENE_FILE, load_features, load_memories
from gsencoder.fusion.package import PACKAGE_FILE
from gsencoder.infer.encode import Encoder
from gsencoder.models.output_space import WEIGHTS_FILE, load_output_spaces

WRITTEN = {
    "fuse": (SCENE_FILE, FEATURES_FILE), "memory": (SCENE_FILE, MEMORY_FILE), "pack": (PACKAGE_FILE,),
    "train": (WEIGHTS_FILE,), "reconstruct": ("splat.ply",),
}  # fmt: skip
KINDS = {name: f"a folder that `gsencoder {name}` wrote" for name in WRITTEN} | {
    "unfinished": "the state of an unfinished run", "scene": "a scene",
    "several": "a folder of folders of features (room, …)", "empty": "an empty folder", "missing": "",
    "notes.csv": "a .csv file",
}  # fmt: skip
FEATURES = "expected a folder of features, which `gsencoder fuse`, `encode`, `memory` and `pack` write"
FEATURE_FOLDERS = ("fuse", "memory", "pack")
READERS = {
    "localize, views, ask, pack, view, select, evaluate features=": (load_features, FEATURE_FOLDERS, FEATURES),
    "ask of a set, tune features=": (
        lambda path: scene_folders([path], ["room"]), (*FEATURE_FOLDERS, "several"), FEATURES,
    ),
    "export memory=": (load_memories, ("memory",), "expected a folder with a memory, which `gsencoder memory` writes"),
    "weights=": (Encoder.load, ("train",), "`gsencoder train` w"),
    "fuse basis=": (load_output_spaces, ("train",), "`gsencoder train` w"),
    "fuse, encode, train, reconstruct, evaluate": (
        lambda path: find_scenes([path]),
        ("scene", "reconstruct", "pack", "fuse", "memory", "missing", "notes.csv"),
        "neither a scene nor a folder of scenes; a scene holds one of",
    ),
}  # fmt: skip


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of each kind, as far as names of files tell."""
    monkeypatch.chdir(tmp_path)
    for command, files in WRITTEN.items():
        (tmp_path / command).mkdir()
        (tmp_path / command / "summary.json").write_text(json.dumps({"command": command}))
        for file in files:
            (tmp_path / command / file).write_text("x")
    WorkFolder(tmp_path / "unfinished").take(resume=True)
    write_box(tmp_path / "scene", box_views(box_cameras(2, width=32, height=24, focal=22.0)))
    (tmp_path / "several" / "room").mkdir(parents=True)
    (tmp_path / "several" / "room" / SCENE_FILE).write_text("x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.csv").write_text("x")
    return tmp_path


@pytest.mark.parametrize("options", READERS)
@pytest.mark.usefixtures("folders")
def test_each_kind_of_folder_that_an_option_does_not_take(options: str) -> None:
    read, taken, expected = READERS[options]
    for name, kind in KINDS.items():
        if name not in taken:
            with pytest.raises(InputError) as error:
                read(name)
            assert name in str(error.value)
            assert kind in str(error.value)
            assert expected in str(error.value) or (name == "missing" and "no file at missing" in str(error.value))


@pytest.mark.usefixtures("folders")
def test_a_folder_with_a_splat_names_it() -> None:
    header = b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float %b\nend_header\n"
    Path("reconstruct/splat.ply").write_bytes(header % b"opacity")
    with pytest.raises(InputError, match=r"expected a splat file or a SOG folder; give its splat\.ply$"):
        read_raw("reconstruct")
    with pytest.raises(InputError, match="SOG folder$"):
        read_raw("empty")
    # Boxes are drawn as edges and are no Gaussians.
    Path("reconstruct/boxes.ply").write_bytes(header % b"x")
    with pytest.raises(InputError, match=r"give its splat\.ply$"):
        read_raw("reconstruct")
