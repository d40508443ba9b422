"""Labeled meshes: their files, instances in views, and the labels of the nearest Gaussians.

Vertices are in the order of the file, by which benchmarks count their labels; general readers of meshes do not keep it.

Instance maps of views are drawn with a depth buffer; a pixel has the object of the vertex that is nearest to its point
on the triangle. Where sensor depth is known and differs from the mesh's by more than a tolerance, the pixel has no
object: it shows something that the mesh lacks, such as a person. ScanNet's own instance pictures (instance-filt) are
made in the same way.

A vertex has the most frequent label among the k nearest Gaussians that have features (SceneSplat's benchmark takes
k = 25: Li et al. 2025; pointcept/utils/misc.py, neighbor_voting).
"""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import open_foreign
from gsencoder.core.threads import compiled
from gsencoder.data.splats.ply import PlyElement, PlyHeader, read_header, read_property
from gsencoder.types import MeshLabels, Views
from gsencoder.types.checks import move_origin, transform

MAX_VERTICES = 100_000_000
"""More than this are no mesh of a room."""


def read_mesh(path: Path) -> tuple[Float32[np.ndarray, "V 3"], Int32[np.ndarray, "F 3"] | None]:
    """The vertices and triangles of a mesh; None in place of triangles where the file has no faces."""
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


TOLERANCE = 0.1
"""Difference from sensor depth up to which a pixel shows the mesh, metres, near the camera …"""
RELATIVE_TOLERANCE = 0.05
"""… and as a share of the depth, farther away: the error of depth sensors grows with it."""
NEAR = 0.01
"""Triangles that reach nearer to the camera than this, metres, are not drawn."""


class MeshInstances(Sequence[Int32[np.ndarray, "H W"]]):
    """Instance maps of views as int32 [H, W], 0 = none, each drawn on access."""

    def __init__(self, labels: MeshLabels, views: Views, origin: Float64[np.ndarray, "3"]) -> None:
        """Prepares the maps; nothing is drawn.

        Args:
            labels: of a mesh with faces, in metres.
            views: cameras, and depth where it is known, relative to `origin`.
            origin: that was taken off the world of the mesh.
        """
        if labels.faces is None:
            raise InputError("instance maps: the labeled mesh has no faces; expected the mesh of the data set")
        self._labels, self._views, self._origin = labels, views, origin

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return MeshInstances(self._labels, self._views.select(range(len(self))[index]), self._origin)
        views = self._views
        view = range(len(views))[index]
        # The camera moves to the world of the mesh, in float64.
        cam_from_world = move_origin(views.cameras.cam_from_world[view].astype(np.float64), -self._origin)
        instances, depth = draw_instances(
            self._labels,
            cam_from_world,
            views.cameras.Ks[view].astype(np.float64),
            int(views.cameras.widths[view]),
            int(views.cameras.heights[view]),
        )
        if views.depths is not None:
            sensor = views.depths[view]
            tolerance = np.maximum(np.float32(TOLERANCE), np.float32(RELATIVE_TOLERANCE) * sensor)
            instances[(sensor > 0) & ~(np.abs(depth - sensor) <= tolerance)] = 0
        return instances


def draw_instances(
    labels: MeshLabels,
    cam_from_world: Float64[np.ndarray, "4 4"],
    K: Float64[np.ndarray, "3 3"],
    width: int,
    height: int,
) -> tuple[Int32[np.ndarray, "{height} {width}"], Float32[np.ndarray, "{height} {width}"]]:
    """The object and the depth z of the mesh at each pixel; 0 and infinity where there is none."""
    assert labels.faces is not None
    local = np.ascontiguousarray(transform(cam_from_world, labels.vertices.astype(np.float64)))
    instances = np.zeros((height, width), np.int32)
    inverse = np.zeros((height, width), np.float64)
    draw_triangles(local, labels.faces, labels.instances, np.ascontiguousarray(K), NEAR, inverse, instances)
    with np.errstate(divide="ignore"):
        return instances, (1 / inverse).astype(np.float32)


