"""Gaussians in blocks of space, so that those that rays may meet are looked for where a view shows anything at all."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, Int64

from gsencoder.fusion.coverage.kernels import near_rays
from gsencoder.geometry import ALPHA_MIN
from gsencoder.render.rays import Lattice
from gsencoder.types import Cameras, Gaussians

BLOCKS, PARTS = 24, 2
"""Blocks along each axis, and parts of a block along each axis."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShapeRows:
    """Gaussians without colors, as `Gaussians` has them; rows of checked ones are not checked again."""

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]

    @classmethod
    def of(cls, gaussians: Gaussians, rows: Int64[np.ndarray, " n"]) -> "ShapeRows":
        return cls(
            means=gaussians.means[rows],
            quats=gaussians.quats[rows],
            scales=gaussians.scales[rows],
            opacities=gaussians.opacities[rows],
        )

    def __len__(self) -> int:
        return len(self.means)


class Blocks:
    """Gaussians sorted by the block of space that their means lie in.

    Attributes:
        gaussians: all of them, in the order in which they came.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = gaussians
        # The opacity falls to ALPHA_MIN at this many standard deviations from the center.
        largest = math.sqrt(2 * math.log(max(float(gaussians.opacities.max(initial=0)) / ALPHA_MIN, 1)))
        reaches = largest * gaussians.scales.max(axis=1)
        means = gaussians.means
        # Most means lie between these quantiles; the others count to the blocks at the border.
        some = means[:: max(1, len(means) // 10_000)]
        low, high = np.quantile(some, (0.01, 0.99), axis=0).astype(np.float32)
        fine = BLOCKS * PARTS
        cell = np.clip((means - low) * (fine / np.maximum(high - low, 1e-12)), 0, fine - 1).astype(np.int32)
        block, part = np.divmod(cell, PARTS)
        codes = ((block[:, 0] * BLOCKS + block[:, 1]) * BLOCKS + block[:, 2]) * PARTS**3
        codes += (part[:, 0] * PARTS + part[:, 1]) * PARTS + part[:, 2]
        self._order = np.argsort(codes, kind="stable")
        codes = codes[self._order]
        self._block_starts = _starts(codes // PARTS**3)
        self._block_of = np.empty(len(means), np.int32)
        self._block_of[self._order] = np.repeat(np.arange(len(self._block_starts) - 1), np.diff(self._block_starts))
        self._starts = _starts(codes)
        self._means, self._reaches = means[self._order], reaches[self._order]
        first = np.minimum.reduceat(self._means, self._starts[:-1], axis=0).astype(np.float64)
        last = np.maximum.reduceat(self._means, self._starts[:-1], axis=0).astype(np.float64)
        reach = np.maximum.reduceat(self._reaches, self._starts[:-1])
        self._centers, self._radii = (first + last) / 2, np.linalg.norm(last - first, axis=1) / 2 + reach

    def near(
        self,
        cameras: Cameras,
        view: int,
        lattice: Lattice,
        ends: Float32[np.ndarray, " squares"],
        shape: tuple[int, int],
        near: float,
    ) -> Int64[np.ndarray, " n"]:
        """The rows of Gaussians that may touch a square of rays, ascending.

        Args:
            cameras: of the views.
            view: which of them.
            lattice: of its rays.
            ends: for each square, `kernels.TILE` rays along a side, the depth behind which its rays meet nothing; −inf
                where it has none.
            shape: number of squares in a line, and of lines.
            near: near plane, world units.
        """
        pose, K = cameras.cam_from_world[view].astype(np.float64), cameras.Ks[view].astype(np.float64)
        rays = (lattice.x0, lattice.y0, lattice.dx, lattice.dy)
        z = self._centers @ pose[2, :3] + pose[2, 3]
        # The ball of a block that reaches behind the camera has no bounds in the picture.
        ahead, around = np.flatnonzero(z > 2 * self._radii + near), np.flatnonzero(np.abs(z) <= 2 * self._radii + near)
        settings = (pose, K, near, rays, ends, shape)
        out = np.empty(len(ahead), np.int64)
        each = np.stack([ahead, ahead + 1], axis=1)
        count = near_rays(self._centers, 2 * self._radii, 1.0, each, *settings, out)
        blocks = np.concatenate([around, out[:count]])
        parts = np.stack([self._starts[blocks], self._starts[blocks + 1]], axis=1)
        out = np.empty(int((parts[:, 1] - parts[:, 0]).sum()), np.int64)
        count = near_rays(self._means, self._reaches, 0.0, parts, *settings, out)
        return np.sort(self._order[out[:count]])

    def around(self, row: int, count: int) -> Int64[np.ndarray, " n"]:
        """Up to so many Gaussians of the block of a Gaussian: those nearest to it, itself among them."""
        block = self._block_of[row]
        rows = self._order[self._block_starts[block] : self._block_starts[block + 1]]
        distances = np.square(self.gaussians.means[rows] - self.gaussians.means[row]).sum(axis=1)
        return rows[np.argsort(distances, kind="stable")[:count]]


def _starts(codes: Int32[np.ndarray, " N"]) -> Int64[np.ndarray, " starts"]:
    """Where runs of equal codes begin, and where the last one ends."""
    return np.concatenate(([0], np.flatnonzero(np.diff(codes)) + 1, [len(codes)]))
