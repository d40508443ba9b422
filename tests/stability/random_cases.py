"""Random extreme cases, for searches: several things may be extreme at once, within the domains of routines."""

import math
from dataclasses import dataclass, replace

import numpy as np
from splats import random_rotation
from stability.extremes import Case, camera, case, vectors_of


@dataclass(frozen=True)
class Recipe:
    """What a case is made from; each field is near its ordinary value at 0, so that shrinking leads there.

    Attributes:
        n: Gaussians.
        origin: decades of the distance from the origin, in extents of the scene, 0 to 5.
        unit: decades of the scene's size, −6 to 6.
        scale: decades of the sizes of Gaussians, relative to the scene, −8 to 12.
        aspect: decades of the ratio of largest to smallest axis, 0 to 6.
        opacity: 0 = uniform, 1 = 0 or 1, 2 = faint, 3 = opaque.
        fov: decades of the tangent of half the field of view, −3 (0.1°) to 1.1 (170°).
        depth: decades of the distance of the nearest Gaussians, −2 to 2, in extents of the scene.
        size: pixels of the picture's longer side.
        norm: decades of the length of features, −8 to 6.
        mean: decades of the length of their mean, relative to the spread, −3 to 3.
        rank: dimensions that they span.
        logits: decades of the attention scores, 0 to 4.
        seed: of the rest.
    """

    n: int = 20
    origin: float = 0.0
    unit: float = 0.0
    scale: float = 0.0
    aspect: float = 0.0
    opacity: int = 0
    fov: float = 0.0
    depth: float = 0.0
    size: int = 12
    norm: float = 0.0
    mean: float = 0.0
    rank: int = 24
    logits: float = 0.0
    seed: int = 0

    def make(self) -> Case:
        rng = np.random.default_rng(self.seed)
        made, unit, tangent = case(self.n), 10.0**self.unit, 10.0**self.fov
        z = 10.0**self.depth * (1 + rng.uniform(0, 1, self.n))
        local = np.stack([*(rng.uniform(-1.2, 1.2, (2, self.n)) * tangent * z), z], axis=1) * unit
        # Narrow pictures of far scenes keep the Gaussians' size on the picture; wide ones that in the scene.
        sizes = 0.1 * unit * 10.0 ** (self.scale + self.depth) * min(tangent, 1) * np.ones((self.n, 3))
        sizes[:, 1] *= 10.0 ** (-self.aspect * rng.uniform(0, 1))
        sizes[:, 2] *= 10.0**-self.aspect
        quats = rng.normal(size=(self.n, 4))
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        opacities = (
            rng.uniform(0, 1, self.n), rng.integers(0, 2, self.n).astype(float), rng.uniform(0, 0.02, self.n),
            np.ones(self.n),
        )[self.opacity]  # fmt: skip
        extent = max(np.abs(local).max(), 1e-30)
        away = 10.0**self.origin * extent * (self.origin > 0)
        center = away * np.array([0.6, -0.64, 0.48])
        pose = np.eye(4)
        pose[:3, :3] = random_rotation(rng)
        pose[:3, 3] = -pose[:3, :3] @ center
        gaussians = replace(
            made.gaussians, means=(center + local @ pose[:3, :3]).astype(np.float32),
            scales=np.maximum(sizes, 1e-18).astype(np.float32), quats=quats.astype(np.float32),
            opacities=opacities.astype(np.float32),
        )  # fmt: skip
        focal = self.size / 2 / tangent
        return Case(
            gaussians=gaussians, cameras=camera(self.size, max(1, self.size * 2 // 3), focal, pose),
            vectors=vectors_of(self.n, 10.0**self.norm, self.rank, 10.0**self.mean), logits=10.0**self.logits,
            voxel=extent / 20,
        )  # fmt: skip


LOW = Recipe(1, 0.0, -6.0, -8.0, 0.0, 0, -3.0, -2.0, 1, -8.0, -3.0, 1, 0.0, 0)
HIGH = Recipe(60, 5.0, 6.0, 12.0, 6.0, 3, math.log10(math.tan(math.radians(85))), 2.0, 24, 6.0, 3.0, 24, 4.0, 1000)
"""The ranges that searches draw from."""

FAILED: tuple[Recipe, ...] = (
    # Boxes: trimesh has none for volumes below 1e-12, and raised a TypeError.
    Recipe(unit=-6.0, depth=-2.0),
    # Projection in float32 lost the shape of a scene that is far from the origin: 0.04 of the pixel coordinates.
    Recipe(origin=5.0, unit=2.0),
    # …, and 1e-4 of them where the camera is turned and the field of view is 0.1°.
    Recipe(fov=-3.0, seed=4),
    # The square of a determinant of 1e10 pixels was beyond float32: conics were 0 and their gradients not numbers.
    Recipe(scale=12.0),
    # A quaternion of length 1e-9 was not brought to length 1.
    Recipe(norm=-8.0, rank=1),
)
"""What searches broke, shrunk; each was mended and is tried again."""
