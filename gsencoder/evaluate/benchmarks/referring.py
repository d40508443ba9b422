"""Objects that a sentence refers to: the share of the sentences whose box has an IoU of 0.25, or 0.5, or more.

ScanRefer's metric (Chen et al. 2020; `benchmark/eval.py` and `scripts/eval.py`), also for the unique, the multiple and
the other sentences alone. A sentence without a predicted box has the IoU 0. A method that finds several boxes is also
scored by the best of the first five, and of all, as SplatDistill does for its table 5 (sec. 4.5). A user cannot know
which box that is.

The class of an object is that of its raw name: one of 17 named classes, or *others*, which is one class. A sentence is
*unique* if its object is the only one of its class among the objects that the sentences of its scene describe, else
*multiple* (ScanRefer's lib/dataset.py).

Labels are ScanRefer's list of {scene_id, object_id, object_name, ann_id, description, token}, which `read_scanrefer`
reads. The box of the object may stand there as bbox, and unique_multiple and others as in predictions; what is not
there comes from the labels of the scans and from ScanNet's label map. A prediction is {scene_id, object_id, ann_id,
bbox, unique_multiple, others}; the last two are optional, and are taken where the labels do not say them, as in
ScanRefer's own tool. A bbox is a list of the eight corners of an axis-aligned box, or of its lower and upper corner. A
prediction may have bboxes, a list of boxes with the likeliest first, in place of bbox, which is then the first of them;
[] or null stands for no box.

`evaluate protocol=referring` answers a sentence with the boxes of the words that the text table knows in it, the first
of them first, or of the whole sentence where a text tower can embed it. Without a file of sentences, the names of the
scene's objects are asked, one sentence an object.
"""

import math
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning, counted, error_prefix, listed
from gsencoder.core.files import write_json
from gsencoder.core.settings import option
from gsencoder.data.labels.classes import COLUMNS, ids_of_names, read_label_map, scannet_classes
from gsencoder.data.labels.expressions import (
    Expression,
    boxes_from_labels,
    boxes_from_scans,
    described,
    read_nr3d,
    read_scanrefer,
    write_scanrefer,
)
from gsencoder.data.labels.files import (
    Entry,
    annotation_id,
    box_corners,
    box_ious,
    brief,
    corner_bounds,
    entries_of,
    flag_value,
    object_id,
    read_benchmark_json,
    refuse_repeated,
    scene_name,
)
from gsencoder.data.labels.scans import find_labels, find_scannet_files
from gsencoder.evaluate.benchmarks.files import ScoreOptions
from gsencoder.evaluate.benchmarks.protocol import LABELS, PREDICTIONS, Benchmark, Evaluation, Protocol, SceneResult
from gsencoder.evaluate.tables import ScoreReport, grouped, spread, table_of
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.text.question_words import words_in
from gsencoder.text.vocabulary import Words, closed_table
from gsencoder.types import GaussianFeatures, Localization, MeshLabels, Scene

OPTIONS = ("label_map", "scans", "allow_missing")
IOUS = (0.25, 0.5)
"""IoUs from which on a box counts."""
BEST_OF = 5
"""Number of boxes of which the best counts in the paper's table."""
CANDIDATES = 10
"""Boxes that are predicted for each sentence."""
MAX_BOXES = 10_000
"""Largest number of boxes of one sentence."""
OTHERS = "others"
"""Class of the objects that are of none of the 17 named ones."""
UNNAMED = ("wall", "floor", "otherfurniture")
"""Those of ScanNet's 20 classes that are not among the 17."""
EXPECTED = "scene_id, object_id, ann_id and bbox"
NO_BOX = "the object has no box in the truth"
"""Reason for which a sentence is not scored."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferringProtocol(Protocol):
    """Which sentences are asked, and how."""

    name: Literal["referring"] = "referring"
    expressions: str = option(
        "", "sentences: ScanRefer's JSON or Nr3D's CSV; empty = the names of the scenes' small objects"
    )
    query: Literal["names", "sentence"] = option(
        "names", "what of a sentence is looked for: the names of the text table in it, or the whole"
    )

    def start(self, evaluation: Evaluation) -> "ReferringBenchmark":
        return ReferringBenchmark(self, evaluation)


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedBoxes:
    """The boxes predicted for one sentence, lower and upper corners, the likeliest first, and what its file
    says of `multiple` and `others`, as ScanRefer's own files do."""

    scene: str
    object_id: int
    annotation: str
    boxes: Float64[np.ndarray, "K 2 3"]
    multiple: bool | None = None
    others: bool | None = None

    @property
    def key(self) -> tuple[str, int, str]:
        return self.scene, self.object_id, self.annotation


