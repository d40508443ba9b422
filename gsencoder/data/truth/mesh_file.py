"""Vertices, one property of them, and triangles of a .ply mesh, in the order of the file.

Benchmarks count their labels by this order, which general readers of meshes do not promise.
"""

from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float32, Int32, Int64

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import open_foreign
from gsencoder.data.splat_formats.ply import PlyElement, PlyHeader, read_header, read_property

MAX_VERTICES = 100_000_000
"""More than this are no mesh of a room."""


def read_mesh(path: Path) -> tuple[Float32[np.ndarray, "V 3"], Int32[np.ndarray, "F 3"] | None]:
    """The vertices and triangles of a mesh; None in place of triangles where the file has no faces.

    Raises:
        InputError: missing, not a .ply, truncated, no vertices, vertices that are not finite, faces that are not
            triangles or that name a vertex that is not there.
    """
    with _opened(path) as stream:
        header, size = _header(path, stream)
        columns = [read_property(path, stream, header, size, name) for name in "xyz"]
        vertices = np.stack(columns, axis=1)
        good = np.isfinite(vertices).all(axis=1) & (np.abs(vertices) < np.finfo(np.float32).max).all(axis=1)
        if not good.all():
            bad = np.flatnonzero(~good)
            raise InputError(
                f"{path}: vertex {bad[0]:,} is not finite ({bad.size:,} of {len(vertices):,}); get the file anew"
            )
        faces = header.element("face")
        if faces is None or not faces.count:
            return vertices.astype(np.float32), None
        rows = _read_triangles(path, stream, header, faces, size)
    outside = (rows < 0) | (rows >= len(vertices))
    if outside.any():
        row, column = (int(each[0]) for each in np.nonzero(outside))
        raise InputError(f"{path}: face {row:,} names vertex {rows[row, column]:,} of {len(vertices):,}")
    return vertices.astype(np.float32), rows.astype(np.int32)


def read_vertex_labels(path: Path) -> Int32[np.ndarray, " V"]:
    """The property `label` of each vertex of a mesh, such as the nyu40 ids of ScanNet's _vh_clean_2.labels.ply.

    Raises:
        InputError: missing, not a .ply, truncated, without labels, or with labels that are not whole numbers.
    """
    with _opened(path) as stream:
        header, size = _header(path, stream)
        values = read_property(path, stream, header, size, "label")
    good = (np.abs(values) < 2**31) & (values == np.round(values))
    if not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise InputError(f"{path}: the label of vertex {row:,} is {values[row]:g}; expected a whole number")
    return values.astype(np.int32)


def _opened(path: Path) -> BinaryIO:
    with readable(path):
        return open_foreign(path)


def _header(path: Path, stream: BinaryIO) -> tuple[PlyHeader, int]:
    if stream.read(4)[:3] != b"ply":
        raise InputError(f"{path}: not a .ply file; expected the mesh of the data set")
    size = stream.seek(0, 2)
    stream.seek(0)
    header = read_header(path, stream)
    vertex = header.element("vertex")
    if vertex is None or not vertex.count:
        raise InputError(f"{path}: holds no vertices; expected the mesh of the data set")
    if vertex.count > MAX_VERTICES:
        raise InputError(f"{path}: claims {vertex.count:,} vertices, at most {MAX_VERTICES:,} are read")
    return header, size


def _read_triangles(
    path: Path, stream: BinaryIO, header: PlyHeader, faces: PlyElement, size: int
) -> Int64[np.ndarray, "F 3"]:
    if faces.triangle is None or [element.name for element in header.elements[:2]] != ["vertex", "face"]:
        raise InputError(f"{path}: expected vertices, and then faces with one list of vertices each")
    vertex = header.element("vertex")
    assert vertex is not None
    assert vertex.dtype is not None
    if header.encoding == "ascii":
        stream.seek(header.start)
        lines = islice(stream, vertex.count, vertex.count + faces.count)
        try:
            table = np.loadtxt(lines, dtype=np.int64, comments=None, ndmin=2, encoding="latin-1")
        except ValueError as error:
            raise InputError(f"{path}: a face cannot be read: {' '.join(str(error).split())[:120]}") from error
        if table.shape != (faces.count, 4):
            raise InputError(f"{path}: expected {faces.count:,} triangles, got {list(table.shape)} numbers")
        counts, rows = table[:, 0], np.asarray(table[:, 1:])
    else:
        start = header.start + vertex.count * vertex.dtype.itemsize
        end = start + faces.count * faces.triangle.itemsize
        if end > size:
            raise InputError(
                f"{path}: {faces.count:,} triangles end at byte {end:,}, but the file has {size:,}; it is truncated, "
                "or its faces are not triangles"
            )
        stream.seek(start)
        records = np.fromfile(stream, faces.triangle, faces.count)
        counts, rows = records["n"], records["v"].astype(np.int64)
    if (counts != 3).any():
        row = int(np.flatnonzero(counts != 3)[0])
        raise InputError(f"{path}: face {row:,} has {counts[row]} vertices; expected triangles")
    return rows
