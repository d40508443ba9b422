"""The state of a run is its own: kept when it is cut off, known again, never mixed up with what others made."""

from collections.abc import Callable
from pathlib import Path

import pytest

from gsencoder.app.output import DISCARDED_FILE, MARKER_FILE, WorkFolder
from gsencoder.core.errors import InputError


def run(path: Path, inside: Callable[[Path], None] = lambda path: None, *, anew: bool = False) -> None:
    with WorkFolder(path) as work:
        work.take(resume=not anew)
        inside(work.path)


def cut_off(path: Path, *names: str) -> list[str]:
    """Leaves what a run leaves that was stopped after it had written these files; what it had found there."""
    names_before = []

    def inside(path: Path) -> None:
        names_before.extend(contents(path))
        for name in names:
            (path / name).write_text("state")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(path, inside)
    return names_before


def contents(path: Path) -> list[str]:
    return sorted(entry.name for entry in path.iterdir())


def test_state_is_kept_when_a_run_is_cut_off_and_goes_when_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "run.training"
    cut_off(path, "state")
    assert contents(path) == ["state", MARKER_FILE]
    with WorkFolder(path) as work:
        work.take(resume=True)
        assert contents(path) == ["state", MARKER_FILE]
    assert not path.exists()


@pytest.mark.parametrize("anew", [True, False])
def test_a_state_that_a_kill_left_half_removed_is_not_continued(tmp_path, monkeypatch, anew):
    """A run is killed while it removes its state: as it begins anew, or once its results are written."""

    class Killed(BaseException):
        pass

    def killed(path: Path, **_: object) -> None:
        raise Killed

    path = tmp_path / "run"
    cut_off(path, "checkpoint", "log")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", killed)
        with pytest.raises(Killed):
            run(path, anew=anew)
    # Nothing was removed here, and any part of it may have been.
    assert {"checkpoint", "log"} <= {*contents(path)}
    assert cut_off(path, "checkpoint") == [MARKER_FILE]
    assert contents(path) == ["checkpoint", MARKER_FILE]


def test_a_folder_that_no_run_made_is_never_taken_or_removed(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError, match="holds something else"), WorkFolder(tmp_path) as work:
        work.take(resume=True)
    assert (tmp_path / "notes.txt").is_file()
    with (
        pytest.raises(InputError, match="cannot save the state of this run here.*give another out="),
        WorkFolder(tmp_path / "notes.txt") as work,
    ):
        work.take(resume=True)


@pytest.mark.parametrize(("message", "noted"), [("no labels", True), ("{path} has other settings", False)])
def test_an_error_that_is_not_about_the_state_says_that_it_can_be_continued(tmp_path, message, noted):
    path = tmp_path / "run"

    def fail() -> None:
        with WorkFolder(path) as work:
            work.take(resume=True)
            (path / "half.bin").touch()
            raise InputError(message.format(path=path))

    with pytest.raises(InputError) as caught:
        fail()
    assert any("continues it" in note for note in getattr(caught.value, "__notes__", ())) == noted


def test_a_run_that_was_killed_in_its_first_moments_does_not_block_the_next(tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.mkdir()
    (path / f".{MARKER_FILE}.0123456789ab.tmp").touch()
    with WorkFolder(path) as work:
        work.take(resume=True)
    assert not path.exists()


def test_a_kill_while_the_folder_is_removed_leaves_one_that_is_known(tmp_path, monkeypatch):
    path = tmp_path / "run"
    cut_off(path, "a", "b", "z")
    removed, unlink = [], Path.unlink

    def killed(self: Path, *, missing_ok: bool = False) -> None:
        if len(removed) == 2:
            raise KeyboardInterrupt
        removed.append(self)
        unlink(self, missing_ok=missing_ok)

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        run(path, lambda _: patched.setattr(Path, "unlink", killed))
    assert DISCARDED_FILE in contents(path)
    run(path, anew=True)
    assert not path.exists()


def test_two_runs_do_not_share_a_folder(tmp_path: Path) -> None:
    with WorkFolder(tmp_path / "run") as first:
        first.take(resume=True)
        (first.path / "state").touch()
        with pytest.raises(InputError, match="another run saves its state here now"), WorkFolder(first.path) as second:
            second.take(resume=True)
        assert contents(first.path) == ["state", MARKER_FILE]
    with WorkFolder(tmp_path / "run") as third:
        third.take(resume=True)


@pytest.mark.parametrize("anew", [True, False])
def test_what_cannot_be_removed_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, anew: bool) -> None:
    cut_off(tmp_path / "run", "state")

    def refused(self: Path, **_: object) -> None:
        raise PermissionError(1, "Operation not permitted", str(self))

    problem = "cannot save the state of this run here" if anew else "results are written.*remove it"
    monkeypatch.setattr(Path, "unlink", refused)
    with pytest.raises(InputError, match=problem):
        run(tmp_path / "run", anew=anew)


@pytest.mark.parametrize("taken", [True, False])
def test_an_error_before_anything_was_computed_speaks_of_no_state_and_leaves_none(tmp_path, taken):
    path = tmp_path / "run"
    if not taken:
        cut_off(path, "state of another run")

    def fail() -> None:
        with WorkFolder(path) as work:
            if taken:
                work.take(resume=True)
            raise InputError("no labels")

    with pytest.raises(InputError) as caught:
        fail()
    assert getattr(caught.value, "__notes__", []) == []
    assert path.exists() == (not taken)
