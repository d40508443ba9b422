"""What a scene or an option names is a regular file: pipes and devices end with an error, within a second."""

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from viewed_rooms import save_viewed_room

from gsencoder.app.main import COMMANDS, _impossible_sizes, main
from gsencoder.core.archive import read_npz
from gsencoder.core.errors import InputError
from gsencoder.core.files import TEXT_BYTES, check_foreign, open_foreign, read_foreign, read_foreign_text
from gsencoder.core.pretrained import load_companion, open_session, read_config
from gsencoder.data.labels.files import read_checked
from gsencoder.data.labels.mesh import read_mesh
from gsencoder.data.readers.colmap import read_colmap
from gsencoder.data.readers.images import load_npy, open_picture
from gsencoder.data.readers.posed import table_lines
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.data.splats.files import load_property, load_splat
from gsencoder.data.splats.ply import read_points
from gsencoder.evaluate.benchmarks.files import scene_files
from gsencoder.text.models import _load_tokenizer


def make_no_file(path: Path, kind: str) -> Path:
    """A pipe, a folder, a link to a device that never ends, or a link to nothing."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero" if kind == "device" else path.parent / "gone")
    return path


@contextmanager
def ends_within(seconds: float) -> Iterator[None]:
    """Raises TimeoutError in a block that takes longer."""

    def late(*_: object) -> None:
        raise TimeoutError(f"it did not end within {seconds:g} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


READERS: dict[str, Callable[[Path], object]] = {
    "picture.png": open_picture,
    "depth.npy": load_npy,
    "poses.txt": table_lines,
    "pose.json": read_json,
    "splat.ply": load_splat,
    "further.ply": lambda path: load_property(path, "x"),
    "truth.txt": read_checked,
    "mesh.ply": read_mesh,
    "points.ply": read_points,
    "model.onnx": lambda path: open_session(path, "a test"),
    "tokenizer.json": _load_tokenizer,
    "config.json": lambda path: read_config(path.parent, "a test"),
    "chat_template.jinja": lambda path: load_companion(object, path.parent, "a test", "template"),
    "masks.npz": lambda path: read_npz(path, {"pred_masks": ("b", 2)}),
    "bytes": read_foreign,
    "text": read_foreign_text,
}


@pytest.fixture
def within_a_second():
    with ends_within(1.0):
        yield


@pytest.mark.usefixtures("within_a_second")
@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_and_a_device_are_refused_by_every_reader(tmp_path, name, kind):
    path = make_no_file(tmp_path / name, kind)
    with pytest.raises(InputError, match="not a regular file") as caught:
        READERS[name](path)
    assert str(path) in str(caught.value)


@pytest.mark.usefixtures("within_a_second")
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_a_binary_model_that_is_no_file_is_refused(tmp_path, kind):
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        make_no_file(tmp_path / name, kind)
    with pytest.raises(InputError):
        read_colmap(tmp_path, tmp_path, tmp_path)


def test_links_to_files_are_read_and_large_files_are_not(tmp_path):
    (tmp_path / "file").write_bytes(b"\xef\xbb\xbfa\r\nb")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert read_foreign_text(tmp_path / "link") == "a\nb"
    assert len(read_foreign(tmp_path / "link", 7)) == 7
    for refuse in (read_foreign, read_foreign_text, open_foreign, check_foreign):
        with pytest.raises(InputError, match="7 bytes; at most 6"):
            refuse(tmp_path / "link", 6)
    with (tmp_path / "large").open("wb") as stream:
        stream.truncate(TEXT_BYTES + 1)
    with pytest.raises(InputError, match="at most 268,435,456 are read"):
        read_foreign_text(tmp_path / "large")
    with pytest.raises(InputError, match="is a folder"):
        open_foreign(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_foreign(tmp_path / "missing")


@pytest.mark.usefixtures("within_a_second")
@pytest.mark.parametrize("kind", ["pipe", "dangling"])
def test_truth_of_a_scene_that_cannot_be_read_is_named_and_not_left_out(tmp_path, kind):
    for folder in ("predictions", "truth"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.txt").write_text("1\n")
    path = tmp_path / "truth" / "b.txt"
    if kind == "dangling":
        path.symlink_to(tmp_path / "gone")
    else:
        make_no_file(path, kind)
    with pytest.raises(InputError, match=r"b\.txt"):
        scene_files(tmp_path / "predictions", tmp_path / "truth")


def test_masks_are_refused_by_their_declared_size(tmp_path, monkeypatch):
    np.savez_compressed(tmp_path / "a.npz", pred_masks=np.zeros((2048, 1024), bool))
    kinds = {"pred_masks": ("b", 2)}
    assert read_npz(tmp_path / "a.npz", kinds)["pred_masks"].shape == (2048, 1024)
    monkeypatch.setattr("gsencoder.core.archive.LARGEST_ARRAY", 1 << 20)
    with pytest.raises(InputError, match="claims"):
        read_npz(tmp_path / "a.npz", kinds)


# Commands: exit code 2 within seconds, and a line that names the file

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
