"""Classes that are scored: those of ScanNet's benchmarks, or of a CSV file with the columns id, name and group."""

import csv
import io
from pathlib import Path

from gsencoder.core.errors import InputError, about
from gsencoder.core.files import csv_text, write_bytes
from gsencoder.data.labels.classes import COLUMNS, ClassTable, read_class_list, read_instance_classes, scannet_classes
from gsencoder.data.labels.files import read_checked_text

MAX_CLASS_BYTES = 4 << 20


STUFF = ("wall", "floor")
"""Classes of ScanNet's benchmarks that have labels and no instances."""


def load_classes(classes: str, *, instances: bool = False) -> ClassTable:
    """The classes of a benchmark, or of a file.

    Args:
        classes: scannet20, scannet200, a CSV file with the columns id, name and group where classes have groups, or a
            list of names (.txt) such as ScanNet++'s top100.txt, whose ids count its lines from 0.
        instances: whether instances are scored: the benchmarks then leave out wall and floor, so that 18 and 198
            classes remain. Of a list those in NAME_instance.txt beside it; those of a CSV file are all scored.

    Raises:
        InputError: no such benchmark or file, one that is not such a table, or instances of a class with the id 0.
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
    text = read_checked_text(path, max_bytes=MAX_CLASS_BYTES)
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
