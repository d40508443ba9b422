"""Average precision of instances, as ScanNet's `evaluate_semantic_instance.py` counts it (Dai et al. 2017).

A true instance is one of a scored class with 100 vertices or more. A prediction is a mask of vertices with a class and
a score; masks of fewer than 100 vertices are left out, as are those of classes that are not scored. At a threshold of
the IoU:

* True instances, in the order of their ids, take the predictions of their class whose IoU is strictly above the
  threshold, in the order in which these are listed, unless another instance has them already. The highest score is that
  of the match, and each further prediction is a false positive.
* A prediction that is above the threshold with no instance of its class is a false positive, unless more than that
  share of its vertices is ignored: vertices without a scored class, and those of its class's instances that have fewer
  than 100.

From 0.5 on a prediction can match one instance only, and the order in which predictions are listed means nothing; at
0.25 one may lie on several, and the order counts there, as in the official script, whatever the scores are.

Precision p and recall r are taken at each distinct score, from the lowest, and the point (1, 0) is added; AP sums
p[i] · (r[i - 1] - r[i + 1]) / 2, with r[-1] = r[0] and a 0 after the last. AP of a class is the mean over the
thresholds 0.50, 0.55, …, 0.90; AP50 and AP25 are those at 0.5 and 0.25. Without true instances a class has none, and
means leave it out; with some and no predictions it is 0. Without classes, all masks and instances are of one class;
what is labeled as no class remains ignored.

Files: labels are SCENE.txt with one number a line, class id · 1000 + number of the instance, and 0 for none, or the
folders of scans. A prediction is SCENE.txt with "mask file, class id, score" in each line, where the mask file lies
below the same folder and has one number a line, 0 outside of the mask; or SCENE.npz with pred_masks (bool, vertices ×
masks), pred_classes (integers) and pred_scores (floating point), as OpenMask3D and Mask3D name them.

`evaluate protocol=instances` (SplatDistill sec. 4.2, tables 2 and 7) takes the clusters of Gaussians that `localize`
finds for the name of each class as masks, with the probability of their box as the score. Or the true objects are given
as class-agnostic proposals: their class is recognized by the mean feature, and the score is the class's share in a
softmax over the cosines of all classes.
"""

import io
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsencoder.core.archive import read_npz
from gsencoder.core.errors import InputError, counted, error_prefix
from gsencoder.core.files import write_bytes
from gsencoder.core.settings import option
from gsencoder.data.labels.classes import (
    IDS_PER_CLASS,
    ClassTable,
    ids_of_names,
    instance_ids,
    load_classes,
    write_classes,
)
from gsencoder.data.labels.files import (
    read_checked_text,
    read_integer_lines,
    read_mask,
    write_integer_lines,
)
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
from gsencoder.evaluate.sources import LabeledPoints, class_cosines
from gsencoder.evaluate.tables import ScoreReport, spread, table_of
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures, Scene

