"""The extremes that numeric routines are measured at: one small scene each, in which one thing is extreme.

A routine reads some parts of a case (`PARTS`), and an extreme changes some. Where they share none, the routine would be
measured on what it was measured on at `ordinary`, so that the cell does not apply.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from splats import front_camera, random_gaussians, random_rotation

from gsencoder.types import Cameras, Gaussians

CHANNELS = 24
"""Of the feature vectors of a case."""
NEAR = 0.01
PARTS = ("splat", "camera", "vectors", "logits")


@dataclass(frozen=True)
class Case:
    """What routines are measured on.

    Attributes:
        gaussians: the splat, SH degree 3.
        cameras: one camera.
        vectors: one feature vector a Gaussian, [N, CHANNELS] float32.
        logits: largest magnitude of attention scores.
        voxel: edge of a cell of the encoder's grid, world units.
    """

    gaussians: Gaussians
    cameras: Cameras
    vectors: np.ndarray
    logits: float = 10.0
    voxel: float = 0.1


@dataclass(frozen=True)
class Extreme:
    """A named case.

    Attributes:
        name: in the table.
        what: one line for the documentation.
        changes: the parts in which it differs from `ordinary`.
        make: the case.
    """

    name: str
    what: str
    changes: frozenset[str]
    make: Callable[[], Case]


def camera(width: int = 24, height: int = 16, focal: float = 20.0, pose: np.ndarray | None = None) -> Cameras:
    made = front_camera(width, height, focal)
    return made if pose is None else replace(made, cam_from_world=pose[None].astype(np.float32))


def vectors_of(n: int, norm: float = 1.0, rank: int = CHANNELS, mean: float = 0.3) -> np.ndarray:
    """Vectors of length `norm`, approximately, that span `rank` directions; `mean` is the share of what is common."""
    rng = np.random.default_rng(n)
    local = rng.normal(size=(n, rank)) @ np.linalg.qr(rng.normal(size=(CHANNELS, rank)))[0].T / math.sqrt(rank)
    common = rng.normal(size=CHANNELS)
    made = local + mean * common / np.linalg.norm(common)
    return (norm * made).astype(np.float32)


def case(
    n: int = 100, *, cameras: Cameras | None = None, vectors: np.ndarray | None = None, logits: float = 10.0
) -> Case:
    gaussians = random_gaussians(n, 1, log_scale=-1.5, degree=3)
    gaussians = replace(gaussians, sh=(gaussians.sh * 0.3).astype(np.float32))
    return Case(gaussians, cameras or camera(), vectors_of(n) if vectors is None else vectors, logits)


def splat(n: int = 100, **fields: np.ndarray) -> Case:
    """The ordinary case with some fields of the Gaussians replaced."""
    made = case(n)
    return replace(made, gaussians=replace(made.gaussians, **{k: v.astype(np.float32) for k, v in fields.items()}))


def far(origin: float, unit: float) -> Case:
    """The ordinary scene, `unit` times as large, at a distance from the origin. float32 rounds what it is made of; the
    rounded arrays are the case."""
    made, rng = case(), np.random.default_rng(5)
    center = origin * np.array([0.6, -0.64, 0.48])
    rotation = random_rotation(rng)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    means = center + unit * made.gaussians.means.astype(np.float64) @ rotation
    gaussians = replace(made.gaussians, means=means.astype(np.float32), scales=made.gaussians.scales * np.float32(unit))
    return replace(made, gaussians=gaussians, cameras=camera(pose=pose), voxel=0.1 * unit)


def needles() -> Case:
    scales = np.tile([1.0, 1e-6, 1e-6], (100, 1))
    return splat(scales=scales, opacities=np.full(100, 0.9))


def layers(n: int = 10_000) -> Case:
    """Faint Gaussians one behind the other, all in front of every pixel."""
    rng = np.random.default_rng(2)
    means = np.stack([rng.normal(size=n) * 0.01, rng.normal(size=n) * 0.01, np.linspace(2, 4, n)], axis=1)
    made = splat(n, means=means, scales=np.full((n, 3), 0.5), opacities=rng.uniform(0.002, 0.02, n))
    return replace(made, cameras=camera(6, 4, 5.0))


def transparent_and_opaque() -> Case:
    return splat(opacities=np.where(np.arange(100) % 2, 1.0, 0.0))


def inside() -> Case:
    """The camera is in the middle of a large Gaussian, and in the skirts of a dozen."""
    means, scales = case().gaussians.means.copy(), case().gaussians.scales.copy()
    means[:12] = np.random.default_rng(1).normal(size=(12, 3)) * 0.1
    means[:12, 2] = np.abs(means[:12, 2]) + 0.011
    means[0], scales[:12] = (0.0, 0.0, 0.02), 1.0
    return splat(means=means, scales=scales)


def near_plane() -> Case:
    """A dozen Gaussians by one part in a million before and behind the near plane."""
    means, scales = case().gaussians.means.copy(), case().gaussians.scales.copy()
    means[:12, :2] *= 0.005
    means[:12, 2] = NEAR * (1 + 1e-6 * np.where(np.arange(12) % 2, 1, -1))
    scales[:12] *= 0.01
    return splat(means=means, scales=scales)


def narrow() -> Case:
    """0.1° across; the scene is as far away as it has to be."""
    means = case().gaussians.means * np.array([0.3, 0.3, 100]) + np.array([0, 0, 300])
    made = splat(means=means)
    return replace(made, cameras=camera(focal=12 / math.tan(math.radians(0.05))))


def wide() -> Case:
    """170° across, with Gaussians up to the border."""
    rng = np.random.default_rng(3)
    means = case().gaussians.means.copy()
    means[:50, :2] = rng.uniform(-10, 10, (50, 2))
    means[:50, 2] = rng.uniform(0.05, 1, 50)
    return replace(splat(means=means), cameras=camera(focal=12 / math.tan(math.radians(85))))


def with_vectors(vectors: np.ndarray) -> Callable[[], Case]:
    return lambda: case(vectors=vectors)


def one_cell() -> Case:
    rng = np.random.default_rng(4)
    return splat(500, means=np.array([0.05, 0.05, 2.05]) + rng.uniform(-0.04, 0.04, (500, 3)))


SPLAT, CAMERA, VECTORS, LOGITS = (frozenset([part]) for part in PARTS)
EXTREMES: tuple[Extreme, ...] = (
    Extreme("ordinary", "100 Gaussians in a ball before a camera of 24 × 16 pixels", frozenset(PARTS), case),
    Extreme("origin 1e5", "scene and camera 10⁵ units from the origin", SPLAT | CAMERA, lambda: far(1e5, 1)),
    Extreme("origin 1e7", "… 10⁷ units, the scene 100 times as large", SPLAT | CAMERA, lambda: far(1e7, 1e2)),
    Extreme("origin 1e9", "… 10⁹ units, the scene 10⁴ times as large", SPLAT | CAMERA, lambda: far(1e9, 1e4)),
    Extreme("scales 1e-9", "standard deviations of 10⁻⁹", SPLAT, lambda: splat(scales=np.full((100, 3), 1e-9))),
    Extreme("scales 1e4", "standard deviations of 10⁴", SPLAT, lambda: splat(scales=np.full((100, 3), 1e4))),
    Extreme("needles", "standard deviations of 1, 10⁻⁶ and 10⁻⁶", SPLAT, needles),
    Extreme(
        "coincident", "100 Gaussians with one center", SPLAT, lambda: splat(means=np.tile([0.1, -0.2, 2.0], (100, 1)))
    ),
    Extreme("10,000 layers", "10⁴ faint Gaussians before every pixel", SPLAT, layers),
    Extreme("opacity 0 and 1", "every other Gaussian opaque, the others not there", SPLAT, transparent_and_opaque),
    Extreme("camera inside", "the camera in the middle of a Gaussian", SPLAT, inside),
    Extreme("near plane", "Gaussians within 10⁻⁶ of the near plane", SPLAT, near_plane),
    Extreme("fov 0.1°", "a picture 0.1° across", SPLAT | CAMERA, narrow),
    Extreme("fov 170°", "a picture 170° across", SPLAT | CAMERA, wide),
    Extreme("one pixel", "a picture of one pixel", CAMERA, lambda: case(cameras=camera(1, 1, 1.0))),
    Extreme("one Gaussian", "a splat of one Gaussian", SPLAT | VECTORS, lambda: case(1)),
    Extreme("one cell", "500 Gaussians in one cell of the grid", SPLAT, one_cell),
    Extreme("norm 1e-8", "feature vectors of length 10⁻⁸", VECTORS, with_vectors(vectors_of(100, 1e-8))),
    Extreme("norm 1e6", "feature vectors of length 10⁶", VECTORS, with_vectors(vectors_of(100, 1e6))),
    Extreme(
        "narrow cone", "a mean 10³ times as long as the spread", VECTORS, with_vectors(vectors_of(100, 1.0, mean=1e3))
    ),
    Extreme(
        "rank 2", "feature vectors that span two directions", VECTORS, with_vectors(vectors_of(100, rank=2, mean=0))
    ),
    Extreme("equal vectors", "one vector for all", VECTORS, with_vectors(np.tile(vectors_of(100)[:1], (100, 1)))),
    Extreme("logits 1e4", "attention scores from −10⁴ to 10⁴", LOGITS, lambda: case(logits=1e4)),
)
