"""`reconstruct`, as a user runs it: RGB-D, points, a splat to refine, photographs alone, and what goes wrong."""

import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from archives import flip_bit
from command_runs import refusal, results_of
from PIL import Image
from reconstructions import QUICK, interrupt, never
from textured_box import box_cameras

from gsencoder.app import main as cli
from gsencoder.app.commands import reconstruct as command
from gsencoder.core.errors import InputError
from gsencoder.data.photographs import Photographs
from gsencoder.data.splats.files import load_splat
from gsencoder.reconstruct import run as reconstruct
from gsencoder.reconstruct import score as scores
from gsencoder.reconstruct.run import split
from gsencoder.types import Views

pytestmark = pytest.mark.slow


def test_a_room_becomes_a_splat_with_a_log_and_pictures(built: Path) -> None:
    results = results_of(built)
    assert (results["source"], results["steps"], results["views"], results["held_out"]) == ("depth", 12, 4, 2)
    splat = load_splat(built / results["splat"])
    assert len(splat) == results["gaussians"] > 500
    assert splat.sh_degree == 1
    lines = (built / "log.csv").read_text().splitlines()
    assert lines[0] == "step,seconds,gaussians,psnr,ssim,matched_psnr,seen_psnr,seen_ssim,seen"
    first, last = (dict(zip(lines[0].split(","), map(float, line.split(",")), strict=True)) for line in lines[1:])
    assert (first["step"], last["step"]) == (0, 12)
    assert last["psnr"] == results["psnr"] > first["psnr"]
    assert last["seen_psnr"] == results["seen_psnr"] > first["seen_psnr"]
    assert last["seen"] == first["seen"] == results["seen"] > 0.3
    assert (built / "held_out.png").is_file()
    assert not built.with_name("built.reconstruction").exists()


