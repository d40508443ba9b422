"""Output folders are whole or absent; one that cannot be written or replaced is a line that names it."""

import errno
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from gsencoder.app import output as outputs
from gsencoder.app.output import check_output_files, output_folder, refuse_to_replace_inputs
from gsencoder.core.errors import InputError
from gsencoder.core.files import SUMMARY_NAME, write_bytes


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def write_and_raise(path: Path, error: BaseException, **options: Any) -> None:
    with output_folder(path, **options) as folder:
        (folder / "a").write_text("x")
        raise error


def fill(path: Path, text: str, **options: Any) -> None:
    with output_folder(path, record=lambda: {"command": "fuse"}, **options) as folder:
        (folder / "deep").mkdir()
        (folder / "deep" / "data.txt").write_text(text)


def test_a_folder_appears_whole_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "new" / "parents" / "out"
    with output_folder(path) as folder:
        (folder / "a").write_text("x")
        assert not path.exists()
        assert folder.parent == path.parent
    assert names(path) == ["a"]
    assert names(path.parent) == ["out"]


def test_a_block_that_ends_early_leaves_nothing_but_the_earlier_results(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_and_raise(tmp_path / "out", KeyboardInterrupt())
    assert names(tmp_path) == []
    fill(tmp_path / "out", "old")
    with pytest.raises(ZeroDivisionError):
        write_and_raise(tmp_path / "out", ZeroDivisionError(), overwrite=True)
    assert (tmp_path / "out" / "deep" / "data.txt").read_text() == "old"
    assert names(tmp_path) == ["out"]


def test_an_existing_folder_is_refused_unless_overwrite(tmp_path: Path) -> None:
    fill(tmp_path / "out", "old")
    with pytest.raises(InputError, match="holds the results of an earlier run; give another out= or overwrite=true"):
        fill(tmp_path / "out", "new")
    fill(tmp_path / "out", "new", overwrite=True)
    assert (tmp_path / "out" / "deep" / "data.txt").read_text() == "new"
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_kill_between_two_renames_loses_no_earlier_results(overwrite, tmp_path, monkeypatch):
    """Where names cannot be exchanged there is a moment in which no folder has the name."""
    monkeypatch.setattr(outputs, "_exchange", lambda *_: False)
    fill(tmp_path / "out", "old")
    rename, calls = os.rename, []

    def killed(source: str | Path, target: str | Path) -> None:
        calls.append(target)
        if len(calls) > 1:
            raise KeyboardInterrupt
        rename(source, target)

    with monkeypatch.context() as patched:
        patched.setattr(os, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            fill(tmp_path / "out", "new", overwrite=True)
    assert names(tmp_path) == [".out.earlier"]
    if overwrite:
        fill(tmp_path / "out", "new", overwrite=True)
    else:
        with pytest.raises(InputError, match="holds the results of an earlier run"):
            fill(tmp_path / "out", "new")
    assert names(tmp_path) == ["out"]
    assert (tmp_path / "out" / "deep" / "data.txt").read_text() == ("new" if overwrite else "old")


@pytest.mark.skipif(sys.platform != "linux", reason="renameat2 is Linux's")
def test_linux_exchanges_the_two_folders_in_one_step(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).touch()
    assert outputs._exchange(tmp_path / "a", tmp_path / "b")
    assert names(tmp_path / "a") == ["b"]
    assert not outputs._exchange(tmp_path / "a", tmp_path / "missing")


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_that_no_run_wrote_is_never_replaced(tmp_path: Path, overwrite: bool) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"is a folder with other contents \(no summary.json\)"):
        fill(tmp_path / "home", "new", overwrite=overwrite)
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="is a file, and the results are a folder"):
        fill(tmp_path / "file", "new", overwrite=overwrite)
    assert (tmp_path / "home" / "thesis.tex").read_text() == "years of work"


