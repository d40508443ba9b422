"""What a command is given, or a scene names, and is no file: exit code 2 within seconds, and a line that names it."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from no_files import ends_within, make_no_file
from viewed_rooms import save_viewed_room

from gsencoder.app.main import COMMANDS, _impossible_sizes, main
from gsencoder.core.errors import InputError

SECONDS = 10.0
OUT = {"export": "out.onnx", "repair": "out.ply"}
KINDS = ("pipe", "device", "folder", "dangling")
OPTIONS = [
    "fuse ROOM splat=BAD.ply teacher=palette",
    "encode ROOM weights=BAD.safetensors",
    "localize FEATURES query=mug words=BAD.npz",
    "ask FEATURES dry_run=true questions=BAD.jsonl",
    "evaluate ROOM protocol=instances classes=BAD.csv",
    "repair BAD.ply",
    "reconstruct BAD.mp4",
    "score semantics predictions=TABLES truth=TABLES classes=scannet20 scenes=BAD.txt",
]
"""Commands, and what stands for the thing that is no file."""
CONTENTS = [
    ("inspect ROOM", "room/transforms.json"),
    ("localize FEATURES query=mug", "features/features.safetensors"),
    ("score instances predictions=TABLES truth=TRUTH classes=scannet20", "tables/a.txt"),
]
"""Commands, and the file of their inputs that is no file."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    save_viewed_room(folder)
    for name in ("tables", "truth"):
        (folder / name).mkdir()
        (folder / name / "a.txt").write_text("1\n")
    return folder


def refusal(words: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What a command says that ends with exit code 2, in one line."""
    for name in ("room", "features", "tables", "truth"):
        words = words.replace(name.upper(), str(folder / name))
    command, *rest = words.replace("BAD", str(folder / "bad")).split()
    out = () if command in ("inspect", "view") else (f"out={folder / OUT.get(command, 'out')}",)
    COMMANDS[command].load()  # Which takes longer than a refusal may.
    with ends_within(SECONDS):
        code = main([command, *rest, *out])
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith("error: ")]
    assert (code, len(lines)) == (2, 1), (code, error)
    assert "Traceback" not in error
    return lines[0]


@pytest.mark.parametrize("words", OPTIONS)
def test_an_option_that_names_no_file_is_refused(made, words, tmp_path, capsys):
    name = next(part for part in words.replace("=", " ").replace("/", " ").split() if part.startswith("BAD"))
    for part in ("room", "features", "tables", "truth"):
        (tmp_path / part).symlink_to(made / part)
    path = tmp_path / name.replace("BAD", "bad")
    make_no_file(path, KINDS[OPTIONS.index(words) % 4])
    assert path.name in refusal(words, tmp_path, capsys)


@pytest.mark.parametrize(("words", "name"), CONTENTS)
def test_a_file_of_a_scene_that_is_none_is_refused(made, words, name, tmp_path, capsys):
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    path = tmp_path / name
    path.unlink()
    make_no_file(path, "pipe")
    assert path.name in refusal(words, tmp_path, capsys)


@pytest.mark.parametrize(
    "make", [lambda: np.zeros(10**14), lambda: torch.zeros(10**14), lambda: np.zeros(10**20), lambda: [0] * 10**18]
)
def test_sizes_that_cannot_be_allocated_are_one_line(make: Callable[[], object]) -> None:
    with pytest.raises(InputError, match="^the machine has not enough memory for a size"), _impossible_sizes():
        make()


def test_other_errors_stay_as_they_are() -> None:
    for error in (RuntimeError("shape"), OverflowError("math range error"), InputError("its own")):
        with pytest.raises(type(error), match=str(error)), _impossible_sizes():
            raise error


@pytest.mark.parametrize(
    "words",
    [
        ["inspect", "LOOP"],
        ["localize", "LOOP", "query=mug"],
        ["export", "sizes=[99999999999]", "out=LOOP.onnx"],
        ["train", "LOOP", "model.projector=1000000000"],
    ],
)
def test_commands_end_in_one_line(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert main([word.replace("LOOP", str(loop)) for word in words]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
