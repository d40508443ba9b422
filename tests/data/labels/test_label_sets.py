"""Classes of ScanNet and ScanNet++: maps of raw names, splits, and the truth files that are made of them."""

from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from labeled_scans import group, write_scannetpp_labels

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.classes import (
    COLUMNS,
    ClassTable,
    ids_of_benchmark,
    ids_of_names,
    instance_ids,
    load_classes,
    read_class_list,
    read_instance_classes,
    read_label_map,
    scannet_classes,
    vertex_classes,
)
from gsencoder.data.labels.files import read_split
from gsencoder.evaluate.benchmarks.instances import instance_ids_of_scan
from gsencoder.evaluate.benchmarks.semantics import class_ids_of_scan
from gsencoder.types import MeshLabels


def write_map(path: Path, *rows: str, header: str = "id\traw_category\tcategory\tcount\tnyu40id\tnyuClass") -> Path:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


ROWS = (
    "1\twall\twall\t8277\t1\twall",
    "6\tcouch\tcouch\t502\t6\tsofa",
    "10\toffice chair\toffice chair\t595\t5\tchair",
    "25\tdoor frame\tdoor frame\t768\t8\tdoor",
    "43\tpaper\tpaper\t3\t40\totherprop",
)


def test_raw_names_have_the_ids_of_each_benchmark(tmp_path: Path) -> None:
    path = write_map(tmp_path / "map.tsv", *ROWS)
    nyu40, own = (read_label_map(path, COLUMNS[name]) for name in ("scannet20", "scannet200"))
    assert nyu40 == {"wall": 1, "couch": 6, "office chair": 5, "door frame": 8, "paper": 40}
    assert own == {"wall": 1, "couch": 6, "office chair": 10, "door frame": 25, "paper": 43}
    names = ["paper", "office chair", "door frame", "paper"]
    # Ids that are not among the twenty stay, as in ScanNet's script; those of the 200 become 0, as in theirs.
    assert ids_of_names(names, nyu40) == {"paper": 40, "office chair": 5, "door frame": 8}
    assert ids_of_names(names, own, scannet_classes("scannet200")) == {"paper": 0, "office chair": 10, "door frame": 0}
    with pytest.warns(SceneWarning, match=r"2 of 3 names are not in the label map and have no class \(first: 'Wall'\)"):
        assert ids_of_names(["Wall", "wall", "beanbag"], nyu40) == {"Wall": 0, "wall": 1, "beanbag": 0}


@pytest.mark.parametrize(
    ("rows", "column", "problem"),
    [
        (("1\twall\twall\t1\tone\tx",), "nyu40id", "line 2: nyu40id must be a whole number, got 'one'"),
        (("1\twall\ta\t1\t1\tx", "2\twall\ta\t1\t2\tx"), "nyu40id", "line 3: 'wall' has nyu40id 2, and 1 before"),
        (ROWS, "mpcat40", "its first line lacks mpcat40"),
        ((), "id", "maps no name"),
    ],
)
def test_a_wrong_label_map_is_refused_with_its_line(tmp_path, rows, column, problem):
    path = write_map(tmp_path / "map.tsv", *rows)
    with pytest.raises(InputError, match=problem) as error:
        read_label_map(path, column)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_list_of_classes_counts_from_zero(tmp_path: Path) -> None:
    path = tmp_path / "top100.txt"
    path.write_text("wall\nceiling\n\noffice chair\n")
    assert read_class_list(path) == ClassTable(ids=(0, 1, 2), names=("wall", "ceiling", "office chair"))
    path.write_text("wall\nwall\n")
    with pytest.raises(InputError, match="'wall' is there twice"):
        read_class_list(path)
    path.write_text("\n")
    with pytest.raises(InputError, match=r"top100.txt: classes: expected one or more"):
        read_class_list(path)


def test_a_split_is_one_name_a_line(tmp_path: Path) -> None:
    path = tmp_path / "val.txt"
    path.write_text(f"scene0011_00\r\n\n{'a' * 255}  \n", encoding="utf-8-sig")
    assert read_split(path) == ("scene0011_00", "a" * 255)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("a\nb\na\n", "line 3: 'a' is already on line 1"),
        ("../a\n", "line 1: expected the name of a scene, got '../a'"),
        ("x" * 256, "line 1: expected the name of a scene"),
        ("\n\n", "lists no scene"),
    ],
)
def test_a_wrong_split_is_refused_with_its_line(tmp_path: Path, content: str, problem: str) -> None:
    path = tmp_path / "val.txt"
    path.write_text(content)
    with pytest.raises(InputError, match=problem):
        read_split(path)


LABELS = MeshLabels(
    vertices=np.zeros((6, 3), np.float32),
    instances=np.array([3, 0, 12, 3, 5, 5], np.int32),
    objects=((12, "couch"), (3, "wall"), (5, "beanbag")),
)


NAMES = dict(LABELS.objects)