def test_a_splat_is_refined(room: Path, built: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = [str(room), f"splat={built / 'splat.ply'}", f"out={out}", *QUICK]
    assert cli.main(["reconstruct", *words]) == 0
    results = results_of(out)
    assert results["source"] == "splat"
    assert results["psnr"] > results_of(built)["psnr"]


def test_a_run_that_isinterrupted_goes_on_to_the_same_splat(room, built, tmp_path, monkeypatch):
    out = tmp_path / "out"
    advance = reconstruct.Optimizer.advance

    def stop_at_five(self: reconstruct.Optimizer) -> dict[str, float]:
        if self.step == 5:
            raise KeyboardInterrupt
        return advance(self)

    words = ["reconstruct", str(room), f"out={out}", *QUICK]
    with monkeypatch.context() as patched:
        patched.setattr(reconstruct.Optimizer, "advance", stop_at_five)
        assert cli.main(words) == 130
    assert not out.exists()
    with monkeypatch.context() as patched:
        patched.setattr(reconstruct, "initial_gaussians", never)
        # With other threads the budget would allow another size of the photographs; that of the first run stays.
        patched.setattr(command, "choose_scale", never)
        assert cli.main(words) == 0
    results = results_of(out)
    assert {name: results[name] for name in ("seeds", "source")} == {
        name: results_of(built)[name] for name in ("seeds", "source")
    }
    splat, whole = load_splat(out / "splat.ply"), load_splat(built / "splat.ply")
    for name in ("means", "quats", "scales", "opacities", "sh"):
        np.testing.assert_array_equal(getattr(splat, name), getattr(whole, name))
    with monkeypatch.context() as patched:
        patched.setattr(reconstruct.Optimizer, "advance", stop_at_five)
        assert cli.main([*words, "overwrite=true"]) == 130
    assert (out / "splat.ply").is_file()


def test_photographs_alone_are_placed_or_refused_in_words(tmp_path, capsys, room):
    alone = tmp_path / "alone"
    alone.mkdir()
    assert "neither a scene nor a folder of scenes" in refusal(capsys, "reconstruct", str(alone))
    for number, path in enumerate(sorted((room / "images").iterdir())[:2]):
        shutil.copy(path, alone / f"{number}{path.suffix}")
    assert "expected at least 3 photographs" in refusal(capsys, "reconstruct", str(alone), f"out={tmp_path / 'out'}")
    for number in range(4):
        Image.new("RGB", (80, 60), (60 * number, 90, 20)).save(alone / f"{number}.png")
    problem = refusal(capsys, "reconstruct", str(alone), f"out={tmp_path / 'out'}")
    assert "could be placed" in problem or "cannot place these photographs" in problem
    assert not (tmp_path / "out").exists()


def test_photographs_alone_are_placed_once_and_become_a_splat(tmp_path, photographs, monkeypatch, capsys):
    folder, out = shutil.copytree(photographs, tmp_path / "photographs"), tmp_path / "out"
    words = ["reconstruct", str(folder), f"out={out}", "quiet=true", "optimize.steps=6", "data.image_scale=0.25"]
    words += ["sfm.size=400", "sfm.features=2000", "dense.spacing=3"]
    with monkeypatch.context() as patched:
        patched.setattr(reconstruct.Optimizer, "advance", interrupt)
        assert cli.main(words) == 130
    work = out.with_name("out.reconstruction")
    placed = (work / "placed.json").read_bytes()
    monkeypatch.setattr("gsencoder.reconstruct.sfm.load_pycolmap", never)
    # Places of another placement would put old Gaussians into a new world.
    for damaged in (b"", b'{"asked": 1}', placed.replace(b"grey", b"gray"), b"\xff\xfe"):
        (work / "placed.json").write_bytes(damaged)
        assert "photographs were placed (placed.json, sparse/0) is gone or damaged" in refusal(capsys, *words)
    (work / "placed.json").write_bytes(placed)
    for file in sorted((work / "sparse" / "0").iterdir()):
        flip_bit(file, 4 * file.stat().st_size)
        assert "(placed.json, sparse/0) is gone or damaged" in refusal(capsys, *words)
        flip_bit(file, 4 * file.stat().st_size)
    os.utime(folder / "grey.jpg", ns=(1, 1))
    assert "belongs to other photographs" in refusal(capsys, *words)
    shutil.copystat(photographs / "grey.jpg", folder / "grey.jpg")
    capsys.readouterr()
    assert cli.main(words) == 0
    assert "could not be placed and are not used: grey.jpg" in capsys.readouterr().err
    results = results_of(out)
    assert results["missing"] == ["grey.jpg"]
    assert results["placed"] == 6
    assert results["swept"] > results["filled"] / 10 > 0
    assert len(load_splat(out / "splat.ply")) > 5000
    fused = tmp_path / "features"
    scene = [str(out), "splat=splat.ply", f"data.images={folder}", "data.image_scale=0.25", "data.max_views=3"]
    assert cli.main(["fuse", *scene, "teacher=palette", f"out={fused}", "quiet=true"]) == 0
    assert results_of(fused)["seen"] > 1000
    assert "in another; give a scene with the poses" in refusal(
        capsys, "reconstruct", str(folder), f"out={tmp_path / 'refined'}", f"splat={out / 'splat.ply'}"
    )


def test_photographs_that_cannot_be_placed_are_told_before_any_is(photographs, tmp_path, capsys, monkeypatch):
    words = ["reconstruct", str(tmp_path), f"out={tmp_path / 'out'}"]
    monkeypatch.setattr("gsencoder.reconstruct.sfm._map", never)
    for path in sorted(photographs.iterdir())[:4]:
        shutil.copy(path, tmp_path)
    assert "sfm.size: expected 64" in refusal(capsys, *words, "sfm.size=99999999999")
    bad = tmp_path / "bad.jpg"
    bad.write_bytes((tmp_path / "20240212_003919.jpg").read_bytes()[:5000])
    assert "bad.jpg: cannot be decoded" in refusal(capsys, *words)
    bad.write_bytes(b"")
    assert "bad.jpg: not a readable picture" in refusal(capsys, *words)
    bad.unlink()
    bad.symlink_to("nowhere.jpg")
    assert "bad.jpg: no such file" in refusal(capsys, *words)
    bad.unlink()
    shutil.copy(tmp_path / "20240212_003919.jpg", os.fsencode(tmp_path) + b"/caf\xe9.jpg")
    assert "has bytes that are no text" in refusal(capsys, *words)


def test_films_beside_photographs_are_named(room, tmp_path, capsys, monkeypatch):
    for path in sorted((room / "images").iterdir())[:3]:
        shutil.copy(path, tmp_path)
    (tmp_path / "film.MP4").write_bytes(b"")
    (tmp_path / ".hidden.jpg").write_bytes(b"")
    assert cli.main(["reconstruct", str(tmp_path), f"out={tmp_path / 'out'}", "quiet=true"]) == 2
    assert "1 files are in formats that cannot be placed and are not used: film.MP4" in capsys.readouterr().err


def test_a_run_does_not_go_on_with_other_photographs_or_a_damaged_log(room, tmp_path, monkeypatch, capsys):
    scene, out = shutil.copytree(room, tmp_path / "scene"), tmp_path / "out"
    words = [str(scene), f"out={out}", *QUICK]
    with monkeypatch.context() as patched:
        patched.setattr(reconstruct.Optimizer, "advance", interrupt)
        assert cli.main(["reconstruct", *words]) == 130
    log = out.with_name("out.reconstruction") / "log.csv"
    text = log.read_text()
    log.write_text(text.replace(".", "x"))
    problem = refusal(capsys, "reconstruct", *words)
    assert "log.csv: damaged: could not convert" in problem
    assert problem.endswith("give resume=false to start again")
    log.write_text(text)
    first, second = sorted((scene / "images").iterdir())[:2]
    shutil.copy(second, first)
    assert "was made with photographs=" in refusal(capsys, "reconstruct", *words)
    assert cli.main(["reconstruct", *words, "resume=false"]) == 0


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["holdout=1"], "holdout: expected 0 (none) or 2 and more"),
        (["data.max_views=2", "holdout=2"], "expected at least 2 photographs to fit"),
        (["seeds.source=points"], "has no structure-from-motion points"),
        pytest.param(
            ["device=cuda"], "sees no GPU", marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is one")
        ),
        (["splat=nothing.ply"], "nothing.ply"),
    ],
)
def test_what_cannot_be_is_told(room, tmp_path, capsys, words, problem):
    assert problem in refusal(capsys, "reconstruct", str(room), f"out={tmp_path / 'out'}", *words)
    assert not (tmp_path / "out").exists()


def test_every_eighth_photograph_is_kept() -> None:
    def posed(count: int) -> Photographs:
        cameras = box_cameras(count, width=8, height=8)
        names = tuple(map(str, range(count)))
        return Photographs(Views(cameras=cameras, names=names, images=[np.zeros((8, 8, 3), np.uint8)] * count))

    assert split(posed(10), 4) == ([1, 2, 3, 5, 6, 7, 9], [0, 4, 8])
    assert split(posed(3), 0) == ([0, 1, 2], [])
    with pytest.raises(InputError, match="at least 2 photographs"):
        split(posed(2), 2)


# Cut off, refused by the disk, or given what it was not meant for: no work is lost


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