def test_an_empty_folder_may_be_written_to(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    fill(tmp_path / "out", "new")
    assert names(tmp_path / "out") == ["deep", SUMMARY_NAME]


def test_a_symbolic_link_keeps_pointing_to_the_results(tmp_path: Path) -> None:
    fill(tmp_path / "real", "old")
    (tmp_path / "link").symlink_to("real")
    fill(tmp_path / "link", "new", overwrite=True)
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "deep" / "data.txt").read_text() == "new"


def test_a_folder_that_another_run_made_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    def slow() -> None:
        with output_folder(tmp_path / "out") as folder:
            (folder / "a").write_text("slow")
            (tmp_path / "out").mkdir()
            (tmp_path / "out" / SUMMARY_NAME).write_text("{}")

    with pytest.raises(InputError, match="holds the results of an earlier run"):
        slow()
    assert names(tmp_path / "out") == [SUMMARY_NAME]


def test_a_second_run_into_the_same_folder_is_told_of_the_first(tmp_path: Path) -> None:
    with output_folder(tmp_path / "out") as folder:
        with pytest.raises(InputError, match="another run is writing this folder now"):
            fill(tmp_path / "out", "second")
        with output_folder(tmp_path / "out2"):
            pass
        assert folder.is_dir()
    assert names(tmp_path) == ["out", "out2"]


KILLED = """
import os, sys, time
from gsencoder.app.output import output_folder
with output_folder(sys.argv[1]) as folder:
    (folder / "half").write_text("x")
    print("writing", flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_kill_leaves_no_output_folder_and_the_next_run_cleans_up(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path / "out")], stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        process.wait()
    (left,) = names(tmp_path)
    assert left.startswith(".out.partial-")
    others = [".out.partial-mine", ".out2.partial-0123abcd", "out.partial-0123abcd"]
    for name in others:
        (tmp_path / name).mkdir()
    fill(tmp_path / "out", "new")
    assert names(tmp_path) == sorted([*others, "out"])


def test_of_runs_that_begin_in_one_moment_one_gets_the_folder(tmp_path: Path) -> None:
    """The outcome of each is its own, or that another is writing; none removes what another has just made."""
    for turn in range(8):
        begun, outcomes = threading.Barrier(4), []

        def run(out: Path = tmp_path / str(turn), begun: threading.Barrier = begun, told: list[str] = outcomes) -> None:
            begun.wait()
            try:
                with output_folder(out) as folder:
                    (folder / "summary.json").write_text("{}")
                    time.sleep(0.01)
                told.append("ok")
            except InputError as error:
                text = str(error)
                told.append("refused" if "another run" in text or "an earlier run" in text else text)

        threads = [threading.Thread(target=run) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(outcomes) == ["ok", "refused", "refused", "refused"]


def test_single_files_are_replaced_only_if_allowed(tmp_path: Path) -> None:
    write_bytes(tmp_path / "a", b"1")
    with pytest.raises(InputError, match="exists; give another out= or overwrite=true"):
        check_output_files([tmp_path / "a"], overwrite=False)
    check_output_files([tmp_path / "a"], overwrite=True)
    check_output_files([tmp_path / "b"], overwrite=False)
    with pytest.raises(InputError, match="is a folder"):
        check_output_files([tmp_path], overwrite=True)
    write_bytes(tmp_path / "a", b"2")
    assert (tmp_path / "a").read_bytes() == b"2"
    assert names(tmp_path) == ["a"]


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


def test_a_place_that_cannot_take_results_is_refused_before_the_work(tmp_path, monkeypatch):
    def refused(path: Path, problem: str) -> None:
        with pytest.raises(InputError, match=problem), output_folder(path):
            raise AssertionError("the block must not begin")

    refused(tmp_path / ("x" * 300), "cannot write here: File name too long")
    fill(tmp_path / ("ü" * 127), "x")
    assert names(tmp_path) == ["ü" * 127]
    (tmp_path / "volume").mkdir()
    monkeypatch.setattr(os.path, "ismount", lambda path: Path(path).name == "volume")
    refused(tmp_path / "volume", "volume: is a mount point.*give a folder in it")
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