def test_a_vertex_has_the_class_of_its_objects_name() -> None:
    assert vertex_classes(LABELS.instances, NAMES, {"couch": 6, "wall": 1}).tolist() == [1, 0, 6, 1, 0, 0]
    classes = vertex_classes(LABELS.instances, NAMES, {"couch": 6, "wall": 0}, none=-1)
    assert classes.tolist() == [0, -1, 6, 0, -1, -1]
    assert vertex_classes(np.zeros(6, np.int32), {}, {}).tolist() == [0] * 6
    assert vertex_classes(np.zeros(0, np.int32), {}, {}).tolist() == []
    # An object without a name has no class, even where some class has an empty one.
    assert vertex_classes(np.array([7], np.int32), {}, {"wall": 1}).tolist() == [0]


def test_the_classes_are_those_of_scannets_own_lists() -> None:
    names = (
        *("wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf", "picture"),
        *("counter", "desk", "curtain", "refrigerator", "shower curtain", "toilet", "sink", "bathtub"),
        "otherfurniture",
    )
    twenty = scannet_classes("scannet20")
    assert twenty.names == names
    assert twenty.ids == (*range(1, 13), 14, 16, 24, 28, 33, 34, 36, 39)
    # Of "id name group" for each id in VALID_CLASS_IDS_200, with CLASS_LABELS_200 of scannet200_constants.py and the
    # three lists of scannet200_splits.py (ScanNet's repository, 520d564).
    many = scannet_classes("scannet200")
    group_of = {name: group for group, members in many.groups.items() for name in members}
    text = "".join(f"{number} {name} {group_of[name]}\n" for number, name in many.name_of.items())
    assert sha256(text.encode()).hexdigest() == "8a4c044c50bed27ac77eb2ce1a0714ecfe56fb73fd8b88002f7ff569dfa708e1"


def test_an_instance_is_its_class_times_a_thousand_and_its_number() -> None:
    # The bean bag has no class: 0 · 1000 + 5.
    assert instance_ids(LABELS.instances, NAMES, {"couch": 6, "wall": 1}).tolist() == [1003, 0, 6012, 1003, 5, 5]
    # 1000 would be read as an object of the next class.
    for ids, expected in (([1, 999], [5001, 5999, 0]), ([1, 1000], [5001, 5002, 0])):
        instances = np.array([*ids, 0], np.int32)
        assert instance_ids(instances, dict.fromkeys(ids, "chair"), {"chair": 5}).tolist() == expected


def test_objects_are_numbered_within_their_class_in_the_order_of_their_ids() -> None:
    instances = np.array([2000, 3, 0, 1200, 77, 2000], np.int32)
    names = {3: "bed", 77: "chair", 1200: "chair", 2000: "bed"}
    assert instance_ids(instances, names, {"bed": 4, "chair": 5}).tolist() == [4002, 4001, 0, 5002, 5001, 4002]
    # Without a class the number means nothing, and may be none.
    assert instance_ids(instances, names, {"bed": 4}).tolist() == [4002, 4001, 0, 0, 0, 4002]
    assert instance_ids(np.zeros(0, np.int32), {}, {}).tolist() == []


def test_no_more_than_999_objects_of_a_class_fit(tmp_path: Path) -> None:
    instances = np.arange(1001, 2001, dtype=np.int32)
    names = dict.fromkeys(range(1001, 2001), "bed")
    assert instance_ids(instances[:999], names, {"bed": 4}).tolist() == list(range(4001, 5000))
    with pytest.raises(InputError, match="'bed': 1,000 objects are of its class; up to 999 fit"):
        instance_ids(instances, names, {"bed": 4})
    # Objects of no class may be any number.
    assert not instance_ids(instances, names, {}).any()


def test_ids_in_any_order_lead_to_the_rows_of_their_names() -> None:
    table = ClassTable(names=("c", "a", "b"), ids=(30, 10, 20), groups={"g": ("b", "c")})
    assert table.rows(np.array([10, 20, 30, 0, 25, 99, -10])).tolist() == [1, 2, 0, -1, -1, -1, -1]
    assert table.without(("a", "x")).rows(np.array([10, 20, 30])).tolist() == [-1, 1, 0]
    assert (len(table), table.name_of, table.id_of["b"]) == (3, {30: "c", 10: "a", 20: "b"}, 20)


def test_names_and_ids_are_there_once(tmp_path: Path) -> None:
    for names, ids, message in ((("bed", "bed"), (1, 2), "'bed'"), (("bed", "chair"), (1, 1), "the id 1")):
        with pytest.raises(InputError, match=f"{message} is there twice"):
            ClassTable(names=names, ids=ids)
    path = tmp_path / "classes.csv"
    path.write_text("id,name\n0,bed\n")
    assert load_classes(str(path)).ids == (0,)
    with pytest.raises(InputError, match="classes: 'bed' has the id 0, which files of instances cannot hold"):
        load_classes(str(path), instances=True)


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