Referred = tuple[tuple[Expression, ...], list[PredictedBoxes]]


class ReferringBenchmark(Benchmark[Referred]):
    def __init__(self, protocol: ReferringProtocol, evaluation: Evaluation) -> None:
        self.protocol, self.evaluation = protocol, evaluation
        self.raw_ids = (
            read_label_map(Path(evaluation.label_map), COLUMNS["scannet20"]) if evaluation.label_map else None
        )
        self.sentences: tuple[Expression, ...] = ()
        self.others: list[str] = []
        if protocol.expressions:
            self.sentences = read_expressions(Path(protocol.expressions))
            self.others = [each.scene for each in self.sentences if each.scene not in evaluation.scene_names]
        if self.others and len(self.others) == len(self.sentences):
            raise InputError(
                f"protocol.expressions: none of the {len(self.sentences)} sentences of {protocol.expressions} is about "
                f"a scene that is evaluated ({listed(sorted(evaluation.scene_names), 3)}); first {self.others[0]}"
            )

    def predict(self, scene: Scene, features: GaussianFeatures) -> Referred:
        mesh = None if scene.folder is None else find_labels(scene.folder)
        expressions = self._expressions(scene, mesh)
        # Boxes of a file are in the aligned frame of its scans, those of a scene's objects in its world.
        aligned = mesh.aligned_from_world if mesh is not None and self.sentences else None
        words, localization = self.evaluation.words, self.evaluation.localization
        return expressions, predict_referring(
            scene, features, expressions, words, self.protocol, localization, aligned_from_world=aligned
        )

    def report(self, results: Sequence[SceneResult[Referred]]) -> ScoreReport:
        """Writes and scores both lists."""
        if self.others:
            warnings.warn(
                f"{len(self.others)} of {len(self.sentences)} sentences do not count: they are about "
                f"{len(set(self.others))} scenes that are not evaluated (first: {self.others[0]})",
                SceneWarning,
                stacklevel=2,
            )
        ordered = sorted(results, key=lambda result: result.scene)
        labels, predictions = (self.evaluation.file(f"{name}.json") for name in (LABELS, PREDICTIONS))
        write_scanrefer(labels, [each for result in ordered for each in result.value[0]])
        write_referring_predictions(predictions, [each for result in ordered for each in result.value[1]])
        report = score(predictions, labels, ScoreOptions(method=self.evaluation.method))
        more = {"other_scenes": len(self.others)} if self.others else {}
        return replace(report, results={**report.results, **more})

    def _expressions(self, scene: Scene, mesh: MeshLabels | None) -> tuple[Expression, ...]:
        """The sentences about a scene, with the boxes of a ScanNet scan's labels where they have none, and with what is
        known of their kinds: by ScanNet's label map, or by the names themselves where the names are what is asked."""
        if not self.sentences:
            expressions = expressions_of_objects(scene)
            return with_kinds(expressions, {each.object_name: each.object_name for each in expressions})
        expressions = tuple(each for each in self.sentences if each.scene == scene.name)
        lacking = any(each.aabb is None for each in expressions)
        if lacking and mesh is not None and scene.folder is not None and find_scannet_files(scene.folder) is not None:
            expressions = boxes_from_labels(expressions, mesh)
        if self.raw_ids is None:
            return expressions
        return with_kinds(expressions, named_classes((each.object_name for each in expressions), self.raw_ids))


