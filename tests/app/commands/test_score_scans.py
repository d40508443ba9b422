"""`gsencoder score` with the labels of ScanNet's scans and ScanRefer's own files as truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_runs import refusal, results_of
from instance_scenes import write_text_prediction
from labeled_scans import (
    ROOM_NAMES,
    group,
    names_of_room,
    write_scannet_labels,
    write_scannet_scan,
    write_scannetpp_scan,
)

from gsencoder.app import main as cli
from gsencoder.data.labels.classes import ids_of_names, instance_ids, read_label_map
from gsencoder.data.labels.files import read_integer_lines, write_integer_lines
from gsencoder.data.labels.scans import read_scannet_labels
from gsencoder.data.synthetic import make_room
from gsencoder.evaluate.benchmarks.instances import prediction_of_masks
from gsencoder.text.table import make_text_table, save_text_table

ROWS = ("1\twall\t1", "2\tchair\t5", "10\toffice chair\t5", "6\tcouch\t6", "43\tpaper\t40")
"""Of each raw name the id of ScanNet200, and nyu40id, which ScanNet's 20 classes have."""
SIZES = (150, 120, 110, 40)
"""Vertices of a chair, a sofa, a wall, and of a sheet of paper, which is of none of the 20 classes."""


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """Two scans and a label map beside their folder."""
    names = ("office chair", "couch", "wall", "paper")
    rng = np.random.default_rng(0)
    for scene in ("scene0000_00", "scene0001_00"):
        segments = np.repeat(np.arange(len(names)), SIZES)
        vertices = rng.normal(size=(len(segments), 3)).astype(np.float32)
        groups = [group(number, name, [number]) for number, name in enumerate(names)]
        write_scannet_labels(tmp_path / "scans" / scene, scene, vertices, segments, groups)
    (tmp_path / "map.tsv").write_text("\n".join(["id\traw_category\tnyu40id", *ROWS]) + "\n")
    return tmp_path / "scans"


def words_of(protocol: str, scans: Path, *options: str, classes: str = "scannet20") -> list[str]:
    files = [f"predictions={scans.parent / 'predictions'}", f"label_map={scans.parent / 'map.tsv'}"]
    return ["score", protocol, *files, f"truth={scans}", f"classes={classes}", *options]


def write_masks(scans: Path, *, vertices: int = sum(SIZES)) -> Path:
    """The chair's and the sofa's mask, of which that of the sofa has half of the wall."""
    folder = scans.parent / "predictions"
    folder.mkdir(exist_ok=True)
    rows = np.arange(vertices)
    masks = [rows < 150, (rows >= 150) & (rows < 325)]
    for scene in ("scene0000_00", "scene0001_00"):
        made = prediction_of_masks(scene, masks, [5, 6], [0.9, 0.8], num_vertices=vertices)
        write_text_prediction(folder, made)
    return folder


def write_truth_files(scans: Path) -> Path:
    """The instances of the scans."""
    folder = scans.parent / "truth"
    folder.mkdir()
    for scan in scans.iterdir():
        labels = read_scannet_labels(scan)
        ids = ids_of_names((name for _, name in labels.objects), read_label_map(scans.parent / "map.tsv", "nyu40id"))
        values = instance_ids(labels.instances, dict(labels.objects), ids)
        write_integer_lines(folder / f"{scan.name}.txt", values)
    return folder


def test_instances_of_scans_have_the_scores_of_the_truth_that_is_written_of_them(scans: Path, tmp_path: Path) -> None:
    write_masks(scans)
    truth = write_truth_files(scans)
    assert read_integer_lines(truth / "scene0000_00.txt")[[0, 150, 270, 380]].tolist() == [5001, 6002, 1003, 40004]
    outs = tmp_path / "scans_out", tmp_path / "files_out"
    assert cli.main([*words_of("instances", scans), f"out={outs[0]}", "quiet=true"]) == 0
    words = ["score", "instances", f"predictions={tmp_path / 'predictions'}", f"truth={truth}", "classes=scannet20"]
    assert cli.main([*words, f"out={outs[1]}", "quiet=true"]) == 0
    results = results_of(outs[0])
    assert results == results_of(outs[1])
    # Chairs: 1. Sofas: an IoU of 120/175, above the thresholds to 0.65. Walls are no instances.
    assert (results["truths"], results["ap_50"]) == (4, 1.0)
    assert results["ap"] == pytest.approx((1 + 4 / 9) / 2)


