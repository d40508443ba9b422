"""Files that a benchmark is scored from: the options of `score`, and one file a scene for predictions and labels."""

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from gsencoder.core.errors import InputError, counted, listed, readable
from gsencoder.core.files import check_foreign
from gsencoder.core.settings import option
from gsencoder.data.labels.classes import ids_of_raw_names
from gsencoder.data.labels.files import read_split
from gsencoder.data.labels.scans import AGGREGATION, ANNOTATION


@dataclass(frozen=True, kw_only=True)
class ScoreOptions:
    """Options of scores; `OPTIONS` of a module names those that it takes. Without slots, for a command to inherit."""

    method: str = option("predictions", "name of the predictions in the table")
    classes: str = option(
        "",
        "of instances, semantics and recognition: scannet20, scannet200, a CSV file with the columns id, "
        "name and, if there are any, group, or ScanNet++'s top100.txt; empty for recognition = all names of the "
        "truth",
    )
    label_map: str = option(
        "",
        "scannetv2-labels.combined.tsv, or ScanNet++'s map_benchmark.csv: of instances and semantics it "
        "gives the objects of truth=SCANS a class, of referring it tells unique from multiple where "
        "the truth does not",
    )
    scans: str = option("", "of referring: folder of ScanNet's scans, whose labels have the boxes that truth= has not")
    scenes: str = option("", "of instances and semantics: a split, one scene a line; empty = all scenes of the truth")
    allow_missing: bool = option(
        False,
        "of recognition, referring, answers and captions: count what has no prediction as wrong, instead "
        "of refusing the file",
    )
    min_iou: float = option(0.5, "of captions: IoU that a box must be above for its caption to count", ge=0, le=1)
    distractors: int = option(
        0, "of retrieval: texts or pictures of others in a query's pool, drawn by its name; 0 = all", ge=0
    )
    java: bool = option(
        True, "of answers and captions: use Java's tokenizer and METEOR where they are there; without, columns say so"
    )

    def required_classes(self) -> str:
        """The classes, which must be given."""
        if not self.classes:
            raise InputError("classes= is missing: scannet20, scannet200, or a CSV file with the columns id and name")
        return self.classes

    def raw_ids(self) -> dict[str, int] | None:
        """Class id of each raw name of ScanNet's or ScanNet++'s objects, where labels are those of scans."""
        return ids_of_raw_names(self.label_map, self.required_classes()) if self.label_map else None

    def split(self) -> tuple[str, ...] | None:
        """Names of the scenes to score; None = all of the labels."""
        return read_split(Path(self.scenes)) if self.scenes else None


def refuse_missing(missing: Sequence[str], subject: str, predictions: Path, options: ScoreOptions) -> None:
    """Refuses samples without a prediction, unless they count as wrong."""
    if missing and not options.allow_missing:
        raise InputError(
            f"{predictions}: {counted(len(missing), subject)} without a prediction, first {missing[0][:60]}; "
            "allow_missing=true counts them as wrong"
        )


RESULT_FILES = ("semantic_instance_evaluation.txt", "semantic_label_evaluation.txt")
"""What ScanNet's scripts write into the folder of the predictions."""


class SceneFiles(NamedTuple):
    """The prediction of one scene, and its labels: a file, or the folder of a scan."""

    scene: str
    prediction: Path
    labels: Path


def scene_files(
    predictions: Path,
    labels: Path,
    *,
    scenes: Collection[str] | None = None,
    suffixes: Collection[str] = (".txt",),
    scans: bool = False,
) -> tuple[SceneFiles, ...]:
    """Finds the files of every scene to score, in the order of the names.

    ScanNet's scripts score the scenes that have predictions, and pass over the others. Here those are refused: the
    scores of a method that got through some scenes do not compare with those of one that got through all.

    Args:
        scenes: those to score, such as the ones of a split; None = all of the labels.
        scans: whether `labels` has the folders of ScanNet's scans, each with the label files of its scene.
    """
    for folder in (predictions, labels):
        if not folder.is_dir():
            raise InputError(f"{folder}: expected a folder with a file for each scene")
    if predictions.resolve() == labels.resolve():
        raise InputError(f"{predictions}: predictions and truth are the same folder")
    predicted: dict[str, Path] = {}
    for path in _files(predictions, suffixes):
        if path.stem in predicted:
            raise InputError(
                f"{predictions}: the scene {path.stem} has both {predicted[path.stem].name} and {path.name}"
            )
        predicted[path.stem] = path
    if not predicted:
        expected = " or ".join(f"SCENE{suffix}" for suffix in suffixes)
        raise InputError(f"{predictions}: no predictions; expected {expected} for each scene (pickles are refused)")
    label_files = _label_files(labels, scans)
    foreign = [scene for scene in predicted if scene not in label_files]
    if foreign:
        some = listed(sorted(label_files), 3)
        raise InputError(f"{predicted[foreign[0]]}: there is no truth of this scene in {labels}; it has {some}")
    names = sorted(label_files if scenes is None else set(scenes))
    unknown = [scene for scene in names if scene not in label_files]
    if unknown:
        raise InputError(f"{labels}: no truth of {counted(len(unknown), 'scene')} to score: {listed(unknown)}")
    missing = [scene for scene in names if scene not in predicted]
    if missing:
        raise InputError(f"{predictions}: no prediction of {counted(len(missing), 'scene')}: {listed(missing)}")
    return tuple(SceneFiles(scene, predicted[scene], label_files[scene]) for scene in names)


def _label_files(labels: Path, scans: bool) -> dict[str, Path]:
    """The file or the scan's folder of each labeled scene, by its name."""
    files = {path.stem: path for path in _files(labels, (".txt",))}
    folders = {
        path.name: path
        for path in sorted(labels.iterdir())
        if any(os.path.lexists(path / name) for name in (f"{path.name}{AGGREGATION}", f"scans/{ANNOTATION}"))
    }
    if scans and not folders:
        raise InputError(
            f"{labels}: no scans; expected SCENE/SCENE{AGGREGATION} or SCENE/scans/{ANNOTATION} (SCENE.txt has ids of "
            "classes and needs no label_map=)"
        )
    if not scans and not files:
        instead = " (labels of scans need label_map=)" if folders else ""
        raise InputError(f"{labels}: no truth; expected SCENE.txt for each scene{instead}")
    return folders if scans else files


def _files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    files = sorted(path for path in folder.iterdir() if path.suffix in suffixes and path.name not in RESULT_FILES)
    for path in files:
        with readable(path):
            check_foreign(path)
    return files
