"""Semantic labels of vertices: IoU and accuracy of classes, as ScanNet's and SceneSplat's benchmarks count them.

Vertices whose true label is no class are left out. Of the others, over all scenes,

    IoU of a class      = right / (right + missed + wrong)
    accuracy of a class = right / (right + missed)

where *missed* vertices of the class are predicted as another class, or as none, and *wrong* ones are of another class
and predicted as this one (ScanNet's `evaluate_semantic_label.py`). mIoU is the mean over the classes that are in truth
or predictions, mAcc that over the classes in truth, and accuracy the share of all vertices that are right (SceneSplat's
`ZeroShotSemSegTester`, Li et al. 2025; the 1e-10 that it adds to denominators is left out). A class that is predicted
and not in truth has the IoU 0; the evaluation that SceneSplat runs during training leaves it out, and so does
`miou_present`. f-mIoU, f-mAcc and f-accuracy are the same over the foreground: all classes but wall, floor and ceiling.
Vertices of these still count as wrong where they are predicted as another class.

Files of semantic labels, in ScanNet's format: SCENE.txt with one class id a line, for predictions and truth.

Both look the same, so that nothing tells whether they are swapped.

The semantics protocol: the class of each point by the nearest word to its feature (mIoU, mAcc, f-mIoU).

Each Gaussian is given the class whose name is nearest to its feature, among the classes of all scenes or of a
benchmark. A vertex of a labeled mesh has the class that is most frequent among the nearest Gaussians with a feature,
however far they are, as SceneSplat's benchmark counts (Li et al. 2025; pointcept/utils/misc.py, neighbor_voting).
Points without a named object are ignored.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Int32, Int64

from gsencoder.core.arrays import first_repeated
from gsencoder.core.errors import InputError, about, listed
from gsencoder.data.labels.classes import ClassTable, vertex_classes
from gsencoder.data.labels.expressions import IDS_PER_CLASS
from gsencoder.data.labels.files import read_whole_numbers
from gsencoder.data.labels.mesh import VOTERS, labels_of_vertices
from gsencoder.evaluate.benchmarks.files import scene_files
from gsencoder.evaluate.benchmarks.instances import classes_of_scan
from gsencoder.evaluate.sources import LabeledPoints, nearest_class
from gsencoder.evaluate.tables import mean_of
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures, Gaussians

BACKGROUND = ("wall", "floor", "ceiling")
"""Names that SceneSplat excludes from the foreground. ScanNet's 20 classes have no ceiling."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelCounts:
    """Vertices of one scene by true and predicted class.

    Attributes:
        confusion: by row of the true class, and of the predicted one; the last column counts what is predicted as none.
        ignored: vertices whose true label is no class.
    """

    scene: str
    confusion: Int64[np.ndarray, "C C_1"]
    ignored: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassScores:
    """Scores of one class.

    Attributes:
        iou: NaN if it is neither in truth nor predicted.
        accuracy: NaN if it is not in truth.
        predictions: vertices predicted as the class, of those that are not ignored.
    """

    iou: float
    accuracy: float
    truths: int
    predictions: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticAverages:
    """Means over classes; NaN where no class counts.

    Attributes:
        miou: mean IoU of the classes in truth or predictions.
        macc: mean accuracy of the classes in truth.
        accuracy: share of the vertices of these classes that are right.
    """

    miou: float
    miou_present: float
    macc: float
    accuracy: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticScores:
    """The scores of scenes.

    Attributes:
        foreground: over those that are not excluded.
        excluded: names of the classes that are.
        ignored: vertices whose true label is no class.
        unlabeled: vertices that count, and are predicted as no class.
    """

    scenes: int
    overall: SemanticAverages
    foreground: SemanticAverages
    excluded: tuple[str, ...]
    classes: dict[str, ClassScores]
    vertices: int
    ignored: int
    unlabeled: int


def count_labels(
    scene: str, truth: Int64[np.ndarray, " V"], predicted: Int64[np.ndarray, " _V"], classes: ClassTable
) -> LabelCounts:
    """Counts the vertices of a scene by true and predicted class.

    Args:
        truth: class id of each vertex; others are ignored.
        predicted: class id of each vertex; others are no class.
    """
    if len(truth) != len(predicted):
        raise InputError(
            f"{scene}: the prediction has {len(predicted):,} labels, and the truth {len(truth):,}; expected one for "
            "each vertex of the same mesh"
        )
    number = len(classes.names)
    true_rows, rows = classes.rows(truth), classes.rows(predicted)
    with_class = true_rows >= 0
    columns = np.where(rows < 0, number, rows)
    cells = np.bincount(true_rows[with_class] * (number + 1) + columns[with_class], minlength=number * (number + 1))
    return LabelCounts(
        scene=scene, confusion=cells.reshape(number, number + 1), ignored=int(len(truth) - with_class.sum())
    )


