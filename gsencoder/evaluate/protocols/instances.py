"""The instances protocol: average precision of masks with a class and a score (SplatDistill sec. 4.2, tables 2 and 7).

Masks are the clusters of Gaussians that `localize` finds for the name of each class, with the probability of their box
as the score. Or the true objects are given as class-agnostic proposals: their class is recognized by the mean feature,
and the score is the class's share in a softmax over the cosines of all classes.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from gsencoder.core.errors import InputError, about
from gsencoder.data.labels.classes import ClassTable
from gsencoder.data.labels.expressions import instance_truth
from gsencoder.evaluate.benchmarks.instances import MIN_REGION, InstancePrediction, InstanceTruth, prediction_of_masks
from gsencoder.evaluate.sources import LabeledPoints, class_cosines
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.text.table import TextEncoder
from gsencoder.types import GaussianFeatures, Scene

Proposals = Literal["clusters", "truth"]
TEMPERATURE = 0.1
"""Of the softmax over classes, as for relevancy (LERF)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InstancesProtocol:
    """Where masks come from, and which count."""

    name: Literal["instances"] = "instances"
    proposals: Proposals = field(
        default="clusters",
        metadata={
            "help": "masks: clusters = what localize finds for each class; truth = the true objects, to be named"
        },
    )
    min_region: int = field(
        default=MIN_REGION, metadata={"help": "smallest number of points of a true object and of a mask that count"}
    )
    class_agnostic: bool = field(default=False, metadata={"help": "leave the classes of masks out of account"})

    def __post_init__(self) -> None:
        if self.min_region < 1:
            raise InputError(f"min_region: expected 1 or more, got {self.min_region}")


def true_instances(points: LabeledPoints, classes: ClassTable) -> InstanceTruth:
    """The true instances of a scene.

    Raises:
        InputError: a class has a thousand objects or more, whose ids the benchmark's format cannot hold, or the id 0.
    """
    classes.check_instance_ids()
    with about(f"scene {points.scene}"):
        return InstanceTruth(scene=points.scene, ids=instance_truth(points.objects, points.names, classes.id_of))


def predict_instances(
    scene: Scene,
    points: LabeledPoints,
    features: GaussianFeatures,
    classes: ClassTable,
    text: TextEncoder,
    protocol: InstancesProtocol = InstancesProtocol(),
    localization: LocalizeConfig = LocalizeConfig(),
) -> InstancePrediction:
    """Masks of a scene's points, each with a class and a score.

    Args:
        scene: with Gaussians.
        points: of the scene.
        features: of the Gaussians.
        classes: whose names are looked for.
        text: turns names into vectors.
        protocol: where masks come from.
        localization: settings of `localize`, for clusters.
    """
    ids = classes.id_of
    if protocol.proposals == "clusters":
        queried = replace(scene, features={features.space.name: features})
        boxes = localize(queried, classes.names, text, localization).boxes
        masks = [points.masked(box.rows.astype(np.int64), len(features)) for box in boxes]
        labels, scores = [ids[box.query] for box in boxes], [float(box.probability) for box in boxes]
    else:
        numbers = list(points.named_ids())
        cosines = class_cosines(features, [points.rows_of(number) for number in numbers], classes.names, text)
        rows = np.flatnonzero(np.isfinite(cosines).all(axis=1))
        shares = np.exp((cosines[rows] - cosines[rows].max(axis=1, keepdims=True, initial=-1)) / TEMPERATURE)
        shares /= shares.sum(axis=1, keepdims=True)
        masks = [points.objects == numbers[row] for row in rows]
        labels = [classes.ids[number] for number in shares.argmax(axis=1)]
        scores = [float(each) for each in shares.max(axis=1, initial=0)]
    return prediction_of_masks(scene.name, masks, labels, scores, num_vertices=len(points))
