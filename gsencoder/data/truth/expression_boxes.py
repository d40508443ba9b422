"""Boxes of the objects that expressions refer to, from the labels of ScanNet's scans.

ScanRefer's own files have no boxes. Its scripts take that of an object's vertices along the axes of the aligned scan
(data/scannet/load_scannet_data.py), and so does this module.
"""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.truth.expressions import Expression
from gsencoder.data.truth.scannet_labels import read_scannet_labels
from gsencoder.types import MeshLabels


def boxes_from_scans(expressions: Sequence[Expression], scans: Path) -> tuple[Expression, ...]:
    """Gives expressions without a box that of their object; one scan is in memory at a time.

    Args:
        expressions: of any scenes.
        scans: folder with a folder of each scene, which has the label files of its scan.

    Returns:
        The expressions, in order.

    Raises:
        InputError: a scan is missing or wrong, or has no such object.
    """
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

    Raises:
        InputError: an object that the labels do not have.
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
