"""Output folders are whole or absent."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from output_folders import fill, names, write_and_raise

from gsencoder.app import output as outputs
from gsencoder.app.output import check_output_files, output_folder
from gsencoder.core.errors import InputError
from gsencoder.core.files import SUMMARY_NAME, write_bytes


def test_a_folder_appears_whole_when_the_block_ends(tmp_path: Path) -> None:
    path = tmp_path / "new" / "parents" / "out"
    with output_folder(path) as folder:
        (folder / "a").write_text("x")
        assert not path.exists()
        assert folder.parent == path.parent
    assert names(path) == ["a"]
    assert names(path.parent) == ["out"]


def test_whatever_ends_the_block_early_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write_and_raise(tmp_path / "out", KeyboardInterrupt())
    assert names(tmp_path) == []


def test_a_failed_run_leaves_the_earlier_results_alone(tmp_path: Path) -> None:
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
