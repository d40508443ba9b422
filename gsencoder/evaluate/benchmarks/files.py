"""Classes that are scored: those of ScanNet's benchmarks, or of a CSV file with the columns id, name and group."""

import csv
import io
import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from gsencoder.core.errors import InputError, about, counted, listed, readable
from gsencoder.core.files import check_foreign, csv_text, write_bytes
from gsencoder.data.labels.classes import COLUMNS, ClassTable, read_class_list, read_instance_classes, scannet_classes
from gsencoder.data.labels.files import PICKLE_SUFFIXES, read_checked_text
from gsencoder.data.labels.scans import AGGREGATION, ANNOTATION

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


RESULT_FILES = ("semantic_instance_evaluation.txt", "semantic_label_evaluation.txt")
"""What ScanNet's scripts write into the folder of the predictions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneFiles:
    """The files of one scene.

    Attributes:
        scene: its name, that of both files without the suffix.
        truth: what it is held against: a file, or the folder of a scan.
    """

    scene: str
    prediction: Path
    truth: Path


def scene_files(
    predictions: Path,
    truth: Path,
    *,
    scenes: Collection[str] | None = None,
    suffixes: Collection[str] = (".txt",),
    scans: bool = False,
) -> tuple[SceneFiles, ...]:
    """Finds the files of every scene to score, in the order of the names.

    ScanNet's scripts score the scenes that have predictions, and pass over the others. Here those are refused: the
    scores of a method that got through some scenes cannot stand beside those of one that got through all.

    Args:
        predictions: folder with SCENE.txt, or what `suffixes` allows.
        truth: folder with SCENE.txt, or of scans.
        scenes: those to score, such as the ones of a split; None = all of the truth.
        scans: whether `truth` has the folders of ScanNet's scans, each with the label files of its scene.
    """
    for folder in (predictions, truth):
        if not folder.is_dir():
            raise InputError(f"{folder}: expected a folder with a file for each scene")
    if predictions.resolve() == truth.resolve():
        raise InputError(f"{predictions}: predictions and truth are the same folder")
    predicted: dict[str, Path] = {}
    for path in _files(predictions, suffixes):
        if path.stem in predicted:
            raise InputError(
                f"{predictions}: the scene {path.stem} has both {predicted[path.stem].name} and {path.name}"
            )
        predicted[path.stem] = path
    if not predicted:
        pickled = [path.name for path in sorted(predictions.iterdir()) if path.suffix.lower() in PICKLE_SUFFIXES]
        because = f"; {pickled[0]} is a pickle, which is refused since reading it can run code" if pickled else ""
        expected = " or ".join(f"SCENE{suffix}" for suffix in suffixes)
        raise InputError(f"{predictions}: no predictions; expected {expected} for each scene{because}")
    true_files = _true_files(truth, scans)
    foreign = [scene for scene in predicted if scene not in true_files]
    if foreign:
        some = listed(sorted(true_files), 3)
        raise InputError(f"{predicted[foreign[0]]}: there is no truth of this scene in {truth}; it has {some}")
    names = sorted(true_files if scenes is None else set(scenes))
    unknown = [scene for scene in names if scene not in true_files]
    if unknown:
        raise InputError(f"{truth}: no truth of {counted(len(unknown), 'scene')} to score: {listed(unknown)}")
    missing = [scene for scene in names if scene not in predicted]
    if missing:
        raise InputError(f"{predictions}: no prediction of {counted(len(missing), 'scene')}: {listed(missing)}")
    return tuple(SceneFiles(scene=s, prediction=predicted[s], truth=true_files[s]) for s in names)


def _true_files(truth: Path, scans: bool) -> dict[str, Path]:
    """The file or the scan's folder of each scene with truth, by its name."""
    files = {path.stem: path for path in _files(truth, (".txt",))}
    folders = {
        path.name: path
        for path in sorted(truth.iterdir())
        if any(os.path.lexists(path / name) for name in (f"{path.name}{AGGREGATION}", f"scans/{ANNOTATION}"))
    }
    if scans:
        if not folders:
            instead = "; SCENE.txt has ids of classes and needs no label map" if files else ""
            raise InputError(
                f"{truth}: no scans; expected SCENE/SCENE{AGGREGATION} or SCENE/scans/{ANNOTATION}, and the "
                f"files beside it{instead}"
            )
        return folders
    if not files:
        instead = (
            f"; the labels of {counted(len(folders), 'scan')} that it holds become truth by "
            f"scannetv2-labels.combined.tsv "
            "or ScanNet++'s map_benchmark.csv (label_map=)"
            if folders
            else ""
        )
        raise InputError(f"{truth}: no truth; expected SCENE.txt for each scene{instead}")
    return files


def _files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    files = sorted(path for path in folder.iterdir() if path.suffix in suffixes and path.name not in RESULT_FILES)
    for path in files:
        with readable(path):
            check_foreign(path)
    return files
