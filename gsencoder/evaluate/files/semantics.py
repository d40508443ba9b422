"""Files of semantic labels, in ScanNet's format: SCENE.txt with one class id a line, for predictions and truth.

Both look the same, so that nothing tells whether they are swapped.
"""

from collections.abc import Collection, Iterator
from pathlib import Path

from gsencoder.core.errors import InputError, about
from gsencoder.evaluate.files.label_files import read_whole_numbers
from gsencoder.evaluate.files.scene_folders import scene_files
from gsencoder.evaluate.scores.class_table import ClassTable
from gsencoder.evaluate.scores.instances import IDS_PER_LABEL
from gsencoder.evaluate.scores.semantics import LabelCounts, count_labels


def count_label_files(
    predictions: Path, truth: Path, classes: ClassTable, *, scenes: Collection[str] | None = None
) -> Iterator[LabelCounts]:
    """Counts the labels of the predictions of a folder by the truth of another, one scene in memory at a time.

    Args:
        predictions: folder of SCENE.txt.
        truth: folder of SCENE.txt.
        classes: that are scored.
        scenes: to score; None = all of the truth.

    Raises:
        InputError: files that cannot be used, scenes that are in one folder only, or numbers of vertices that differ.
    """
    for files in scene_files(predictions, truth, scenes=scenes):
        true, found = read_whole_numbers(files.truth), read_whole_numbers(files.prediction)
        for path, labels in ((files.truth, true), (files.prediction, found)):
            if not len(labels):
                raise InputError(f"{path}: no vertices; expected one class id for each")
            if not (classes.rows(labels) >= 0).any() and (classes.rows(labels // IDS_PER_LABEL) >= 0).any():
                raise InputError(
                    f"{path}: ids such as {labels.max()} are those of instances, class id · {IDS_PER_LABEL} + number; "
                    "expected class ids"
                )
        with about(files.prediction):
            counts = count_labels(files.scene, true, found, classes)
        yield counts
