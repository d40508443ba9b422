"""Gaussians: a splat in physical values."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from gsencoder.types.checks import UNIT_TOLERANCE, check_array, check_finite, check_rows, fail

SH_C0 = 0.5 / math.sqrt(math.pi)
"""A color is ½ + SH_C0 times its degree-0 coefficient, plus what depends on direction."""


def sh_from_colors(colors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 1 3"]:
    """Degree-0 coefficients that show `colors` (0 to 1) from everywhere, in their float type."""
    return ((colors - 0.5) / SH_C0)[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gaussians:
    """A splat in physical values.

    Attributes:
        means: centers, in world units relative to the scene's origin.
        quats: unit rotations wxyz, world_from_gaussian.
        scales: standard deviations along the Gaussian's own axes, > 0, world units.
        opacities: in [0, 1].
        sh: spherical-harmonic color coefficients, degree-major as in the INRIA files; K = 1, 4, 9 or 16.
    """

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N K 3"]

    def __post_init__(self) -> None:
        n = len(self.means) if isinstance(self.means, np.ndarray) and self.means.ndim else 0
        check_array("Gaussians", "means", self.means, "float32", (n, 3))
        check_array("Gaussians", "quats", self.quats, "float32", (n, 4))
        check_array("Gaussians", "scales", self.scales, "float32", (n, 3))
        check_array("Gaussians", "opacities", self.opacities, "float32", (n,))
        check_array("Gaussians", "sh", self.sh, "float32", (n, "K", 3))
        if self.sh.shape[1] not in (1, 4, 9, 16):
            fail("Gaussians", "sh", "1, 4, 9 or 16 coefficients (SH degree 0 to 3)", str(self.sh.shape[1]))
        for name in ("means", "quats", "scales", "opacities", "sh"):
            check_finite("Gaussians", name, getattr(self, name))
        with np.errstate(over="ignore"):  # A norm beyond float32 is infinite, and refused.
            norms = np.linalg.norm(self.quats, axis=1)
        check_rows(
            "Gaussians", "quats", np.asarray(np.abs(norms - 1) <= UNIT_TOLERANCE), "unit quaternions", self.quats
        )
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
        return Gaussians(
            means=self.means[rows],
            quats=self.quats[rows],
            scales=self.scales[rows],
            opacities=self.opacities[rows],
            sh=self.sh[rows],
        )
