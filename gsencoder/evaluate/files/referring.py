"""Files of boxes of sentences: truth in ScanRefer's own format, and predictions in that of its benchmark.

Truth is ScanRefer's list of {scene_id, object_id, object_name, ann_id, description, token}, which `read_scanrefer`
reads. The box of the object may stand there as bbox, and unique_multiple and others as in predictions; what is not
there comes from the labels of the scans and from ScanNet's label map. A prediction is {scene_id, object_id, ann_id,
bbox, unique_multiple, others}; the last two are optional, and are taken where the truth does not say them, as
ScanRefer's own tool takes them. A bbox is a list of the eight corners of an axis-aligned box, or of its lower and upper
corner. A prediction may have bboxes, a list of boxes with the likeliest first, in place of or beside bbox, which is
then the first of them; [] or null stands for no box.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, about
from gsencoder.core.files import write_json
from gsencoder.data.labels.classes import COLUMNS, read_label_map
from gsencoder.data.labels.expressions import boxes_from_scans, described, read_scanrefer
from gsencoder.data.labels.files import (
    Corner,
    Entry,
    annotation_id,
    box_corners,
    corner_bounds,
    entries_of,
    flag_value,
    object_id,
    read_benchmark_json,
    refuse_repeated,
    scene_name,
    shown,
)
from gsencoder.evaluate.scores.referring import (
    PredictedBoxes,
    ReferredObject,
    ReferringResult,
    compare_boxes,
    referred_objects,
)
from gsencoder.evaluate.scores.referring_kinds import named_classes, with_kinds

MAX_BOXES = 10_000
"""Largest number of boxes of one sentence."""
EXPECTED = "scene_id, object_id, ann_id and bbox"


def compare_box_files(
    predictions: Path,
    truth: Path,
    *,
    label_map: Path | None = None,
    scans: Path | None = None,
    allow_missing: bool = False,
) -> tuple[tuple[ReferringResult, ...], dict[str, int]]:
    """Reads predictions and truth, and computes the IoUs of every sentence, as `compare_boxes` does.

    Args:
        predictions: JSON of boxes by sentence.
        truth: see `read_referring_truth`.
        label_map: see there.
        scans: see there.
        allow_missing: see `compare_boxes`.

    Raises:
        InputError: a file that cannot be used, or what `compare_boxes` refuses.
    """
    boxes = read_referring_predictions(predictions)
    objects = read_referring_truth(truth, label_map=label_map, scans=scans)
    with about(predictions):
        return compare_boxes(boxes, objects, allow_missing=allow_missing)


def read_referring_truth(
    path: Path, *, label_map: Path | None = None, scans: Path | None = None
) -> tuple[ReferredObject, ...]:
    """Reads the objects of ScanRefer's sentences.

    Args:
        path: ScanRefer's JSON of a whole split, whose sentences say which objects are alone in their class.
        label_map: scannetv2-labels.combined.tsv, which gives raw names ScanRefer's classes where the file does not say
            unique_multiple; without it, sentences are neither unique nor multiple.
        scans: folder of ScanNet's scans, whose labels have the boxes that the file does not have.

    Raises:
        InputError: not such a file, or no sentence has a box.
    """
    expressions = read_scanrefer(path)
    if scans is not None:
        expressions = boxes_from_scans(expressions, scans)
    if expressions and all(each.aabb is None for each in expressions):
        raise InputError(
            f"{path}: no sentence has a box (bbox), as in ScanRefer's own files; the folder of ScanNet's scans has "
            "them (scans=)"
        )
    if label_map is not None:
        mapping = read_label_map(label_map, COLUMNS["scannet20"])
        expressions = with_kinds(expressions, named_classes((each.object_name for each in expressions), mapping))
    return referred_objects(expressions)


def read_referring_predictions(path: Path) -> tuple[PredictedBoxes, ...]:
    """Reads the boxes predicted for each sentence.

    Raises:
        InputError: not such a file, a sentence that is there twice, or a box that is none.
    """
    boxes = []
    for row in entries_of(read_benchmark_json(path), path, EXPECTED):
        entry, where = row
        for key in ("description", "token", "object_name"):
            if key in entry:
                raise InputError(f"{where}: unexpected key {key!r} of the truth; predictions and truth may be swapped")
        boxes.append(
            PredictedBoxes(
                scene=scene_name(entry.get("scene_id"), where),
                object=str(object_id(entry.get("object_id"), where)),
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
        corners = [box_corners(_corner(lower), _corner(upper)) for lower, upper in item.boxes]
        flags = {"unique_multiple": item.multiple, "others": item.others}
        rows.append(
            {
                "scene_id": item.scene,
                "object_id": item.object,
                "ann_id": item.annotation,
                "bbox": corners[0] if corners else None,
                "bboxes": corners,
                **{key: int(value) for key, value in flags.items() if value is not None},
            }
        )
    write_json(path, rows)


def _corner(values: Float64[np.ndarray, "3"]) -> Corner:
    x, y, z = values.tolist()
    return x, y, z


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
            actual = f"{len(several):,}" if isinstance(several, list) else shown(several)
            raise InputError(f"{where}: bboxes must be a list of at most {MAX_BOXES:,} boxes, got {actual}")
        boxes = [corner_bounds(box, where, f"bboxes[{index}]") for index, box in enumerate(several)]
        if single and single != boxes[:1]:
            raise InputError(f"{where}: bbox is not the first of bboxes")
    return np.array(boxes, np.float64).reshape(len(boxes), 2, 3)
