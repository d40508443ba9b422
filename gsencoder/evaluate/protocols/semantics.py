"""The semantics protocol: the class of each point by the nearest word to its feature (mIoU, mAcc, f-mIoU).

Each Gaussian is given the class whose name is nearest to its feature, among the classes of all scenes or of a
benchmark, and points take the class of their Gaussian. Points without a named object are ignored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Int64

from gsencoder.evaluate.class_scores import nearest_class
from gsencoder.evaluate.labeled_points import LabeledPoints
from gsencoder.evaluate.scores.class_table import ClassTable
from gsencoder.evaluate.scores.semantics import BACKGROUND
from gsencoder.text.encoder import TextEncoder
from gsencoder.types import GaussianFeatures

NO_CLASS = 0
"""Id of points of no class, in truth and predictions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SemanticsProtocol:
    """Which classes are of the foreground."""

    name: Literal["semantics"] = "semantics"
    excluded: tuple[str, ...] = field(
        default=tuple(sorted(BACKGROUND)), metadata={"help": "classes that f-mIoU leaves out"}
    )


def semantic_truth(points: LabeledPoints, classes: ClassTable) -> Int64[np.ndarray, " P"]:
    """The class id of each point's object; `NO_CLASS` for points without a named object."""
    ids = dict(zip(classes.names, classes.ids, strict=True))
    truth = np.full(len(points), NO_CLASS, np.int64)
    for number, name in points.named_ids().items():
        if name in ids:
            truth[points.objects == number] = ids[name]
    return truth


def predict_semantics(
    points: LabeledPoints, features: GaussianFeatures, classes: ClassTable, text: TextEncoder
) -> Int64[np.ndarray, " P"]:
    """The predicted class id of each point; `NO_CLASS` where no Gaussian with a feature is near."""
    nearest = nearest_class(features, classes.names, text)
    ids = np.array([*classes.ids, NO_CLASS], np.int64)
    return np.asarray(points.from_gaussians(ids[nearest], NO_CLASS))


def classes_of(names: Sequence[str]) -> ClassTable:
    """A table of classes without a benchmark: ids from 1 in the order of the names."""
    return ClassTable(names=tuple(names), ids=tuple(range(1, len(names) + 1)))
