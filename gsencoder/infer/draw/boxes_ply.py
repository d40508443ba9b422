"""Boxes as a colored point cloud that MeshLab, CloudCompare and Open3D show."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.files import atomic_file
from gsencoder.types import Box, Localization, Scene

EDGES = np.array([(a, b) for a in range(8) for b in range(a + 1, 8) if (a ^ b).bit_count() == 1], np.int32)
"""The 12 edges of a box whose corner k lies at the upper end of axis d where bit d of k is set."""
POINTS_ON_EDGE = 100
_TEN = (
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189),
    (140, 86, 75), (227, 119, 194), (127, 127, 127), (188, 189, 34), (23, 190, 207),
)  # fmt: skip
"""Tableau's ten colors, which matplotlib calls tab10."""


def word_color(index: int) -> tuple[int, int, int]:
    """The color of a localization's word, by its place; ten differ, then they repeat."""
    return _TEN[index % len(_TEN)]


def box_corners(box: Box, *, oriented: bool = True) -> Float64[np.ndarray, "8 3"]:
    """The corners of a box's oriented or axis-aligned box, in the order that `EDGES` joins."""
    unit = np.array([[(corner >> axis) & 1 for axis in range(3)] for corner in range(8)], np.float64)
    if oriented:
        return box.obb_center + ((unit - 0.5) * box.obb_size) @ box.obb_rotation.T
    return box.aabb_min + unit * (box.aabb_max - box.aabb_min)


def write_boxes_ply(
    path: str | Path,
    scene: Scene,
    localization: Localization,
    *,
    oriented: bool = False,
) -> None:
    """Writes the Gaussians of all boxes as points in their word's color, and the boxes' edges.

    Edges are drawn as rows of points (every viewer shows those) and listed as `edge` elements between the corners (for
    those that draw lines). Boxes after a word's first are darker. Positions are doubles in world coordinates.

    Args:
        path: a .ply file.
        scene: its Gaussians and origin.
        localization: what was found in it.
        oriented: draw the oriented boxes, not the axis-aligned ones.

    Raises:
        InputError: a scene without Gaussians or with fewer than the boxes name, or a file that cannot be written.
    """
    means = np.zeros((0, 3), np.float32) if scene.gaussians is None else scene.gaussians.means
    points: list[np.ndarray] = []
    colors: list[np.ndarray] = []
    edges: list[np.ndarray] = []
    count = 0
    steps = np.linspace(0, 1, POINTS_ON_EDGE)[1:-1, None]
    for box in localization.boxes:
        if box.rows.size and int(box.rows.max()) >= len(means):
            raise InputError(
                f"write_boxes_ply: box of {box.query!r} has row {box.rows.max()} of {len(means)} Gaussians"
            )
        corners = box_corners(box, oriented=oriented)
        lines = [corners[a] + steps * (corners[b] - corners[a]) for a, b in EDGES]
        inside = means[box.rows].astype(np.float64) + scene.origin
        part = np.concatenate([corners, *lines, inside])
        points.append(part)
        shade = 1.0 if box.rank == 0 else 0.6
        color = np.array(word_color(localization.queries.index(box.query))) * shade
        colors.append(np.broadcast_to(color.astype(np.uint8), part.shape))
        edges.append(EDGES + count)
        count += len(part)
    with atomic_file(path) as stream:
        stream.write(
            _ply_bytes(
                np.concatenate(points) if points else np.zeros((0, 3)),
                np.concatenate(colors) if colors else np.zeros((0, 3), np.uint8),
                np.concatenate(edges) if edges else np.zeros((0, 2), np.int32),
            )
        )


def _ply_bytes(points: Float64[np.ndarray, "n 3"], colors: UInt8[np.ndarray, "n 3"], edges: np.ndarray) -> bytes:
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property double {axis}" for axis in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element edge {len(edges)}", "property int vertex1", "property int vertex2", "end_header\n"]
    vertices = np.empty(len(points), [("position", "<f8", 3), ("color", "u1", 3)])
    vertices["position"], vertices["color"] = points, colors
    return "\n".join(header).encode() + vertices.tobytes() + edges.astype("<i4").tobytes()
