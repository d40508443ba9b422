"""Labels of a ScanNet scan from its own files.

A scan ID has ID_vh_clean_2.ply (the mesh), ID_vh_clean_2.0.010000.segs.json (a segment for each vertex),
ID.aggregation.json (objects as groups of segments), and ID.txt, whose line `axisAlignment` turns the world of the poses
and of the mesh into the frame in which ScanNet's benchmarks of boxes (ScanRefer and its kin) are stated. Ids are
objectId + 1, as in ScanNet's own scripts, so that 0 can mean no object; ScanRefer's object_id is objectId.

Reference: Dai et al., ScanNet, 2017; ScanNet's BenchmarkScripts/3d_helpers/export_train_mesh_for_evaluation.py.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.data.readers.posed import rigid_pose
from gsencoder.data.truth.checked_files import read_checked_text
from gsencoder.data.truth.mesh_file import read_mesh
from gsencoder.data.truth.segment_files import SegmentVertices, check_counts, read_groups, read_segments
from gsencoder.types import MeshLabels

AGGREGATION, SEGMENTS, MESH = ".aggregation.json", "_vh_clean_2.0.010000.segs.json", "_vh_clean_2.ply"
MAX_META_BYTES = 1 << 20


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanNetFiles:
    """The label files of one scan.

    Attributes:
        name: of the scan, such as scene0000_00.
        aggregation: objects as groups of segments.
        segments: segment of each vertex.
        mesh: the vertices.
        meta: text that may state the alignment of axes, or None.
    """

    name: str
    aggregation: Path
    segments: Path
    mesh: Path
    meta: Path | None = None

    @property
    def missing(self) -> tuple[Path, ...]:
        """Those of the files that do not exist."""
        return tuple(path for path in (self.aggregation, self.segments, self.mesh) if not path.is_file())


def find_scannet_files(folder: Path) -> ScanNetFiles | None:
    """The label files of a scan in a folder, or of a scan of the folder's or its parent's name in the parent.

    The second is for frames that were exported to a folder inside the scan's. None where there is no annotation.

    Raises:
        InputError: the folder holds annotations of several scans, and none has its name.
    """
    folder = folder.absolute()
    # _vh_clean.aggregation.json belongs to the mesh of full resolution, which no benchmark uses.
    scans = sorted(
        path.name[: -len(AGGREGATION)]
        for path in folder.glob(f"*{AGGREGATION}")
        if path.is_file() and not path.name.endswith(f"_vh_clean{AGGREGATION}")
    )
    if folder.name in scans:
        return _files(folder, folder.name)
    if len(scans) > 1:
        raise InputError(
            f"{folder}: holds annotations of {len(scans)} scans ({', '.join(scans)[:80]}); expected one, or one named "
            f"{folder.name}{AGGREGATION}"
        )
    if scans:
        return _files(folder, scans[0])
    for name in (folder.name, folder.parent.name):
        if name and (folder.parent / f"{name}{AGGREGATION}").is_file():
            return _files(folder.parent, name)
    return None


def _files(folder: Path, name: str) -> ScanNetFiles:
    meta = folder / f"{name}.txt"
    return ScanNetFiles(
        name=name,
        aggregation=folder / f"{name}{AGGREGATION}",
        segments=folder / f"{name}{SEGMENTS}",
        mesh=folder / f"{name}{MESH}",
        meta=meta if meta.is_file() else None,
    )


def read_scannet_labels(source: Path | ScanNetFiles) -> MeshLabels:
    """The labels of a scan.

    A segment that several objects list belongs to the last of them, as ScanNet's script writes one after the other.

    Args:
        source: folder of the scan, or its files.

    Raises:
        InputError: a file is missing or wrong; file and entry are named. See `read_groups`, `read_segments`,
            `read_mesh` and `read_axis_alignment`.
    """
    files = source if isinstance(source, ScanNetFiles) else find_scannet_files(source)
    if files is None:
        raise InputError(f"{source}: no annotation of ScanNet; expected ID{AGGREGATION}, ID{SEGMENTS} and ID{MESH}")
    if files.missing:
        raise InputError(f"{files.missing[0]}: no such file; the labels of {files.name} need it")
    groups = read_groups(files.aggregation, first_id=0)
    segments = read_segments(files.segments)
    vertices, faces = read_mesh(files.mesh)
    check_counts(segments, vertices, files.segments, files.mesh)
    rows_of = SegmentVertices(segments, files.segments)
    instances = np.zeros(len(vertices), np.int32)
    for group in groups:
        instances[rows_of.of(group, files.aggregation)] = group.id + 1
    return MeshLabels(
        vertices=vertices,
        instances=instances,
        objects=tuple((group.id + 1, group.label) for group in groups),
        faces=faces,
        aligned_from_world=None if files.meta is None else read_axis_alignment(files.meta),
    )


def read_axis_alignment(path: Path) -> Float64[np.ndarray, "4 4"] | None:
    """The transform aligned_from_world of a scan's ID.txt (`axisAlignment = ` and 16 numbers, row by row).

    None where the file has no such line, as those of test scans; the world is used as it is then.

    Raises:
        InputError: unreadable, or a line that is not a rigid transform.
    """
    lines = read_checked_text(path, max_bytes=MAX_META_BYTES).splitlines()
    entries = [words for words in (line.partition("=") for line in lines) if words[0].strip() == "axisAlignment"]
    if not entries:
        return None
    try:
        values = np.array(entries[-1][2].split(), np.float64)
    except ValueError:
        values = np.zeros(0)
    if len(values) != 16:
        raise InputError(f"{path}: axisAlignment: expected 16 numbers, got {entries[-1][2].strip()[:60]!r}")
    rigid_pose(values.reshape(4, 4), f"{path}: axisAlignment")
    # As it is written, as benchmarks apply it, and not the nearest rotation.
    return values.reshape(4, 4)
