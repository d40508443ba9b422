"""The semantics protocol: the class of each point by the nearest word to its feature (mIoU, mAcc, f-mIoU).

Each Gaussian is given the class whose name is nearest to its feature, among the classes of all scenes or of a
benchmark. A vertex of a labeled mesh has the class that is most frequent among the nearest Gaussians with a feature,
however far they are, as SceneSplat's benchmark counts (Li et al. 2025; pointcept/utils/misc.py, neighbor_voting).
Points without a named object are ignored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Int32

from gsencoder.core.errors import InputError
from gsencoder.data.labels.classes import ClassTable, vertex_classes
from gsencoder.data.labels.mesh import VOTERS, labels_of_vertices
from gsencoder.evaluate.benchmarks.semantics import BACKGROUND
from gsencoder.evaluate.sources import LabeledPoints, nearest_class
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures, Gaussians

NO_CLASS, NO_CLASS_BESIDE_ZERO = 0, -100
"""Ids of points of no class, in truth and predictions; the second where 0 is the id of a class, as in ScanNet++."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticsProtocol:
    """How vertices get the class of Gaussians, and which classes are of the foreground."""

    name: Literal["semantics"] = "semantics"
    voters: int = field(
        default=VOTERS,
        metadata={
            "help": "on meshes: nearest Gaussians with a feature whose most frequent class a vertex has; 1 = the "
            "nearest one"
        },
    )
    excluded: tuple[str, ...] = field(
        default=tuple(sorted(BACKGROUND)), metadata={"names": True, "help": "classes that f-mIoU leaves out"}
    )

    def __post_init__(self) -> None:
        if self.voters < 1:
            raise InputError(f"voters: expected 1 or more, got {self.voters}")


def semantic_truth(points: LabeledPoints, classes: ClassTable) -> Int32[np.ndarray, " P"]:
    """The class id of each point's object; `id_of_none` for points without a named object."""
    return vertex_classes(points.objects, points.names, classes.id_of, none=id_of_none(classes))


def id_of_none(classes: ClassTable) -> int:
    """The id of points of no class."""
    return NO_CLASS_BESIDE_ZERO if 0 in classes.ids else NO_CLASS


def predict_semantics(
    points: LabeledPoints,
    gaussians: Gaussians,
    features: GaussianFeatures,
    classes: ClassTable,
    text: TextEncoder,
    protocol: SemanticsProtocol = SemanticsProtocol(),
) -> Int32[np.ndarray, " P"]:
    """The predicted class id of each point; `id_of_none` where no Gaussian has a feature.

    Args:
        points: of a scene.
        gaussians: of the scene.
        features: of the Gaussians.
        classes: that can be predicted.
        text: turns their names into vectors.
        protocol: how many Gaussians vote for a vertex.

    Raises:
        InputError: words of another space, or a name that `text` does not know.
    """
    nearest = nearest_class(features, classes.names, text)
    none = id_of_none(classes)
    labels = np.array([*classes.ids, none], np.int32)[nearest]
    if points.positions is None:
        return labels
    return labels_of_vertices(
        points.positions, gaussians.means, labels, k=protocol.voters, none=none, voters=nearest >= 0
    )


def classes_of(names: Sequence[str]) -> ClassTable:
    """A table of classes without a benchmark: ids from 1 in the order of the names."""
    return ClassTable(names=tuple(names), ids=tuple(range(1, len(names) + 1)))
