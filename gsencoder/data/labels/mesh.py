"""Labeled meshes: their files, instances in views, and the labels of the nearest Gaussians.

Vertices are in the order of the file, by which benchmarks count their labels.

Instance maps of views are drawn with a depth buffer; a pixel has the object of the vertex that is nearest to its point
on the triangle. Where sensor depth is known and differs from the mesh's by more than a tolerance, the pixel has no
object: it shows something that the mesh lacks, such as a person. ScanNet's own instance pictures (instance-filt) are
made in the same way.

A vertex has the most frequent label among the k nearest Gaussians that have features (SceneSplat's benchmark takes
k = 25: Li et al. 2025; pointcept/utils/misc.py, neighbor_voting).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import check_foreign
from gsencoder.core.threads import compiled
from gsencoder.types import MeshLabels, Views
from gsencoder.types.scene import move_origin, transform


def read_mesh(path: Path) -> tuple[Float32[np.ndarray, "V 3"], Int32[np.ndarray, "F 3"] | None]:
    """The vertices and triangles of a .ply, in their order; None in place of triangles where the file has no faces."""
    with readable(path):
        check_foreign(path)
    import trimesh

    try:
        mesh: Any = trimesh.load(path, file_type="ply", process=False)
    except Exception as error:  # trimesh's readers raise whatever their parsers do.
        message = " ".join(f"{type(error).__name__}: {error}".split())[:160]
        raise InputError(f"{path}: not a mesh that trimesh can read ({message})") from error
    vertices = np.asarray(getattr(mesh, "vertices", ()), np.float64).reshape(-1, 3)
    faces = np.asarray(getattr(mesh, "faces", ()))
    if not len(vertices):
        raise InputError(f"{path}: holds no vertices; expected the mesh of the data set")
    good = np.isfinite(vertices).all(axis=1) & (np.abs(vertices) < np.finfo(np.float32).max).all(axis=1)
    if not good.all():
        bad = np.flatnonzero(~good)
        raise InputError(f"{path}: vertex {bad[0]:,} is not finite ({bad.size:,} of {len(vertices):,}); get it again")
    if not len(faces):
        return vertices.astype(np.float32), None
    outside = (faces < 0) | (faces >= len(vertices))
    if outside.any():
        row, column = (int(each[0]) for each in np.nonzero(outside))
        raise InputError(f"{path}: face {row:,} names vertex {faces[row, column]:,} of {len(vertices):,}")
    return vertices.astype(np.float32), faces.astype(np.int32)


TOLERANCE = 0.1
"""Difference from sensor depth up to which a pixel shows the mesh, metres, near the camera …"""
RELATIVE_TOLERANCE = 0.05
"""… and as a share of the depth, farther away: the error of depth sensors grows with it."""
NEAR = 0.01
"""Triangles that reach nearer to the camera than this, metres, are not drawn."""


class MeshInstances(Sequence[Int32[np.ndarray, "H W"]]):
    """Instance maps of views as int32 [H, W], 0 = none, each drawn on access."""

    def __init__(self, labels: MeshLabels, views: Views, origin: Float64[np.ndarray, "3"]) -> None:
        """The mesh has faces and is in metres; the views are relative to `origin`, taken off its world."""
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
CHUNK = 4096
"""Vertices whose votes are counted at once."""


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
        voters: which Gaussians are looked at, such as the visible ones; None = all.
    """
    if voters is not None:
        means, labels = means[voters], labels[voters]
    result = np.full(len(vertices), none, np.int32)
    if not len(means):
        return result
    from scipy.spatial import cKDTree

    names, codes = np.unique(labels, return_inverse=True)
    tree, k = cKDTree(means), min(k, len(means))
    for start in range(0, len(vertices), CHUNK):
        votes = codes[tree.query(vertices[start : start + CHUNK], k=k)[1].reshape(-1, k)]
        counts = np.zeros((len(votes), len(names)), np.int32)
        np.add.at(counts, (np.arange(len(votes))[:, None], votes), 1)
        counts[:, names == none] = 0
        result[start : start + CHUNK] = np.where(counts.any(axis=1), names[counts.argmax(axis=1)], none)
    return result


def nearest_rows(
    points: Float[np.ndarray, "P 3"], targets: Float[np.ndarray, "T 3"], *, max_distance: float = np.inf
) -> Int64[np.ndarray, " P"]:
    """The row of the nearest target of each point; -1 where none is within the distance, itself included."""
    from scipy.spatial import cKDTree

    if not len(targets):
        return np.full(len(points), -1)
    # The bound excludes itself, and makes queries far from the targets short.
    _, rows = cKDTree(targets).query(points, distance_upper_bound=np.nextafter(max_distance, np.inf))
    return np.where(rows < len(targets), rows, -1).astype(np.int64)
