"""The referring protocol: boxes of what sentences describe (ScanRefer; SplatDistill sec. 4.5, table 5).

A sentence is answered by the boxes of the words that the text table knows in it, the first of them first, or of the
whole sentence where a text tower can embed it. Without a file of sentences, the names of the scene's objects are asked,
one sentence an object.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.expressions import Expression, read_nr3d, read_scanrefer
from gsencoder.evaluate.benchmarks.referring import PredictedBoxes
from gsencoder.infer.ask.ask import words_in
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.text.vocabulary import Words, closed_table
from gsencoder.types import GaussianFeatures, Localization, Scene

CANDIDATES = 10
"""Boxes that are predicted for each sentence."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferringProtocol:
    """Which sentences are asked, and how."""

    name: Literal["referring"] = "referring"
    expressions: str = field(
        default="",
        metadata={"help": "sentences: ScanRefer's JSON or Nr3D's CSV; empty = the names of the scenes' small objects"},
    )
    query: Literal["names", "sentence"] = field(
        default="names",
        metadata={"help": "what of a sentence is looked for: the names of the text table in it, or the whole"},
    )

    def __post_init__(self) -> None:
        if self.query not in ("names", "sentence"):
            raise InputError(f"query: expected names or sentence, got {self.query!r}")


def read_expressions(path: Path) -> tuple[Expression, ...]:
    """ScanRefer's JSON, or Nr3D's CSV by its ending.

    Raises:
        InputError: neither, or damaged.
    """
    return read_nr3d(path) if path.suffix.lower() == ".csv" else read_scanrefer(path)


def expressions_of_objects(scene: Scene) -> tuple[Expression, ...]:
    """A sentence for each named small object of a scene: its name, with its box in the world's axes."""
    return tuple(
        Expression(
            scene=scene.name,
            object_id=each.id,
            object_name=each.name,
            annotation="0",
            text=each.name,
            tokens=tuple(each.name.split()),
            aabb=(tuple(each.aabb_min.tolist()), tuple(each.aabb_max.tolist())),
        )
        for each in scene.objects
        if each.name and each.placed
    )


def predict_referring(
    scene: Scene,
    features: GaussianFeatures,
    expressions: Sequence[Expression],
    text: Words,
    protocol: ReferringProtocol = ReferringProtocol(),
    localization: LocalizeConfig = LocalizeConfig(),
    *,
    aligned_from_world: Float64[np.ndarray, "4 4"] | None = None,
) -> list[PredictedBoxes]:
    """The boxes of each sentence about a scene, the most probable first; none where no word of it is known or present.

    Args:
        scene: with Gaussians.
        features: of the Gaussians.
        expressions: about this scene.
        text: turns words into vectors.
        protocol: what of a sentence is looked for.
        localization: settings of `localize`.
        aligned_from_world: rigid transform into the frame in which true boxes are axis-aligned; None = the world.
    """
    table = closed_table(text)
    queries_of = {
        each: (each.text,) if protocol.query == "sentence" else words_in(each.text, table) for each in expressions
    }
    words = list(dict.fromkeys(words[0] for words in queries_of.values() if words))
    corners: dict[str, list[Float64[np.ndarray, "2 3"]]] = {}
    if words:
        with_features = replace(scene, features={features.space.name: features})
        with warnings.catch_warnings():
            # Sentences without a box are counted in the result.
            warnings.simplefilter("ignore", SceneWarning)
            localized = localize(with_features, words, text, localization)
        corners = corners_of_words(scene, localized, aligned_from_world)
    boxes = {
        each: corners.get(queries_of[each][0], [])[:CANDIDATES] if queries_of[each] else [] for each in expressions
    }
    return [
        PredictedBoxes(
            scene=each.scene,
            object=str(each.object_id),
            annotation=each.annotation,
            boxes=np.array(boxes[each], np.float64).reshape(-1, 2, 3),
        )
        for each in expressions
    ]


def corners_of_words(
    scene: Scene, localization: Localization, aligned_from_world: Float64[np.ndarray, "4 4"] | None = None
) -> dict[str, list[Float64[np.ndarray, "2 3"]]]:
    """Lower and upper corners of the boxes of each word, best first, along the axes of the aligned frame."""
    corners: dict[str, list[Float64[np.ndarray, "2 3"]]] = {}
    for box in localization.boxes:
        if aligned_from_world is None:
            pair = np.stack([box.aabb_min, box.aabb_max])
        else:
            assert scene.gaussians is not None
            world = scene.gaussians.means[box.rows].astype(np.float64) + scene.origin
            points = world @ aligned_from_world[:3, :3].T + aligned_from_world[:3, 3]
            pair = np.stack([points.min(axis=0), points.max(axis=0)])
        corners.setdefault(box.query, []).append(pair)
    return corners
