"""Points with a true object each, and the Gaussians that speak for them.

Benchmarks count points of a scan. Where a scene has a labeled mesh, the points are its vertices: a mask or a feature
reaches each vertex from the nearest Gaussian, a class from a vote of the nearest ones. Where a scene has instance
pictures instead, the points are the Gaussians themselves, and the object of each is the instance on whose pixels most
of its blending weight falls, less what measured depth says is hidden.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int32, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.labels.mesh import nearest_rows
from gsencoder.fusion.lift import VisibilityConfig, keep_visible
from gsencoder.render import blend
from gsencoder.types import MeshLabels, Scene

MIN_WEIGHT = 1.0
"""Pixels that a Gaussian must cover in all views together for its label to count."""
MAX_DISTANCE = 0.1
"""Metres from a vertex to the nearest Gaussian, beyond which nothing is predicted for it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LabeledPoints:
    """Points of a scene.

    Attributes:
        scene: its name.
        objects: id of the object of each point, 0 = none.
        names: the class of each object that has one, by its id.
        gaussians: row of the Gaussian that each point takes predictions from, -1 = none is near.
        positions: of vertices, in the frame of the Gaussians; None where the points are the Gaussians themselves.
    """

    scene: str
    objects: Int32[np.ndarray, " P"]
    names: Mapping[int, str]
    gaussians: Int64[np.ndarray, " P"]
    positions: Float64[np.ndarray, "P 3"] | None = None

    def __len__(self) -> int:
        return len(self.objects)

    def named_ids(self) -> dict[int, str]:
        """The classes of the objects that have points, by their id in ascending order."""
        present = np.unique(self.objects)
        return {int(number): self.names[int(number)] for number in present if int(number) in self.names}

    def renamed(self, names: Mapping[str, str]) -> "LabeledPoints":
        """The points with other class names; objects whose name is not a key have no class."""
        return replace(self, names={number: names[name] for number, name in self.names.items() if name in names})

    def rows_of(self, number: int) -> Int64[np.ndarray, " n"]:
        """The Gaussians that speak for the points of an object, ascending, each once."""
        rows = np.unique(self.gaussians[self.objects == number])
        return rows[rows >= 0]

    def masked(self, rows: Int64[np.ndarray, " n"], count: int) -> Bool[np.ndarray, " P"]:
        """Which points take their prediction from some of `count` Gaussians."""
        inside = np.zeros(count + 1, bool)
        inside[rows] = True
        return inside[self.gaussians]


def labeled_points(
    scene: Scene, mesh: MeshLabels | None = None, *, max_distance: float = MAX_DISTANCE
) -> LabeledPoints:
    """The labeled points of a scene with Gaussians.

    Args:
        scene: with Gaussians; without a mesh, with views that have instance pictures, and objects.
        mesh: labeled, in the world of the scene, or None.
        max_distance: from a vertex to the nearest Gaussian, metres; world units where their length is not known.

    Raises:
        InputError: no Gaussians, or neither a mesh nor instance pictures and objects.
    """
    if scene.gaussians is None:
        raise InputError(f"scene {scene.name} has no Gaussians")
    if mesh is not None:
        return _vertices(scene, mesh, max_distance / (scene.metres_per_unit or 1.0))
    views = scene.views
    if views is None or views.instances is None or not scene.objects:
        raise InputError(
            f"scene {scene.name} has no true objects: expected a labeled mesh, or views with instance pictures "
            "(instance_file_path in transforms.json) and an objects.json that names them"
        )
    names = {each.id: each.name for each in scene.objects if each.name}
    gaussians = scene.gaussians
    ids = np.array(sorted({each.id for each in scene.objects}), np.int32)
    sums = torch.zeros(len(gaussians), len(ids) + 1)
    for view in range(len(views)):
        b = blend(gaussians, views.cameras, view)
        if views.depths is not None:
            b = keep_visible(b, views.depths[view], VisibilityConfig())
        # Column 0 is for pixels of no object.
        pixels = np.asarray(views.instances[view]).ravel()
        columns = np.where(np.isin(pixels, ids), np.searchsorted(ids, pixels) + 1, 0)
        b.lift_codes_into(torch.from_numpy(columns.astype(np.int32)), sums)
    weights = sums.sum(dim=1).numpy()
    best = sums.argmax(dim=1).numpy()
    objects = np.where(weights >= MIN_WEIGHT, np.concatenate([[0], ids])[best], 0).astype(np.int32)
    return LabeledPoints(scene=scene.name, objects=objects, names=names, gaussians=np.arange(len(gaussians)))


def _vertices(scene: Scene, mesh: MeshLabels, max_distance: float) -> LabeledPoints:
    assert scene.gaussians is not None
    positions = mesh.vertices.astype(np.float64) - scene.origin
    return LabeledPoints(
        scene=scene.name,
        objects=mesh.instances,
        names=dict(mesh.objects),
        gaussians=nearest_rows(positions, scene.gaussians.means.astype(np.float64), max_distance=max_distance),
        positions=positions,
    )
