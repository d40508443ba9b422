"""Scenes: Gaussians, cameras, posed views and labeled objects of one place.

A transform [R | t] takes points of one frame to another, x ↦ R x + t, and its name says which: `target_from_source`.
Camera axes are OpenCV's: x right, y down, z forward.

Cameras: pinhole intrinsics and rigid poses, projection and its inverse (Hartley and Zisserman 2004, ch. 6), for numpy
arrays of any float type; gsencoder.geometry holds both for tensors. Pixel centers lie at .5, as in COLMAP. Depth
is z in the camera, and not the length of the ray.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, UInt8

from gsencoder.core.arrays import UNIT_TOLERANCE, check_array, check_finite, check_rows, fail
from gsencoder.core.errors import InputError
from gsencoder.types.features import FeatureMap, FeatureSpace, GaussianFeatures

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's camera axes are x right, y up, z backward. The matrix is its own inverse."""


def transform(
    target_from_source: Float[np.ndarray, "*v 4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "*v n 3"]:
    """R x + t for each transform and point, in the float type of both.

    The result is laid out coordinate by coordinate: long rows of x, y and z are several times faster to compute with.
    """
    moved = target_from_source[..., :3, :3] @ points.T
    moved += target_from_source[..., :3, 3:]
    return moved.mT


def invert_rigid(target_from_source: Float[np.ndarray, "*v 4 4"]) -> Float[np.ndarray, "*v 4 4"]:
    """source_from_target of rigid transforms: [Rᵀ | −Rᵀt]."""
    rotation = target_from_source[..., :3, :3].mT
    inverse = np.zeros_like(target_from_source)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3:] = -(rotation @ target_from_source[..., :3, 3:])
    inverse[..., 3, 3] = 1
    return inverse


def move_origin(
    cam_from_world: Float64[np.ndarray, "*v 4 4"], origin: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "*v 4 4"]:
    """The same camera in a world whose coordinates count from `origin`: t becomes t + R·origin.

    In float64, so that for a distant origin the large numbers cancel before anything is rounded to float32.
    """
    moved = cam_from_world.copy()
    moved[..., :3, 3] += cam_from_world[..., :3, :3] @ origin
    return moved


def perpendicular(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """A unit vector perpendicular to `direction`, which is of any length but zero.

    It is the cross product with the coordinate axis that is farthest from parallel: the result of the z axis is y.
    """
    normal = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    return normal / np.linalg.norm(normal)


def look_rotation(forward: Float64[np.ndarray, "V 3"], up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "V 3 3"]:
    """Rotations cam_from_world of cameras that look along `forward`, level with `up`; rows are right, down, forward.

    Args:
        forward: unit vectors in the world.
        up: of the world, of any length; not parallel to any of them.
    """
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def look_at(
    centers: Float64[np.ndarray, "V 3"], forward: Float64[np.ndarray, "V 3"], up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "V 4 4"]:
    """cam_from_world of cameras at `centers` with the axes of `look_rotation`."""
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = look_rotation(forward, up)
    poses[:, :3, 3] = -np.einsum("vij,vj->vi", poses[:, :3, :3], centers)
    return poses


SH_C0 = 0.5 / math.sqrt(math.pi)  # A color is ½ + SH_C0 times its degree-0 coefficient, plus what depends on direction


def sh_from_colors(colors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 1 3"]:
    """Degree-0 coefficients that show `colors` (0 to 1) from everywhere, in their float type."""
    return ((colors - 0.5) / SH_C0)[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gaussians:
    """A splat in physical values."""

    means: Float32[np.ndarray, "N 3"]  # world units, relative to the scene's origin
    quats: Float32[np.ndarray, "N 4"]  # unit rotations wxyz, world_from_gaussian
    scales: Float32[np.ndarray, "N 3"]  # standard deviations along the Gaussian's own axes, > 0, world units
    opacities: Float32[np.ndarray, " N"]  # in [0, 1]
    sh: Float32[np.ndarray, "N K 3"]  # color coefficients, degree-major as in the INRIA files; K = 1, 4, 9 or 16

    def __post_init__(self) -> None:
        n = len(self.means) if isinstance(self.means, np.ndarray) and self.means.ndim else 0
        check_array("Gaussians", "means", self.means, "float32", (n, 3))
        check_array("Gaussians", "quats", self.quats, "float32", (n, 4))
        check_array("Gaussians", "scales", self.scales, "float32", (n, 3))
        check_array("Gaussians", "opacities", self.opacities, "float32", (n,))
        check_array("Gaussians", "sh", self.sh, "float32", (n, "K", 3))
        if self.sh.shape[1] not in (1, 4, 9, 16):
            fail("Gaussians", "sh", "1, 4, 9 or 16 coefficients (SH degree 0 to 3)", str(self.sh.shape[1]))
        for name in self.__dataclass_fields__:
            check_finite("Gaussians", name, getattr(self, name))
        with np.errstate(over="ignore"):  # A norm beyond float32 is infinite, and refused.
            norms = np.sqrt(np.einsum("nk,nk->n", self.quats, self.quats))
        check_rows(
            "Gaussians", "quats", np.asarray(np.abs(norms - 1) <= UNIT_TOLERANCE), "unit quaternions", self.quats
        )
        if not (self.scales > 0).all():
            check_rows("Gaussians", "scales", np.asarray((self.scales > 0).all(axis=1)), "scales > 0", self.scales)
        inside = np.asarray((self.opacities >= 0) & (self.opacities <= 1))
        check_rows("Gaussians", "opacities", inside, "values in [0, 1]", self.opacities)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    def select(self, rows: np.ndarray) -> "Gaussians":
        """The Gaussians of `rows` (indices or a mask), in that order."""
        return Gaussians(**{name: getattr(self, name)[rows] for name in self.__dataclass_fields__})


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> Float64[np.ndarray, "3 3"]:
    """K of focal lengths and a principal point, all in pixels."""
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], np.float64)


def pixel_centers(width: int, height: int) -> Float64[np.ndarray, "{height} {width} 2"]:
    """Coordinates (u, v) of all pixels of an image."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def project_points(
    points: Float[np.ndarray, "*v n 3"], K: Float[np.ndarray, "*v 3 3"], *, min_depth: float | None = None
) -> Float[np.ndarray, "*v n 2"]:
    """Pixels (fx·x/z + cx, fy·y/z + cy) of points in camera axes; not finite where z = 0.

    A point behind the camera has the pixel of its mirror image −x in front of it, so that `unproject_points` with its
    negative depth gives it back. With `min_depth` z is raised to it first: such points leave the image sideways.
    """
    rows = points.mT
    z = rows[..., 2:, :] if min_depth is None else np.maximum(rows[..., 2:, :], min_depth)
    pixels = rows[..., :2, :] * np.diagonal(K, axis1=-2, axis2=-1)[..., :2, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        pixels /= z
        pixels += K[..., :2, 2:]
    return pixels.mT


def unproject_points(
    pixels: Float[np.ndarray, "*n 2"], depths: Float[np.ndarray, "*n"], K: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Points in camera axes of pixels at depths z: the inverse of `project_points`."""
    x = (pixels[..., 0] - K[0, 2]) / K[0, 0] * depths
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1] * depths
    return np.stack((x, y, depths), axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cameras:
    """Pinhole cameras without distortion (it is removed at load)."""

    cam_from_world: Float32[np.ndarray, "V 4 4"]  # rigid, OpenCV camera axes, world relative to the scene's origin
    Ks: Float32[np.ndarray, "V 3 3"]  # pixels, pixel centers at .5
    widths: Int32[np.ndarray, " V"]  # of the images, pixels
    heights: Int32[np.ndarray, " V"]

    def __post_init__(self) -> None:
        v = len(self.cam_from_world) if isinstance(self.cam_from_world, np.ndarray) and self.cam_from_world.ndim else 0
        check_array("Cameras", "cam_from_world", self.cam_from_world, "float32", (v, 4, 4))
        check_array("Cameras", "Ks", self.Ks, "float32", (v, 3, 3))
        check_array("Cameras", "widths", self.widths, "int32", (v,))
        check_array("Cameras", "heights", self.heights, "int32", (v,))
        check_finite("Cameras", "cam_from_world", self.cam_from_world)
        check_finite("Cameras", "Ks", self.Ks)
        r = self.cam_from_world[:, :3, :3].astype(np.float64)
        rigid = np.abs(r.transpose(0, 2, 1) @ r - np.eye(3)).max(axis=(1, 2), initial=0) <= UNIT_TOLERANCE
        rigid &= np.linalg.det(r) > 0
        rigid &= (self.cam_from_world[:, 3] == np.array([0, 0, 0, 1], np.float32)).all(axis=1)
        check_rows(
            "Cameras", "cam_from_world", rigid, "rigid transforms (orthonormal, right-handed)", self.cam_from_world
        )
        pinhole = (self.Ks[:, 0, 0] > 0) & (self.Ks[:, 1, 1] > 0) & (self.Ks[:, 2] == np.array([0, 0, 1])).all(axis=1)
        pinhole &= (self.Ks[:, 1, 0] == 0) & (self.Ks[:, 0, 1] == 0)
        check_rows("Cameras", "Ks", pinhole, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0", self.Ks)
        check_rows("Cameras", "widths", self.widths > 0, "positive sizes", self.widths)
        check_rows("Cameras", "heights", self.heights > 0, "positive sizes", self.heights)

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @property
    def world_from_cam(self) -> Float64[np.ndarray, "V 4 4"]:
        """The inverse poses."""
        return invert_rigid(self.cam_from_world.astype(np.float64))

    @property
    def centers(self) -> Float64[np.ndarray, "V 3"]:
        """Camera centers in the world, −Rᵀt."""
        return self.world_from_cam[:, :3, 3]

    def project(
        self, points: Float[np.ndarray, "n 3"], view: int | None = None, *, min_depth: float | None = None
    ) -> tuple[Float[np.ndarray, "*v n 2"], Float[np.ndarray, "*v n"]]:
        """Pixels and depths of world points, in the points' float type; see `project_points` for those behind, and for
        `min_depth`, which leaves the depths that are returned as they are.

        Args:
            view: one camera; None = all of them, which puts an axis V before the others.
        """
        chosen = slice(None) if view is None else view
        poses, center = self.cam_from_world[chosen].astype(np.float64), np.zeros(3, points.dtype)
        if points.dtype != np.float64 and len(self):
            # In float32 a scene far from the origin would lose its shape in R x + t: x counts from the cameras instead,
            # which are the same for one view as for all.
            center = np.median(self.centers, axis=0).astype(points.dtype)
            points = points - center
        local = transform(move_origin(poses, center.astype(np.float64)).astype(points.dtype), points)
        K = self.Ks[chosen].astype(points.dtype, copy=False)
        return project_points(local, K, min_depth=min_depth), local[..., 2]

    def in_image(
        self,
        pixels: Float[np.ndarray, "*v n 2"],
        depths: Float[np.ndarray, "*v n"],
        view: int | None = None,
        *,
        near: float = 0.0,
    ) -> Bool[np.ndarray, "*v n"]:
        """Which projected points lie in the image and beyond depth `near`; what may hide them is not asked."""
        chosen = slice(None) if view is None else view
        u, v = pixels[..., 0], pixels[..., 1]
        # In the pixels' own type: against integers a comparison of float32 is done in float64.
        width, height = (size[chosen][..., None].astype(pixels.dtype) for size in (self.widths, self.heights))
        return (depths > near) & (u >= 0) & (u < width) & (v >= 0) & (v < height)

    def unproject(
        self, pixels: Float[np.ndarray, "*n 2"], depths: Float[np.ndarray, "*n"], view: int
    ) -> Float[np.ndarray, "*n 3"]:
        """World points of pixels at depths z, in their float type: the inverse of `project`."""
        local = unproject_points(pixels, depths, self.Ks[view].astype(pixels.dtype, copy=False))
        center = invert_rigid(self.cam_from_world[view].astype(np.float64))[:3, 3]
        return self.rotate_to_world(local, view) + center.astype(local.dtype, copy=False)

    def rays(self, view: int, pixels: Float[np.ndarray, "*n 2"] | None = None) -> Float[np.ndarray, "*n 3"]:
        """World directions through pixels, of depth 1: `center + depth · ray` is the point of that depth.

        Args:
            pixels: (u, v); None = the centers of all pixels of the image, [H, W].
        """
        if pixels is None:
            pixels = pixel_centers(int(self.widths[view]), int(self.heights[view]))
        ones = np.ones(pixels.shape[:-1], pixels.dtype)
        local = unproject_points(pixels, ones, self.Ks[view].astype(pixels.dtype, copy=False))
        return self.rotate_to_world(local, view)

    def rotate_to_world(self, directions: Float[np.ndarray, "*n 3"], view: int) -> Float[np.ndarray, "*n 3"]:
        """Directions in a camera's axes, such as normals, as directions in the world."""
        # Row vectors times R are Rᵀ times column vectors.
        return directions @ self.cam_from_world[view, :3, :3].astype(directions.dtype, copy=False)

    def select(self, views: Sequence[int] | np.ndarray | slice) -> "Cameras":
        """The cameras of `views`, in that order."""
        rows = views if isinstance(views, slice) else np.asarray(views, dtype=np.int64)
        return Cameras(**{name: getattr(self, name)[rows] for name in self.__dataclass_fields__})

    def resized(self, longest: int, *, enlarge: bool = True) -> "Cameras":
        """The same fields of view in pictures whose longer side has `longest` pixels; without `enlarge`, at most."""
        factors = longest / np.maximum(self.widths, self.heights)
        if not enlarge:
            factors = np.minimum(factors, 1)
        widths, heights = (np.maximum(1, size * factors + 0.5).astype(np.int32) for size in (self.widths, self.heights))
        return self.resized_to(widths, heights)

    def resized_to(self, widths: Int32[np.ndarray, " V"], heights: Int32[np.ndarray, " V"]) -> "Cameras":
        """The same fields of view in pictures of these sizes in pixels."""
        scale = np.ones((len(self), 3))
        scale[:, 0], scale[:, 1] = widths / self.widths, heights / self.heights
        Ks = (self.Ks * scale[:, :, None]).astype(np.float32)
        return Cameras(cam_from_world=self.cam_from_world, Ks=Ks, widths=widths, heights=heights)


def concatenate_cameras(parts: Sequence[Cameras]) -> Cameras:
    """The cameras of one or more lists, one list after the other."""
    fields = Cameras.__dataclass_fields__
    return Cameras(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})


LAZY = ("images", "depths", "masks", "empty", "instances")  # Fields of Views that are sequences with one entry a camera


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Views:
    """Cameras with what was seen through them. The sequences load on access: `views.images[3]` reads one file."""

    cameras: Cameras
    names: tuple[str, ...]  # unique, as the scene's files give them
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]] | None = None  # RGB
    depths: Sequence[Float32[np.ndarray, "_ _"]] | None = None  # z in world units, 0 = none
    masks: Sequence[Bool[np.ndarray, "_ _"]] | None = None  # True = use this pixel
    # True = the photograph shows that nothing is there, as transparency does; such pixels are masked, too.
    empty: Sequence[Bool[np.ndarray, "_ _"]] | None = None
    instances: Sequence[Int32[np.ndarray, "_ _"]] | None = None  # 0 = none
    # EXIF orientations, 1 to 8: how the stored pixels, which cameras and pictures are of, are turned to be upright
    # (`gsencoder.types.orientation`); None = all are.
    orientations: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        if len(self.names) != len(self.cameras):
            fail("Views", "names", f"{len(self.cameras)} names, one a camera", str(len(self.names)))
        if len(set(self.names)) != len(self.names):
            fail("Views", "names", "unique names", f"{len(self.names) - len(set(self.names))} repeated")
        for name in (*LAZY, "orientations"):
            value = getattr(self, name)
            if value is not None and len(value) != len(self.cameras):
                fail("Views", name, f"{len(self.cameras)} entries, one a camera", str(len(value)))

    def __len__(self) -> int:
        return len(self.cameras)

    def select(self, views: Sequence[int] | np.ndarray) -> "Views":
        """The views of these rows, in that order; files are still read on access."""
        rows = [int(view) for view in views]
        lazy = {name: None if (items := getattr(self, name)) is None else Selected(items, rows) for name in LAZY}
        return Views(
            cameras=self.cameras.select(rows),
            names=tuple(self.names[row] for row in rows),
            orientations=None if self.orientations is None else tuple(self.orientations[row] for row in rows),
            **lazy,
        )