OPTIONS = ("classes", "label_map", "scenes")
OVERLAPS = np.append(np.arange(0.5, 0.95, 0.05), 0.25)
"""Thresholds of IoU. Their floating-point values decide ties: 0.6 here is 0.6000000000000001."""
MIN_REGION = 100
"""Smallest number of vertices of an instance and of a mask that count."""
TEMPERATURE = 0.1
"""Of the softmax over classes, as for relevancy (LERF)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InstancesProtocol(Protocol):
    """Where masks come from, and whether classes count."""

    name: Literal["instances"] = "instances"
    proposals: Literal["clusters", "truth"] = option(
        "clusters", "masks: clusters = what localize finds for each class; truth = the true objects, to be named"
    )
    class_agnostic: bool = option(False, "leave the classes of masks out of account")

    def start(self, evaluation: Evaluation) -> "InstancesBenchmark":
        return InstancesBenchmark(self, evaluation)


class InstancesBenchmark(Benchmark[None]):
    """Each scene has its own two files, which are written as it is predicted."""

    def __init__(self, protocol: InstancesProtocol, evaluation: Evaluation) -> None:
        self.protocol, self.evaluation = protocol, evaluation
        self.classes = predicted_classes(evaluation, instances=True)

    def predict(self, scene: Scene, features: GaussianFeatures) -> None:
        points, classes = self.classes.points(scene), self.classes.table
        masks = predict_instances(
            scene, points, features, classes, self.evaluation.words, self.protocol, self.evaluation.localization
        )
        with error_prefix(f"scene {scene.name}"):
            ids = instance_ids(points.objects, points.names, classes.id_of)
        for name in (LABELS, PREDICTIONS):
            self.evaluation.file(name).mkdir(exist_ok=True)
        write_integer_lines(self.evaluation.file(LABELS) / f"{scene.name}.txt", ids)
        write_instance_prediction(self.evaluation.file(PREDICTIONS), masks)

    def report(self, results: Sequence[SceneResult[None]]) -> ScoreReport:  # noqa: ARG002 - files hold all
        write_classes(self.evaluation.file(CLASS_IDS), self.classes.table)
        return score_instances(
            self.evaluation.file(PREDICTIONS),
            self.evaluation.file(LABELS),
            self.classes.table,
            method=self.evaluation.method,
            class_agnostic=self.protocol.class_agnostic,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class InstancePrediction:
    """Masks of a scene of V vertices, each with a class id and a finite score; masks may overlap, and hold the vertices
    of each, ascending, each once."""

    scene: str
    num_vertices: int
    masks: tuple[Int64[np.ndarray, " _n"], ...]
    labels: Int64[np.ndarray, " M"]
    scores: Float64[np.ndarray, " M"]


def prediction_of_masks(
    scene: str,
    masks: Sequence[Bool[np.ndarray, " _V"]] | Bool[np.ndarray, "M V"],
    labels: Sequence[int],
    scores: Sequence[float],
    *,
    num_vertices: int,
) -> InstancePrediction:
    """The prediction of masks that say for each vertex whether it belongs to them."""
    for index, (mask, score) in enumerate(zip(masks, scores, strict=True)):
        if len(mask) != num_vertices:
            raise InputError(f"{scene}: mask {index} has {len(mask):,} vertices, and the scene {num_vertices:,}")
        if not math.isfinite(score):
            raise InputError(f"{scene}: prediction {index} has the score {score}; expected finite scores")
    return InstancePrediction(
        scene=scene,
        num_vertices=num_vertices,
        masks=tuple(np.flatnonzero(mask) for mask in masks),
        labels=np.array(labels, np.int64),
        scores=np.array(scores, np.float64),
    )


def predict_instances(
    scene: Scene,
    points: LabeledPoints,
    features: GaussianFeatures,
    classes: ClassTable,
    text: TextEncoder,
    protocol: InstancesProtocol = InstancesProtocol(),
    localization: LocalizeConfig = LocalizeConfig(),
) -> InstancePrediction:
    """Masks of a scene's points, each with a class and a score."""
    ids = classes.id_of
    if protocol.proposals == "clusters":
        queried = replace(scene, features={features.space.name: features})
        boxes = localize(queried, classes.names, text, localization).boxes
        masks = [points.masked(box.rows.astype(np.int64), len(features)) for box in boxes]
        labels, scores = [ids[box.query] for box in boxes], [float(box.probability) for box in boxes]
    else:
        numbers = list(points.named_ids())
        cosines = class_cosines(features, [points.rows_of(number) for number in numbers], classes.names, text)
        rows = np.flatnonzero(np.isfinite(cosines).all(axis=1))
        shares = np.exp((cosines[rows] - cosines[rows].max(axis=1, keepdims=True, initial=-1)) / TEMPERATURE)
        shares /= shares.sum(axis=1, keepdims=True)
        masks = [points.objects == numbers[row] for row in rows]
        labels = [classes.ids[number] for number in shares.argmax(axis=1)]
        scores = [float(each) for each in shares.max(axis=1, initial=0)]
    return prediction_of_masks(scene.name, masks, labels, scores, num_vertices=len(points))


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """Average precision of the masks in a folder of SCENE.txt or SCENE.npz."""
    return score_instances(
        predictions,
        labels,
        load_classes(options.required_classes(), instances=True),
        method=options.method,
        scenes=options.split(),
        raw_ids=options.raw_ids(),
    )