def read_expressions(path: Path) -> tuple[Expression, ...]:
    """ScanRefer's JSON, or Nr3D's CSV by its ending."""
    return read_nr3d(path) if path.suffix.lower() == ".csv" else read_scanrefer(path)


def expressions_of_objects(scene: Scene) -> tuple[Expression, ...]:
    """A sentence for each named small object of a scene: its name, with its box in the world's axes."""
    return tuple(
        Expression(
            scene=scene.name,
            object_id=each.id,
            object_name=each.name,
            annotation="0",
            text=each.name,
            tokens=tuple(each.name.split()),
            aabb=(tuple(each.aabb_min.tolist()), tuple(each.aabb_max.tolist())),
        )
        for each in scene.objects
        if each.name and each.placed
    )


def predict_referring(
    scene: Scene,
    features: GaussianFeatures,
    expressions: Sequence[Expression],
    text: Words,
    protocol: ReferringProtocol = ReferringProtocol(),
    localization: LocalizeConfig = LocalizeConfig(),
    *,
    aligned_from_world: Float64[np.ndarray, "4 4"] | None = None,
) -> list[PredictedBoxes]:
    """The boxes of each sentence about a scene, the most probable first; none where no word of it is known or present.

    Args:
        protocol: what of a sentence is looked for.
        aligned_from_world: rigid transform into the frame in which true boxes are axis-aligned; None = the world.
    """
    table = closed_table(text)
    # Each sentence has the boxes of its first known word, or of itself.
    words = {
        each: each.text if protocol.query == "sentence" else next(iter(words_in(each.text, table)), "")
        for each in expressions
    }
    asked = list(dict.fromkeys(filter(None, words.values())))
    corners: dict[str, list[Float64[np.ndarray, "2 3"]]] = {}
    if asked:
        with_features = replace(scene, features={features.space.name: features})
        with warnings.catch_warnings():
            # Sentences without a box are counted in the result.
            warnings.simplefilter("ignore", SceneWarning)
            localized = localize(with_features, asked, text, localization)
        corners = corners_of_words(scene, localized, aligned_from_world)
    return [
        PredictedBoxes(
            scene=each.scene,
            object_id=each.object_id,
            annotation=each.annotation,
            boxes=np.array(corners.get(words[each], [])[:CANDIDATES], np.float64).reshape(-1, 2, 3),
        )
        for each in expressions
    ]


def corners_of_words(
    scene: Scene, localization: Localization, aligned_from_world: Float64[np.ndarray, "4 4"] | None = None
) -> dict[str, list[Float64[np.ndarray, "2 3"]]]:
    """Lower and upper corners of the boxes of each word, best first, along the axes of the aligned frame."""
    corners: dict[str, list[Float64[np.ndarray, "2 3"]]] = {}
    for box in localization.boxes:
        if aligned_from_world is None:
            pair = np.stack([box.aabb_min, box.aabb_max])
        else:
            assert scene.gaussians is not None
            world = scene.gaussians.means[box.rows].astype(np.float64) + scene.origin
            points = world @ aligned_from_world[:3, :3].T + aligned_from_world[:3, 3]
            pair = np.stack([points.min(axis=0), points.max(axis=0)])
        corners.setdefault(box.query, []).append(pair)
    return corners


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferringResult:
    """One sentence, scored: the IoUs of the predicted boxes with that of its object, whether its scene has several
    objects of its class, and whether its class is none of the named ones; None if that is not known."""

    scene: str
    object_id: int
    annotation: str
    ious: tuple[float, ...]
    multiple: bool | None
    others: bool | None


