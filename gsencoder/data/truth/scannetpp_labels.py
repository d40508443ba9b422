"""Labels of a ScanNet++ scene from its own files: scans/ with mesh_aligned_0.05.ply, segments.json and
segments_anno.json.

The world is that of the laser scan, which is also the frame of the poses and of the boxes: there is no alignment to
apply. Ids are the objectIds of the annotation. Objects overlap: a vertex can belong to several, of which ScanNet++'s
toolkit (semantic/transforms/mesh.py) keeps the smallest.

Reference: Yeshwanth et al., ScanNet++, 2023.
"""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.data.truth.mesh_file import read_mesh
from gsencoder.data.truth.segment_files import SegmentVertices, check_counts, read_groups, read_segments
from gsencoder.types import MeshLabels

ANNOTATION, SEGMENTS, MESH = "segments_anno.json", "segments.json", "mesh_aligned_0.05.ply"
MAX_OBJECTS_OF_A_VERTEX = 3
"""Objects after the third that claim a vertex, in the order of the file, are not looked at, as in the toolkit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanNetPPFiles:
    """The label files of one scene: objects as groups of segments, the segment of each vertex, and the mesh."""

    annotation: Path
    segments: Path
    mesh: Path

    @property
    def missing(self) -> tuple[Path, ...]:
        """Those of the files that do not exist."""
        return tuple(path for path in (self.annotation, self.segments, self.mesh) if not path.is_file())


def find_scannetpp_files(folder: Path) -> ScanNetPPFiles | None:
    """The label files of a scene, given itself, its scans/, or its dslr/ or iphone/; None without an annotation."""
    folder = folder.absolute()
    homes = [folder / "scans", folder]
    if folder.name in ("dslr", "iphone"):
        homes.append(folder.parent / "scans")
    for home in homes:
        if (home / ANNOTATION).is_file():
            return ScanNetPPFiles(annotation=home / ANNOTATION, segments=home / SEGMENTS, mesh=home / MESH)
    return None


def read_scannetpp_labels(source: Path | ScanNetPPFiles, *, names: Collection[str] | None = None) -> MeshLabels:
    """The labels of a scene.

    A vertex that several objects claim belongs to the one with the fewest vertices, and of equal ones to the first in
    the file. An object whose vertices all belong to others stays in the list.

    Args:
        source: folder of the scene, or its files.
        names: raw names of the objects that are labeled, as benchmarks take those of their classes only, which decides
            what a vertex with several objects belongs to; None = all. Others are left out.

    Raises:
        InputError: a file is missing or wrong; file and entry are named. See `read_groups`, `read_segments` and
            `read_mesh`.
    """
    files = source if isinstance(source, ScanNetPPFiles) else find_scannetpp_files(source)
    if files is None:
        raise InputError(f"{source}: no annotation of ScanNet++; expected scans/ with {ANNOTATION}, {SEGMENTS}, {MESH}")
    if files.missing:
        raise InputError(f"{files.missing[0]}: no such file; the labels of the scene need it")
    # Objects count from 1: the toolkit takes 0 for the background.
    groups = [group for group in read_groups(files.annotation, first_id=1) if names is None or group.label in names]
    segments = read_segments(files.segments)
    vertices, faces = read_mesh(files.mesh)
    check_counts(segments, vertices, files.segments, files.mesh)
    rows_of = SegmentVertices(segments, files.segments)
    instances = np.zeros(len(vertices), np.int32)
    claims = np.zeros(len(vertices), np.int8)
    smallest = np.full(len(vertices), np.iinfo(np.int64).max)
    for group in groups:
        rows = rows_of.of(group, files.annotation)
        rows = rows[claims[rows] < MAX_OBJECTS_OF_A_VERTEX]
        claims[rows] += 1
        count = len(rows)
        rows = rows[count < smallest[rows]]
        instances[rows], smallest[rows] = group.id, count
    return MeshLabels(
        vertices=vertices,
        instances=instances,
        objects=tuple((group.id, group.label) for group in groups),
        faces=faces,
    )