class Selected(Sequence[Any]):
    """Entries `rows` of a sequence, each read on access."""

    def __init__(self, items: Sequence[Any], rows: list[int]) -> None:
        self.items, self.rows = items, rows

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return Selected(self.items, self.rows[index])
        return self.items[self.rows[index]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SceneObject:
    """A labeled object, for evaluation. The box is in world coordinates, origin included."""

    id: int  # its value in the instance maps
    name: str | None
    aabb_min: Float64[np.ndarray, "3"]
    aabb_max: Float64[np.ndarray, "3"]
    # One of the small objects, as opposed to furniture; of scanned scenes whatever is no part of the building
    # (`gsencoder.data.labels.scans.is_placed`).
    placed: bool = True
    views: int | None = 0  # in how many it shows; None where not counted (`with_counted_views` of the same module does)
    max_pixels: int | None = 0  # its largest visible area in a view; None as above


def check_unit(metres_per_unit: float, name: str) -> None:
    """Complains about what is no unit of length."""
    good = isinstance(metres_per_unit, (int, float)) and not isinstance(metres_per_unit, bool)
    if not good or not 0 < metres_per_unit <= sys.float_info.max:
        raise InputError(f"{name}: expected a positive number of metres, got {str(metres_per_unit)[:40]}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """A place: Gaussians, or views, or both; positions are relative to `origin`."""

    name: str  # for people and for output folders
    gaussians: Gaussians | None = None
    views: Views | None = None
    features: dict[str, GaussianFeatures] = field(default_factory=dict)  # by name of the space
    origin: Float64[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))  # boxes add it back
    metres_per_unit: float | None = None  # None = unknown
    up: Float64[np.ndarray, "3"] | None = None  # unit vector in the world; None = unknown
    objects: tuple[SceneObject, ...] = ()
    sfm_points: Float32[np.ndarray, "P 3"] | None = None
    sfm_colors: UInt8[np.ndarray, "P 3"] | None = None
    folder: Path | None = None  # that the scene was read from

    def __post_init__(self) -> None:
        if self.name in ("", ".", "..") or "/" in self.name or "\0" in self.name:
            fail("Scene", "name", "a name that a folder can have", repr(self.name[:60]))
        check_array("Scene", "origin", self.origin, "float64", (3,))
        if not np.isfinite(self.origin).all():
            fail("Scene", "origin", "finite values", str(self.origin.tolist()))
        if self.metres_per_unit is not None:
            check_unit(self.metres_per_unit, "Scene.metres_per_unit")
        if self.up is not None:
            check_array("Scene", "up", self.up, "float64", (3,))
            if not abs(float(np.linalg.norm(self.up)) - 1) <= UNIT_TOLERANCE:
                fail("Scene", "up", "a unit vector or None", str(self.up.tolist()))
        for name, features in self.features.items():
            if self.gaussians is None or len(features) != len(self.gaussians):
                got = "no Gaussians" if self.gaussians is None else f"{len(self.gaussians)} Gaussians"
                fail("Scene", f"features[{name!r}]", f"{len(features)} Gaussians to lie on", got)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshLabels:
    """The vertices of a mesh and the object of each, as a benchmark's ground truth has them.

    Attributes:
        vertices: in the world of the scene's poses, world units, no origin subtracted; in the order of the mesh file,
            since benchmarks count by it.
        instances: the id of each vertex's object, 0 = none.
        objects: (id from 1, raw name), in the order of the annotation. An object may have no vertex left, where others
            overlap it.
        faces: rows of vertices; None where the file has none or they were not read.
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


@runtime_checkable
class Teacher(Protocol):
    """Turns one view into a feature map.

    A teacher may also have `kinds`, the names that its maps show; they are stored with the features as words.

    Attributes:
        table: the vectors that all its maps are codes into or shares of; None where maps are dense or each has its own
            table.
        mean: the space's mean, where it is known without looking at the scene.
        needs_images: whether it looks at photographs (a splat without views is then rendered for it).
        cheap: whether making a map twice costs less than keeping it on disk.
    """

    @property
    def space(self) -> FeatureSpace: ...

    @property
    def table(self) -> Float32[np.ndarray, "C D"] | None: ...

    @property
    def mean(self) -> Float32[np.ndarray, " D"] | None: ...

    @property
    def needs_images(self) -> bool: ...

    @property
    def cheap(self) -> bool: ...

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The features of one view. What calls it (`gsencoder.fusion.checkpoint.upright`) gives upright views."""
        ...

    def settings(self) -> dict[str, Any]:
        """Everything that changes its output, as JSON values: stored with the features, compared on resuming."""
        ...
