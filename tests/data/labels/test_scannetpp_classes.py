"""ScanNet++'s classes: ids are lines of a list, instances have classes of a second one, raw names lead to both."""

from pathlib import Path

import numpy as np
import pytest
from labeled_scans import group, write_scannetpp_labels

from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import ClassTable, ids_of_benchmark, load_classes, read_instance_classes
from gsencoder.evaluate.benchmarks.instances import instance_ids_of_scan
from gsencoder.evaluate.benchmarks.semantics import class_ids_of_scan

MAP = """class,count,instance_map_to,semantic_map_to
wall,90,None,
walls,3,,wall
table,80,,
desk,40,table,table
remove,9,None,None
office desk,2,,desk
"""


@pytest.fixture
def lists(tmp_path: Path) -> Path:
    """A folder like metadata/semantic_benchmark."""
    (tmp_path / "top100.txt").write_text("wall\nfloor\ntable\n")
    (tmp_path / "top100_instance.txt").write_text("table\n")
    (tmp_path / "map_benchmark.csv").write_text(MAP)
    return tmp_path


def test_names_lead_to_classes_as_in_the_toolkit(lists: Path) -> None:
    # Nothing as the target keeps the name, None drops it, and targets are not mapped again.
    classes = load_classes(str(lists / "top100.txt"))
    assert classes == ClassTable(names=("wall", "floor", "table"), ids=(0, 1, 2))
    ids = ids_of_benchmark(lists / "map_benchmark.csv", classes)
    assert ids == {"wall": 0, "walls": 0, "table": 2, "desk": 2}


def test_instances_have_the_classes_of_the_second_list_and_the_ids_of_the_first(lists: Path) -> None:
    assert load_classes(str(lists / "top100.txt"), instances=True) == ClassTable(names=("table",), ids=(2,))
    (lists / "top100_instance.txt").write_text("tables\n")
    with pytest.raises(InputError, match="'tables' is no class of top100.txt"):
        read_instance_classes(lists / "top100.txt")
    (lists / "top100_instance.txt").unlink()
    with pytest.raises(InputError, match=r"top100_instance.txt: no such file"):
        load_classes(str(lists / "top100.txt"), instances=True)


def test_the_truth_of_a_scan_is_that_of_the_objects_with_a_class(lists: Path) -> None:
    # Vertices 0 and 1 are a wall, 2 and 3 a desk, 4 is to be removed; "remove" claims the desk, too, and has no class.
    segments = np.array([0, 0, 1, 1, 2])
    groups = [group(1, "wall", [0]), group(2, "desk", [1]), group(3, "remove", [1]), group(4, "remove", [2])]
    scan = write_scannetpp_labels(lists / "abc", np.eye(5, 3, dtype=np.float32), segments, groups)
    every = load_classes(str(lists / "top100.txt"))
    ids = ids_of_benchmark(lists / "map_benchmark.csv", every)
    assert class_ids_of_scan(scan, ids, every).tolist() == [0, 0, 2, 2, -1]
    ids_of_instances = instance_ids_of_scan(scan, ids, load_classes(str(lists / "top100.txt"), instances=True))
    assert ids_of_instances.tolist() == [1, 1, 2002, 2002, 0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("class,count\nwall,3\n", "its first line lacks semantic_map_to"),
        ("class,semantic_map_to\nwall,None\n", "no name leads to one of the 1 classes"),
        ("class,semantic_map_to\nwall,wall\n", "no name leads to one of the 1 classes"),
        ('class,semantic_map_to\n"wall', "not a readable table"),
    ],
)
def test_maps_that_are_none_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        ids_of_benchmark(tmp_path / "map.csv", ClassTable(names=("sofa",), ids=(1,)))
