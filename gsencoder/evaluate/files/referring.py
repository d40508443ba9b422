"""Files of boxes of sentences, in ScanRefer's format: lists of JSON objects with scene_id, object_id, ann_id and bbox.

A bbox is a list of the eight corners of an axis-aligned box, of which the lowest and highest coordinates count, or of
its lower and upper corner. In truth, unique_multiple is 1 if the scene has several objects of the class, and others is
1 if the class is none of the named ones; ScanRefer's own tool reads both from the prediction, and so does this one
where the truth has none. A truth whose bbox is null is not scored. A prediction may have bboxes, a list of boxes with
the likeliest first, in place of or beside bbox, which is then the first of them; [] or null stands for nothing found.
"""

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import about
from gsencoder.core.files.json_values import write_json
from gsencoder.evaluate.files.json_entries import Entry, read_entries, shown
from gsencoder.evaluate.scores.referring import (
    PredictedBoxes,
    ReferredObject,
    ReferringResult,
    compare_boxes,
    described,
)

MAX_COORDINATE = 1e9
"""Larger coordinates are no places."""
MAX_BOXES = 10_000
"""Largest number of boxes of one sentence."""


def compare_box_files(
    predictions: Path, truth: Path, *, allow_missing: bool = False
) -> tuple[tuple[ReferringResult, ...], dict[str, int]]:
    """Reads predictions and truth, and computes the IoUs of every sentence, as `compare_boxes` does.

    Raises:
        InputError: a file that cannot be used, or what `compare_boxes` refuses.
    """
    true, found = read_referring_truth(truth), read_referring_predictions(predictions)
    with about(predictions):
        return compare_boxes(found, true, allow_missing=allow_missing)


def read_referring_truth(path: Path) -> tuple[ReferredObject, ...]:
    """Reads the box of each sentence's object.

    Raises:
        InputError: not such a file, a sentence that is there twice, or a box that is none.
    """
    entries, items = read_entries(path), []
    for entry in entries:
        if "bboxes" in entry:
            raise entry.error("unexpected key 'bboxes'; predictions and truth may be swapped")
        if "bbox" not in entry:
            raise entry.error("bbox is missing; expected the box of the object, or null if it has none")
        box = entry.values["bbox"]
        items.append(
            ReferredObject(
                scene=entry.word("scene_id"),
                object=entry.number_word("object_id"),
                annotation=entry.number_word("ann_id"),
                box=None if box is None else _box(box, "bbox", entry),
                multiple=entry.flag("unique_multiple"),
                others=entry.flag("others"),
            )
        )
    _refuse_twice(entries, [item.key for item in items])
    return tuple(items)


def read_referring_predictions(path: Path) -> tuple[PredictedBoxes, ...]:
    """Reads the boxes predicted for each sentence.

    Raises:
        InputError: not such a file, a sentence that is there twice, or a box that is none.
    """
    entries, items = read_entries(path), []
    for entry in entries:
        for key in ("description", "token", "object_name"):
            if key in entry:
                raise entry.error(f"unexpected key {key!r} of the truth; predictions and truth may be swapped")
        items.append(
            PredictedBoxes(
                scene=entry.word("scene_id"),
                object=entry.number_word("object_id"),
                annotation=entry.number_word("ann_id"),
                boxes=_boxes(entry),
                multiple=entry.flag("unique_multiple"),
                others=entry.flag("others"),
            )
        )
    _refuse_twice(entries, [item.key for item in items])
    return tuple(items)


def write_referring_truth(path: Path, truth: Sequence[ReferredObject]) -> None:
    """Writes truth, boxes as eight corners."""
    rows = [
        {
            "scene_id": item.scene,
            "object_id": item.object,
            "ann_id": item.annotation,
            "bbox": None if item.box is None else _corners(item.box),
            **_flags(item.multiple, item.others),
        }
        for item in truth
    ]
    write_json(path, rows)


def write_referring_predictions(path: Path, predictions: Sequence[PredictedBoxes]) -> None:
    """Writes predictions, boxes as eight corners. ScanRefer's tool takes the file if each sentence has a box and both
    `multiple` and `others`."""
    rows = []
    for item in predictions:
        corners = [_corners(box) for box in item.boxes]
        rows.append(
            {
                "scene_id": item.scene,
                "object_id": item.object,
                "ann_id": item.annotation,
                "bbox": corners[0] if corners else None,
                "bboxes": corners,
                **_flags(item.multiple, item.others),
            }
        )
    write_json(path, rows)


def _boxes(entry: Entry) -> Float64[np.ndarray, "K 2 3"]:
    if "bbox" not in entry and "bboxes" not in entry:
        raise entry.error("bbox is missing; expected a box, or null if nothing was found")
    first, several = entry.values.get("bbox"), entry.values.get("bboxes")
    single = [] if first is None else [_box(first, "bbox", entry)]
    if "bboxes" not in entry or several is None:
        found = single
    else:
        if not isinstance(several, list) or len(several) > MAX_BOXES:
            got = f"{len(several):,}" if isinstance(several, list) else shown(several)
            raise entry.error(f"bboxes must be a list of at most {MAX_BOXES:,} boxes, got {got}")
        found = [_box(box, f"bboxes[{index}]", entry) for index, box in enumerate(several)]
        if single and not (found and np.array_equal(single[0], found[0])):
            raise entry.error("bbox is not the first of bboxes")
    return np.array(found, np.float64).reshape(len(found), 2, 3)


def _box(value: Any, key: str, entry: Entry) -> Float64[np.ndarray, "2 3"]:
    rows = value if isinstance(value, list) else []
    if len(rows) not in (2, 8) or any(not isinstance(row, list) or len(row) != 3 for row in rows):
        raise entry.error(f"{key} must be eight corners, or a lower and an upper one, of three numbers each")
    for number in itertools.chain(*rows):
        good = isinstance(number, (int, float)) and not isinstance(number, bool)
        if not good or abs(number) > MAX_COORDINATE or not math.isfinite(number):
            raise entry.error(f"{key} has {shown(number)} where a finite number is expected")
    corners = np.array(rows, np.float64)
    if len(corners) == 2 and (corners[0] > corners[1]).any():
        raise entry.error(f"{key}: the lower corner {corners[0].tolist()} is not below the upper {corners[1].tolist()}")
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def _corners(box: Float64[np.ndarray, "2 3"]) -> list[list[float]]:
    return [[x, y, z] for x, y, z in itertools.product(*box.T.tolist())]


def _flags(multiple: bool | None, others: bool | None) -> dict[str, int]:
    known = {"unique_multiple": multiple, "others": others}
    return {key: int(value) for key, value in known.items() if value is not None}


def _refuse_twice(entries: Sequence[Entry], keys: Sequence[tuple[str, str, str]]) -> None:
    seen: set[tuple[str, str, str]] = set()
    for entry, key in zip(entries, keys, strict=True):
        if key in seen:
            raise entry.error(f"{described(key)} is there already; expected each once")
        seen.add(key)
