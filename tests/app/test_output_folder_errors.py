"""Output folders that cannot be written or replaced: each is a line that names the folder."""

import errno
import os
import re
from pathlib import Path

import pytest
from output_folders import fill, names, write_and_raise

from gsencoder.app.output import output_folder, refuse_to_replace_inputs
from gsencoder.core.errors import InputError

FULL, LARGE = "no space left on the device", r"a file would grow larger than .* \(ulimit -f\)"


@pytest.mark.parametrize(
    ("error", "problem"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "x"), FULL),
        (OSError("4096 requested and 100 written"), FULL),
        (RuntimeError("I/O error: No space left on device (os error 28)"), FULL),
        (OSError(errno.EFBIG, "File too large"), LARGE),
    ],
)
def test_a_full_disk_is_one_line_that_names_the_folder(tmp_path: Path, error: Exception, problem: str) -> None:
    with pytest.raises(InputError, match=rf"out: {problem}: no result was written$"):
        write_and_raise(tmp_path / "out", error)
    assert names(tmp_path) == []


def test_a_full_disk_at_the_last_moment_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="no space left"):
        fill(tmp_path / "out", "new")
    assert names(tmp_path) == []


def test_messages_name_the_folder_asked_for_not_the_temporary_one(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"out/a\.xyz: cannot write xyz") as caught, output_folder(out) as folder:
        raise InputError(f"{folder}/a.xyz: cannot write xyz")
    assert ".partial" not in str(caught.value)
    with pytest.raises(InputError, match=r"out/no/a: cannot write: No such file"), output_folder(out) as folder:
        (folder / "no" / "a").write_text("x")
    with pytest.raises(FileNotFoundError), output_folder(tmp_path / "out"):
        (tmp_path / "input").read_text()


def test_a_place_that_cannot_be_written_is_a_named_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"file/out: \S*/file is a file, so no folder can be made in it"):
        fill(tmp_path / "file" / "out", "x")
    with pytest.raises(InputError, match="cannot write here: Not a directory"):
        fill(tmp_path / "file" / "deep" / "out", "x")


def test_a_name_longer_than_the_system_allows_is_refused_before_the_work(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match="cannot write here: File name too long"),
        output_folder(tmp_path / ("x" * 300)),
    ):
        raise AssertionError("the block must not begin")
    fill(tmp_path / ("ü" * 127), "x")
    assert names(tmp_path) == ["ü" * 127]


def test_inputs_inside_the_folder_to_replace_are_protected(tmp_path: Path) -> None:
    fill(tmp_path / "out", "old")
    inside, out = str(tmp_path / "out" / "deep"), str(tmp_path / "out")
    for values in ({"paths": [inside]}, {"paths": [out]}, {"weights": out}, {"seeds": {"mesh": inside}, "voxel": 2}):
        with pytest.raises(InputError, match="holds the input"):
            refuse_to_replace_inputs(tmp_path / "out", values)
    (tmp_path / "splat.ply").touch()
    (tmp_path / "link.ply").symlink_to("splat.ply")
    with pytest.raises(InputError, match=r"splat.ply: is the input paths=.*link.ply, so it cannot be replaced"):
        refuse_to_replace_inputs(tmp_path / "splat.ply", {"paths": [str(tmp_path / "link.ply")]})
    refuse_to_replace_inputs(tmp_path / "out", {"out": out, "paths": [str(tmp_path)], "splat": str(tmp_path / "out2")})
    refuse_to_replace_inputs(tmp_path / "out", {"weights": str(tmp_path / "out" / "nothing"), "query": "a\0b"})


def test_a_disk_that_is_full_elsewhere_is_not_said_to_be_full_here(tmp_path: Path) -> None:
    words = "No space left on device"
    with (
        pytest.raises(InputError, match=r"out: no space left.*: no result was written$"),
        output_folder(tmp_path / "out") as own,
    ):
        raise InputError(f"{own}/a.ply: cannot be written: {words}")
    with pytest.raises(InputError, match=rf"^/elsewhere/b: cannot be written: {re.escape(words)}$"):
        write_and_raise(tmp_path / "out", InputError(f"/elsewhere/b: cannot be written: {words}"))


def test_a_mount_point_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "volume").mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path).name == "volume")
    with (
        pytest.raises(InputError, match="volume: is a mount point.*give a folder in it"),
        output_folder(tmp_path / "volume"),
    ):
        raise AssertionError("the block must not begin")
    fill(tmp_path / "volume" / "out", "x")


def test_an_output_that_the_system_does_not_let_go_is_named_and_kept(tmp_path, monkeypatch):
    fill(tmp_path / "out", "old")

    def refused(source: str | Path, *_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted", str(source))

    monkeypatch.setattr("gsencoder.app.output._exchange", lambda *_: False)
    with monkeypatch.context() as patched:
        patched.setattr(os, "rename", refused)
        with pytest.raises(InputError, match="out: cannot be replaced by the results: Operation not permitted"):
            fill(tmp_path / "out", "new", overwrite=True)
    assert (tmp_path / "out" / "deep" / "data.txt").read_text() == "old"
    assert names(tmp_path) == ["out"]