# Without fused products, unlike `gsencoder.core.threads.kernel`: of an edge of two triangles, each then finds a
# pixel exactly as far on its side as the other finds it beyond, and no pixel between them is left to neither.
@compiled
@no_type_check
def draw_triangles(local, faces, labels, K, near, inverse, instances):
    """Draws triangles into a buffer of 1/z, which is linear in the picture; the larger one is nearer."""
    height, width = instances.shape
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        if not (local[a, 2] > near and local[b, 2] > near and local[c, 2] > near):
            continue
        za, zb, zc = 1 / local[a, 2], 1 / local[b, 2], 1 / local[c, 2]
        ua, va = K[0, 0] * local[a, 0] * za + K[0, 2], K[1, 1] * local[a, 1] * za + K[1, 2]
        ub, vb = K[0, 0] * local[b, 0] * zb + K[0, 2], K[1, 1] * local[b, 1] * zb + K[1, 2]
        uc, vc = K[0, 0] * local[c, 0] * zc + K[0, 2], K[1, 1] * local[c, 1] * zc + K[1, 2]
        left, right = max(0.0, np.ceil(min(ua, ub, uc) - 0.5)), min(width - 1.0, np.floor(max(ua, ub, uc) - 0.5))
        top, bottom = max(0.0, np.ceil(min(va, vb, vc) - 0.5)), min(height - 1.0, np.floor(max(va, vb, vc) - 0.5))
        if left > right or top > bottom:
            continue
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area == 0:
            continue
        for row in range(int(top), int(bottom) + 1):
            for column in range(int(left), int(right) + 1):
                u, v = column + 0.5, row + 0.5
                wa = ((ub - u) * (vc - v) - (vb - v) * (uc - u)) / area
                wb = ((uc - u) * (va - v) - (vc - v) * (ua - u)) / area
                # And not 1 - wa - wb, which rounds otherwise.
                wc = ((ua - u) * (vb - v) - (va - v) * (ub - u)) / area
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                nearness = wa * za + wb * zb + wc * zc
                if nearness <= inverse[row, column]:
                    continue
                inverse[row, column] = nearness
                # Weights on the triangle itself, up to a common factor.
                wa, wb, wc = wa * za, wb * zb, wc * zc
                if wa >= wb and wa >= wc:
                    instances[row, column] = labels[a]
                elif wb >= wc:
                    instances[row, column] = labels[b]
                else:
                    instances[row, column] = labels[c]


VOTERS = 25
"""Gaussians that vote for the label of a vertex, as in SceneSplat's benchmark."""

CHUNK = 1 << 16
"""Points of one query."""
MAX_VOTES = 1 << 22
"""Counters of votes that exist at once: points times distinct labels."""


def labels_of_vertices(
    vertices: Float[np.ndarray, "V 3"],
    means: Float[np.ndarray, "N 3"],
    labels: Int[np.ndarray, " N"],
    *,
    k: int = VOTERS,
    none: int = -1,
    voters: Bool[np.ndarray, " N"] | None = None,
) -> Int32[np.ndarray, " V"]:
    """The most frequent label among the k nearest Gaussians of each vertex; of equally frequent ones the smallest.

    Labels `none` are among the k but do not count; a vertex whose nearest Gaussians all have it has none.

    Args:
        means: centers of the Gaussians, in the frame of the vertices.
        k: number of Gaussians that vote; 1 = the nearest one. All vote where there are fewer.
        none: what means no label, in and out.
        voters: which Gaussians are looked at, such as those that were seen; None = all.
    """
    if voters is not None:
        means, labels = means[voters], labels[voters]
    result = np.full(len(vertices), none, np.int32)
    if not len(means):
        return result
    names, codes = np.unique(labels, return_inverse=True)
    # The last counter is that of neighbors that do not vote.
    codes = np.where(labels == none, len(names), codes).astype(np.int64)
    codes = np.append(codes, len(names))
    k = min(k, len(means))
    chunk = max(1, min(CHUNK, MAX_VOTES // max(len(names) + 1, k)))
    for part, rows in _neighbors(vertices, means, k, np.inf, chunk):
        votes = codes[rows] + np.arange(len(rows))[:, None] * (len(names) + 1)
        counts = np.bincount(votes.ravel(), minlength=len(rows) * (len(names) + 1))
        counts = counts.reshape(len(rows), len(names) + 1)[:, : len(names)]
        best = counts.argmax(axis=1)
        elected = counts[np.arange(len(rows)), best] > 0
        result[part][elected] = names[best[elected]]
    return result


def nearest_rows(
    points: Float[np.ndarray, "P 3"], targets: Float[np.ndarray, "T 3"], *, max_distance: float = np.inf
) -> Int64[np.ndarray, " P"]:
    """The row of the nearest target of each point; -1 where none is near enough.

    Args:
        points: finite, in the frame of the targets.
        max_distance: largest distance, itself included, in the unit of both.
    """
    result = np.full(len(points), -1, np.int64)
    for part, rows in _neighbors(points, targets, 1, max_distance, CHUNK):
        result[part] = np.where(rows[:, 0] < len(targets), rows[:, 0], -1)
    return result


def _neighbors(
    points: Float[np.ndarray, "P 3"], targets: Float[np.ndarray, "T 3"], k: int, max_distance: float, chunk: int
) -> Iterator[tuple[slice, Int64[np.ndarray, "n {k}"]]]:
    """The rows of the k nearest targets, of one chunk of points after the other; T beyond the distance."""
    from scipy.spatial import cKDTree

    if not len(targets):
        return
    tree = cKDTree(targets)
    for start in range(0, len(points), chunk):
        part = slice(start, start + chunk)
        # The bound excludes itself, and makes queries far from the targets short.
        _, rows = tree.query(points[part], k=k, distance_upper_bound=np.nextafter(max_distance, np.inf))
        yield part, rows.reshape(-1, k).astype(np.int64)
