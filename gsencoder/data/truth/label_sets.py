"""Classes of ScanNet's benchmarks, and how raw names of annotations become their ids.

scannet_classes.csv holds the 20 and the 200 classes with ids and names, and of the 200 whether a class is head, common
or tail, as ScanNet's BenchmarkScripts/ScanNet200/scannet200_constants.py and scannet200_splits.py have them
(Rozenberszki et al., Language-Grounded Indoor 3D Semantic Segmentation in the Wild, 2022). Ids of the 20 are nyu40id,
ids of the 200 are id, both columns of scannetv2-labels.combined.tsv, which comes with ScanNet and maps raw names to
them.
"""

import csv
import io
import warnings
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from gsencoder.core.errors import InputError, SceneWarning, about
from gsencoder.data.truth.checked_files import read_checked_text
from gsencoder.data.truth.class_table import ClassTable

CLASSES = Path(__file__).parent / "scannet_classes.csv"
COLUMNS = {"scannet20": "nyu40id", "scannet200": "id"}
"""The column of the label map that holds the ids of a set."""
DEFAULT_COLUMN = "id"
"""That of other classes."""
MAX_MAP_BYTES = 16 << 20
MAX_CLASS_LIST_BYTES = 4 << 20


@cache
def scannet_classes(name: str) -> ClassTable:
    """The classes of scannet20 or scannet200.

    Raises:
        InputError: another name.
    """
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
    """The classes of a text file with one name a line, such as ScanNet++'s top100.txt; ids count the lines from 0.

    Raises:
        InputError: unreadable, too large, empty, or a name is there twice.
    """
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

    Raises:
        InputError: unreadable, too large, without the columns, an id that is no whole number, or a raw name with two
            different ids; the line is named.
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
        names: raw names of objects.
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
