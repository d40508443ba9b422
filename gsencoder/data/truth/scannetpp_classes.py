"""Classes of ScanNet++'s benchmark, in its own files below metadata/semantic_benchmark/.

top100.txt has one class a line, whose ids count the lines from 0; top100_instance.txt has those of them that have
instances (wall, ceiling and floor have none). map_benchmark.csv leads raw names of annotations to classes: its column
semantic_map_to has the class of the name in the column class, nothing where the name is a class itself, and None where
it has none. Its column instance_map_to is not read: the toolkit maps instances by semantic_map_to, too
(semantic/transforms/mesh.py, MapLabelToIndex), and then keeps those of top100_instance.txt.
"""

import csv
import io
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.data.truth.checked_files import read_checked_text
from gsencoder.data.truth.class_table import ClassTable
from gsencoder.data.truth.label_sets import MAX_MAP_BYTES, read_class_list

RAW, TARGET = "class", "semantic_map_to"
NO_TARGET = "None"


def read_instance_classes(path: Path) -> ClassTable:
    """The classes of a list that have instances, with the ids of the list: those of NAME_instance.txt beside NAME.txt.

    Raises:
        InputError: a list is wrong, the second one is missing, or it has a name that the first one lacks.
    """
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

    Raises:
        InputError: unreadable, too large, without the columns, or it maps no name.
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
    """The class id of each raw name in map_benchmark.csv that leads to a class of a table.

    Raises:
        InputError: as `read_benchmark_map`, or no name leads to a class.
    """
    id_of = classes.id_of
    ids = {raw: id_of[target] for raw, target in read_benchmark_map(path).items() if target in id_of}
    if not ids:
        raise InputError(f"{path}: no name leads to one of the {len(classes)} classes; compare it with classes=")
    return ids
