"""Limits of meshes and of labels of their vertices: the last value that is taken, and the first that is not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labeled_scans import group, write_ply, write_scannet_labels, write_scannetpp_labels

from gsencoder.core.errors import InputError
from gsencoder.data.labels.mesh import read_mesh
from gsencoder.data.labels.scans import read_scannet_labels, read_scannetpp_labels

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [4, 4, 4], [5, 5, 5]], np.float32)
SEGMENTS = np.array([7, 7, 2, 9, 9, 4])
FACES = np.array([[0, 1, 2], [3, 4, 5]])


def scan(folder: Path, **changes: Any) -> Path:
    return write_scannet_labels(
        folder / "s", "s", **({"vertices": VERTICES, "segments": SEGMENTS, "groups": []} | changes)
    )


def error_of(folder: Path) -> str:
    with pytest.raises(InputError) as error:
        read_scannet_labels(folder)
    return str(error.value)


def test_coordinates_are_finite_and_those_of_float32(tmp_path: Path) -> None:
    for wrong in (np.nan, np.inf, -np.inf, np.finfo(np.float32).max):
        vertices = VERTICES.copy()
        vertices[4, 1] = wrong
        with pytest.raises(InputError, match=r"vertex 4 is not finite \(1 of 6\); get the file anew"):
            read_mesh(write_ply(tmp_path / "a.ply", vertices, FACES))


@pytest.mark.parametrize("text", [False, True])
def test_faces_keep_the_order_of_their_vertices_and_name_vertices_that_are_there(tmp_path: Path, text: bool) -> None:
    faces = np.array([[5, 0, 3], [1, 4, 2]])
    read = read_mesh(write_ply(tmp_path / "a.ply", VERTICES, faces, text=text))[1]
    assert read is not None
    assert read.tolist() == faces.tolist()
    for wrong in (-1, 6):
        with pytest.raises(InputError, match=f"face 1 names vertex {wrong} of 6"):
            read_mesh(write_ply(tmp_path / "a.ply", VERTICES, np.array([[5, 0, 3], [1, 4, wrong]]), text=text))


@pytest.mark.parametrize(
    ("number", "fits"), [(2**31 - 2, True), (2**31 - 1, False), (-1, False), (True, False), (1.0, False)]
)
def test_the_objectId_and_the_number_after_it_fit_into_int32(tmp_path: Path, number: Any, fits: bool) -> None:
    groups = [group(0, "couch", [7]), group(number, "lamp", [9])]
    if fits:
        assert read_scannet_labels(scan(tmp_path, groups=groups)).instances.max() == number + 1
        return
    problem = error_of(scan(tmp_path, groups=groups))
    assert f"segGroups[1]: objectId must be a whole number from 0, got {number}" in problem


@pytest.mark.parametrize("number", [2**63 - 1, -(2**63)])
def test_segments_are_numbers_of_64_bits(tmp_path: Path, number: int) -> None:
    segments = [7, 7, 2, 9, number, 4]
    groups = [group(0, "couch", [number, 7])]
    labels = read_scannet_labels(scan(tmp_path, segments=segments, groups=groups))
    assert labels.instances.tolist() == [1, 1, 0, 0, 1, 0]
    beyond = number + (1 if number > 0 else -1)
    problem = error_of(scan(tmp_path, segments=[7, 7, 2, 9, beyond, 4], groups=groups))
    assert "segIndices[4]: expected a whole number, got " in problem


def test_names_of_objects_have_at_most_a_thousand_characters(tmp_path: Path) -> None:
    long = read_scannet_labels(scan(tmp_path, groups=[group(0, "a" * 1000, [7])]))
    assert long.objects == ((1, "a" * 1000),)
    assert "label has 1,001 characters" in error_of(scan(tmp_path, groups=[group(0, "a" * 1001, [7])]))


def test_of_equally_large_objects_of_scannetpp_the_first_has_the_vertex(tmp_path: Path) -> None:
    groups = [group(8, "table", [7, 9]), group(2, "cloth", [9, 7]), group(5, "cup", [9])]
    folder = write_scannetpp_labels(tmp_path, VERTICES, SEGMENTS, groups, faces=FACES)
    assert read_scannetpp_labels(folder).instances.tolist() == [8, 8, 0, 5, 5, 0]
    # A name that is left out claims nothing.
    some = read_scannetpp_labels(folder, names=("cloth", "lamp"))
    assert (some.instances.tolist(), some.objects) == ([2, 2, 0, 2, 2, 0], ((2, "cloth"),))
