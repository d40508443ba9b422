"""The recognition protocol: what given objects are, by the mean feature of their Gaussians (SplatDistill sec. 4.2,
table 1; CLIP²). The true objects are given, so that features alone are measured, and no segmentation."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.evaluate.benchmarks.recognition import NamedInstance, RankedNames
from gsencoder.evaluate.sources import LabeledPoints, class_cosines
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures

RANKED = 10
"""Names that are predicted for each object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionProtocol:
    """Which objects count."""

    name: Literal["recognition"] = "recognition"
    min_points: int = field(default=1, metadata={"help": "smallest number of points of an object that counts"})

    def __post_init__(self) -> None:
        if self.min_points < 1:
            raise InputError(f"min_points: expected 1 or more, got {self.min_points}")


def recognition_truth(points: LabeledPoints, protocol: RecognitionProtocol) -> list[NamedInstance]:
    """The named objects of a scene with enough points, by ascending id."""
    counts = np.bincount(points.objects)
    return [
        NamedInstance(scene=points.scene, object=str(number), name=name)
        for number, name in points.named_ids().items()
        if counts[number] >= protocol.min_points
    ]


def predict_recognition(
    points: LabeledPoints,
    features: GaussianFeatures,
    truth: Sequence[NamedInstance],
    names: Sequence[str],
    text: TextEncoder,
) -> list[RankedNames]:
    """The classes nearest to the mean feature of each object's Gaussians, the nearest first.

    An object of which no Gaussian was seen has no names.
    """
    parts = [points.rows_of(int(each.object)) for each in truth]
    cosines = class_cosines(features, parts, names, text)
    return [
        RankedNames(
            scene=each.scene,
            object=each.object,
            names=()
            if np.isnan(row).any()
            else tuple(names[number] for number in np.argsort(-row, kind="stable")[:RANKED]),
        )
        for each, row in zip(truth, cosines, strict=True)
    ]
