"""Files that another program cuts off while they are read: an error that names the file, and no process that the system
ends without a word (SIGBUS), as it does where a page of a memory map lies beyond the end of the file."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from asked_rooms import save_room
from torch.utils.data import DataLoader, Dataset

from gsencoder.app import main as cli
from gsencoder.core.archive import MappedArrays, open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.core.pretrained import check_fetched, digest_files
from gsencoder.data.readers.images import load_npy
from gsencoder.text.table import load_text_table
from gsencoder.train.loop import lost_workers

ROWS = np.arange(400_000, dtype=np.float32).reshape(-1, 4)
TYPES = {"rows": ("float32", 2)}


def archive(folder: Path) -> Path:
    write_archive(folder / "a.safetensors", {"rows": ROWS}, {})
    return folder / "a.safetensors"


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def read_of_archive(folder: Path) -> None:
    path = archive(folder)
    with open_archive(path) as file:
        cut(path)
        file.array("rows", "float32", ("N", 4))


def read_of_map(read: Callable[[MappedArrays], object]) -> Callable[[Path], None]:
    def run(folder: Path) -> None:
        mapped = MappedArrays(archive(folder), TYPES)
        cut(mapped.path)
        read(mapped)

    return run


def read_of_npy(folder: Path) -> None:
    path = folder / "depth.npy"
    np.save(path, ROWS)
    cut(path)
    load_npy(path)


READS: dict[str, Callable[[Path], None]] = {
    "an array of an archive": read_of_archive,
    "a whole array": read_of_map(lambda mapped: mapped.array("rows")),
    "rows": read_of_map(lambda mapped: mapped.rows("rows", np.array([len(ROWS) - 1]))),
    "a range of rows": read_of_map(lambda mapped: mapped.rows("rows", slice(len(ROWS) - 9, len(ROWS)))),
    "a .npy file": read_of_npy,
}


@pytest.mark.parametrize("kind", READS)
def test_a_file_that_is_cut_off_while_it_is_open_is_named(kind: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"(cut off|not a readable)") as raised:
        READS[kind](tmp_path)
    assert str(tmp_path) in str(raised.value)


def test_depth_that_was_read_does_not_depend_on_its_file(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", ROWS)
    values = load_npy(tmp_path / "depth.npy")
    cut(tmp_path / "depth.npy")
    np.testing.assert_array_equal(values, ROWS)


def test_words_that_are_cut_off_while_they_are_copied_are_named(tmp_path, monkeypatch, capsys):
    def cut_off(source: Any, copy: Any) -> None:
        content = source.read()
        copy.write(content[: len(content) // 2])

    save_room(tmp_path / "features")
    monkeypatch.setattr("gsencoder.core.archive.shutil.copyfileobj", cut_off)
    assert cli.main(["pack", str(tmp_path / "features"), "form=npz", f"out={tmp_path / 'out'}", "quiet=true"]) == 2
    assert capsys.readouterr().err.startswith(f"error: {tmp_path / 'features' / 'words.safetensors'}: ")
    assert not (tmp_path / "out").exists()


WITHOUT_A_CHECK = """
import json, mmap, os, sys
import gsencoder.app.main as cli

def load():
    def run(config, summary):
        with open(sys.argv[1], "rb") as stream:
            mapped = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        os.truncate(sys.argv[1], 100)
        return mapped[-1]
    return None, run

cli._dispatch = lambda words, began: load()[1](None, None)
cli.main(["inspect"])
"""


@pytest.mark.skipif(sys.platform != "linux", reason="signals of maps differ elsewhere")
def test_a_process_that_the_system_ends_says_where(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(bytes(100_000))
    command = [sys.executable, "-W", "ignore", "-c", WITHOUT_A_CHECK, str(tmp_path / "a")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGBUS
    assert "Bus error" in done.stderr
    assert "in run" in done.stderr


class Ended(Dataset[int]):
    """Samples of which the third ends the process that makes it."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> int:
        if index == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return index


@pytest.mark.skipif(sys.platform != "linux", reason="workers are forked here")
def test_a_data_worker_that_the_system_ends_is_one_line() -> None:
    loader = DataLoader(Ended(), num_workers=1, multiprocessing_context="fork", prefetch_factor=1)
    with pytest.raises(InputError, match=r"makes samples was ended .*DataLoader worker.*same command"), lost_workers():
        list(loader)
    with pytest.raises(RuntimeError, match="shapes"), lost_workers():
        raise RuntimeError("shapes differ")


@pytest.mark.skipif(sys.platform != "linux", reason="a file of the system that cannot be read")
@pytest.mark.parametrize("read", [load_text_table, digest_files, check_fetched])
def test_a_file_whose_disk_fails_is_named(read: Callable[[Path], object]) -> None:
    # Its first page belongs to nobody: reading it is an I/O error.
    with pytest.raises(InputError, match="/proc/self/mem: cannot be read: Input/output error"):
        read(Path("/proc/self/mem"))
