"""Labels of a scanned mesh: which object each vertex belongs to."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32

from gsencoder.types.checks import check_array, check_finite, check_rows, fail


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshLabels:
    """The vertices of a mesh and the object of each, as a benchmark's ground truth has them.

    Attributes:
        vertices: in the world of the scene's poses, world units, no origin subtracted; in the order of the mesh file,
            since benchmarks count by it.
        instances: the id of each vertex's object, 0 = none.
        objects: (id, raw name) of each object, in the order of the annotation; ids are unique and at least 1. An object
            may have no vertex left, where others overlap it.
        faces: rows of the three vertices of each triangle; None where the file has none or they were not read.
        aligned_from_world: rigid transform into the frame in which a benchmark's boxes are axis-aligned, such as that
            of ScanRefer; None where no file states one, and the world is that frame.
    """

    vertices: Float32[np.ndarray, "V 3"]
    instances: Int32[np.ndarray, " V"]
    objects: tuple[tuple[int, str], ...]
    faces: Int32[np.ndarray, "F 3"] | None = None
    aligned_from_world: Float64[np.ndarray, "4 4"] | None = None

    def __post_init__(self) -> None:
        check_array("MeshLabels", "vertices", self.vertices, "float32", ("V", 3))
        check_array("MeshLabels", "instances", self.instances, "int32", (len(self.vertices),))
        check_finite("MeshLabels", "vertices", self.vertices)
        ids = [number for number, _ in self.objects]
        if any(number < 1 for number in ids):
            fail("MeshLabels", "objects", "ids from 1", str(min(ids)))
        if len(set(ids)) != len(ids):
            repeated = next(number for row, number in enumerate(ids) if number in ids[:row])
            fail("MeshLabels", "objects", "unique ids", f"{repeated} twice")
        known = np.asarray(np.isin(self.instances, np.array([0, *ids], np.int64)))
        check_rows("MeshLabels", "instances", known, "0 or the id of an object", self.instances)
        if self.faces is not None:
            check_array("MeshLabels", "faces", self.faces, "int32", ("F", 3))
            inside = np.asarray(((self.faces >= 0) & (self.faces < len(self.vertices))).all(axis=1))
            check_rows("MeshLabels", "faces", inside, f"rows of {len(self.vertices)} vertices", self.faces)
        if self.aligned_from_world is not None:
            check_array("MeshLabels", "aligned_from_world", self.aligned_from_world, "float64", (4, 4))
            check_finite("MeshLabels", "aligned_from_world", self.aligned_from_world)

    def __len__(self) -> int:
        return len(self.vertices)

    def boxes(self, *, aligned: bool = False) -> dict[int, tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]]:
        """Lower and upper corner of the axis-aligned box of each object's vertices; objects without any are left out.

        Args:
            aligned: whether the axes are those of the aligned frame, in which ScanRefer's boxes are, and the corners
                are given there; False = those of the world.
        """
        vertices = self.vertices.astype(np.float64)
        if aligned and self.aligned_from_world is not None:
            vertices = vertices @ self.aligned_from_world[:3, :3].T + self.aligned_from_world[:3, 3]
        rows = np.flatnonzero(self.instances)
        rows = rows[np.argsort(self.instances[rows], kind="stable")]
        ids, starts = np.unique(self.instances[rows], return_index=True)
        if not len(ids):
            return {}
        lower = np.minimum.reduceat(vertices[rows], starts, axis=0)
        upper = np.maximum.reduceat(vertices[rows], starts, axis=0)
        corners = {int(number): (low, high) for number, low, high in zip(ids, lower, upper, strict=True)}
        return {number: corners[number] for number, _ in self.objects if number in corners}
