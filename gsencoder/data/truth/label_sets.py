"""Classes of ScanNet's benchmarks, and how raw names of annotations become their ids.

scannet_classes.csv holds the 20 and the 200 classes with ids and names, and of the 200 whether a class is head, common
or tail, as ScanNet's BenchmarkScripts/ScanNet200/scannet200_constants.py and scannet200_splits.py have them
(Rozenberszki et al., Language-Grounded Indoor 3D Semantic Segmentation in the Wild, 2022). Ids of the 20 are nyu40id,
ids of the 200 are id, both columns of scannetv2-labels.combined.tsv, which comes with ScanNet and maps raw names to
them.
"""

import csv
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Int32

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.types import MeshLabels

CLASSES = Path(__file__).parent / "scannet_classes.csv"
COLUMNS = {"scannet20": "nyu40id", "scannet200": "id"}
"""The column of the label map that holds the ids of a set."""
GROUPS = ("head", "common", "tail")
MAX_MAP_BYTES = 16 << 20
MAX_CLASS_LIST_BYTES = 4 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelSet:
    """The classes of a benchmark, in its order.

    Attributes:
        name: scannet20, scannet200, or that of a file.
        ids: unique; 0 is none in ScanNet's sets.
        names: unique.
        groups: head, common or tail of each class; empty where the benchmark has no groups.
    """

    name: str
    ids: tuple[int, ...]
    names: tuple[str, ...]
    groups: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.ids) != len(self.names) or len(self.groups) not in (0, len(self.ids)):
            raise InputError(f"label set {self.name}: expected as many ids as names, and as many groups or none")
        for what, values in (("id", self.ids), ("name", self.names)):
            if len(set(values)) != len(values):
                raise InputError(f"label set {self.name}: a {what} is there twice")

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def name_of(self) -> dict[int, str]:
        """The name of each id."""
        return dict(zip(self.ids, self.names, strict=True))

    @property
    def id_of(self) -> dict[str, int]:
        """The id of each name."""
        return dict(zip(self.names, self.ids, strict=True))

    def names_in(self, group: str) -> tuple[str, ...]:
        """The names of the classes of a group, such as tail."""
        return tuple(name for name, each in zip(self.names, self.groups, strict=False) if each == group)


@cache
def scannet_label_set(name: str) -> LabelSet:
    """The classes of scannet20 or scannet200.

    Raises:
        InputError: another name.
    """
    with CLASSES.open(encoding="utf-8", newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["set"] == name]
    if not rows:
        raise InputError(f"label set {name[:40]!r}: expected {' or '.join(COLUMNS)}")
    groups = tuple(row["group"] for row in rows)
    return LabelSet(
        name=name,
        ids=tuple(int(row["id"]) for row in rows),
        names=tuple(row["name"] for row in rows),
        groups=groups if any(groups) else (),
    )


def read_class_list(path: Path) -> LabelSet:
    """The classes of a text file with one name a line, such as ScanNet++'s top100.txt; ids count the lines from 0.

    Raises:
        InputError: unreadable, too large, empty, or a name is there twice.
    """
    try:
        if path.stat().st_size > MAX_CLASS_LIST_BYTES:
            raise InputError(f"{path}: {path.stat().st_size:,} bytes, expected one name a line")
        lines = [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
    except InputError:
        raise
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a readable list of names ({' '.join(str(error).split())[:120]})") from error
    names = [line for line in lines if line]
    if not names:
        raise InputError(f"{path}: lists no class; expected one name a line")
    for row, name in enumerate(names):
        if name in names[:row]:
            raise InputError(f"{path}: {name[:40]!r} is there twice; expected each class once")
    return LabelSet(name=path.stem, ids=tuple(range(len(names))), names=tuple(names))


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
    try:
        if path.stat().st_size > MAX_MAP_BYTES:
            raise InputError(f"{path}: {path.stat().st_size:,} bytes, at most {MAX_MAP_BYTES:,} in a label map")
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = csv.DictReader(stream, delimiter="\t")
            missing = [name for name in ("raw_category", column) if name not in (rows.fieldnames or ())]
            if missing:
                raise InputError(
                    f"{path}: has no column {missing[0]!r}; expected scannetv2-labels.combined.tsv, with tabs between"
                )
            for row in rows:
                name, text = row["raw_category"], (row[column] or "").strip()
                if name is None or not text.isascii() or not text.isdigit() or len(text) > 9:
                    raise InputError(
                        f"{path}: line {rows.line_num}: {column} must be a whole number, got {text[:40]!r}"
                    )
                if mapping.setdefault(name, int(text)) != int(text):
                    raise InputError(
                        f"{path}: line {rows.line_num}: {name[:40]!r} has {column} {text}, and {mapping[name]} before"
                    )
    except InputError:
        raise
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: not a readable label map ({' '.join(str(error).split())[:120]})") from error
    if not mapping:
        raise InputError(f"{path}: maps no name; expected scannetv2-labels.combined.tsv")
    return mapping


def ids_of_names(names: Iterable[str], mapping: Mapping[str, int], label_set: LabelSet | None = None) -> dict[str, int]:
    """The id of each raw name; 0 where the map does not have the name.

    Names are compared as they are written, as ScanNet's scripts do.

    Args:
        names: raw names of objects.
        mapping: of `read_label_map`, or `LabelSet.id_of` for names that are those of classes.
        label_set: where given, ids that are not among its own become 0, as in ScanNet200's script; without it they
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
    allowed = None if label_set is None else set(label_set.ids)
    found = {name: mapping.get(name, 0) for name in unique}
    return {name: number if allowed is None or number in allowed else 0 for name, number in found.items()}


def vertex_classes(labels: MeshLabels, class_of: Mapping[str, int], *, none: int = 0) -> Int32[np.ndarray, " V"]:
    """The class of each vertex: that of its object's raw name.

    Args:
        labels: of a mesh.
        class_of: id of each raw name, as `ids_of_names` gives it.
        none: of vertices without an object, and of names that `class_of` lacks.
    """
    ids = np.array([number for number, _ in labels.objects], np.int64)
    classes = np.array([class_of.get(name, none) for _, name in labels.objects], np.int32)
    result = np.full(len(labels), none, np.int32)
    if not len(ids):
        return result
    order = np.argsort(ids)
    labeled = labels.instances > 0
    result[labeled] = classes[order[np.searchsorted(ids[order], labels.instances[labeled])]]
    return result