ReferringTable = dict[str, dict[str, dict[str, Any]]]
"""Accuracies by "unique", "multiple" and "overall", and there by "not_in_others", "in_others" and "overall": sentences,
acc25 and acc50, which are NaN without sentences, where the official script prints 0."""


def score(predictions: Path, labels: Path, options: ScoreOptions) -> ScoreReport:
    """Accuracy of the boxes of sentences."""
    boxes = read_referring_predictions(predictions)
    expressions = read_referring_labels(
        labels,
        label_map=Path(options.label_map) if options.label_map else None,
        scans=Path(options.scans) if options.scans else None,
    )
    with error_prefix(predictions):
        sentences = compare_boxes(boxes, expressions, allow_missing=options.allow_missing)
    if not sentences:
        raise InputError(f"{labels}: nothing to score: it holds no sentence about an object with a box")
    first, best_of, best = (referring_scores(sentences, k) for k in (1, BEST_OF, None))
    by_scene = [
        {"scene": scene, "sentences": len(each), **_accuracies(referring_scores(each))}
        for scene, each in grouped(sentences, "scene").items()
    ]
    tables = {"": first, f", best of {BEST_OF}": best_of, ", best of all": best}
    measured = {f"{options.method}{kind}": _accuracies(each) | _by_uniqueness(each) for kind, each in tables.items()}
    overall = measured[options.method]
    without_box = sum(not each.ious for each in sentences)
    unscored = {NO_BOX: len(expressions) - len(sentences)} if len(sentences) < len(expressions) else {}
    notes = [f"{counted(count, 'sentence')} not scored: {reason}." for reason, count in unscored.items()]
    if unknown := sum(each.multiple is None for each in sentences):
        notes.append(
            f"{counted(unknown, 'sentence')} in the overall columns alone: neither file says what is unique and what "
            "multiple, which ScanNet's label map tells (label_map=)."
        )
    return ScoreReport(
        results={
            "protocol": "referring",
            "sentences": len(sentences),
            "without_box": without_box,
            "not_scored": unscored,
            "thresholds": list(IOUS),
            **overall,
            "best_of": {str(BEST_OF): _accuracies(best_of), "all": _accuracies(best)},
            "tables": {"top_1": first, "best": best},
            "spread": spread(by_scene, ["acc_25", "acc_50"]),
        },
        table=table_of("Referring", measured, published="splatdistill_5_referring", notes=notes),
        rows={
            "scenes": by_scene,
            "sentences": [
                {
                    "scene": each.scene,
                    "object": str(each.object_id),
                    "annotation": each.annotation,
                    "iou": each.ious[0] if each.ious else 0.0,
                    "best_iou": max(each.ious, default=0.0),
                    "multiple": each.multiple,
                }
                for each in sentences
            ],
        },
        line=f"{counted(len(sentences), 'sentence')}: Acc@0.25 {overall['acc_25']:.3f}, Acc@0.5 "
        f"{overall['acc_50']:.3f}; {without_box} without a box; of all boxes the best: "
        + ", ".join(f"{value:.3f}" for value in _accuracies(best).values()),
    )


def _accuracies(table: ReferringTable) -> dict[str, float]:
    cell = table["overall"]["overall"]
    return {"acc_25": cell["acc25"], "acc_50": cell["acc50"]}


def _by_uniqueness(table: ReferringTable) -> dict[str, float]:
    return {f"{kind}_{k}": table[kind]["overall"][f"acc{k}"] for kind in ("unique", "multiple") for k in (25, 50)}


