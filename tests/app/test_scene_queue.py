"""Many scenes in one command: what is finished is skipped, what fails waits for the end, and processes share."""

import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from textured_box import box_cameras, box_views, write_box

from gsencoder.app import main as cli
from gsencoder.app.options import SharedScenesConfig
from gsencoder.app.output import output_folder
from gsencoder.app.run import Run
from gsencoder.core.errors import BusyError, InputError
from gsencoder.data.scenes import find_scenes, listed_paths
from gsencoder.reconstruct.sfm import find_photographed


@dataclass(frozen=True, kw_only=True)
class QueueConfig(SharedScenesConfig):
    paths: tuple[str, ...] = ("a",)
    voxel: float = 0.02
    device: str = "auto"


class Work:
    """A command that writes the name of a scene, and fails where it is asked to."""

    def __init__(self, *failing: str, busy: str = "") -> None:
        self.failing, self.busy, self.done = failing, busy, list[str]()

    def __call__(self, path: Path, out: Path, summary: Run) -> None:
        if path.name == self.busy:
            raise BusyError(f"{out}: another run is writing this folder now")
        with output_folder(out, record=summary.to_dict) as folder:
            if path.name in self.failing:
                raise InputError(f"{path}: no photographs")
            (folder / "name.txt").write_text(path.name)
        self.done.append(path.name)


def queue(tmp_path: Path, work: Work, names: str = "abcd", **options: Any) -> None:
    paths = [tmp_path / "scenes" / name for name in names]
    for path in paths:
        path.mkdir(parents=True, exist_ok=True)
    Run("fuse", QueueConfig(out=tmp_path / "out", **options)).scenes(paths, "features", work)


def test_failures_are_listed_at_the_end_and_the_same_command_tries_them_again(tmp_path, capsys):
    first = Work("b", "d")
    with pytest.raises(InputError, match=r"2 of 4 scenes failed.*tries them again: .*/b, .*/d$"):
        queue(tmp_path, first)
    assert first.done == ["a", "c"]
    said = capsys.readouterr().err.splitlines()
    assert said == [f"failed: {tmp_path / 'scenes' / name}: no photographs" for name in "bd"]
    second = Work()
    queue(tmp_path, second, device="cpu")
    assert second.done == ["b", "d"]
    assert "2 of 4 scenes were finished before" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == list("abcd")


def test_each_of_several_scenes_has_its_own_warnings_in_its_summary(tmp_path: Path) -> None:
    summary = Run("fuse", QueueConfig(out=tmp_path / "out"))
    assert summary.add_warning("weights: old") == "weights: old"
    shown, given = list[str](), list[Run]()

    def run(path: Path, out: Path, one: Run) -> None:
        with output_folder(out, record=one.to_dict):
            # As the command line does, which knows the summary of the whole run alone.
            shown.append(summary.add_warning(texts[path.name]))
        given.append(one)

    texts = {"a": "dark", "b": f"{tmp_path / 'b'}/depth: dark", "c": "c: dark"}
    summary.scenes([tmp_path / name for name in texts], "features", run)
    # The run shows and keeps all, with the name of the scene where a warning does not say it.
    assert shown == ["a: dark", texts["b"], texts["c"]]
    assert summary.warnings == ["weights: old", *shown]
    for one, (name, text) in zip(given, texts.items(), strict=True):
        record = json.loads((tmp_path / "out" / name / "summary.json").read_text())
        assert record["warnings"] == one.warnings == ["weights: old", text]
    # What comes after the last scene is of none.
    assert summary.add_warning("disk: slow") == "disk: slow"
    assert given[-1].warnings == ["weights: old", texts["c"]]


def test_results_of_other_settings_are_neither_taken_nor_replaced(tmp_path, capsys):
    queue(tmp_path, Work())
    other = Work()
    with pytest.raises(InputError, match="4 of 4 scenes failed"):
        queue(tmp_path, other, voxel=0.01)
    assert capsys.readouterr().err.count("results of other settings (voxel)") == 4
    assert other.done == []
    again = Work()
    (tmp_path / "out" / "b" / "summary.json").write_text("{")
    with pytest.raises(InputError, match="1 of 4 scenes failed"):
        queue(tmp_path, again)
    assert "summary.json: cannot be read" in capsys.readouterr().err


