"""Instance maps of views from a labeled mesh: what a camera sees of it, kept where the depth sensor agrees.

The triangles are drawn with a depth buffer; a pixel has the object of the vertex that is nearest to its point on the
triangle. Where sensor depth is known and differs from the mesh's by more than a tolerance, the pixel has no object: it
shows something that the mesh lacks, such as a person, or that was scanned elsewhere. ScanNet's own
instance pictures (instance-filt) are made in the same way.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32

from gsencoder.core.errors import InputError
from gsencoder.types import MeshLabels, Views
from gsencoder.types.checks import move_origin, transform

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

        Raises:
            InputError: the mesh has no faces.
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
    """The object and the depth z of the mesh at each pixel; 0 and infinity where there is none.

    Args:
        labels: of a mesh with faces.
        cam_from_world: of the camera, in the world of the mesh.
        K: intrinsics, pixel centers at .5.
        width: of the picture, pixels.
        height: of the picture, pixels.
    """
    # numba is loaded when something is drawn, and not with every scene.
    from gsencoder.data.truth.mesh_raster import draw_triangles

    assert labels.faces is not None
    local = np.ascontiguousarray(transform(cam_from_world, labels.vertices.astype(np.float64)))
    instances = np.zeros((height, width), np.int32)
    inverse = np.zeros((height, width), np.float64)
    draw_triangles(local, labels.faces, labels.instances, np.ascontiguousarray(K), NEAR, inverse, instances)
    with np.errstate(divide="ignore"):
        return instances, (1 / inverse).astype(np.float32)