def compare_boxes(
    predictions: Sequence[PredictedBoxes], sentences: Sequence[Expression], *, allow_missing: bool = False
) -> tuple[ReferringResult, ...]:
    """The IoUs of every sentence whose object has a box, in order.

    What predictions say of `multiple` and `others` is taken where the sentences do not say it, and must not contradict
    them. A sentence without a prediction is refused, or with `allow_missing` counts as one without a box.
    """
    prediction_of = {prediction.key: prediction for prediction in predictions}
    keys = {item.key for item in sentences}
    unknown = next((key for key in prediction_of if key not in keys), None)
    if unknown is not None:
        raise InputError(f"{described(unknown)} is predicted, and not in the truth")
    results = []
    for item in sentences:
        if item.aabb is None:
            continue
        prediction = prediction_of.get(item.key)
        if prediction is None and not allow_missing:
            raise InputError(f"{described(item.key)} has no prediction")
        ious: tuple[float, ...] = ()
        multiple, others = item.multiple, item.others
        if prediction is not None:
            ious = tuple(box_ious(prediction.boxes, np.array(item.aabb, np.float64)).tolist())
            multiple = _agreed(multiple, prediction.multiple, "unique_multiple", item.key)
            others = _agreed(others, prediction.others, "others", item.key)
        results.append(
            ReferringResult(
                scene=item.scene,
                object_id=item.object_id,
                annotation=item.annotation,
                ious=ious,
                multiple=multiple,
                others=others,
            )
        )
    return tuple(results)


def referring_scores(results: Sequence[ReferringResult], k: int | None = 1) -> ReferringTable:
    """The scores of sentences of any scenes, by the best of the first k boxes of each; None = of all.

    Those whose `multiple` or `others` is not known count in "overall" alone.
    """
    ious = np.array([max(each.ious[:k], default=0.0) for each in results], np.float64)
    multiple, others = ([getattr(each, name) for each in results] for name in ("multiple", "others"))

    def cell(rows: list[bool]) -> dict[str, Any]:
        inside = ious[np.array(rows, bool)]
        acc25, acc50 = (float((inside >= least).mean()) if len(inside) else math.nan for least in IOUS)
        return {"sentences": len(inside), "acc25": acc25, "acc50": acc50}

    return {
        subset: {
            kind: cell([row in subsets and each in kinds for row, each in zip(multiple, others, strict=True)])
            for kind, kinds in (("not_in_others", [False]), ("in_others", [True]), ("overall", [False, True, None]))
        }
        for subset, subsets in (("unique", [False]), ("multiple", [True]), ("overall", [False, True, None]))
    }


def _agreed(true: bool | None, predicted: bool | None, subject: str, key: tuple[str, int, str]) -> bool | None:
    if true is not None and predicted is not None and true != predicted:
        raise InputError(
            f"{described(key)}: {subject} is {int(predicted)} in the prediction, and {int(true)} in the truth"
        )
    return predicted if true is None else true


def named_classes(names: Iterable[str], nyu40_ids: Mapping[str, int]) -> dict[str, str]:
    """ScanRefer's class of each raw name: one of 17 of ScanNet's 20 classes, or `OTHERS`.

    Its `lib/dataset.py` takes the column nyu40class of scannetv2-labels.combined.tsv, of which nyu40id is the number.

    Warns:
        SceneWarning: names that the map does not have; they are counted, and are others.
    """
    plain = {name: name.replace("_", " ") for name in names}
    classes = scannet_classes("scannet20").without(UNNAMED)
    ids, name_of = ids_of_names(plain.values(), nyu40_ids, classes), classes.name_of
    return {name: name_of.get(ids[raw], OTHERS) for name, raw in plain.items()}


def with_kinds(expressions: Sequence[Expression], class_of: Mapping[str, str]) -> tuple[Expression, ...]:
    """Expressions that say `multiple` and `others`; those that say it already keep it."""
    kinds = [class_of[each.object_name] for each in expressions]
    keys = [(each.scene, str(each.object_id), kind) for each, kind in zip(expressions, kinds, strict=True)]
    return tuple(
        replace(
            each,
            multiple=multiple if each.multiple is None else each.multiple,
            others=kind == OTHERS if each.others is None else each.others,
        )
        for each, kind, multiple in zip(expressions, kinds, several_of_their_class(keys), strict=True)
    )


