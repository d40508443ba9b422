"""Boxes of expressions from labels: of the object that is meant, in the axes of the aligned scan."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from labeled_scans import group, write_scannet_labels

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.expressions import Expression, boxes_from_labels, boxes_from_scans
from gsencoder.data.labels.scans import read_scannet_labels

# A quarter turn about z, and a shift: aligned (x, y, z) = (-y + 10, x, z - 1).
ALIGNMENT = np.array([[0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, -1], [0, 0, 0, 1]], np.float64)
VERTICES = np.array([[1, 2, 3], [4, 6, 8], [0, 0, 0], [7, 7, 7], [9, 9, 9]], np.float32)
STATED = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def meaning(number: int, scene: str = "s0", **changes: object) -> Expression:
    made = Expression(scene=scene, object_id=number, object_name="x", annotation="0", text="it", tokens=("it",))
    return replace(made, **changes)  # type: ignore[arg-type]


def write_scan(folder: Path, alignment: np.ndarray | None = ALIGNMENT) -> Path:
    """Object 2 has the first two vertices, 0 the third, 1 the fourth, which the last, 5, has as well."""
    groups = [group(2, "a", [10]), group(0, "b", [20]), group(1, "c", [30]), group(5, "d", [30, 40])]
    segments = np.array([10, 10, 20, 30, 40])
    return write_scannet_labels(folder, folder.name, VERTICES, segments, groups, alignment=alignment)


def test_the_box_is_that_of_the_meant_objects_vertices_in_the_aligned_axes(tmp_path: Path) -> None:
    labels = read_scannet_labels(write_scan(tmp_path / "s0"))
    boxes = boxes_from_labels([meaning(2), meaning(0), meaning(1), meaning(5), meaning(2, aabb=STATED)], labels)
    assert [each.aabb for each in boxes] == [
        ((4.0, 1.0, 2.0), (8.0, 4.0, 7.0)),
        ((10.0, 0.0, -1.0), (10.0, 0.0, -1.0)),
        None,  # All of its vertices belong to object 5.
        ((1.0, 7.0, 6.0), (3.0, 9.0, 8.0)),
        STATED,
    ]
    assert [each.object_id for each in boxes] == [2, 0, 1, 5, 2]
    with pytest.raises(InputError, match="s0: its labels have no object with the objectId 3"):
        boxes_from_labels([meaning(3)], labels)


def test_expressions_of_several_scans_stay_in_order_and_scans_that_nothing_needs_are_not_read(tmp_path: Path) -> None:
    write_scan(tmp_path / "s0")
    write_scan(tmp_path / "s1", alignment=None)
    expressions = [
        meaning(0, "s1"),
        meaning(2, "s0"),
        meaning(0, "nowhere", aabb=STATED),
        meaning(2, "s1"),
        meaning(0, "s0"),
    ]
    with pytest.warns(SceneWarning, match="axisAlignment"):
        boxes = boxes_from_scans(expressions, tmp_path)
    assert [(each.scene, each.object_id) for each in boxes] == [(each.scene, each.object_id) for each in expressions]
    assert [each.aabb and each.aabb[0] for each in boxes] == [
        (0.0, 0.0, 0.0),
        (4.0, 1.0, 2.0),
        (0.0, 0.0, 0.0),
        (1.0, 2.0, 3.0),
        (10.0, 0.0, -1.0),
    ]
    assert boxes_from_scans([], tmp_path) == ()
    with pytest.raises(InputError, match="nowhere: no annotation of ScanNet"):
        boxes_from_scans([meaning(0, "nowhere")], tmp_path)
