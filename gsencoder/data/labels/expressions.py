"""Expressions that refer to one object of a scene: ScanRefer, Nr3D, and Scan2Cap's captions, in their own files.

ScanRefer (Chen et al. 2020): ScanRefer_filtered_{train,val}.json, a list of {scene_id, object_id, object_name, ann_id,
description, token}. Scan2Cap's benchmark adds to each entry the box of the object as `bbox`, eight corners
(ScanRefer_filtered_{train,val}_gt_bbox.json). ScanRefer's predictions say unique_multiple (1 if the scene has several
objects of the class) and others (1 if the class is none of the named ones), and both may stand here as well. Nr3D
(ReferIt3D, Achlioptas et al. 2020): nr3d.csv.

Boxes of the objects that expressions refer to, from the labels of ScanNet's scans.

ScanRefer's own files have no boxes. Its scripts take that of an object's vertices along the axes of the aligned scan
(data/scannet/load_scannet_data.py), and so does this module.
"""

import ast
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import write_json
from gsencoder.data.labels.files import (
    LIST_BYTES,
    MAX_TEXT,
    Corner,
    Entry,
    annotation_id,
    box_corners,
    brief,
    corner_bounds,
    entries_of,
    flag_value,
    id_value,
    object_id,
    read_benchmark_json,
    read_rows,
    refuse_repeated,
    scene_name,
    text_list,
    text_value,
)
from gsencoder.data.labels.scans import read_scannet_labels
from gsencoder.types import MeshLabels

SCANREFER = "scene_id, object_id, object_name, ann_id, description and token"
NR3D_COLUMNS = ("assignmentid", "utterance", "instance_type", "scan_id", "target_id", "tokens")
"""Columns that are read of Nr3D."""
PREDICTED = ("answer_top10", "pred_answers_at10", "caption", "aabb", "boxes", "bboxes")
"""Keys that predictions have and annotations have not."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Expression:
    """What one annotator wrote of one object; None where the file does not say."""

    scene: str
    object_id: int  # `objectId` of ScanNet's aggregation file, from 0
    object_name: str  # as the file writes it; ScanRefer has underscores between words
    annotation: str  # id of the expression among those of the object
    text: str
    tokens: tuple[str, ...]  # the words of the text as the data set cuts it, lower case in ScanRefer
    aabb: tuple[Corner, Corner] | None = None  # of the object, in the axes of the aligned scan and its unit
    multiple: bool | None = None  # whether the scene has several objects of its class
    others: bool | None = None  # whether its class is none of ScanRefer's named ones

    @property
    def key(self) -> tuple[str, int, str]:
        """Scene, object and annotation, which together belong to one expression only."""
        return self.scene, self.object_id, self.annotation


def read_scanrefer(path: str | Path) -> tuple[Expression, ...]:
    """Reads ScanRefer's JSON, with or without boxes."""
    file = Path(path)
    rows = read_benchmark_json(file)
    if isinstance(rows, dict):
        raise InputError(
            f"{file}: expected a list of expressions with {SCANREFER}, got an object; were predictions and truth "
            "swapped?"
        )
    expressions = tuple(_scanrefer(entry) for entry in entries_of(rows, file, SCANREFER))
    _refuse_repeated(file, expressions)
    _check_objects(expressions, file)
    return expressions


def write_scanrefer(path: str | Path, expressions: Sequence[Expression]) -> None:
    """Writes expressions as ScanRefer's files have them, with boxes and kinds where these are known."""
    _refuse_repeated(Path(path), expressions)
    rows = [
        {
            "scene_id": each.scene,
            "object_id": str(each.object_id),
            "object_name": each.object_name,
            "ann_id": each.annotation,
            "description": each.text,
            "token": list(each.tokens),
        }
        | ({"bbox": box_corners(*each.aabb)} if each.aabb else {})
        | ({} if each.multiple is None else {"unique_multiple": int(each.multiple)})
        | ({} if each.others is None else {"others": int(each.others)})
        for each in expressions
    ]
    write_json(path, rows)


def read_nr3d(path: str | Path) -> tuple[Expression, ...]:
    """Reads Nr3D's CSV."""
    file = Path(path)
    expressions = tuple(_nr3d(row, where) for row, where in read_rows(file, NR3D_COLUMNS, max_bytes=LIST_BYTES))
    _refuse_repeated(file, expressions)
    return expressions


def described(key: tuple[str, int | str, str]) -> str:
    """An expression's name in messages, by scene, object and annotation."""
    return f"sentence {key[2][:40]} about object {key[1]} of {key[0]}"


