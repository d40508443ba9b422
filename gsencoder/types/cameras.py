"""Cameras: pinhole intrinsics and rigid poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32

from gsencoder.types.checks import UNIT_TOLERANCE, check_array, check_finite, check_rows


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
    def centers(self) -> Float64[np.ndarray, "V 3"]:
        """Camera centers in the world, −Rᵀt."""
        pose = self.cam_from_world.astype(np.float64)
        return -np.einsum("vji,vj->vi", pose[:, :3, :3], pose[:, :3, 3])

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
        sizes = np.maximum(1, np.stack((self.widths, self.heights), axis=1) * factors[:, None] + 0.5).astype(np.int32)
        scale = np.ones((len(self), 3))
        scale[:, 0], scale[:, 1] = sizes[:, 0] / self.widths, sizes[:, 1] / self.heights
        return Cameras(
            cam_from_world=self.cam_from_world,
            Ks=(self.Ks * scale[:, :, None]).astype(np.float32),
            widths=np.ascontiguousarray(sizes[:, 0]),
            heights=np.ascontiguousarray(sizes[:, 1]),
        )
