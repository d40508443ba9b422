"""`gsencoder select`: what it writes, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of
from selected_rooms import EMBEDDINGS, SPACE, read_labels, selected_room, words

from gsencoder.app import main as cli
from gsencoder.data.splats.files import load_splat
from gsencoder.fusion.folder import WORDS_FILE, save_features, save_memories
from gsencoder.text.table import make_text_table, save_text_table
from gsencoder.types import MemoryBank, QueryMemory

SCENE, KINDS = selected_room()
assert SCENE.gaussians is not None
assert SCENE.views is not None
HOSTILE = ("<script>alert(1)</script>", 'a "b"/../c', "\u202edrawkcab")


@pytest.fixture(scope="module")
def features(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("table") / "features"
    save_features(folder, SCENE, SCENE.features["names"], {})
    save_text_table(folder / WORDS_FILE, words())
    return folder


def run(features: Path, out: Path, *arguments: str) -> None:
    assert cli.main(["select", str(features), f"out={out}", "quiet=true", *arguments]) == 0


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_objects_and_rest_are_the_whole_scene(features: Path, tmp_path: Path) -> None:
    out = tmp_path / "selection"
    run(features, out, "query=mug,book")
    assert names_in(out) == [
        "book.ply", "holes.json", "labels.json", "labels.ply", "mug.ply", "rest.ply", "summary.json",
    ]  # fmt: skip
    labeled = read_labels(out)
    for label, name in enumerate(("rest", "mug", "book")):
        part = load_splat(out / f"{name}.ply", origin=SCENE.origin)
        rows = labeled.labels == label
        assert (part.means == labeled.gaussians.means[rows]).all()
        assert (part.sh == SCENE.gaussians.sh[rows]).all()
        assert labeled.names[label].file == f"{name}.ply"
        assert labeled.names[label].count == rows.sum() > 0
    results = results_of(out)
    assert results["views"] == 8
    assert results["selection"]["labels"] == json.loads((out / "labels.json").read_text())["labels"]
    assert [word["query"] for word in results["words"]] == ["mug", "book"]
    holes = json.loads((out / "holes.json").read_text())
    assert holes == results["holes"]
    assert holes["views"] == holes["views_with_objects"] == 8
    assert holes["pixels"] == sum(hole["pixels"] for hole in holes["by_view"])


def test_the_parts_that_are_asked_for_are_written(features, tmp_path, capsys, monkeypatch):
    run(features, tmp_path / "a", "query=mug", "write=objects", "format=spz")
    assert names_in(tmp_path / "a") == ["mug.spz", "summary.json"]
    run(features, tmp_path / "b", "query=mug", "write=rest", "format=compressed.ply", "select.views=0")
    assert names_in(tmp_path / "b") == ["rest.compressed.ply", "summary.json"]
    run(features, tmp_path / "c", "query=mug", "write=labels", "box=0")
    assert names_in(tmp_path / "c") == ["labels.json", "labels.ply", "summary.json"]
    assert [each.file for each in read_labels(tmp_path / "c").names] == [None, None]
    capsys.readouterr()
    monkeypatch.chdir(tmp_path)  # Lines are cut at 200 columns.
    assert cli.main(["select", str(features), "query=mug,lamp", "out=d"]) == 0
    mug, lamp, where = capsys.readouterr().out.splitlines()[-3:]
    assert mug.startswith("mug: ")
    assert mug.endswith("to start with, mug.ply")
    assert lamp.startswith("lamp: absent (probability")
    assert "1 object, rest.ply of " in where
    assert names_in(tmp_path / "d").count("lamp.ply") == 0


def test_packages_and_memories_are_selected_from_like_features(features: Path, tmp_path: Path) -> None:
    expected = {}
    for form in ("compact", "index"):
        packed = tmp_path / form
        assert cli.main(["pack", str(features), f"form={form}", f"out={packed}", "quiet=true"]) == 0
        expected[form] = packed
    memory = tmp_path / "memory"
    field = SCENE.features["names"]
    bank = MemoryBank(
        components=EMBEDDINGS, sources=np.zeros((4, 3), np.int32), threshold=0.9, mean=field.mean,
        grid_from_image=np.tile(np.eye(2, 3), (4, 1, 1)), coverage=1.0, cosine=1.0, space=SPACE,
    )  # fmt: skip
    queries = QueryMemory(
        queries=field.features - field.mean, weights=field.weights, projection=np.eye(8, dtype=np.float32), bank=bank,
        scoring="centered", temperature=0.1, mean=field.mean,
    )  # fmt: skip
    memory.mkdir()
    save_memories(memory, replace(SCENE, features={}), {"labels": queries})
    save_text_table(memory / WORDS_FILE, words())
    expected["memory"] = memory
    for form, folder in expected.items():
        out = tmp_path / f"{form}_selection"
        run(folder, out, "query=mug", "write=labels")
        assert ((read_labels(out).labels == 1) == (KINDS == 0)).mean() > 0.98


def test_a_bare_splat_is_selected_from_with_a_warning(tmp_path, capsys, monkeypatch):
    bare = tmp_path / "bare"
    save_features(bare, replace(SCENE, views=None), SCENE.features["names"], {})
    save_text_table(bare / WORDS_FILE, words())
    monkeypatch.setattr("gsencoder.infer.select.ORBITS", 4)
    run(bare, tmp_path / "out", "query=mug")
    assert "has no views" in capsys.readouterr().err
    assert results_of(tmp_path / "out")["placed_cameras"] is True
    assert "holes.json" not in names_in(tmp_path / "out")


def test_names_of_objects_lead_to_safe_names_of_files(tmp_path: Path) -> None:
    folder, out = tmp_path / "features", tmp_path / "out"
    save_features(folder, SCENE, SCENE.features["names"], {})
    save_text_table(folder / WORDS_FILE, make_text_table((*HOSTILE, "lamp"), EMBEDDINGS, "table"))
    (tmp_path / "queries.txt").write_text("\n".join(HOSTILE[:2]), encoding="utf-8")
    run(folder, out, f"queries={tmp_path / 'queries.txt'}", "write=[objects,labels]")
    assert names_in(out) == [
        "a_b_c.ply", "labels.json", "labels.ply", "script_alert_1_script.ply", "summary.json",
    ]  # fmt: skip
    assert [each.name for each in read_labels(out).names] == [None, *HOSTILE[:2]]
    assert names_in(tmp_path) == ["features", "out", "queries.txt"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "query= is missing"),
        (["query=mug", "box=0", "threshold=0.5"], "box= and threshold= are two ways"),
        (["query=mug", "box=3"], "box=3: 'mug' has one box, number 0"),
        (["query=mug", "threshold=-1", "select.grow=false"], "is selected, so nothing is left"),
        (["query=lamp"], "no Gaussian of table is selected; absent: 'lamp'"),
        (["query=teapot"], "teapot"),
        (["query=mug", "write=[]"], "write"),
    ],
)
def test_what_cannot_be_done_ends_in_one_line(features, tmp_path, capsys, arguments, message):
    out = tmp_path / "out"
    assert message in refusal(capsys, "select", str(features), f"out={out}", *arguments)
    assert not out.exists()
