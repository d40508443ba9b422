"""The `synthetic` teacher: wide maps of known rank and noise that agree between views, for measuring speed and error.

Real dense teachers take most of a second a view; this one takes milliseconds, and what fusing should find is known.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.core.errors import InputError
from gsencoder.fusion.lift import ray_pixels
from gsencoder.render.rays import grid_lattice
from gsencoder.types import FeatureMap, FeatureSpace, Views

RAYS = 16
"""Rays over which a cell's features are averaged, as a patch of a vision transformer averages what it covers."""


class SyntheticTeacher:
    """A few random directions mixed by smooth functions of the 3D point that a pixel sees, plus noise and a mean.

    With x the world point of a pixel (from its depth), e_k random unit vectors of D channels and m a random vector of
    norm 1,

        features(x) = m + √(2(1 − noise) / rank) · Σ_k cos(ω_k · x + φ_k) e_k + √(noise / D) · n,    n ~ N(0, 1)

    so the energy about the mean is about 1 a cell, of which the share `noise` is spread evenly over all channels and
    differs between views, and the rest has rank `rank` and does not. Averaging over a cell's pixels takes a little off
    the finest waves. A cell without any depth has the mean and noise alone.
    """

    table = None
    mean = None
    needs_images = False
    cheap = True

    def __init__(
        self,
        *,
        channels: int = 1280,
        rank: int = 32,
        noise: float = 0.1,
        seed: int = 0,
        height: int = 24,
        width: int = 32,
        wavelength: float = 1.0,
    ) -> None:
        """Draws directions and waves.

        Args:
            channels: D.
            rank: directions that carry the signal.
            noise: share of the energy that is noise, in [0, 1).
            seed: of everything that is random.
            height: cells of a map; the whole image is resized to them, as 336 × 448 pixels to 24 × 32.
            width: cells of a map.
            wavelength: shortest wave of the signal in world units; the longest is four times as long.

        Raises:
            InputError: sizes that are not positive, rank above the channels, noise outside [0, 1).
        """
        if min(channels, rank, height, width) < 1 or rank > channels:
            raise InputError(f"synthetic teacher: expected sizes ≥ 1 and rank ≤ channels, got {rank} of {channels}")
        if not 0 <= noise < 1 or not 0 < wavelength < math.inf:
            raise InputError(
                f"synthetic teacher: expected noise in [0, 1) and wavelength > 0, got {noise}, {wavelength}"
            )
        self.noise, self.seed, self.height, self.width, self.wavelength = noise, seed, height, width, wavelength
        rng = np.random.default_rng(seed)
        directions = rng.standard_normal((rank, channels))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        self.directions: Float32[np.ndarray, "rank D"] = (directions * math.sqrt(2 * (1 - noise) / rank)).astype(
            np.float32
        )
        center = rng.standard_normal(channels)
        self.center: Float32[np.ndarray, " D"] = (center / np.linalg.norm(center)).astype(np.float32)
        waves = rng.standard_normal((rank, 3))
        lengths = wavelength * 4 ** rng.uniform(size=(rank, 1))
        self.waves: Float64[np.ndarray, "rank 3"] = (
            2 * np.pi * waves / np.linalg.norm(waves, axis=1, keepdims=True) / lengths
        )
        self.phases: Float64[np.ndarray, " rank"] = rng.uniform(0, 2 * np.pi, rank)
        self.space = FeatureSpace(
            name=f"synthetic-{channels}",
            channels=channels,
            teacher="synthetic",
            weights=f"seed {seed}, rank {rank}, noise {noise:g}",
            preprocessing=f"resize to {width}×{height} cells",
        )

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The features of one view; the same view gives the same noise.

        Raises:
            InputError: the scene has no depth.
        """
        if views.depths is None:
            raise InputError("synthetic teacher: the scene has no depth to find the points that its pixels see")
        cameras = views.cameras
        size = int(cameras.widths[view]), int(cameras.heights[view])
        affine = np.array([[self.width / size[0], 0, 0], [0, self.height / size[1], 0]])
        lattice = grid_lattice(affine, self.width, self.height, RAYS)
        y, x = ray_pixels(lattice, *size)
        z = views.depths[view][np.ix_(y, x)].astype(np.float64)
        points = cameras.unproject(np.stack(np.meshgrid(x + 0.5, y + 0.5), axis=-1), z, view)
        mixed = np.cos(points @ self.waves.T + self.phases) * (z > 0)[..., None]
        blocks = mixed.reshape(self.height, lattice.side, self.width, lattice.side, -1)
        rays = (z > 0).reshape(self.height, lattice.side, self.width, lattice.side).sum(axis=(1, 3))
        mixed = (blocks.sum(axis=(1, 3)) / np.maximum(rays, 1)[..., None]).astype(np.float32)
        features = np.random.default_rng([self.seed, view]).standard_normal(
            (self.height, self.width, self.space.channels), np.float32
        )
        features *= np.float32(math.sqrt(self.noise / self.space.channels))
        features += mixed @ self.directions
        features += self.center
        return FeatureMap(features=features, grid_from_image=affine, space=self.space)

    def settings(self) -> dict[str, Any]:
        return {
            "name": "synthetic",
            "space": self.space.weights,
            "grid": [self.height, self.width],
            "wavelength": self.wavelength,
        }
