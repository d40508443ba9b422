"""Classes from CSV files, and truth from the labels of scans: whose id is on which vertex."""

from pathlib import Path

import numpy as np
import pytest
from labeled_scans import group, write_scannet_labels

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.classes import ClassTable, load_classes, write_classes
from gsencoder.data.labels.files import write_integer_lines
from gsencoder.evaluate.benchmarks.files import scene_files
from gsencoder.evaluate.benchmarks.instances import instance_ids_of_scan
from gsencoder.evaluate.benchmarks.semantics import class_ids_of_scan, count_label_files

TABLE = ClassTable(
    names=("office chair", "bed", "lamp"), ids=(12, 4, 999_999_999), groups={"tail": ("lamp",), "head": ("bed",)}
)


def written(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def test_a_table_is_read_as_it_was_written_with_groups_and_classes_of_none(tmp_path: Path) -> None:
    write_classes(tmp_path / "c.csv", TABLE)
    again = load_classes(str(tmp_path / "c.csv"), instances=True)
    assert (again.names, again.ids, dict(again.groups)) == (TABLE.names, TABLE.ids, dict(TABLE.groups))


def test_columns_may_come_in_any_order_and_names_lose_blanks_at_their_ends(tmp_path: Path) -> None:
    path = written(tmp_path / "c.csv", '\ufeffname,color,id\n" wall, white ",x,1\nfloor ,,2\n')
    table = load_classes(path, instances=True)
    # Those of a file are all scored as instances, walls and floors too.
    assert (table.names, table.ids, table.groups) == (("wall, white", "floor"), (1, 2), {})


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("id,name\n1,bed\nx,lamp\n", "line 3: id must be a whole number, got 'x'"),
        ("id,name\n٣,bed\n", "line 2: id must be a whole number"),
        ("id,name\n1\n", "line 2: name is empty"),
        ("id,label\n1,bed\n", "the columns id, name; its first line lacks name"),
        ('id,name\n1,"bed\n', "not a readable table"),
        ("id,name\n", "classes: expected one or more"),
        ("id,name\n1,bed\n1,lamp\n", "the id 1 is there twice"),
    ],
)
def test_a_wrong_table_is_refused_with_its_line(tmp_path: Path, text: str, problem: str) -> None:
    path = written(tmp_path / "c.csv", text)
    with pytest.raises(InputError, match=problem) as error:
        load_classes(path)
    assert str(error.value).startswith(path)


def test_what_is_no_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="scannet40 is no file; expected scannet20, scannet200, a CSV"):
        load_classes("scannet40")
    with (tmp_path / "large.csv").open("wb") as stream:
        stream.truncate((4 << 20) + 1)
    with pytest.raises(InputError, match="large.csv: "):
        load_classes(str(tmp_path / "large.csv"))


# Truth of scans


CLASSES = ClassTable(names=("chair", "sofa"), ids=(5, 6))
RAW = {"office chair": 5, "couch": 6, "wall": 1}


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """Objects in another order than their ids, of which 8 is missing; two vertices belong to none."""
    segments = np.array([30, 10, 10, 20, 40, 50, 30])
    groups = [
        group(9, "couch", [20]), group(0, "office chair", [10]), group(4, "wall", [30]),
        group(7, "beanbag", [40]),
    ]  # fmt: skip
    vertices = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32)
    return write_scannet_labels(tmp_path / "scans" / "s0", "s0", vertices, segments, groups)


def test_vertices_of_a_scan_have_class_and_objectId_plus_one(scan: Path) -> None:
    with pytest.warns(SceneWarning, match="1 of 4 names are not in the label map"):
        ids = instance_ids_of_scan(scan, RAW, CLASSES)
    # A wall has an id of the map that is not scored: it is no class, as the beanbag is.
    assert ids.tolist() == [5, 5001, 5001, 6010, 8, 0, 5]
    with pytest.warns(SceneWarning):
        assert class_ids_of_scan(scan, RAW, CLASSES).tolist() == [-1, 5, 5, 6, -1, -1, -1]


def test_a_class_may_have_the_id_0_among_labels_and_not_among_instances(scan: Path) -> None:
    zero, raw = ClassTable(names=("chair", "wall"), ids=(5, 0)), {**RAW, "wall": 0}
    with pytest.warns(SceneWarning):
        assert class_ids_of_scan(scan, raw, zero).tolist() == [0, 5, 5, -1, -1, -1, 0]


# Folders


def label_folders(folder: Path, **labels: list[int]) -> tuple[Path, Path]:
    for name in ("predictions", "truth"):
        (folder / name).mkdir()
        write_integer_lines(folder / name / "s.txt", np.array(labels[name]))
    return folder / "predictions", folder / "truth"


@pytest.mark.parametrize("wrong", [[7, 9, 100], [255, 255, 255], [-1, -1, -1]])
def test_labels_of_no_class_are_not_taken_for_instances_of_class_0(tmp_path: Path, wrong: list[int]) -> None:
    classes = ClassTable(names=("wall", "bed"), ids=(0, 4))
    (counts,) = count_label_files(*label_folders(tmp_path, predictions=wrong, truth=[0, 4, 4]), classes)
    assert counts.confusion.tolist() == [[0, 0, 1], [0, 0, 2]]


def test_truth_and_prediction_of_a_scene_are_not_taken_for_each_other(tmp_path: Path) -> None:
    folders = label_folders(tmp_path, predictions=[1, 1, 4], truth=[1, 4, 4])
    classes = ClassTable(names=("wall", "bed"), ids=(1, 4))
    (counts,) = count_label_files(*folders, classes)
    # Rows are true classes.
    assert counts.confusion.tolist() == [[1, 0, 0], [1, 1, 0]]
    (files,) = scene_files(*folders)
    assert (files.prediction, files.labels) == (folders[0] / "s.txt", folders[1] / "s.txt")
