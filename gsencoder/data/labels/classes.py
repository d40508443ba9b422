"""Classes of benchmarks, and how raw names of annotations become their ids.

scannet_classes.csv holds ScanNet's 20 and 200 classes, and of the 200 whether a class is head, common or tail, as
BenchmarkScripts/ScanNet200/scannet200_constants.py and scannet200_splits.py have them (Rozenberszki et al.,
Language-Grounded Indoor 3D Semantic Segmentation in the Wild, 2022). Ids of the 20 are nyu40id, ids of the 200 are id,
both columns of scannetv2-labels.combined.tsv, which comes with ScanNet and maps raw names to them.

ScanNet++ has its classes in metadata/semantic_benchmark/: top100.txt has one a line, whose ids count the lines from 0;
top100_instance.txt has those of them that have instances. map_benchmark.csv leads raw names to classes: its column
semantic_map_to has the class of the name in the column class, nothing where the name is a class itself, and None where
it has none. The toolkit maps instances by this column, too (semantic/transforms/mesh.py, MapLabelToIndex).
"""

import warnings
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Int32, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, SceneWarning, error_prefix
from gsencoder.core.files import csv_text, write_bytes
from gsencoder.data.labels.files import read_checked_text, read_rows


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassTable:
    """Classes that are scored. Other ids of labels are ignored."""

    names: tuple[str, ...]
    ids: tuple[int, ...]  # of the names, in files; 0 or more
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # names of classes, such as head, common, tail

    def __post_init__(self) -> None:
        if not self.names:
            raise InputError("classes: expected one or more")
        for kind, values in (("name", self.names), ("id", self.ids)):
            if repeated := first_repeated(values):
                raise InputError(f"classes: the {kind} {repeated[0]!r} is there twice")

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

    def without(self, names: Collection[str]) -> "ClassTable":
        """The table without some names; names that it does not have are passed over."""
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
"""The column of the label map that holds the ids of a set; of other classes it is id."""
MAX_BYTES = 16 << 20
STUFF = ("wall", "floor")
"""Classes of ScanNet's benchmarks that have labels and no instances."""
IDS_PER_CLASS = 1000
"""A line of the labels of instances holds the class id times this plus the number of the instance."""


@cache
def scannet_classes(name: str) -> ClassTable:
    """The classes of scannet20 or scannet200."""
    rows = [row for row, _ in read_rows(CLASSES, ("set", "id", "name", "group"), max_bytes=MAX_BYTES)]
    return _table(row for row in rows if row["set"] == name)


def _table(rows: Iterable[Mapping[str, str]]) -> ClassTable:
    rows, groups = list(rows), dict[str, tuple[str, ...]]()
    for row in rows:
        if group := row.get("group"):
            groups[group] = (*groups.get(group, ()), row["name"].strip())
    return ClassTable(
        names=tuple(row["name"].strip() for row in rows), ids=tuple(int(row["id"]) for row in rows), groups=groups
    )


def read_class_list(path: Path) -> ClassTable:
    """The classes of a text file with one name a line, such as ScanNet++'s top100.txt; ids count the lines from 0."""
    lines = [line.strip() for line in read_checked_text(path, max_bytes=MAX_BYTES).splitlines()]
    names = tuple(line for line in lines if line)
    with error_prefix(path):
        return ClassTable(names=names, ids=tuple(range(len(names))))


def read_label_map(path: Path, column: str) -> dict[str, int]:
    """The ids of raw names in scannetv2-labels.combined.tsv.

    Args:
        column: which ids, such as nyu40id or id; see `COLUMNS`.
    """
    mapping: dict[str, int] = {}
    for row, where in read_rows(path, ("raw_category", column), max_bytes=MAX_BYTES, delimiter="\t"):
        name, number = row["raw_category"], _id(row[column].strip(), where, column)
        if mapping.setdefault(name, number) != number:
            raise InputError(f"{where}: {name[:40]!r} has {column} {number}, and {mapping[name]} before")
    if not mapping:
        raise InputError(f"{path}: maps no name; expected scannetv2-labels.combined.tsv")
    return mapping


def _id(word: str, where: str, column: str) -> int:
    if not word.isascii() or not word.isdigit() or len(word) > 9:
        raise InputError(f"{where}: {column} must be a whole number, got {word[:40]!r}")
    return int(word)


def ids_of_names(names: Iterable[str], mapping: Mapping[str, int], classes: ClassTable | None = None) -> dict[str, int]:
    """The id of each raw name; 0 where the map does not have the name.

    Names are compared as they are written, as ScanNet's scripts do.

    Args:
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


def read_instance_classes(path: Path) -> ClassTable:
    """Those classes of a list that NAME_instance.txt next to NAME.txt names too, with the ids of the list."""
    every, instance_list = read_class_list(path), path.with_name(f"{path.stem}_instance.txt")
    names = read_class_list(instance_list).names
    foreign = [name for name in names if name not in every.names]
    if foreign:
        raise InputError(f"{instance_list}: {foreign[0][:40]!r} is no class of {path.name}")
    return ClassTable(names=names, ids=tuple(every.id_of[name] for name in names))


def ids_of_benchmark(path: Path, classes: ClassTable) -> dict[str, int]:
    """The class id of each raw name in map_benchmark.csv that leads to a class of a table.

    Of a name that is there several times the last line with a class counts, as in the toolkit.
    """
    raw, target = "class", "semantic_map_to"
    mapping: dict[str, str] = {}
    for row, _ in read_rows(path, (raw, target), max_bytes=MAX_BYTES):
        if row[raw] and not row[target]:
            mapping.setdefault(row[raw], row[raw])
        elif row[raw] and row[target] != "None":
            mapping[row[raw]] = row[target]
    id_of = classes.id_of
    ids = {name: id_of[leads_to] for name, leads_to in mapping.items() if leads_to in id_of}
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
    return read_label_map(Path(label_map), COLUMNS.get(classes, "id"))


def load_classes(classes: str, *, instances: bool = False) -> ClassTable:
    """The classes of a benchmark, or of a file.

    Args:
        classes: scannet20, scannet200, a CSV file with the columns id, name and group where classes have groups, or a
            list of names (.txt) such as ScanNet++'s top100.txt, whose ids count its lines from 0.
        instances: whether instances are scored: the benchmarks then leave out wall and floor, so that 18 and 198
            classes remain. Of a list those in NAME_instance.txt next to it; those of a CSV file are all scored.
    """
    path = Path(classes)
    if classes in COLUMNS:
        table = scannet_classes(classes).without(STUFF if instances else ())
    elif not path.is_file():
        raise InputError(
            f"classes: {classes} is no file; expected {', '.join(COLUMNS)}, a CSV file with the columns id and name, "
            "or a list of names (.txt)"
        )
    elif path.suffix.lower() == ".txt":
        table = read_instance_classes(path) if instances else read_class_list(path)
    else:
        rows = read_rows(path, ("id", "name"), max_bytes=MAX_BYTES)
        for row, where in rows:
            _id(row["id"], where, "id")
            if not row["name"].strip():
                raise InputError(f"{where}: name is empty")
        with error_prefix(path):
            table = _table(row for row, _ in rows)
    if instances and 0 in table.ids:
        raise InputError(
            f"classes: {table.name_of[0]!r} has the id 0, which files of instances cannot hold: a vertex has class id "
            "· 1000 + number of the instance, and below 1000 it has none; give the class another id, or leave it out"
        )
    return table


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

    The arguments are those of `vertex_classes`.
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
