"""Files of semantic labels, in ScanNet's format: SCENE.txt with one class id a line, for predictions and truth.

Both look the same, so that nothing tells whether they are swapped.
"""

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from gsencoder.core.errors import InputError, about
from gsencoder.data.labels.classes import ClassTable
from gsencoder.data.labels.expressions import IDS_PER_CLASS
from gsencoder.data.labels.files import read_whole_numbers
from gsencoder.evaluate.files.scan_truth import classes_of_scan
from gsencoder.evaluate.files.scene_folders import scene_files
from gsencoder.evaluate.scores.semantics import LabelCounts, count_labels

RAW_IDS = range(1100, 1358)
"""Ids from here to the end of ScanNet's raw ones are no instances: no scene has a hundred of class 1."""


def count_label_files(
    predictions: Path,
    truth: Path,
    classes: ClassTable,
    *,
    scenes: Collection[str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
) -> Iterator[LabelCounts]:
    """Counts the labels of the predictions of a folder by the truth of another, one scene in memory at a time.

    Args:
        predictions: folder of SCENE.txt.
        truth: folder of SCENE.txt, or of ScanNet's scans.
        classes: that are scored.
        scenes: to score; None = all of the truth.
        raw_ids: class id of each raw name, of `read_label_map`, where the truth is the labels of scans.

    Raises:
        InputError: files that cannot be used, scenes that are in one folder only, or numbers of vertices that differ.
    """
    for files in scene_files(predictions, truth, scenes=scenes, scans=raw_ids is not None):
        labels = _labels(files.truth, classes) if raw_ids is None else classes_of_scan(files.truth, raw_ids, classes)
        predicted = _labels(files.prediction, classes)
        with about(files.prediction):
            counts = count_labels(files.scene, labels, predicted, classes)
        yield counts


def _labels(path: Path, classes: ClassTable) -> Int64[np.ndarray, " V"]:
    labels = read_whole_numbers(path)
    if not len(labels):
        raise InputError(f"{path}: no vertices; expected one class id for each")
    large = labels[(labels >= IDS_PER_CLASS) & ((labels < RAW_IDS.start) | (labels >= RAW_IDS.stop))]
    instances = large // IDS_PER_CLASS
    if not (classes.rows(labels) >= 0).any() and (classes.rows(instances) >= 0).any():
        raise InputError(
            f"{path}: ids such as {labels.max()} are those of instances, class id · {IDS_PER_CLASS} + number; expected "
            "class ids"
        )
    return labels
