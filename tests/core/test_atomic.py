"""Atomic files: whole or as before, with one hidden name that the next run uses again; and logs, line by line."""

import errno
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from safetensors.numpy import save

from gsencoder.core.archive import copy_checked, write_archive, write_safetensors
from gsencoder.core.errors import InputError, WriteError
from gsencoder.core.files import atomic_file, write_bytes, write_picture
from gsencoder.core.logs import LOG_FILE, Log, read_log

KILLED = """
import os, signal, sys
from pathlib import Path
from gsencoder.core.files import atomic_file
with atomic_file(Path(sys.argv[1])) as stream:
    stream.write(b"half")
    stream.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="signals and locks")
def test_what_a_killed_run_left_is_written_over_by_the_next(tmp_path: Path) -> None:
    write_bytes(tmp_path / "a", b"earlier")
    for _ in range(2):
        subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "a")], check=False)
        assert names(tmp_path) == [".a.tmp", "a"]
        assert (tmp_path / "a").read_bytes() == b"earlier"
    write_bytes(tmp_path / "a", b"n")
    assert names(tmp_path) == ["a"]
    assert (tmp_path / "a").read_bytes() == b"n"
    # A file may have the longest name, and its temporary one is shorter then.
    write_bytes(tmp_path / ("é" * 127), b"x")
    assert names(tmp_path) == ["a", "é" * 127]


def test_a_hidden_file_that_cannot_be_emptied_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bytes(tmp_path / "a", b"earlier")
    monkeypatch.setattr(os, "ftruncate", Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
    with pytest.raises(InputError, match="no space left"):
        write_bytes(tmp_path / "a", b"new")
    assert names(tmp_path) == ["a"]
    assert (tmp_path / "a").read_bytes() == b"earlier"


def test_of_many_writers_every_reader_sees_one_whole(tmp_path: Path) -> None:
    parts = [bytes([letter]) * 50_000 for letter in b"abcd"]
    seen, begun = set(), threading.Barrier(4)

    def write(part: bytes) -> None:
        begun.wait()
        for _ in range(25):
            write_bytes(tmp_path / "x", part)
            seen.add((tmp_path / "x").read_bytes())

    with ThreadPoolExecutor(len(parts)) as pool:
        list(pool.map(write, parts))
    assert seen <= set(parts)
    assert names(tmp_path) == ["x"]


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="needs symbolic links")
def test_a_link_in_the_place_of_the_hidden_file_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / ".a.tmp").symlink_to("precious")
    with pytest.raises(InputError, match="a: cannot write"):
        write_bytes(tmp_path / "a", b"x")
    assert (tmp_path / "precious").read_text() == "mine"


def test_archives_are_the_bytes_that_safetensors_writes(tmp_path: Path, rng: np.random.Generator) -> None:
    kinds = ("uint8", "uint16", "float16", "int32", "float32", "float64", "int64")
    shapes = ((), (0, 3), (5,), (2, 3, 4))
    arrays = {
        f'{"zaäb"[number % 4]}{number} "': rng.integers(0, 9, shape).astype(kind)
        for number, (kind, shape) in enumerate((kind, shape) for kind in kinds for shape in shapes)
    }
    for each in ({}, arrays, dict(list(arrays.items())[5:6])):
        text = {"gsencoder": '{"é": "\\n\u2028"}'}
        write_safetensors(tmp_path / "a", each, text)
        assert (tmp_path / "a").read_bytes() == save(each, text)
    write_archive(tmp_path / "b", {"a": np.arange(12).reshape(3, 4).T}, {})
    assert names(tmp_path) == ["a", "b"]


@pytest.mark.parametrize("name", ["a.png", "a.JPG"])
def test_pictures_are_written_in_the_format_of_their_suffix(name: str, tmp_path: Path) -> None:
    from PIL import Image

    pixels = np.full((6, 9, 3), 128, np.uint8)
    write_picture(tmp_path / name, pixels)
    with Image.open(tmp_path / name) as read:
        assert read.format == ("PNG" if name.endswith("png") else "JPEG")
        np.testing.assert_array_equal(np.asarray(read), pixels)
    write_picture(tmp_path / "d.png", np.full((2, 3), 40_000, np.uint16))
    with Image.open(tmp_path / "d.png") as read:
        assert np.asarray(read).max() == 40_000


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (OSError(errno.EDQUOT, os.strerror(errno.EDQUOT)), "a: no space left on the device"),
        (OSError("4096 requested and 100 written"), "a: no space left on the device"),
        (OSError(errno.EIO, os.strerror(errno.EIO)), "a: cannot write: Input/output error"),
    ],
)
def test_what_the_system_refuses_is_told_from_a_target_that_cannot_be(tmp_path, fault, message):
    write_bytes(tmp_path / "a", b"earlier")
    with pytest.raises(WriteError, match=message), atomic_file(tmp_path / "a"):
        raise fault
    assert (tmp_path / "a").read_bytes() == b"earlier"
    for target, wrong in ((tmp_path, "is a folder; give the name of a file"), (tmp_path / "b" / "c", "does not exist")):
        with pytest.raises(InputError, match=wrong) as refused:
            write_bytes(target, b"")
        assert not isinstance(refused.value, WriteError)


def test_a_copy_is_checked_whole_before_it_is_seen_and_a_damaged_one_names_its_source(tmp_path: Path) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_bytes(b"whole")
    target.write_bytes(b"earlier")

    def check(copy: Path) -> None:
        assert target.read_bytes() == b"earlier"
        # What the source becomes after it was read is nothing to the copy.
        source.write_bytes(b"cut")
        assert copy.read_bytes() == b"whole"

    def refuse(copy: Path) -> None:
        raise InputError(f"{copy}: is damaged")

    copy_checked(source, target, check)
    assert target.read_bytes() == b"whole"
    with pytest.raises(InputError, match=f"^{source}: is damaged$"):
        copy_checked(source, target, refuse)
    assert target.read_bytes() == b"whole"
    assert names(tmp_path) == ["source", "target"]


def test_columns_may_be_added_on_the_way(tmp_path: Path) -> None:
    log = Log(tmp_path, done=0, events=False)
    log.add(0, {"loss": 1.0})
    log.add(1, {"loss": 0.5, "score": 0.9})
    log.add(2, {"loss": 0.4})
    assert (tmp_path / LOG_FILE).read_text() == "step,loss,score\n0,1.0,\n1,0.5,0.9\n2,0.4,\n"


def test_a_continued_log_has_every_step_once(tmp_path: Path) -> None:
    log = Log(tmp_path, done=0, events=False)
    for step in range(1, 5):
        log.add(step, {"loss": float(step)})
    with (tmp_path / LOG_FILE).open("a") as stream:
        stream.write("5,3.")  # What a kill in the middle of a line leaves.
    again = Log(tmp_path, done=2, events=False)
    again.add(3, {"loss": 9.0})
    assert [row["loss"] for row in read_log(tmp_path / LOG_FILE)] == ["1.0", "2.0", "9.0"]


def test_a_file_that_is_no_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / LOG_FILE).write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"log\.csv: cannot be continued"):
        Log(tmp_path, done=1, events=False)


def test_tensorboard_shows_pictures_and_the_steps_of_a_continued_run_once(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log = Log(tmp_path, done=0, events=True)
    for step in range(1, 5):
        log.add(step, {"loss": float(step)})
    log.picture(0, "validation/sheet", np.zeros((4, 4, 3), np.uint8))
    assert (tmp_path / "validation" / "sheet_000000.png").is_file()
    again = Log(tmp_path, done=2, events=True, begun=True)
    for step in range(3, 6):
        again.add(step, {"loss": 10.0 * step})
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    losses = [(event.step, event.value) for event in events.Scalars("loss")]
    assert losses == [(1, 1.0), (2, 2.0), (3, 30.0), (4, 40.0), (5, 50.0)]
