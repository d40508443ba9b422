"""Classes of benchmarks: names, ids in files, and groups such as head, common and tail.

Classes of ScanNet's benchmarks, and how raw names of annotations become their ids.

scannet_classes.csv holds the 20 and the 200 classes with ids and names, and of the 200 whether a class is head, common
or tail, as ScanNet's BenchmarkScripts/ScanNet200/scannet200_constants.py and scannet200_splits.py have them
(Rozenberszki et al., Language-Grounded Indoor 3D Semantic Segmentation in the Wild, 2022). Ids of the 20 are nyu40id,
ids of the 200 are id, both columns of scannetv2-labels.combined.tsv, which comes with ScanNet and maps raw names to
them.

Classes of ScanNet++'s benchmark, in its own files below metadata/semantic_benchmark/.

top100.txt has one class a line, whose ids count the lines from 0; top100_instance.txt has those of them that have
instances (wall, ceiling and floor have none). map_benchmark.csv leads raw names of annotations to classes: its column
semantic_map_to has the class of the name in the column class, nothing where the name is a class itself, and None where
it has none. Its column instance_map_to is not read: the toolkit maps instances by semantic_map_to, too
(semantic/transforms/mesh.py, MapLabelToIndex), and then keeps those of top100_instance.txt.
"""

import csv
import io
import warnings
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Int32, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, SceneWarning, about
from gsencoder.core.files import csv_text, write_bytes
from gsencoder.data.labels.files import read_checked_text


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassTable:
    """Classes that are scored. Whatever truth has beside them is ignored.

    Attributes:
        names: of the classes, each once.
        ids: of the classes in files, each once and 0 or more.
        groups: names of classes by the name of a group, such as ScanNet200's head, common and tail.
    """

    names: tuple[str, ...]
    ids: tuple[int, ...]
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.names or len(self.names) != len(self.ids):
            raise InputError(
                f"classes: expected one id for each of one or more names, got {len(self.names)} names and "
                f"{len(self.ids)} ids"
            )
        for kind, values in (("name", self.names), ("id", self.ids)):
            if repeated := first_repeated(values):
                raise InputError(f"classes: the {kind} {repeated[0]!r} is there twice")
        if min(self.ids) < 0:
            raise InputError(f"classes: expected ids of 0 or more, got {min(self.ids)}")
        for group, names in self.groups.items():
            unknown = [name for name in names if name not in self.names]
            if unknown:
                raise InputError(f"classes: {unknown[0]!r} of the group {group!r} is no class")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def name_of(self) -> dict[int, str]:
        """The name of each id."""
        return dict(zip(self.ids, self.names, strict=True))

    @property
    def id_of(self) -> dict[str, int]:
        """The id of each name."""
        return dict(zip(self.names, self.ids, strict=True))

    def check_instance_ids(self) -> None:
        """Checks that files of instances can hold all ids: class id · 1000 + number, below 1000 = no instance."""
        if 0 in self.ids:
            raise InputError(
                f"classes: {self.name_of[0]!r} has the id 0, which files of instances cannot hold: a vertex has "
                "class id · 1000 + number of the instance, and below 1000 it has none; give the class another id, here "
                "and in the files, or leave it out of classes="
            )

    def without(self, names: Collection[str]) -> "ClassTable":
        """The table without some names, of which those that it does not have are passed over."""
        rows = [row for row, name in enumerate(self.names) if name not in names]
        return ClassTable(
            names=tuple(self.names[row] for row in rows),
            ids=tuple(self.ids[row] for row in rows),
            groups={
                group: tuple(name for name in members if name not in names) for group, members in self.groups.items()
            },
        )

    def rows(self, ids: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
        """The row of each id in the table; -1 for ids that it does not have."""
        order = np.argsort(self.ids)
        ascending = np.array(self.ids, np.int64)[order]
        positions = np.minimum(np.searchsorted(ascending, ids), len(ascending) - 1)
        return np.where(ascending[positions] == ids, order[positions], -1)


CLASSES = Path(__file__).parent / "scannet_classes.csv"
COLUMNS = {"scannet20": "nyu40id", "scannet200": "id"}
"""The column of the label map that holds the ids of a set."""
DEFAULT_COLUMN = "id"
"""That of other classes."""
MAX_MAP_BYTES = 16 << 20
MAX_CLASS_LIST_BYTES = 4 << 20
STUFF = ("wall", "floor")
"""Classes of ScanNet's benchmarks that have labels and no instances."""
IDS_PER_CLASS = 1000
"""A line of the labels of instances holds the class id times this plus the number of the instance."""


@cache
def scannet_classes(name: str) -> ClassTable:
    """The classes of scannet20 or scannet200."""
    with CLASSES.open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["set"] == name]
    if not rows:
        raise InputError(f"classes {name[:40]!r}: expected {' or '.join(COLUMNS)}")
    return ClassTable(
        ids=tuple(int(row["id"]) for row in rows),
        names=tuple(row["name"] for row in rows),
        groups={
            group: tuple(row["name"] for row in rows if row["group"] == group)
            for group in dict.fromkeys(row["group"] for row in rows if row["group"])
        },
    )


