"""Cameras: pinhole intrinsics and rigid poses, projection and its inverse (Hartley and Zisserman 2004, ch. 6).

For numpy arrays of any float type, without torch; gsencoder.geometry holds the pinhole for tensors. Pixel centers lie
at .5, as in COLMAP. Depth is z in the camera, and not the length of the ray.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32

from gsencoder.types.checks import UNIT_TOLERANCE, check_array, check_finite, check_rows
from gsencoder.types.poses import invert_rigid, move_origin, transform


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
    negative depth gives it back.

    Args:
        points: [x, y, z] in camera axes.
        K: intrinsics of each camera.
        min_depth: where given, z is raised to it first, so that points behind the camera leave the image sideways.
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
    """Pinhole cameras without distortion (it is removed at load).

    Attributes:
        cam_from_world: rigid transforms into OpenCV camera axes; world is relative to the scene's origin.
        Ks: intrinsics in pixels, pixel centers at .5.
        widths: image widths in pixels.
        heights: image heights in pixels.
    """

    cam_from_world: Float32[np.ndarray, "V 4 4"]
    Ks: Float32[np.ndarray, "V 3 3"]
    widths: Int32[np.ndarray, " V"]
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
        """Pixels and depths of world points, in the points' float type; see `project_points` for those behind.

        Args:
            points: in the cameras' world.
            view: one camera; None = all of them, which puts an axis V before the others.
            min_depth: see `project_points`; the depths that are returned stay as they are.
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
        """Which projected points lie in the image and beyond depth `near`; what may hide them is not asked.

        Args:
            pixels: of `project`, for the same view.
            depths: beside them.
            view: one camera; None = all of them.
            near: smallest depth, world units, itself excluded.
        """
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
            view: the camera.
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
        return Cameras(
            cam_from_world=self.cam_from_world[rows],
            Ks=self.Ks[rows],
            widths=self.widths[rows],
            heights=self.heights[rows],
        )

    def resized(self, longest: int, *, enlarge: bool = True) -> "Cameras":
        """The same fields of view in pictures whose longer side has so many pixels; without `enlarge`, at most so
        many."""
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
