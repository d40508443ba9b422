"""`reconstruct` when it is cut off, refused by the disk, or given what it was not meant for: no work is lost."""

import errno
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command_runs import refusal, results_of
from reconstructions import QUICK, interrupt, never

from gsencoder.app import main as cli
from gsencoder.reconstruct import run as reconstruct
from gsencoder.reconstruct import score as scores

pytestmark = pytest.mark.slow


def test_a_judgement_that_was_cut_off_is_made_when_the_run_goes_on(room, built, tmp_path, monkeypatch):
    out, score, calls = tmp_path / "out", scores.score, []

    def cut_off_at_the_last(*arguments: object) -> object:
        calls.append(arguments)
        return interrupt() if len(calls) == 2 else score(*arguments)

    words = ["reconstruct", str(room), f"out={out}", *QUICK]
    with monkeypatch.context() as patched:
        patched.setattr(scores, "score", cut_off_at_the_last)
        assert cli.main(words) == 130
    with monkeypatch.context() as patched:
        patched.setattr(reconstruct.Optimizer, "advance", never)
        assert cli.main(words) == 0
    results, whole = (results_of(folder) for folder in (out, built))
    assert [results[name] for name in ("psnr", "ssim")] == [whole[name] for name in ("psnr", "ssim")]
    steps = [line.split(",")[0] for line in (out / "log.csv").read_text().splitlines()]
    assert steps == ["step", "0", "12"]


def test_results_that_cannot_be_written_cost_no_step(room, tmp_path, monkeypatch, capsys):
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    words = [str(room), f"out={tmp_path / 'out'}", *QUICK, "checkpoint_every=1000"]
    with monkeypatch.context() as patched:
        patched.setattr("gsencoder.app.commands.reconstruct.save_splat", full)
        assert "no space left on the device: no result was written" in refusal(capsys, "reconstruct", *words)
    monkeypatch.setattr(reconstruct.Optimizer, "advance", never)
    assert cli.main(["reconstruct", *words]) == 0


def test_settings_that_cannot_work_leave_no_state_that_others_stumble_over(room, tmp_path, capsys):
    words = [str(room), f"out={tmp_path / 'out'}", *QUICK]
    assert "is raster.near small enough?" in refusal(capsys, "reconstruct", *words, "raster.near=1e9")
    assert cli.main(["reconstruct", *words]) == 0


def test_photographs_that_are_masked_all_over_are_not_fitted(room, tmp_path, capsys):
    from PIL import Image

    scene = shutil.copytree(room, tmp_path / "scene")
    for path in (scene / "images").iterdir():
        picture = Image.open(path).convert("RGBA")
        picture.putalpha(0)
        picture.save(path.with_suffix(".png"))
    (scene / "floor.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 2 0\nf 1 2 3\n")
    seeds = ("seeds.source=mesh", f"seeds.mesh={scene / 'floor.obj'}")
    problem = refusal(capsys, "reconstruct", str(scene), f"out={tmp_path / 'out'}", *QUICK, *seeds)
    assert "4 of 4 photographs to fit are masked all over" in problem


def test_a_disk_without_room_for_the_database_is_told_before_it_fills(photographs, tmp_path, monkeypatch, capsys):
    room_left = shutil.disk_usage(tmp_path)._replace(free=1 << 20)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: room_left)
    problem = refusal(capsys, "reconstruct", str(photographs), f"out={tmp_path / 'out'}", "quiet=true")
    assert "placing 7 photographs may take 9 MiB, and 1 are free on this disk; make room" in problem


def test_a_signal_is_ours_after_pycolmap_came(tmp_path: Path, photographs: Path) -> None:
    script = (
        "import os, signal, sys\n"
        "from gsencoder.app import main as cli\n"
        "from gsencoder.reconstruct import sfm\n"
        "sfm._map = lambda *_: os.kill(os.getpid(), signal.SIGTERM)\n"
        "sys.exit(cli.main(sys.argv[1:]))\n"
    )
    words = ["reconstruct", str(photographs), f"out={tmp_path / 'out'}", "quiet=true"]
    done = subprocess.run([sys.executable, "-c", script, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGTERM
    stopped, note = done.stderr.splitlines()[-2:]
    assert stopped.startswith("stopped: SIGTERM")
    assert note.startswith("note: ")
    assert "holds what was computed" in note
    assert not list(tmp_path.glob(".out.partial-*"))