def read_class_list(path: Path) -> ClassTable:
    """The classes of a text file with one name a line, such as ScanNet++'s top100.txt; ids count the lines from 0."""
    lines = [line.strip() for line in read_checked_text(path, max_bytes=MAX_CLASS_LIST_BYTES).splitlines()]
    names = [line for line in lines if line]
    if not names:
        raise InputError(f"{path}: lists no class; expected one name a line")
    with about(path):
        return ClassTable(names=tuple(names), ids=tuple(range(len(names))))


def read_label_map(path: Path, column: str) -> dict[str, int]:
    """The ids of raw names in scannetv2-labels.combined.tsv.

    Args:
        path: of that file, which comes with ScanNet.
        column: which ids, such as nyu40id or id; see `COLUMNS`.
    """
    mapping: dict[str, int] = {}
    text = read_checked_text(path, max_bytes=MAX_MAP_BYTES)
    rows = csv.DictReader(io.StringIO(text, newline=""), delimiter="\t")
    try:
        missing = [name for name in ("raw_category", column) if name not in (rows.fieldnames or ())]
        if missing:
            raise InputError(
                f"{path}: has no column {missing[0]!r}; expected scannetv2-labels.combined.tsv, with tabs between"
            )
        for row in rows:
            name, word = row["raw_category"], (row[column] or "").strip()
            if name is None or not word.isascii() or not word.isdigit() or len(word) > 9:
                raise InputError(f"{path}: line {rows.line_num}: {column} must be a whole number, got {word[:40]!r}")
            if mapping.setdefault(name, int(word)) != int(word):
                raise InputError(
                    f"{path}: line {rows.line_num}: {name[:40]!r} has {column} {word}, and {mapping[name]} before"
                )
    except csv.Error as error:
        raise InputError(f"{path}: not a readable label map ({' '.join(str(error).split())[:120]})") from error
    if not mapping:
        raise InputError(f"{path}: maps no name; expected scannetv2-labels.combined.tsv")
    return mapping


def ids_of_names(names: Iterable[str], mapping: Mapping[str, int], classes: ClassTable | None = None) -> dict[str, int]:
    """The id of each raw name; 0 where the map does not have the name.

    Names are compared as they are written, as ScanNet's scripts do.

    Args:
        mapping: of `read_label_map`, or `ClassTable.id_of` for names that are those of classes.
        classes: where given, ids that are not among its own become 0, as in ScanNet200's script; without it they
            stay, as in the script of the 20 classes, whose evaluation leaves them out.

    Warns:
        SceneWarning: names that the map does not have; they are counted.
    """
    unique = list(dict.fromkeys(names))
    unknown = [name for name in unique if name not in mapping]
    if unknown:
        warnings.warn(
            f"{len(unknown)} of {len(unique)} names are not in the label map and have no class (first: "
            f"{unknown[0][:40]!r})",
            SceneWarning,
            stacklevel=2,
        )
    ids = {name: mapping.get(name, 0) for name in unique}
    if classes is None:
        return ids
    numbers = set(classes.ids)
    return {name: number if number in numbers else 0 for name, number in ids.items()}