def test_folders_that_do_not_fit_are_refused(scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_masks(scans)
    without_map = [word for word in words_of("instances", scans) if not word.startswith("label_map")]
    assert "no truth; expected SCENE.txt for each scene (labels of scans need" in refusal(capsys, *without_map)
    truth = write_truth_files(scans)
    words = [word for word in words_of("instances", scans) if not word.startswith("truth")]
    message = refusal(capsys, *words, f"truth={truth}")
    assert "no scans; expected SCENE/SCENE.aggregation.json" in message
    assert "missing.tsv: no such file" in refusal(capsys, *without_map, f"label_map={tmp_path / 'missing.tsv'}")
    write_masks(scans, vertices=7)
    assert "has 7 lines, and the scene 420 vertices" in refusal(capsys, *words_of("instances", scans))
    write_masks(scans)
    (scans / "scene0001_00" / "scene0001_00_vh_clean_2.ply").unlink()
    assert "scene0001_00_vh_clean_2.ply: no such file" in refusal(capsys, *words_of("instances", scans))


@pytest.mark.slow
def test_evaluate_scores_a_scan_on_its_vertices_and_takes_boxes_and_kinds_of_sentences_from_it(tmp_path: Path) -> None:
    room = make_room(0, objects=3, views=3, width=80, height=60)
    scan = write_scannet_scan(room, tmp_path / "scene0000_00")
    names = sorted(set(names_of_room(room).values()) | set(ROOM_NAMES.values()))
    table = make_text_table(names, np.eye(len(names), dtype=np.float32), "room-words")
    save_text_table(tmp_path / "words.safetensors", table)
    words = f"teacher.words={tmp_path / 'words.safetensors'}"
    placed = [thing for thing in room.objects if thing.placed and thing.name]
    sentences = [
        {
            "scene_id": "scene0000_00", "object_id": str(thing.id - 1), "object_name": str(thing.name),
            "ann_id": "0", "description": f"the {thing.name}", "token": ["the", str(thing.name)],
        }
        for thing in placed
    ]  # fmt: skip
    (tmp_path / "ScanRefer.json").write_text(json.dumps(sentences))
    rows = [f"{thing.name}\t5" for thing in {thing.name: thing for thing in placed}.values()]
    (tmp_path / "map.tsv").write_text("\n".join(["raw_category\tnyu40id", *rows]) + "\n")
    options = [f"protocol.expressions={tmp_path / 'ScanRefer.json'}", f"label_map={tmp_path / 'map.tsv'}"]
    base = ["evaluate", str(scan), words, "quiet=true"]
    assert cli.main([*base, "protocol=referring", *options, f"out={tmp_path / 'referring'}"]) == 0
    results = results_of(tmp_path / "referring")
    # All things are chairs by this map, so that none is unique.
    assert (results["sentences"], results["unique_25"]) == (len(placed), None)
    assert results["acc_25"] >= 0.5
    out = tmp_path / "semantics"
    assert cli.main([*base, "protocol=semantics", f"out={out}"]) == 0
    scores = results_of(out)
    assert (scores["vertices"] > 1000, scores["unlabeled"]) == (True, 0)
    assert scores["miou"] > 0.6


# ScanNet++'s lists of classes, on a room in its files


@pytest.fixture(scope="module")
def scannetpp(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan, its words, and lists: the first class, with the id 0, is a thing that the room has."""
    folder = tmp_path_factory.mktemp("scannetpp")
    made = make_room(0, objects=4, views=4, width=64, height=48)
    write_scannetpp_scan(made, folder / "scans" / "room")
    names = list(dict.fromkeys(each.name for each in made.objects if each.name))
    words = [*names, *ROOM_NAMES.values()]
    save_text_table(folder / "words.safetensors", make_text_table(words, np.eye(len(words), dtype=np.float32), "w"))
    (folder / "top100.txt").write_text("".join(f"{name}\n" for name in names))
    (folder / "top100_instance.txt").write_text("".join(f"{name}\n" for name in names[1:]))
    rows = ["class,count,instance_map_to,semantic_map_to", *(f"{name},1,," for name in names), "floor,1,None,None"]
    (folder / "map_benchmark.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["semantics", "instances"])
def test_scans_and_the_files_that_evaluate_writes_have_one_truth(protocol, scannetpp, tmp_path, monkeypatch):
    monkeypatch.setattr("gsencoder.evaluate.benchmarks.instances.MIN_REGION", 20)
    lists = [f"classes={scannetpp / 'top100.txt'}", f"label_map={scannetpp / 'map_benchmark.csv'}"]
    words = f"teacher.words={scannetpp / 'words.safetensors'}"
    seeds = ["seeds.source=mesh", f"seeds.mesh={scannetpp / 'scans' / 'room' / 'scans' / 'mesh_aligned_0.05.ply'}"]
    command = ["evaluate", str(scannetpp / "scans" / "room"), f"protocol={protocol}", words, *lists, *seeds]
    assert cli.main([*command, f"out={tmp_path / 'a'}", "quiet=true"]) == 0
    first = results_of(tmp_path / "a")
    del first["gaussians"]
    predictions = f"predictions={tmp_path / 'a' / 'predictions'}"
    for name, more in (
        ("files", [f"truth={tmp_path / 'a' / 'truth'}", lists[0]]),
        ("scans", [f"truth={scannetpp / 'scans'}", *lists]),
    ):
        out = f"out={tmp_path / name}"
        assert cli.main(["score", protocol, predictions, *more, out, "quiet=true"]) == 0
        assert results_of(tmp_path / name) == first
    if protocol == "semantics":
        assert first["miou"] > 0.5
        labels = {int(line) for line in (tmp_path / "a" / "truth" / "room.txt").read_text().split()}
        assert {-100, 0} <= labels