def _scanrefer(row: Entry) -> Expression:
    entry, where = row
    if "description" not in entry:
        swapped = next((key for key in PREDICTED if key in entry), None)
        hint = f", got {swapped}: these are predictions" if swapped else ""
        raise InputError(
            f"{where}: expected an expression with a description{hint}; predictions and truth may be swapped"
        )
    box = entry.get("bbox")
    return Expression(
        scene=scene_name(entry.get("scene_id"), where),
        object_id=object_id(entry.get("object_id"), where),
        object_name=text_value(entry.get("object_name"), where, "object_name"),
        annotation=annotation_id(entry.get("ann_id"), where),
        text=text_value(entry["description"], where, "description"),
        tokens=text_list(entry.get("token"), where, "token", empty=True),
        aabb=None if box is None else corner_bounds(box, where, "bbox"),
        multiple=flag_value(entry.get("unique_multiple"), where, "unique_multiple"),
        others=flag_value(entry.get("others"), where, "others"),
    )


def _nr3d(row: Mapping[str, str], where: str) -> Expression:
    return Expression(
        scene=scene_name(row["scan_id"], where),
        object_id=object_id(row["target_id"], where, "target_id"),
        object_name=text_value(row["instance_type"], where, "instance_type"),
        annotation=id_value(row["assignmentid"], where, "assignmentid"),
        text=text_value(row["utterance"], where, "utterance"),
        tokens=_literal_tokens(row["tokens"], where),
    )


def _literal_tokens(text: str, where: str) -> tuple[str, ...]:
    """A list of words as Python writes it, which is what the file has; nothing is executed."""
    if len(text) > MAX_TEXT:
        raise InputError(f"{where}: tokens has {len(text):,} characters, expected at most {MAX_TEXT:,}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SyntaxWarning)
            warnings.simplefilter("ignore", DeprecationWarning)
            value = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, RecursionError, MemoryError):
        value = None
    if not isinstance(value, list):
        raise InputError(f"{where}: tokens must be a list of words such as ['the', 'chair'], got {brief(text)}")
    return text_list(value, where, "tokens", empty=True)


def _refuse_repeated(path: Path, expressions: Sequence[Expression]) -> None:
    refuse_repeated(path, [each.key for each in expressions], described)


def _check_objects(expressions: Sequence[Expression], path: Path) -> None:
    first: dict[tuple[str, int], int] = {}
    for index, each in enumerate(expressions):
        row = first.setdefault((each.scene, each.object_id), index)
        other = expressions[row]
        if (other.object_name, other.aabb) != (each.object_name, each.aabb):
            attribute = "names" if other.object_name != each.object_name else "boxes"
            raise InputError(
                f"{path}: entries {row} and {index} give object {each.object_id} of {each.scene} different {attribute}"
            )


def boxes_from_scans(expressions: Sequence[Expression], scans: Path) -> tuple[Expression, ...]:
    """Gives expressions, in order, without a box that of their object, from label files in SCANS/SCENE."""
    lacking: dict[str, list[int]] = {}
    for row, each in enumerate(expressions):
        if each.aabb is None:
            lacking.setdefault(each.scene, []).append(row)
    result = list(expressions)
    for scene, rows in lacking.items():
        labels = read_scannet_labels(scans / scene)
        if labels.aligned_from_world is None:
            warnings.warn(
                f"{scans / scene}: has no axisAlignment (in {scene}.txt), so boxes are in the raw scan's frame",
                SceneWarning,
                stacklevel=2,
            )
        for row, each in zip(rows, boxes_from_labels([expressions[row] for row in rows], labels), strict=True):
            result[row] = each
    return tuple(result)


def boxes_from_labels(expressions: Iterable[Expression], labels: MeshLabels) -> tuple[Expression, ...]:
    """Gives expressions about one scene without a box that of their object in a ScanNet scan.

    An object whose vertices all belong to others has no box.
    """
    boxes = labels.boxes(aligned=True)
    ids = {number for number, _ in labels.objects}
    result = []
    for each in expressions:
        # Labels have objectId + 1, so that 0 is none.
        number = each.object_id + 1
        if number not in ids:
            raise InputError(f"{each.scene}: its labels have no object with the objectId {each.object_id}")
        if each.aabb is None and number in boxes:
            (x0, y0, z0), (x1, y1, z1) = (corner.tolist() for corner in boxes[number])
            each = replace(each, aabb=((x0, y0, z0), (x1, y1, z1)))
        result.append(each)
    return tuple(result)


def wrapped_caption(text: str) -> str:
    """A caption between sos and eos with full stops as words, as LEO wraps what a language model says; one that begins
    with sos and ends with eos is left as it is.
    """
    words = text.split(" ")
    return text if words[0] == "sos" and words[-1] == "eos" else f"sos {text} eos".replace(". ", " . ")
