"""Recognition of given objects: the instances are known, and each is to be named with one of the classes.

Top-1 accuracy of a class is the share of its instances whose first name is right, and top-k that of those whose first k
names have the right one. The paper's table 1, after CLIP² (Zeng et al. 2023), prints top-1 of each of ScanNet's classes
and their unweighted mean; there are 17 of them, without "otherfurniture". The mean over instances, in which frequent
classes count more, stands beside it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsencoder.core.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedInstance:
    """An instance of the truth.

    Attributes:
        scene: name of its scene.
        object: its id there.
        name: its class.
    """

    scene: str
    object: str
    name: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RankedNames:
    """What an instance is predicted to be.

    Attributes:
        scene: name of its scene.
        object: its id there.
        names: of classes, the likeliest first, each once; none where the method has no answer.
    """

    scene: str
    object: str
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognizedInstance:
    """An instance with its place in the ranking.

    Attributes:
        scene: name of its scene.
        object: its id there.
        name: its class.
        place: of this class among the predicted names, from 1; 0 if it is not among them.
        first: the name predicted first; None without an answer.
    """

    scene: str
    object: str
    name: str
    place: int
    first: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognitionScores:
    """The scores of instances; NaN without any.

    Attributes:
        instances: how many.
        unanswered: of them, those that have no prediction; they count as wrong.
        classes: for each k, accuracy by name of the class; NaN for classes without instances.
        mean: for each k, the mean over the classes that have instances.
        overall: for each k, the mean over instances.
        counts: instances by name of the class.
    """

    instances: int
    unanswered: int
    classes: dict[int, dict[str, float]]
    mean: dict[int, float]
    overall: dict[int, float]
    counts: dict[str, int]


def recognize(
    predictions: Sequence[RankedNames],
    truth: Sequence[NamedInstance],
    classes: Sequence[str],
    *,
    allow_missing: bool = False,
) -> tuple[tuple[RecognizedInstance, ...], int]:
    """Looks up every instance of the truth among the predictions.

    Args:
        predictions: in any order.
        truth: in any order.
        classes: that can be predicted. Instances of other classes are not scored, whether they are predicted or not.
        allow_missing: count instances without a prediction as wrong, instead of refusing them.

    Returns:
        The instances of the classes, in the order of the truth, and the number of instances of other classes.

    Raises:
        InputError: an instance that is there twice, is not in the truth, or has no prediction; a name that is no class.
    """
    known, names = {(item.scene, item.object) for item in truth}, set(classes)
    if len(known) < len(truth):
        raise InputError(_twice([(item.scene, item.object) for item in truth], "truth"))
    answers: dict[tuple[str, str], RankedNames] = {}
    for item in predictions:
        key = item.scene, item.object
        if key in answers:
            raise InputError(_twice([key, key], "predictions"))
        if key not in known:
            raise InputError(f"object {item.object} of {item.scene} is predicted, and not in the truth")
        wrong = next((name for name in item.names if name not in names), None)
        if wrong is not None:
            raise InputError(f"object {item.object} of {item.scene} is predicted as {wrong[:40]!r}, which is no class")
        if len(set(item.names)) < len(item.names):
            raise InputError(f"object {item.object} of {item.scene} has a name twice; expected each once")
        answers[key] = item
    found = []
    for instance in truth:
        if instance.name not in names:
            continue
        answer = answers.get((instance.scene, instance.object))
        if answer is None and not allow_missing:
            raise InputError(f"object {instance.object} of {instance.scene} has no prediction")
        ranked = answer.names if answer else ()
        found.append(
            RecognizedInstance(
                scene=instance.scene,
                object=instance.object,
                name=instance.name,
                place=ranked.index(instance.name) + 1 if instance.name in ranked else 0,
                first=ranked[0] if ranked else None,
            )
        )
    return tuple(found), len(truth) - len(found)


def recognition_scores(
    instances: Sequence[RecognizedInstance], classes: Sequence[str], *, ks: Sequence[int] = (1, 5)
) -> RecognitionScores:
    """The scores of instances of any scenes.

    Args:
        instances: as `recognize` gives them.
        classes: all of them, in the order of the table.
        ks: numbers of names of which one has to be right.

    Raises:
        InputError: an instance that is there twice, one of another class, or a k below 1.
    """
    keys = [(item.scene, item.object) for item in instances]
    if len(set(keys)) < len(keys):
        raise InputError(_twice(keys, "instances"))
    if min(ks, default=1) < 1:
        raise InputError(f"recognition: expected k of 1 or more, got {min(ks)}")
    places: dict[str, list[int]] = {name: [] for name in classes}
    for item in instances:
        if item.name not in places:
            raise InputError(f"object {item.object} of {item.scene} is {item.name[:40]!r}, which is no class")
        places[item.name].append(item.place)
    table = {k: {name: _share(found, k) for name, found in places.items()} for k in ks}
    everything = [item.place for item in instances]
    return RecognitionScores(
        instances=len(instances),
        unanswered=sum(item.first is None for item in instances),
        classes=table,
        mean={k: _mean([value for value in row.values() if not math.isnan(value)]) for k, row in table.items()},
        overall={k: _share(everything, k) for k in ks},
        counts={name: len(found) for name, found in places.items()},
    )


def _share(places: list[int], k: int) -> float:
    return _mean([float(1 <= place <= k) for place in places])


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _twice(keys: Sequence[tuple[str, str]], where: str) -> str:
    seen: set[tuple[str, str]] = set()
    for key in keys:
        if key in seen:
            return f"object {key[1]} of {key[0]} is twice among the {where}; expected each once"
        seen.add(key)
    raise AssertionError("no key is there twice")
