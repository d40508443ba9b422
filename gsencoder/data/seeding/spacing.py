"""The spacing of Gaussians, and an estimate of the unit of length from it."""

import warnings

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import SceneWarning
from gsencoder.core.process import thread_count
from gsencoder.types import Scene

SPACING_SAMPLE = 100_000
NEIGHBOR = 4
"""A point of a square grid has so many neighbors at one step."""


def scene_spacing(means: Float32[np.ndarray, "N 3"]) -> float:
    """Median distance from a point to its fourth nearest neighbor: the step of a grid laid on surfaces.

    The nearest one alone would not do: where two scans of one surface lie a little apart, points come in close pairs.
    Above 100,000 points, a sample of about that many asks (all answer); it is drawn by a hash of the coordinates, so
    the order of the points does not matter. Points in one place count once; 0 where all coincide.
    """
    from scipy.spatial import cKDTree

    if len(means) < 2:
        return 0.0
    queries = means
    every = len(means) // SPACING_SAMPLE
    if every > 1:
        # -0.0 and 0.0 are one place and must hash alike, hence the addition.
        bits = (means + np.float32(0)).view(np.uint32).astype(np.uint64)
        mixed = bits @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
        sample = (mixed >> np.uint64(33)) % np.uint64(every) == 0
        queries = means[sample] if sample.any() else means
    # Column 0 is the point itself.
    tree = cKDTree(means, balanced_tree=False, compact_nodes=False)
    distances = np.asarray(tree.query(queries, k=min(NEIGHBOR, len(means) - 1) + 1, workers=thread_count())[0])
    if (distances[:, 1] == 0).any():
        distinct = np.unique(means, axis=0)
        return scene_spacing(distinct) if len(distinct) < len(means) else 0.0
    return float(np.median(distances[:, -1]))


def unit_of(scene: Scene, voxel: float) -> float:
    """Metres per unit of a scene with Gaussians, for a grid of `voxel` metres.

    Where the scene does not say, its Gaussians are taken to lie one voxel apart, as seeds do.

    Warns:
        SceneWarning: the unit was estimated, and how.
    """
    if scene.metres_per_unit is not None:
        return scene.metres_per_unit
    assert scene.gaussians is not None
    spacing = scene_spacing(scene.gaussians.means)
    if not spacing:
        warnings.warn(
            f"the unit of scene {scene.name!r} is unknown, and its Gaussians all lie in one place; a unit is taken for "
            "1 m; give data.metres_per_unit= if you know better",
            SceneWarning,
            stacklevel=3,
        )
        return 1.0
    unit = voxel / spacing
    warnings.warn(
        f"the unit of scene {scene.name!r} is unknown; its Gaussians lie {spacing:.4g} units apart, which is taken for "
        f"{voxel:g} m, so a unit for {unit:.4g} m; give data.metres_per_unit= if you know better",
        SceneWarning,
        stacklevel=3,
    )
    return unit