def vertex_classes(
    instances: Int32[np.ndarray, " V"], names: Mapping[int, str], class_of: Mapping[str, int], *, none: int = 0
) -> Int32[np.ndarray, " V"]:
    """The class of each vertex: that of its object's name.

    Args:
        instances: the object of each vertex, 0 = none.
        names: the name of each object, such as `dict(MeshLabels.objects)`.
        class_of: id of each name, as `ids_of_names` gives it.
        none: of vertices without an object or of an object without a name, and of names that `class_of` lacks.
    """
    objects, codes = np.unique(instances, return_inverse=True)
    ids = [class_of.get(names.get(number, ""), none) if number > 0 else none for number in objects.tolist()]
    return np.array(ids, np.int32)[codes]


RAW, TARGET = "class", "semantic_map_to"
NO_TARGET = "None"


def read_instance_classes(path: Path) -> ClassTable:
    """Those classes of a list that NAME_instance.txt beside NAME.txt names too, with the ids of the list."""
    every, beside = read_class_list(path), path.with_name(f"{path.stem}_instance.txt")
    if not beside.is_file():
        raise InputError(
            f"{beside}: no such file; expected the classes of {path.name} that have instances, one a line, as "
            f"ScanNet++ "
            "has them"
        )
    names = read_class_list(beside).names
    foreign = [name for name in names if name not in every.names]
    if foreign:
        raise InputError(f"{beside}: {foreign[0][:40]!r} is no class of {path.name}")
    return ClassTable(names=names, ids=tuple(every.id_of[name] for name in names))


def read_benchmark_map(path: Path) -> dict[str, str]:
    """The class of each raw name in map_benchmark.csv; names without a class are left out.

    Of a name that is there several times the last line with a class counts, as in the toolkit.
    """
    rows = csv.DictReader(io.StringIO(read_checked_text(path, max_bytes=MAX_MAP_BYTES), newline=""), strict=True)
    try:
        lines = list(rows)
    except csv.Error as error:
        raise InputError(f"{path}: not a readable CSV file ({' '.join(str(error).split())[:120]})") from error
    missing = [name for name in (RAW, TARGET) if name not in (rows.fieldnames or ())]
    if missing:
        raise InputError(
            f"{path}: has no column {missing[0]!r}; expected ScanNet++'s map_benchmark.csv, with {RAW} and {TARGET}"
        )
    mapping: dict[str, str] = {}
    for row in lines:
        raw, target = row[RAW] or "", row[TARGET] or ""
        if raw and not target:
            mapping.setdefault(raw, raw)
        elif raw and target != NO_TARGET:
            mapping[raw] = target
    if not mapping:
        raise InputError(f"{path}: maps no name; expected ScanNet++'s map_benchmark.csv")
    return mapping


def ids_of_benchmark(path: Path, classes: ClassTable) -> dict[str, int]:
    """The class id of each raw name in map_benchmark.csv that leads to a class of a table."""
    id_of = classes.id_of
    ids = {raw: id_of[target] for raw, target in read_benchmark_map(path).items() if target in id_of}
    if not ids:
        raise InputError(f"{path}: no name leads to one of the {len(classes)} classes; compare it with classes=")
    return ids


def is_scannetpp_map(label_map: str) -> bool:
    """Whether a label map is ScanNet++'s map_benchmark.csv, and not scannetv2-labels.combined.tsv."""
    return Path(label_map).suffix.lower() == ".csv"


def ids_of_raw_names(label_map: str, classes: str) -> dict[str, int]:
    """Class id of each raw name of ScanNet's or ScanNet++'s objects, by a label map and `classes` of `load_classes`."""
    if is_scannetpp_map(label_map):
        return ids_of_benchmark(Path(label_map), load_classes(classes))
    return read_label_map(Path(label_map), COLUMNS.get(classes, DEFAULT_COLUMN))


def load_classes(classes: str, *, instances: bool = False) -> ClassTable:
    """The classes of a benchmark, or of a file.

    Args:
        classes: scannet20, scannet200, a CSV file with the columns id, name and group where classes have groups, or a
            list of names (.txt) such as ScanNet++'s top100.txt, whose ids count its lines from 0.
        instances: whether instances are scored: the benchmarks then leave out wall and floor, so that 18 and 198
            classes remain. Of a list those in NAME_instance.txt beside it; those of a CSV file are all scored.
    """
    table = _table(classes, instances)
    if instances:
        table.check_instance_ids()
    return table


