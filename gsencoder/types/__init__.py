"""The types that stages exchange: frozen dataclasses over numpy arrays, validated when they are created.

Axes: N Gaussians, V views, H W pixels, h w feature-map pixels, D channels, R basis rank, K = (sh_degree + 1)²,
Q queries, C codes. World units are metres where known; camera axes are OpenCV's (x right, y down, z forward);
pixel centers lie at .5; quaternions are wxyz; depth is z. Values are physical: scales are standard deviations and
opacities are probabilities, never logarithms or logits.
"""

from gsencoder.core.arrays import UNIT_TOLERANCE
from gsencoder.types.features import (
    Box,
    FeatureBasis,
    FeatureMap,
    FeatureSpace,
    GaussianFeatures,
    Localization,
    MemoryBank,
    QueryMemory,
)
from gsencoder.types.scene import (
    SH_C0,
    Cameras,
    Gaussians,
    MeshLabels,
    Scene,
    SceneObject,
    Teacher,
    Views,
    check_unit,
    sh_from_colors,
)

__all__ = [
    "SH_C0",
    "UNIT_TOLERANCE",
    "Box",
    "Cameras",
    "FeatureBasis",
    "FeatureMap",
    "FeatureSpace",
    "GaussianFeatures",
    "Gaussians",
    "Localization",
    "MemoryBank",
    "MeshLabels",
    "QueryMemory",
    "Scene",
    "SceneObject",
    "Teacher",
    "Views",
    "check_unit",
    "sh_from_colors",
]
