"""Bit flips in files that are read back and are no archives of arrays: JSON, lines, tables, splats, adapters, graphs.

`tests/test_flipped_bits.py` does the same for archives, each of which has checksums. Of all other files a program of
this package reads its own, either the file has a checksum (rows of prompts and of answers, records of photographs and
of videos, ONNX graphs, pictures of prompts by their names), or it is compared with what the run asks for (settings of
prepared scenes and of a fusion, summaries of finished scenes), or the summary of the run that wrote it lists its
checksum, and the reader warns. What remains is read by people alone: reports, pages, logs (no parameter depends on
them), and what a summary says of times and results.
"""

import json
import warnings
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from archives import flip_bit
from scene_files import write_transforms
from splats import random_gaussians
from training_scenes import DenseSideTeacher
from tuning_pairs import png

from gsencoder.app.options import SharedScenesConfig
from gsencoder.app.output import Summary, output_file, output_folder
from gsencoder.app.run import Run, _is_finished
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import check_written, checksums_of, sealed, write_bytes, write_json, write_picture
from gsencoder.data.labels.files import read_checked
from gsencoder.data.prompts import PROMPTS_FILE, PromptStore
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.data.splats.files import load_splat, save_splat
from gsencoder.data.video import RECORD_FILE, _taken
from gsencoder.evaluate.tradeoff.measure import RECORDS_FILE, Records
from gsencoder.fusion.checkpoint import SETTINGS_FILE, CachedTeacher
from gsencoder.infer.ask.batch import ANSWERS, _answered
from gsencoder.infer.ask.questions import read_answers
from gsencoder.train.prepare import SPACE_FILE as DATASET_SPACE_FILE
from gsencoder.train.prepare import PreparedDataset

FLIPS = 60
SETTINGS = {"fuse": {"views": 3, "rays": 1.5}, "teacher": {"name": "palette"}}
Made = tuple[Path, Callable[[], Any]]


def prompts(folder: Path, name: str) -> Made:
    store = PromptStore(folder)
    for number in range(2):
        store.add(f"key {number}", f"What is number {number}?", [png(number)])
    rows = {key: (prompt.text, prompt.pictures) for key, prompt in store.prompts.items()}
    if name == PROMPTS_FILE:
        # A last line without its end counts as cut off, and its prompt is made again.
        return folder / name, lambda: rows | {k: (p.text, p.pictures) for k, p in PromptStore(folder).prompts.items()}
    (first, *_) = store.prompts["key 0"].pictures
    return folder / "pictures" / first, lambda: store.picture(first).tolist()


def answers(folder: Path) -> Made:
    row = {"id": "1", "digest": "d", "answer": "On the left.", "tokens": {"prompt": 7}, "seconds": 0.25}
    write_bytes(folder / ANSWERS, json.dumps(sealed(row)).encode() + b"\n")
    (folder / "d").mkdir()
    # A question whose answer is not recognized is asked again.
    return folder / ANSWERS, lambda: _answered(folder, {"1": "d"}) or {"1": row}


def fusion(folder: Path) -> Made:
    write_json(folder / SETTINGS_FILE, SETTINGS)
    return folder / SETTINGS_FILE, lambda: CachedTeacher(DenseSideTeacher(), folder, SETTINGS)._settings


def finished(folder: Path) -> Made:
    run = Run("fuse", SharedScenesConfig())
    with output_folder(folder / "out", summary=run) as out:
        (out / "a.txt").write_text("x")
    return folder / "out" / "summary.json", lambda: _is_finished(folder / "out", run)


def frames(folder: Path) -> Made:
    write_picture(folder / "frame_000000.jpg", np.full((8, 8, 3), 90, np.uint8))
    digest = sha256((folder / "frame_000000.jpg").read_bytes()).hexdigest()
    asked = {"video": ["a.mp4", 1, 2]}
    write_json(folder / RECORD_FILE, {"asked": asked, "files": {"frame_000000.jpg": digest}})
    # Frames that are not as recorded are taken again.
    return folder / RECORD_FILE, lambda: _taken(folder, asked) or ("frame_000000.jpg",)