def _table(classes: str, instances: bool) -> ClassTable:
    if classes in COLUMNS:
        every = scannet_classes(classes)
        return every.without(STUFF) if instances else every
    path = Path(classes)
    if not path.is_file():
        raise InputError(
            f"classes: {classes} is no file; expected {', '.join(COLUMNS)}, a CSV file with the columns id and name, "
            "or a list of names (.txt)"
        )
    if path.suffix.lower() == ".txt":
        return read_instance_classes(path) if instances else read_class_list(path)
    return _read_table(path)


def _read_table(path: Path) -> ClassTable:
    """The classes of a CSV file with the columns id, name and group."""
    text = read_checked_text(path, max_bytes=MAX_CLASS_LIST_BYTES)
    reader = csv.DictReader(io.StringIO(text, newline=""), strict=True)
    try:
        rows = list(reader)
    except csv.Error as error:
        raise InputError(f"{path}: not a readable CSV file ({error})") from error
    if not {"id", "name"} <= set(reader.fieldnames or ()):
        raise InputError(
            f"{path}: expected the columns id and name, got {', '.join(reader.fieldnames or ()) or 'none'}"
        )
    ids: list[int] = []
    names: list[str] = []
    groups: dict[str, list[str]] = {}
    for number, row in enumerate(rows, start=2):
        word, name = row["id"] or "", row["name"] or ""
        if not (word.isascii() and word.isdigit() and len(word) <= 9 and name.strip()):
            raise InputError(
                f"{path}: line {number}: expected a whole number and a name, got {word[:40]!r}, {name[:40]!r}"
            )
        ids.append(int(word))
        names.append(name.strip())
        if row.get("group"):
            groups.setdefault(row["group"], []).append(name.strip())
    with about(path):
        return ClassTable(
            names=tuple(names), ids=tuple(ids), groups={group: tuple(members) for group, members in groups.items()}
        )


def write_classes(path: Path, classes: ClassTable) -> None:
    """Writes the table as `load_classes` reads it."""
    group_of = {name: group for group, members in classes.groups.items() for name in members}
    rows = [{"id": number, "name": name, "group": group_of.get(name, "")} for number, name in classes.name_of.items()]
    write_bytes(path, csv_text(rows).encode())


def instance_ids(
    instances: Int32[np.ndarray, " V"], names: Mapping[int, str], class_of: Mapping[str, int]
) -> Int64[np.ndarray, " V"]:
    """Class id · 1000 + number of the instance, and 0 of vertices without an object.

    The number is the id of the object, as ScanNet's script has it. Where an id is 1000 or more, which would read as
    another class, objects are numbered from 1 within their class, in the order of their ids: scores are the same. An
    object without a class has its number alone, which evaluation takes for a region that does not count.

    Args:
        instances: the object of each vertex, 0 = none.
        names: the name of each object, such as `dict(MeshLabels.objects)`.
        class_of: class id of each name, as `ids_of_names` gives it.
    """
    classes = vertex_classes(instances, names, class_of).astype(np.int64)
    objects, first, codes = np.unique(instances, return_index=True, return_inverse=True)
    numbers = objects.astype(np.int64)
    if int(numbers.max(initial=0)) >= IDS_PER_CLASS:
        classes_of_objects = classes[first]
        for number in np.unique(classes_of_objects):
            rows = np.flatnonzero((classes_of_objects == number) & (objects > 0))
            if len(rows) >= IDS_PER_CLASS and number:
                name = names[int(objects[rows[0]])]
                raise InputError(
                    f"{name[:40]!r}: {len(rows):,} objects are of its class; up to {IDS_PER_CLASS - 1} fit into class "
                    "id · 1000 + number"
                )
            # The numbers of objects without a class mean nothing.
            numbers[rows] = np.arange(1, len(rows) + 1) if number else 0
    return classes * IDS_PER_CLASS + numbers[codes]