def score_instances(
    predictions: Path,
    labels: Path,
    classes: ClassTable,
    *,
    method: str = "predictions",
    scenes: Collection[str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
    class_agnostic: bool = False,
) -> ScoreReport:
    """`score`, with classes or without."""
    files = match_instance_files(
        predictions, labels, classes, scenes=scenes, raw_ids=raw_ids, class_agnostic=class_agnostic
    )
    matches = list(files)
    scores = instance_scores(matches, classes)
    instances = int(scores.instances.sum())
    if not instances:
        raise InputError(
            f"{labels}: nothing to score: no object of the {len(classes.names)} classes has {MIN_REGION} vertices or "
            f"more in {counted(len(matches), 'scene')}; compare its ids with those of classes="
        )
    overall = scores.overall
    groups = {f"ap_{group}": values["ap"] for group, values in scores.groups.items()}
    by_scene = [
        {"scene": each.scene, **alone.overall, "truths": int(alone.instances.sum())}
        for each in matches
        for alone in (instance_scores([each], classes),)
    ]
    by_class = [
        {"class": name, **values, "truths": int(number), "predictions": int(count)}
        for (name, values), number, count in zip(
            scores.classes.items(), scores.instances, scores.predictions, strict=True
        )
    ]
    others = sum(each.other_classes for each in matches)
    notes = []
    if scores.equal_scores:
        notes.append(
            "All predictions have one score, so that their ranking is undefined, and average precision is that of one "
            "step."
        )
    if class_agnostic:
        notes.append("All masks are of one class; published figures, which are of classes, are not compared with it.")
    if others:
        notes.append(
            f"Not counted: {counted(others, 'mask')} with a class id that is none of the {len(classes.names)} that are "
            "scored."
        )
    if scores.shared:
        notes.append(
            f"Of the masks {scores.shared:,} overlap several true objects by more than 0.25; AP at 0.25 depends on "
            "the order in which they are listed, as in ScanNet's script."
        )
    return ScoreReport(
        results={
            "protocol": "instances",
            "class_agnostic": class_agnostic,
            "thresholds": [round(float(value), 2) for value in OVERLAPS],
            "truths": instances,
            "predictions": int(scores.predictions.sum()),
            "other_classes": others,
            "equal_scores": scores.equal_scores,
            **overall,
            **groups,
            "spread": spread(by_scene, list(overall)),
        },
        table=table_of(
            "Instances",
            {method: overall | groups},
            published="" if class_agnostic else "splatdistill_2_instances",
            notes=notes,
        ),
        rows={"scenes": by_scene, "classes": by_class},
        line=f"{counted(instances, 'object')} in {counted(scores.scenes, 'scene')}: AP {overall['ap']:.3f}, AP50 "
        f"{overall['ap_50']:.3f}, AP25 {overall['ap_25']:.3f}" + (" without classes" if class_agnostic else ""),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneMatches:
    """Which predictions of a scene are right, at each threshold: all that scores need of it.

    Attributes:
        instances: numbers of instances by class (one class where they were not looked at).
        predictions: numbers of predictions that count, by class.
        shared: number of these predictions that are above the lowest threshold with several instances.
        other_classes: number of predictions whose class is not scored.
        rows: class of each outcome; those of ignored predictions are left out.
        thresholds: index in `OVERLAPS` of each outcome.
        hits: whether it is a match, or a false positive.
    """

    scene: str
    class_agnostic: bool
    instances: Int64[np.ndarray, " C"]
    predictions: Int64[np.ndarray, " C"]
    scores: Float64[np.ndarray, " n"]
    shared: int
    other_classes: int
    rows: Int64[np.ndarray, " K"]
    thresholds: Int64[np.ndarray, " K"]
    hits: Bool[np.ndarray, " K"]
    outcome_scores: Float64[np.ndarray, " K"]


def match_instances(
    ids_of_vertices: Int64[np.ndarray, " V"],
    prediction: InstancePrediction,
    classes: ClassTable,
    *,
    class_agnostic: bool = False,
) -> SceneMatches:
    """Decides at each threshold which predictions of a scene match an instance, are wrong, or are ignored.

    A vertex has class id · 1000 + number of the instance; other ids, such as 0, are no instance.
    """
    if len(ids_of_vertices) != prediction.num_vertices:
        raise InputError(
            f"{prediction.scene}: the masks have {prediction.num_vertices:,} vertices, and the truth "
            f"{len(ids_of_vertices):,}; expected those of the same mesh"
        )
    ids, codes, sizes = np.unique(ids_of_vertices, return_inverse=True, return_counts=True)
    instance_rows, rows = classes.rows(ids // IDS_PER_CLASS), classes.rows(prediction.labels)
    if class_agnostic:
        instance_rows, rows = np.where(instance_rows < 0, -1, 0), np.zeros_like(rows)
    number = 1 if class_agnostic else len(classes.names)
    void = instance_rows < 0
    instance_rows = np.where(ids == 0, -1, instance_rows)
    in_score = (instance_rows >= 0) & (ids >= IDS_PER_CLASS) & (sizes >= MIN_REGION)
    other_classes = int((rows < 0).sum())
    areas = np.array([len(mask) for mask in prediction.masks], np.int64)
    large = np.flatnonzero((rows >= 0) & (areas >= MIN_REGION))
    rows, scores, areas = rows[large], prediction.scores[large], areas[large]
    common = np.zeros((len(large), len(ids)), np.int64)
    for row, index in enumerate(large.tolist()):
        common[row] = np.bincount(codes[prediction.masks[index]], minlength=len(ids))

    same = rows[:, None] == instance_rows
    first, second = np.nonzero(same & (common > 0))
    shared = common[first, second]
    ious = shared / (sizes[second] + areas[first] - shared)
    # The official script adds an instance that is small and a group (an id below 1000) twice.
    small = same & (sizes < MIN_REGION)
    groups = same & (ids < IDS_PER_CLASS)
    ignored = (common * (void + small.astype(np.int64) + groups)).sum(axis=1) / np.maximum(areas, 1)

    scored = in_score[second]
    outcomes = [_outcomes(first, second, ious > overlap, scored, scores, ignored <= overlap) for overlap in OVERLAPS]
    of_instance = np.concatenate([owners for owners, _, _ in outcomes])
    hits = np.concatenate([right for _, right, _ in outcomes])
    multiple = np.bincount(first[(ious > OVERLAPS.min()) & scored], minlength=1)
    return SceneMatches(
        scene=prediction.scene,
        class_agnostic=class_agnostic,
        instances=np.bincount(instance_rows[in_score], minlength=number),
        predictions=np.bincount(rows, minlength=number),
        scores=scores,
        shared=int((multiple > 1).sum()),
        other_classes=other_classes,
        rows=rows[of_instance],
        thresholds=np.repeat(np.arange(len(OVERLAPS)), [len(owners) for owners, _, _ in outcomes]),
        hits=hits,
        outcome_scores=np.concatenate([values for _, _, values in outcomes]),
    )


def _outcomes(
    predictions: Int64[np.ndarray, " P"],
    instances: Int64[np.ndarray, " P"],
    above: Bool[np.ndarray, " P"],
    scored: Bool[np.ndarray, " P"],
    scores: Float64[np.ndarray, " M"],
    counts: Bool[np.ndarray, " M"],
) -> tuple[Int64[np.ndarray, " K"], Bool[np.ndarray, " K"], Float64[np.ndarray, " K"]]:
    """The outcomes of one class at one threshold: the prediction of each, whether it is a match, and its score."""
    candidates = np.flatnonzero(above & scored)
    candidates = candidates[np.lexsort((predictions[candidates], instances[candidates]))]
    used_predictions: set[int] = set()
    matched: dict[int, tuple[int, float]] = {}
    wrong: list[tuple[int, float]] = []
    for prediction, instance in zip(predictions[candidates].tolist(), instances[candidates].tolist(), strict=True):
        if prediction in used_predictions:
            continue
        score = float(scores[prediction])
        if instance in matched:
            # A prediction that comes second is not taken, whichever of both scores is the higher one.
            owner, best = matched[instance]
            matched[instance] = owner, max(best, score)
            wrong.append((prediction, min(best, score)))
        else:
            used_predictions.add(prediction)
            matched[instance] = prediction, score
    alone = np.ones(len(scores), bool)
    alone[predictions[above]] = False
    false = np.flatnonzero(alone & counts)
    owned = [*matched.values(), *wrong]
    return (
        np.concatenate([np.array([owner for owner, _ in owned], np.int64), false]),
        np.arange(len(owned) + len(false)) < len(matched),
        np.concatenate([np.array([score for _, score in owned], np.float64), scores[false]]),
    )


Averages = dict[str, float]
"""ap_25, ap_50 and ap, which is over 0.5 to 0.9; NaN without instances."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InstanceScores:
    """The scores of scenes.

    Attributes:
        overall, groups: means over the classes that have instances, all and those of each group.
        classes: by name; the one class of a class-agnostic score is called "any".
        equal_scores: whether there are several predictions, all with one score. Their ranking is then undefined, and AP
            is recall · (precision + 1) / 2 at each threshold.
        shared: predictions that are above 0.25 with several instances; AP25 depends on the order of the predictions
            where there are any.
    """

    scenes: int
    overall: Averages
    classes: dict[str, Averages]
    groups: dict[str, Averages]
    instances: Int64[np.ndarray, " C"]
    predictions: Int64[np.ndarray, " C"]
    equal_scores: bool
    shared: int


def average_precision(scores: Float64[np.ndarray, " n"], hits: Bool[np.ndarray, " n"], instances: int) -> float:
    """AP of ranked predictions (the module has the equation); predictions of one score are one step."""
    order = np.argsort(scores, kind="stable")
    _, starts = np.unique(scores[order], return_index=True)
    hits_before = np.concatenate([[0], np.cumsum(hits[order])])
    right = hits_before[-1] - hits_before[starts]
    precision = np.append(right / (len(scores) - starts), 1.0)
    recall = np.append(right / instances, 0.0)
    around = np.concatenate([recall[:1], recall, [0.0]])
    return float(precision @ ((around[:-2] - around[2:]) / 2))


def instance_scores(matches: Sequence[SceneMatches], classes: ClassTable) -> InstanceScores:
    """The scores of scenes together, which were matched with these classes."""
    agnostic = matches[0].class_agnostic
    labels = ("any",) if agnostic else classes.names
    instances = np.sum([m.instances for m in matches], axis=0)
    predictions = np.sum([m.predictions for m in matches], axis=0)
    keys = np.concatenate([m.rows * len(OVERLAPS) + m.thresholds for m in matches])
    order = np.argsort(keys, kind="stable")
    starts = np.searchsorted(keys[order], np.arange(len(labels) * len(OVERLAPS) + 1))
    hits = np.concatenate([m.hits for m in matches])[order]
    scores = np.concatenate([m.outcome_scores for m in matches])[order]
    table = np.full((len(labels), len(OVERLAPS)), math.nan)
    for row in np.flatnonzero(instances):
        for column in range(len(OVERLAPS)):
            cell = row * len(OVERLAPS) + column
            part = slice(starts[cell], starts[cell + 1])
            table[row, column] = average_precision(scores[part], hits[part], int(instances[row]))
    ranked = np.concatenate([m.scores for m in matches])
    # A group's names are rows of the table; none of them are scored without classes.
    members = {} if agnostic else {g: [labels.index(name) for name in n] for g, n in classes.groups.items()}
    return InstanceScores(
        scenes=len(matches),
        overall=_averages(table),
        classes={name: _averages(table[row : row + 1]) for row, name in enumerate(labels)},
        groups={group: _averages(table[rows]) for group, rows in members.items()},
        instances=instances,
        predictions=predictions,
        equal_scores=len(ranked) > 1 and bool((ranked == ranked[0]).all()),
        shared=sum(m.shared for m in matches),
    )


def _averages(table: Float64[np.ndarray, "c T"]) -> Averages:
    """Means over the classes of a table that have instances."""
    present = table[~np.isnan(table[:, 0])]
    columns = {"ap_25": OVERLAPS == 0.25, "ap_50": OVERLAPS == 0.5, "ap": OVERLAPS >= 0.5}
    return {name: float(present[:, which].mean()) if len(present) else math.nan for name, which in columns.items()}


MAX_LIST_BYTES = 64 << 20
"""Largest size of the list of a scene's masks."""
MAX_PATH = 1000
"""Largest number of characters of the path of a mask."""
MAX_ID = 2**31 - 1


def instance_ids_of_scan(folder: Path, raw_ids: Mapping[str, int], classes: ClassTable) -> Int64[np.ndarray, " V"]:
    """The instance of each vertex of a scan's mesh; objects of no scored class have their number alone."""
    labels = labels_of_scan(folder, raw_ids)
    names = dict(labels.objects)
    return instance_ids(labels.instances, names, ids_of_names(names.values(), raw_ids, classes))


def match_instance_files(
    predictions: Path,
    labels: Path,
    classes: ClassTable,
    *,
    scenes: Collection[str] | None = None,
    raw_ids: Mapping[str, int] | None = None,
    class_agnostic: bool = False,
) -> Iterator[SceneMatches]:
    """Matches the predictions of a folder with the labels of another, one scene in memory at a time."""
    suffixes = (".txt", ".npz")
    for files in scene_files(predictions, labels, scenes=scenes, suffixes=suffixes, scans=raw_ids is not None):
        if raw_ids is None:
            ids = read_instance_ids(files.labels)
        else:
            ids = instance_ids_of_scan(files.labels, raw_ids, classes)
        masks = read_instance_prediction(files.prediction, num_vertices=len(ids))
        with error_prefix(files.prediction):
            yield match_instances(ids, masks, classes, class_agnostic=class_agnostic)


def read_instance_ids(path: Path) -> Int64[np.ndarray, " V"]:
    """Reads the instance of each vertex of a scene: class id · 1000 + number."""
    ids = read_integer_lines(path, hint="; predictions and truth may be swapped")
    if not len(ids):
        raise InputError(f"{path}: no vertices; expected one whole number for each")
    return ids


def read_instance_prediction(path: Path, *, num_vertices: int) -> InstancePrediction:
    """Reads the masks of a scene, which is named as the file."""
    if path.suffix == ".npz":
        return _read_npz(path, num_vertices)
    lines = read_checked_text(path, max_bytes=MAX_LIST_BYTES).splitlines()
    first: dict[Path, int] = {}
    vertices, labels, scores = [], [], []
    for number, line in enumerate(lines, start=1):
        where, words = f"{path}: line {number}", line.split()
        if len(words) != 3:
            hint = "; predictions and truth may be swapped" if len(words) == 1 else ""
            raise InputError(f"{where}: expected a mask file, a class id and a score, got {line[:60]!r}{hint}")
        if len(words[0]) > MAX_PATH:
            raise InputError(f"{where}: expected a mask file, got a name of {len(words[0]):,} characters")
        file = PurePosixPath(words[0])
        try:
            mask_path = (path.parent / file).resolve()
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(f"{where}: the mask {words[0][:80]!r} cannot be read: {error}") from error
        if file.is_absolute() or not mask_path.is_relative_to(path.parent.resolve()):
            raise InputError(f"{where}: the mask {words[0][:80]!r} is not below {path.parent}")
        if mask_path in first:
            raise InputError(f"{where}: the mask {words[0][:80]!r} is that of line {first[mask_path]} already")
        first[mask_path] = number
        labels.append(_label(words[1], where))
        scores.append(_score(words[2], where))
        with error_prefix(where):
            mask = read_mask(mask_path)
        if len(mask) != num_vertices:
            raise InputError(
                f"{where}: the mask {words[0][:80]!r} has {len(mask):,} lines, and the scene {num_vertices:,} vertices"
            )
        vertices.append(np.flatnonzero(mask))
    return InstancePrediction(
        scene=path.stem,
        num_vertices=num_vertices,
        masks=tuple(vertices),
        labels=np.array(labels, np.int64),
        scores=np.array(scores, np.float64),
    )


def write_instance_prediction(folder: Path, prediction: InstancePrediction) -> None:
    """Writes the masks of a scene as SCENE.npz."""
    masks = np.zeros((prediction.num_vertices, len(prediction.labels)), bool)
    for index, rows in enumerate(prediction.masks):
        masks[rows, index] = True
    data = io.BytesIO()
    np.savez_compressed(data, pred_masks=masks, pred_classes=prediction.labels, pred_scores=prediction.scores)
    write_bytes(folder / f"{prediction.scene}.npz", data.getvalue())


def _read_npz(path: Path, num_vertices: int) -> InstancePrediction:
    arrays = read_npz(path, {"pred_masks": ("b", 2), "pred_classes": ("i", 1), "pred_scores": ("f", 1)})
    masks, labels, scores = arrays["pred_masks"], arrays["pred_classes"], arrays["pred_scores"]
    if len(masks) != num_vertices:
        turned = "; transpose it" if masks.shape[1] == num_vertices else ""
        raise InputError(
            f"{path}: pred_masks is {masks.shape[0]:,} × {masks.shape[1]:,}, and the scene has {num_vertices:,} "
            f"vertices; expected vertices × masks{turned}"
        )
    if not len(labels) == len(scores) == masks.shape[1]:
        raise InputError(
            f"{path}: {masks.shape[1]} masks, {len(labels)} pred_classes and {len(scores)} pred_scores; expected as "
            "many of each"
        )
    with error_prefix(path):
        return prediction_of_masks(
            path.stem, np.ascontiguousarray(masks.T), labels.tolist(), scores.tolist(), num_vertices=num_vertices
        )


def _label(word: str, where: str) -> int:
    """A class id; ScanNet's script takes 5.0 for 5."""
    value = _number(word)
    if not abs(value) <= MAX_ID or value != int(value):
        raise InputError(f"{where}: expected a whole number as the class id, got {word[:40]!r}")
    return int(value)


def _score(word: str, where: str) -> float:
    value = _number(word)
    if not math.isfinite(value):
        raise InputError(f"{where}: expected a finite number as the score, got {word[:40]!r}")
    return value


def _number(word: str) -> float:
    """A number, NaN where it is none: Python reads 1_000 as one, and other tools do not."""
    try:
        return math.nan if "_" in word else float(word)
    except ValueError:
        return math.nan
