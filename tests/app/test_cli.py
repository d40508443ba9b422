"""The command line as its users meet it: help, errors in one line, exit codes, interrupts."""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from toy_commands import splat, write_toy

from gsencoder import __version__
from gsencoder.app import main as cli
from gsencoder.app.main import COMMANDS
from gsencoder.app.output import output_folder
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Stopped
from gsencoder.data.splats.files import load_splat, save_splat


def broken_splat(path: Path) -> Path:
    """The first row has no rotation; everything else is in order."""
    data = bytearray(splat(path).read_bytes())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    row = np.frombuffer(data, np.float32, offset=start).reshape(20, -1).copy()
    columns = [line.split()[-1] for line in data[:start].decode().splitlines() if line.startswith("property")]
    row[0, [columns.index(f"rot_{i}") for i in range(4)]] = 0
    path.write_bytes(bytes(data[:start]) + row.tobytes())
    return path


def test_help_lists_every_command_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ([], ["--help"], ["-h"]):
        assert cli.main(words) == 0
        text = capsys.readouterr().out
        for command in COMMANDS.values():
            assert f"{command.name} " in text
            assert command.help in text
            assert "\n" not in command.help


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command_lists_every_setting_with_default_and_meaning(name, capsys):
    from gsencoder.app.options import options_of

    assert cli.main([name, "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for option in options_of(COMMANDS[name].load()[0]):
        assert f"{option.key}=" in text or option.key == "paths"
        # A preset is described by what it sets in this command.
        assert option.help in text or option.key == "preset"
    assert "out=" in text
    assert "[false]" in text


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"gsencoder {__version__}\n"


def test_cfg_prints_what_the_run_would_use(capsys: pytest.CaptureFixture[str]) -> None:
    from omegaconf import OmegaConf

    assert cli.main(["repair", "a b.ply", "fix=quats,huge", "out=null", "--cfg"]) == 0
    data = OmegaConf.to_container(OmegaConf.create(capsys.readouterr().out))
    assert isinstance(data, dict)
    assert data.pop("data")["max_views"] == 0
    assert data == {
        "out": "null", "overwrite": False, "quiet": False, "preset": "balanced", "paths": ["a b.ply"],
        "fix": ["quats", "huge"], "views": 0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["inspct"], "inspct: no such command; did you mean inspect?"),
        (["inspect", "--hepl"], "--hepl: no such flag; did you mean --help?"),
        (["inspect", "--out=x"], "--out=…: no such flag; settings are written out=…"),
        (["inspect"], "PATH is missing: scenes with posed views, or splats"),
        (["repair", "a.ply", "b.ply", "out=x.ply"], "paths: expected one splat file or scene, got 2"),
        (["inspect", "a.ply", "quiet=x\ny"], "quiet: expected true or false"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_exit_code_2(words, problem, capsys):
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert problem in err
    assert err.startswith("error: ")
    assert err.count("\n") == 1


def test_debug_shows_where_an_error_came_from(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["inspect", "no/such.ply", "--debug"]) == 2
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert err.splitlines()[-1] == "error: no/such.ply: no such file"


def test_inspect_prints_a_table_and_writes_a_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, bad = splat(tmp_path / "good.ply"), broken_splat(tmp_path / "bad.ply")
    assert cli.main(["inspect", str(good), str(bad), f"out={tmp_path / 'out'}"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "1 rows (0); stops loading" in out
    record = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert record["command"] == "inspect"
    assert [item["loadable"] for item in record["results"]["splats"]] == [True, False]
    assert [item["count"] for item in record["results"]["splats"]] == [20, 20]
    assert record["settings"]["paths"] == [str(good), str(bad)]
    # One that is missing is said before the others are looked at, and so is one that is given twice.
    for last, said in ((tmp_path / "none.ply", "no such file"), (good, "is given twice; give it once")):
        assert cli.main(["inspect", str(good), str(last)]) == 2
        assert capsys.readouterr() == ("", f"error: {last}: {said}\n")


def test_repair_mends_what_was_asked_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad, new = broken_splat(tmp_path / "bad.ply"), tmp_path / "new.ply"
    with pytest.raises(InputError, match="gsencoder repair"):
        load_splat(bad)
    assert cli.main(["repair", str(bad), f"out={new}", "fix=nonfinite"]) == 2
    assert "with a zero quaternion" in capsys.readouterr().err
    assert not new.exists()
    assert cli.main(["repair", str(bad), f"out={new}", "fix=nonfinite,quats"]) == 0
    assert "quats: 1 rows set to the identity rotation" in capsys.readouterr().out
    np.testing.assert_array_equal(load_splat(new).quats[0], [1, 0, 0, 0])
    record = json.loads(Path(f"{new}.summary.json").read_text())
    assert [change["count"] for change in record["results"]["changes"]] == [0, 1]
    assert cli.main(["repair", str(bad), f"out={new}"]) == 2
    assert "exists; give another out= or overwrite=true" in capsys.readouterr().err
    assert cli.main(["repair", str(bad), f"out={new}", "overwrite=true"]) == 0


def test_repair_keeps_positions_that_float32_cannot_hold(tmp_path: Path) -> None:
    path, far = tmp_path / "far.ply", np.array([500_000.0, 4_500_000.0, 100.0])
    gaussians = load_splat(splat(tmp_path / "near.ply"))
    save_splat(path, gaussians, origin=far)
    assert cli.main(["repair", str(path), f"out={tmp_path / 'new.ply'}", "quiet=true"]) == 0
    np.testing.assert_allclose(load_splat(tmp_path / "new.ply", origin=far).means, gaussians.means, atol=1e-6)


def test_warnings_are_lines_on_stderr_and_entries_of_the_summary(toy, tmp_path, capsys):
    def run(config: Any, summary: Any) -> None:
        for number in (1, 1, 2):
            warnings.warn(f"{number} images\nwere left out", SceneWarning, stacklevel=1)
        write_toy(config, summary)

    toy(run)
    assert cli.main(["toy", f"out={tmp_path / 'out'}"]) == 0
    lines = [f"{number} images were left out" for number in (1, 1, 2)]
    assert capsys.readouterr().err.splitlines() == [f"warning: {line}" for line in lines]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["warnings"] == lines


def wrapped(stop: Stopped) -> SystemError:
    """As compiled code lets an exception out that a signal raised within it."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = stop
    return error


@pytest.mark.parametrize(
    ("error", "code", "problem"),
    [
        (KeyboardInterrupt(), 130, "interrupted\n"),
        (Stopped(15), 143, "stopped: SIGTERM\n"),
        (wrapped(Stopped(15)), 143, "stopped: SIGTERM\n"),
        (OSError(28, "No space left on device"), 2, "error: standard output: no space left on the device\n"),
    ],
)
def test_what_ends_a_run_early_is_one_line(toy, error, code, problem, tmp_path, capsys, monkeypatch):
    def run(config: Any, summary: Any) -> None:
        with output_folder(config.out):
            if not isinstance(error, OSError):
                raise error
        raise error

    monkeypatch.setattr(cli, "_discard_stdout", lambda: None)
    toy(run)
    assert cli.main(["toy", f"out={tmp_path / 'out'}"]) == code
    assert capsys.readouterr().err == problem
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]


def test_an_input_is_never_replaced_by_the_output(toy: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["toy", f"out={tmp_path / 'out'}", "word=old"]) == 0
    assert cli.main(["toy", str(tmp_path / "out" / "word"), f"out={tmp_path / 'out'}", "overwrite=true"]) == 2
    assert "holds the input" in capsys.readouterr().err
    assert (tmp_path / "out" / "word").read_text() == "old"