def test_workers_begin_at_different_scenes_and_leave_alone_what_another_one_does(tmp_path, capsys):
    firsts = []
    for worker in range(4):
        work = Work()
        queue(tmp_path / str(worker), work, worker=worker)
        assert sorted(work.done) == list("abcd")
        firsts.append(work.done[0])
    assert len(set(firsts)) >= 3
    shared = Work(busy="b")
    queue(tmp_path / "shared", shared)
    assert shared.done == ["a", "c", "d"]
    assert "another run is writing it now" in capsys.readouterr().out


@pytest.mark.parametrize("names", ["a", "ab"])
def test_without_an_output_folder_results_lie_in_outputs(tmp_path, names, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths = [tmp_path / name for name in names]
    Run("fuse", QueueConfig()).scenes(paths, "features", Work())
    for name in names:
        assert (Path("outputs") / name / "features" / "name.txt").read_text() == name


def test_a_scene_that_another_process_finished_meanwhile_is_no_failure(tmp_path: Path) -> None:
    class Late(Work):
        def __call__(self, path: Path, out: Path, summary: Run) -> None:
            with output_folder(out, record=summary.to_dict):
                pass
            super().__call__(path, out, summary)

    late = Late()
    queue(tmp_path, late)
    assert late.done == []


def test_a_list_names_scenes_whatever_wrote_its_lines(tmp_path: Path) -> None:
    for name in ("one", "two words"):
        write_box(tmp_path / name, box_views(box_cameras(2, width=32, height=24, focal=22.0)))
    text = "\ufeff# scenes\r\none\r\n\r\n\ttwo words \r\n"
    (tmp_path / "list.txt").write_bytes(text.encode())
    expected = (tmp_path / "one", tmp_path / "two words")
    assert find_scenes([tmp_path / "list.txt"]) == expected
    assert find_photographed([str(tmp_path / "list.txt")]) == expected
    (tmp_path / "list.txt").write_text("# nothing\n\n")
    with pytest.raises(InputError, match="lists no scene"):
        listed_paths([tmp_path / "list.txt"])
    (tmp_path / "list.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a readable list"):
        listed_paths([tmp_path / "list.txt"])
    (tmp_path / "list.txt").write_text("three\n")
    with pytest.raises(InputError, match="three: no such file"):
        find_scenes([tmp_path / "list.txt"])


def test_folders_of_photographs_alone_are_reconstructed_beside_scenes(tmp_path: Path) -> None:
    from PIL import Image

    write_box(tmp_path / "all" / "scene", box_views(box_cameras(2, width=32, height=24, focal=22.0)))
    for name in ("plain", "nested/images"):
        (tmp_path / "all" / name).mkdir(parents=True)
        Image.new("RGB", (8, 6)).save(tmp_path / "all" / name / "a.jpg")
    (tmp_path / "all" / "notes").mkdir()
    chosen = find_photographed([str(tmp_path / "all")])
    assert [path.name for path in chosen] == ["nested", "plain", "scene"]


@pytest.mark.slow
@pytest.mark.alone
def test_jobs_of_submitit_share_the_scenes_and_their_failures_come_back(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    for name in ("one", "two", "three"):
        write_box(tmp_path / "scenes" / name, box_views(box_cameras(3, width=64, height=48, focal=45.0)))
    broken, out = tmp_path / "scenes" / "two" / "transforms.json", tmp_path / "out"
    good = broken.read_text()
    broken.write_text(good.replace("file_path", "path"))
    # In a process of its own: the launcher sets signal handlers and environment variables for good.
    command = [sys.executable, "-W", "ignore", "-m", "gsencoder", "fuse", str(tmp_path / "scenes"), "teacher=palette"]
    command += [f"out={out}", "-m", "worker=0,1", "hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10"]
    first = subprocess.run(command, check=False, timeout=300, capture_output=True, text=True)
    assert first.returncode == 2
    # Both workers meet the broken scene.
    assert first.stderr.count("1 of 3 scenes failed") == 1
    assert "frame 0 has no file_path" in first.stderr
    assert first.stderr.endswith("error: 2 of 2 runs failed\n")
    assert {path.name for path in out.iterdir()} == {"one", "three", "multirun.yaml", ".submitit"}
    before = (out / "one" / "summary.json").stat().st_mtime_ns
    broken.write_text(good)
    # What the jobs finished, a run without them leaves as it is.
    assert cli.main(["fuse", str(tmp_path / "scenes"), "teacher=palette", f"out={out}", "worker=0", "quiet=true"]) == 0
    assert (out / "two" / "features.safetensors").is_file()
    assert (out / "one" / "summary.json").stat().st_mtime_ns == before
