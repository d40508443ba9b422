"""Semantic labels of vertices: IoU and accuracy of classes, as ScanNet's and SceneSplat's benchmarks count them.

Vertices whose true label is no class are left out. Of the others, over all scenes,

    IoU of a class      = right / (right + missed + wrong)
    accuracy of a class = right / (right + missed)

where *missed* vertices of the class are predicted as another class, or as none, and *wrong* ones are of another class
and predicted as this one (ScanNet's `evaluate_semantic_label.py`). mIoU is the mean over the classes that are labeled
or predicted, mAcc that over the classes that are labeled, and accuracy the share of all vertices that are right
(SceneSplat's `ZeroShotSemSegTester`, Li et al. 2025; the 1e-10 that it adds to denominators is left out). A class that
is predicted and not labeled has the IoU 0; the evaluation that SceneSplat runs during training leaves it out, and so
does `miou_present`. f-mIoU, f-mAcc and f-accuracy are the same over the foreground: all classes but wall, floor and
ceiling. Vertices of these still count as wrong where they are predicted as another class.

Files are ScanNet's: SCENE.txt with one class id a line, for predictions and labels. Both look the same, so that nothing
tells whether they are swapped.

`evaluate protocol=semantics` gives each Gaussian the class whose name is nearest to its feature. A vertex of a labeled
mesh has the class that is most frequent among the nearest Gaussians with a feature, however far they are, as
SceneSplat's benchmark counts (pointcept/utils/misc.py, neighbor_voting). Points without a named object are ignored.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Int32, Int64

from gsencoder.core.errors import InputError, counted, error_prefix
from gsencoder.data.labels.classes import (
    IDS_PER_CLASS,
    ClassTable,
    ids_of_names,
    load_classes,
    vertex_classes,
    write_classes,
)
from gsencoder.data.labels.files import read_integer_lines, write_integer_lines
from gsencoder.data.labels.mesh import VOTERS, labels_of_vertices
from gsencoder.data.labels.scans import labels_of_scan
from gsencoder.evaluate.benchmarks.files import ScoreOptions, scene_files
from gsencoder.evaluate.benchmarks.protocol import (
    CLASS_IDS,
    LABELS,
    PREDICTIONS,
    Benchmark,
    Evaluation,
    Protocol,
    SceneResult,
    predicted_classes,
)
from gsencoder.evaluate.sources import LabeledPoints, nearest_class
from gsencoder.evaluate.tables import ScoreReport, mean_of, spread, table_of
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures, Gaussians, Scene

OPTIONS = ("classes", "label_map", "scenes")
BACKGROUND = ("wall", "floor", "ceiling")
"""Names that SceneSplat excludes from the foreground. ScanNet's 20 classes have no ceiling."""
NO_CLASS, NO_CLASS_BESIDE_ZERO = 0, -100
"""Ids of points of no class, in labels and predictions; the second where 0 is the id of a class, as in ScanNet++."""
RAW_IDS = range(1100, 1358)
"""Ids from here to the end of ScanNet's raw ones are no instances: no scene has a hundred of class 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticsProtocol(Protocol):
    """The classes are options of the command."""

    name: Literal["semantics"] = "semantics"

    def start(self, evaluation: Evaluation) -> "SemanticsBenchmark":
        return SemanticsBenchmark(evaluation)


class SemanticsBenchmark(Benchmark[None]):
    """Each scene has its own two files, which are written as it is predicted."""

    def __init__(self, evaluation: Evaluation) -> None:
        self.evaluation, self.classes = evaluation, predicted_classes(evaluation)

    def predict(self, scene: Scene, features: GaussianFeatures) -> None:
        assert scene.gaussians is not None
        points, classes = self.classes.points(scene), self.classes.table
        predicted = predict_semantics(points, scene.gaussians, features, classes, self.evaluation.words)
        for name, values in ((LABELS, class_ids(points, classes)), (PREDICTIONS, predicted)):
            self.evaluation.file(name).mkdir(exist_ok=True)
            write_integer_lines(self.evaluation.file(name) / f"{scene.name}.txt", values)

    def report(self, results: Sequence[SceneResult[None]]) -> ScoreReport:  # noqa: ARG002 - files hold all
        write_classes(self.evaluation.file(CLASS_IDS), self.classes.table)
        return score_semantics(
            self.evaluation.file(PREDICTIONS),
            self.evaluation.file(LABELS),
            self.classes.table,
            method=self.evaluation.method,
        )


def class_ids(points: LabeledPoints, classes: ClassTable) -> Int32[np.ndarray, " P"]:
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
    voters: int = VOTERS,
) -> Int32[np.ndarray, " P"]:
    """The predicted class id of each point, that of most of the `voters` nearest Gaussians on meshes; `id_of_none`
    where no Gaussian has a feature."""
    nearest = nearest_class(features, classes.names, text)
    none = id_of_none(classes)
    labels = np.array([*classes.ids, none], np.int32)[nearest]
    if points.positions is None:
        return labels
    return labels_of_vertices(points.positions, gaussians.means, labels, k=voters, none=none, voters=nearest >= 0)


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """IoU and accuracy of the labels of vertices in a folder of SCENE.txt."""
    return score_semantics(
        predictions,
        labels,
        load_classes(options.required_classes()),
        method=options.method,
        scenes=options.split(),
        raw_ids=options.raw_ids(),
    )


def score_semantics(
    predictions: Path,
    labels: Path,
    classes: ClassTable,
    *,
    method: str = "predictions",
    scenes: Collection[str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
) -> ScoreReport:
    """`score` with other classes."""
    counts = list(count_label_files(predictions, labels, classes, scenes=scenes, raw_ids=raw_ids))
    scores = semantic_scores(counts, classes)
    if not scores.vertices:
        raise InputError(
            f"{labels}: nothing to score: no vertex of {counted(len(counts), 'scene')} has one of the "
            f"{len(classes.names)} classes; compare its ids with those of classes="
        )
    overall = scores.figures
    by_scene = [
        {"scene": each.scene, **alone.figures, "vertices": alone.vertices}
        for each in counts
        for alone in (semantic_scores([each], classes),)
    ]
    excluded = [name for name in classes.names if name in BACKGROUND]
    notes = [f"Columns f_ leave out {', '.join(excluded)}."] if excluded else []
    if scores.unlabeled:
        notes.append(
            f"{scores.unlabeled:,} of {scores.vertices:,} vertices that count are predicted as none of the classes."
        )
    return ScoreReport(
        results={
            "protocol": "semantics",
            "vertices": scores.vertices,
            "ignored": scores.ignored,
            "unlabeled": scores.unlabeled,
            "excluded": excluded,
            **overall,
            "spread": spread(by_scene, list(overall)),
        },
        table=table_of("Semantic labels", {method: overall}, notes=notes),
        rows={
            "scenes": by_scene,
            "classes": [{"class": name, **values} for name, values in scores.classes.items()],
        },
        line=f"{counted(scores.vertices, 'label')} in {counted(len(counts), 'scene')}: mIoU {overall['miou']:.3f}, "
        f"mAcc {overall['macc']:.3f}, f-mIoU {overall['f_miou']:.3f}; {scores.unlabeled:,} without a prediction",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class LabelCounts:
    """Vertices of one scene by true and predicted class, the last column for what is predicted as none, and those whose
    true label is no class."""

    scene: str
    confusion: Int64[np.ndarray, "C C_1"]
    ignored: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticScores:
    """The scores of scenes.

    Attributes:
        figures: over all classes and, with f_ before the name, over those that are not `BACKGROUND`; NaN where no class
            counts. miou: mean IoU of the classes that are labeled or predicted, miou_present: of those that are
            labeled, macc: mean accuracy of these, accuracy: share of their vertices that are right.
        classes: by name iou (NaN if it is neither labeled nor predicted), accuracy (NaN if it is not labeled), and the
            vertices that have it: truths, and predictions of those that are not ignored.
        ignored: vertices whose true label is no class.
        unlabeled: vertices that count, and are predicted as no class.
    """

    figures: dict[str, float]
    classes: dict[str, dict[str, Any]]
    vertices: int
    ignored: int
    unlabeled: int


def count_labels(
    scene: str, truth: Int64[np.ndarray, " V"], predicted: Int64[np.ndarray, " _V"], classes: ClassTable
) -> LabelCounts:
    """Counts the vertices of a scene by true and predicted class id; other ids are ignored, or no class."""
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


def semantic_scores(counts: Sequence[LabelCounts], classes: ClassTable) -> SemanticScores:
    """The scores of one scene or more together, counted with these classes."""
    number = len(classes.names)
    confusion = np.sum([scene.confusion for scene in counts], axis=0)
    right = np.diagonal(confusion)
    truths, predictions = confusion.sum(axis=1), confusion[:, :number].sum(axis=0)
    union = truths + predictions - right
    iou = np.divide(right, union, out=np.full(number, math.nan), where=union > 0)
    accuracy = np.divide(right, truths, out=np.full(number, math.nan), where=truths > 0)

    def averages(rows: list[int], prefix: str) -> dict[str, float]:
        total = int(truths[rows].sum())
        return {
            f"{prefix}miou": mean_of(iou[rows]),
            f"{prefix}miou_present": mean_of(iou[rows][truths[rows] > 0]),
            f"{prefix}macc": mean_of(accuracy[rows]),
            f"{prefix}accuracy": int(right[rows].sum()) / total if total else math.nan,
        }

    foreground = [row for row, name in enumerate(classes.names) if name not in BACKGROUND]
    columns = zip(iou.tolist(), accuracy.tolist(), truths.tolist(), predictions.tolist(), strict=True)
    return SemanticScores(
        figures=averages(list(range(number)), "") | averages(foreground, "f_"),
        classes={
            name: dict(zip(("iou", "accuracy", "truths", "predictions"), row, strict=True))
            for name, row in zip(classes.names, columns, strict=True)
        },
        vertices=int(truths.sum()),
        ignored=sum(scene.ignored for scene in counts),
        unlabeled=int(confusion[:, number].sum()),
    )


def count_label_files(
    predictions: Path,
    labels: Path,
    classes: ClassTable,
    *,
    scenes: Collection[str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
) -> Iterator[LabelCounts]:
    """Counts the labels in two folders, one scene in memory at a time; arguments as of `score_semantics`."""
    for files in scene_files(predictions, labels, scenes=scenes, scans=raw_ids is not None):
        true_ids = (
            _class_ids(files.labels, classes) if raw_ids is None else class_ids_of_scan(files.labels, raw_ids, classes)
        )
        predicted = _class_ids(files.prediction, classes)
        with error_prefix(files.prediction):
            yield count_labels(files.scene, true_ids, predicted, classes)


def class_ids_of_scan(folder: Path, raw_ids: Mapping[str, int], classes: ClassTable) -> Int64[np.ndarray, " V"]:
    """The class id of each vertex of a scan's mesh, −1 = none."""
    labels = labels_of_scan(folder, raw_ids)
    names = dict(labels.objects)
    ids = ids_of_names(names.values(), raw_ids, classes)
    # 0 stands for none there, unless a raw name leads to it.
    class_of = {name: number for name, number in ids.items() if number or (raw_ids.get(name) == 0 and 0 in classes.ids)}
    return vertex_classes(labels.instances, names, class_of, none=-1).astype(np.int64)


def _class_ids(path: Path, classes: ClassTable) -> Int64[np.ndarray, " V"]:
    labels = read_integer_lines(path)
    if not len(labels):
        raise InputError(f"{path}: no vertices; expected one class id for each")
    large = labels[(labels >= IDS_PER_CLASS) & ((labels < RAW_IDS.start) | (labels >= RAW_IDS.stop))]
    if not (classes.rows(labels) >= 0).any() and (classes.rows(large // IDS_PER_CLASS) >= 0).any():
        raise InputError(
            f"{path}: ids such as {labels.max()} are those of instances, class id · {IDS_PER_CLASS} + number; expected "
            "class ids"
        )
    return labels