def check_excluded(excluded: Collection[str], classes: ClassTable) -> None:
    """Checks that what is to be left out of the foreground are classes. Names of `BACKGROUND` may be none."""
    unknown = [name for name in excluded if name not in classes.names and name not in BACKGROUND]
    if unknown:
        near = get_close_matches(unknown[0], classes.names, n=1)
        raise InputError(
            f"excluded: {unknown[0][:60]!r} is none of the {len(classes.names)} classes"
            + (f"; did you mean {near[0]}?" if near else f" ({listed(classes.names)})")
        )


def semantic_scores(
    counts: Sequence[LabelCounts], classes: ClassTable, *, excluded: Collection[str] = BACKGROUND
) -> SemanticScores:
    """The scores of scenes together; of one scene, its own.

    Args:
        counts: of the scenes, in any order.
        classes: with which they were counted.
        excluded: names of the classes that are not of the foreground. Of `BACKGROUND`, those that are no class are
            passed over.
    """
    if not counts:
        raise InputError("semantics: no scene to score")
    if repeated := first_repeated(scene.scene for scene in counts):
        raise InputError(f"semantics: the scene {repeated[0]} is there twice; each is scored once")
    number = len(classes.names)
    if any(scene.confusion.shape != (number, number + 1) for scene in counts):
        raise InputError("semantics: the scenes were counted with different classes")
    check_excluded(excluded, classes)
    confusion = np.sum([scene.confusion for scene in counts], axis=0)
    right = np.diagonal(confusion)
    truths, predictions = confusion.sum(axis=1), confusion[:, :number].sum(axis=0)
    union = truths + predictions - right
    iou = np.divide(right, union, out=np.full(number, math.nan), where=union > 0)
    accuracy = np.divide(right, truths, out=np.full(number, math.nan), where=truths > 0)

    def averages(rows: list[int]) -> SemanticAverages:
        total = int(truths[rows].sum())
        return SemanticAverages(
            miou=mean_of(iou[rows]),
            miou_present=mean_of(iou[rows][truths[rows] > 0]),
            macc=mean_of(accuracy[rows]),
            accuracy=int(right[rows].sum()) / total if total else math.nan,
        )

    return SemanticScores(
        scenes=len(counts),
        overall=averages(list(range(number))),
        foreground=averages([row for row, name in enumerate(classes.names) if name not in excluded]),
        excluded=tuple(name for name in classes.names if name in excluded),
        classes={
            name: ClassScores(
                iou=float(iou[row]),
                accuracy=float(accuracy[row]),
                truths=int(truths[row]),
                predictions=int(predictions[row]),
            )
            for row, name in enumerate(classes.names)
        },
        vertices=int(truths.sum()),
        ignored=sum(scene.ignored for scene in counts),
        unlabeled=int(confusion[:, number].sum()),
    )


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
        truth: folder of SCENE.txt, or of ScanNet's scans.
        scenes: to score; None = all of the truth.
        raw_ids: class id of each raw name, of `read_label_map`, where the truth is the labels of scans.
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


NO_CLASS, NO_CLASS_BESIDE_ZERO = 0, -100
"""Ids of points of no class, in truth and predictions; the second where 0 is the id of a class, as in ScanNet++."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticsProtocol:
    """How vertices get the class of Gaussians, and which classes are of the foreground."""

    name: Literal["semantics"] = "semantics"
    voters: int = field(
        default=VOTERS,
        metadata={
            "help": "on meshes: nearest Gaussians with a feature whose most frequent class a vertex has; 1 = the "
            "nearest one"
        },
    )
    excluded: tuple[str, ...] = field(
        default=tuple(sorted(BACKGROUND)), metadata={"names": True, "help": "classes that f-mIoU leaves out"}
    )

    def __post_init__(self) -> None:
        if self.voters < 1:
            raise InputError(f"voters: expected 1 or more, got {self.voters}")


def semantic_truth(points: LabeledPoints, classes: ClassTable) -> Int32[np.ndarray, " P"]:
    """The class id of each point's object; `id_of_none` for points without a named object."""
    return vertex_classes(points.objects, points.names, classes.id_of, none=id_of_none(classes))


def id_of_none(classes: ClassTable) -> int:
    """The id of points of no class."""
    return NO_CLASS_BESIDE_ZERO if 0 in classes.ids else NO_CLASS


def predict_semantics(
    points: LabeledPoints,
    gaussians: Gaussians,
    features: GaussianFeatures,
    classes: ClassTable,
    text: TextEncoder,
    protocol: SemanticsProtocol = SemanticsProtocol(),
) -> Int32[np.ndarray, " P"]:
    """The predicted class id of each point; `id_of_none` where no Gaussian has a feature.

    Args:
        text: turns their names into vectors.
        protocol: how many Gaussians vote for a vertex.
    """
    nearest = nearest_class(features, classes.names, text)
    none = id_of_none(classes)
    labels = np.array([*classes.ids, none], np.int32)[nearest]
    if points.positions is None:
        return labels
    return labels_of_vertices(
        points.positions, gaussians.means, labels, k=protocol.voters, none=none, voters=nearest >= 0
    )


def classes_of(names: Sequence[str]) -> ClassTable:
    """A table of classes without a benchmark: ids from 1 in the order of the names."""
    return ClassTable(names=tuple(names), ids=tuple(range(1, len(names) + 1)))