def several_of_their_class(objects: Sequence[tuple[str, str, str]]) -> tuple[bool, ...]:
    """Whether the objects of the class of each sentence in its scene are not exactly one, as ScanRefer counts them."""
    first: dict[tuple[str, str], str] = {}
    for scene, item, name in objects:
        first.setdefault((scene, item), name)
    counts = Counter((scene, name) for (scene, _), name in first.items())
    return tuple(counts[scene, name] != 1 for scene, _, name in objects)


def read_referring_labels(
    path: Path, *, label_map: Path | None = None, scans: Path | None = None
) -> tuple[Expression, ...]:
    """Reads ScanRefer's sentences with the boxes and kinds of their objects."""
    expressions = read_scanrefer(path)
    if scans is not None:
        expressions = boxes_from_scans(expressions, scans)
    if expressions and all(each.aabb is None for each in expressions):
        raise InputError(
            f"{path}: no sentence has a box (bbox), as in ScanRefer's own files; the folder of ScanNet's scans has "
            "them (scans=)"
        )
    if label_map is None:
        return expressions
    raw_ids = read_label_map(label_map, COLUMNS["scannet20"])
    return with_kinds(expressions, named_classes((each.object_name for each in expressions), raw_ids))


def read_referring_predictions(path: Path) -> tuple[PredictedBoxes, ...]:
    """Reads the boxes predicted for each sentence."""
    boxes = []
    for row in entries_of(read_benchmark_json(path), path, EXPECTED):
        entry, where = row
        for key in ("description", "token", "object_name"):
            if key in entry:
                raise InputError(f"{where}: unexpected key {key!r} of the truth; predictions and truth may be swapped")
        boxes.append(
            PredictedBoxes(
                scene=scene_name(entry.get("scene_id"), where),
                object_id=object_id(entry.get("object_id"), where),
                annotation=annotation_id(entry.get("ann_id"), where),
                boxes=_boxes(row),
                multiple=flag_value(entry.get("unique_multiple"), where, "unique_multiple"),
                others=flag_value(entry.get("others"), where, "others"),
            )
        )
    refuse_repeated(path, [each.key for each in boxes], described)
    return tuple(boxes)


def write_referring_predictions(path: Path, predictions: Sequence[PredictedBoxes]) -> None:
    """Writes predictions, boxes as eight corners. ScanRefer's tool takes the file if each sentence has a box and both
    `multiple` and `others`."""
    rows = []
    for item in predictions:
        corners = [box_corners(tuple(lower), tuple(upper)) for lower, upper in item.boxes.tolist()]
        flags = {"unique_multiple": item.multiple, "others": item.others}
        rows.append(
            {
                "scene_id": item.scene,
                "object_id": str(item.object_id),
                "ann_id": item.annotation,
                "bbox": corners[0] if corners else None,
                "bboxes": corners,
                **{key: int(value) for key, value in flags.items() if value is not None},
            }
        )
    write_json(path, rows)


def _boxes(row: Entry) -> Float64[np.ndarray, "K 2 3"]:
    entry, where = row
    if "bbox" not in entry and "bboxes" not in entry:
        raise InputError(f"{where}: bbox is missing; expected a box, or null if there is none")
    first, several = entry.get("bbox"), entry.get("bboxes")
    single = [] if first is None else [corner_bounds(first, where, "bbox")]
    if several is None:
        boxes = single
    else:
        if not isinstance(several, list) or len(several) > MAX_BOXES:
            actual = f"{len(several):,}" if isinstance(several, list) else brief(several)
            raise InputError(f"{where}: bboxes must be a list of at most {MAX_BOXES:,} boxes, got {actual}")
        boxes = [corner_bounds(box, where, f"bboxes[{index}]") for index, box in enumerate(several)]
        if single and single != boxes[:1]:
            raise InputError(f"{where}: bbox is not the first of bboxes")
    return np.array(boxes, np.float64).reshape(len(boxes), 2, 3)