def written(name: str, write: Callable[[Path], Any], read: Callable[[Path], Any]) -> Callable[[Path], Made]:
    """A file in the results of a run, in a folder of them."""

    def make(folder: Path) -> Made:
        with output_folder(folder / "out", summary=Summary("test", {})) as out:
            (out / "deep").mkdir()
            write(out / "deep")
        return folder / "out" / "deep" / name, lambda: read(folder / "out" / "deep" / name)

    return make


def beside(folder: Path) -> Made:
    with output_file(folder / "new.ply", overwrite=False, summary=Summary("repair", {})):
        save_splat(folder / "new.ply", random_gaussians(20))
    return folder / "new.ply", lambda: _arrays(load_splat(folder / "new.ply"))


def _arrays(splat: Any) -> list[Any]:
    return [getattr(splat, name).tolist() for name in ("means", "quats", "scales", "opacities", "sh")]


ROWS = [{"scene_id": "a", "object_id": 3, "label": "mug", "score": 0.5}]
KINDS: dict[str, Callable[[Path], Made]] = {
    "rows of prompts": lambda folder: prompts(folder, PROMPTS_FILE),
    "picture of a prompt": lambda folder: prompts(folder, "picture"),
    "answers of an unfinished run": answers,
    "settings of a fusion": fusion,
    "summary of a finished scene": finished,
    "record of frames": frames,
    "answers": written(ANSWERS, lambda out: write_bytes(out / ANSWERS, b'{"id": "1", "answer": "x"}\n'), read_answers),
    "predictions": written("p.json", lambda out: write_json(out / "p.json", ROWS), read_checked),
    "classes": written("c.csv", lambda out: write_bytes(out / "c.csv", b"id,name\n3,mug\n"), read_checked),
    "transforms": written("transforms.json", lambda out: write_transforms(out, 1), read_json),
    "splat": written("s.ply", lambda o: save_splat(o / "s.ply", random_gaussians(9)), lambda p: _arrays(load_splat(p))),
    "splat of one file": beside,
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_is_told_or_changes_nothing(kind: str, tmp_path: Path) -> None:
    path, read = KINDS[kind](tmp_path)
    sound = path.read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("error", SceneWarning)
        expected = read()
    told = 0
    for bit in np.random.default_rng(0).integers(0, 8 * len(sound), FLIPS).tolist():
        flip_bit(path, bit)
        with warnings.catch_warnings():
            warnings.simplefilter("error", SceneWarning)
            try:
                got = read()
            except (InputError, SceneWarning) as error:
                told += 1
                assert str(path.parent) in str(error)
            else:
                assert got == expected, f"bit {bit} of {8 * len(sound)}"
        path.write_bytes(sound)
    assert told or kind == "record of frames"


def test_of_the_files_of_a_run_those_without_checksums_of_their_own_are_listed(tmp_path: Path) -> None:
    from gsencoder.core.archive import write_archive

    write_archive(tmp_path / "features.safetensors", {"a": np.ones(3)}, {})
    (tmp_path / "adapter_model.safetensors").write_bytes(b"\2\0\0\0\0\0\0\0{}")
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a.json").write_text("{}")
    assert set(checksums_of(tmp_path)) == {"adapter_model.safetensors", "deep/a.json"}


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"files": 3}', '{"files": {"a": 3}}', "\0"])
def test_a_summary_without_checksums_says_nothing_of_files(content: str, tmp_path: Path) -> None:
    (tmp_path / "summary.json").write_text(content)
    (tmp_path / "a").write_text("x")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_written(tmp_path / "a")
        check_written(tmp_path / "missing")


def test_a_file_of_a_run_that_the_disk_does_not_give_back_is_named(tmp_path: Path) -> None:
    # Opens like any file, and gives an I/O error at its first byte.
    bad = Path("/proc/self/mem")
    if not bad.exists():
        pytest.skip("needs /proc, as Linux has it")
    for name in (RECORDS_FILE, DATASET_SPACE_FILE, "a.txt"):
        (tmp_path / name).symlink_to(bad)
    with pytest.raises(InputError, match=r"a\.txt: cannot be read: Input/output error"):
        checksums_of(tmp_path)
    with pytest.raises(InputError, match=rf"{RECORDS_FILE}: cannot be read: Input/output error"):
        Records(tmp_path, {})
    with pytest.raises(InputError, match=rf"{DATASET_SPACE_FILE}: .*Input/output error"):
        PreparedDataset(tmp_path)
