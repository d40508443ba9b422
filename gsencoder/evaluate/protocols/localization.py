"""The localization protocol: the share of objects in labeled scenes whose name leads to a box around them.

For each scene it computes Gaussians (seeds if there are none) and features (fused or encoded), and localizes the names
of all small objects that are seen well enough, with the same settings for all scenes. The first box for a name is
compared with the object of that name that it overlaps most.
"""

import time
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.data.seeding.seed import SeedConfig
from gsencoder.evaluate.boxes import Hit, accuracy, queryable_objects, score_boxes
from gsencoder.evaluate.sources import FeatureSource, with_features
from gsencoder.evaluate.tables import mean_of
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.text.vocabulary import Words
from gsencoder.types import GaussianFeatures, Scene

IOU_THRESHOLDS = (0.25, 0.5)
"""IoUs from which on an object counts as localized."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationProtocol:
    """Selection of the objects whose names are queried."""

    name: Literal["localization"] = "localization"
    min_views: int = field(
        default=5, metadata={"help": "smallest number of views in which an object must be seen to be queried"}
    )
    min_pixels: int = field(
        default=60, metadata={"help": "smallest area in its best view that an object must have to be queried, pixels"}
    )

    def __post_init__(self) -> None:
        for name in ("min_views", "min_pixels"):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneOutcome:
    """The result of the protocol on one scene.

    Attributes:
        hits: one for each queried object.
        seen: number of Gaussians that have features.
        boxless: number of queried names without any box.
    """

    scene: str
    hits: tuple[Hit, ...]
    gaussians: int
    seen: int
    rank: int
    boxless: int
    seconds: dict[str, float]


def evaluate_localization(
    scenes: Iterable[tuple[Scene, float]],
    source: FeatureSource,
    words: Words,
    *,
    protocol: LocalizationProtocol = LocalizationProtocol(),
    seeds: SeedConfig = SeedConfig(),
    localization: LocalizeConfig = LocalizeConfig(),
) -> list[SceneOutcome]:
    """Runs the protocol scene by scene; one scene is in memory at a time.

    Args:
        scenes: scenes with labeled objects and the seconds of loading, as `load_scenes` yields them.
        source: computes the features of a scene.
        words: text table of the features' space.
        seeds: how Gaussians are made for scenes without.

    Returns:
        One outcome per scene, in order.

    Warns:
        SceneWarning: queried names have no box, or scenes have no object to query; each is counted over all scenes.
    """
    outcomes = []
    for scene, load_seconds in scenes:
        outcome = evaluate_scene(scene, source, words, protocol=protocol, seeds=seeds, localization=localization)
        outcomes.append(replace(outcome, seconds={"load": load_seconds, **outcome.seconds}))
    _warn_about_gaps(outcomes)
    return outcomes


def evaluate_scene(
    scene: Scene,
    source: FeatureSource,
    words: Words,
    *,
    protocol: LocalizationProtocol = LocalizationProtocol(),
    seeds: SeedConfig = SeedConfig(),
    localization: LocalizeConfig = LocalizeConfig(),
) -> SceneOutcome:
    """Runs the protocol on one loaded scene; see `evaluate_localization`.

    A scene without objects to query gets neither seeds nor features. The views that show objects are counted where
    their files do not state them.
    """
    scene = with_counted_views(scene)
    if not queryable_objects(scene.objects, min_views=protocol.min_views, min_pixels=protocol.min_pixels):
        count = len(scene.gaussians) if scene.gaussians is not None else 0
        return SceneOutcome(scene=scene.name, hits=(), gaussians=count, seen=0, rank=0, boxless=0, seconds={})
    scene, features, seconds = with_features(scene, source, seeds)
    start = time.perf_counter()
    hits, boxless = score_queries(scene, features, words, protocol, localization)
    return SceneOutcome(
        scene=scene.name,
        hits=tuple(hits),
        gaussians=len(features),
        seen=int(features.seen.sum()),
        rank=features.features.shape[1],
        boxless=boxless,
        seconds={**seconds, "localize": time.perf_counter() - start},
    )


def score_queries(
    scene: Scene,
    features: GaussianFeatures,
    words: Words,
    protocol: LocalizationProtocol,
    localization: LocalizeConfig,
) -> tuple[list[Hit], int]:
    """Localizes the name of each queryable object in features of the scene's Gaussians.

    Returns:
        One hit for each object, and the number of names without a box.
    """
    targets = queryable_objects(scene.objects, min_views=protocol.min_views, min_pixels=protocol.min_pixels)
    names = list(dict.fromkeys(target.name for target in targets if target.name))
    if not names:
        return [], 0
    with warnings.catch_warnings():
        # `evaluate_localization` warns once, with the counts of all scenes.
        warnings.filterwarnings("ignore", ".*words have no box", SceneWarning)
        result = localize(replace(scene, features={features.space.name: features}), names, words, localization)
    return score_boxes(scene, result, targets), len(set(names) - {box.query for box in result.boxes})


def _warn_about_gaps(outcomes: Sequence[SceneOutcome]) -> None:
    empty = [outcome.scene for outcome in outcomes if not outcome.hits]
    if len(empty) == len(outcomes):
        raise InputError(
            f"evaluate: none of {len(outcomes)} scenes has an object to query; expected placed, named objects "
            "that are seen well enough (see protocol.min_views and protocol.min_pixels), in an objects.json or in "
            "the label files of ScanNet or ScanNet++"
        )
    if empty:
        warnings.warn(
            f"{len(empty)} of {len(outcomes)} scenes have no object to query (first: {empty[0]!r})",
            SceneWarning,
            stacklevel=3,
        )
    if boxless := sum(outcome.boxless for outcome in outcomes):
        queried = sum(len(outcome.hits) for outcome in outcomes)
        warnings.warn(f"{boxless} names have no box ({queried} objects were queried)", SceneWarning, stacklevel=3)


def scores(hits: Sequence[Hit]) -> dict[str, Any]:
    """The metrics of the protocol: number of objects, accuracy at each threshold, and mean IoU; for first boxes, and
    with the prefix oracle_ for the best of all boxes of a name, as in SplatDistill's tables."""
    row: dict[str, Any] = {"objects": len(hits)}
    for prefix, oracle in (("", False), ("oracle_", True)):
        row |= {
            f"{prefix}acc_{round(threshold * 100)}": accuracy(hits, threshold, oracle=oracle)
            for threshold in IOU_THRESHOLDS
        }
        ious = [hit.oracle_iou if oracle else hit.iou for hit in hits]
        row[f"{prefix}mean_iou"] = mean_of(ious)
    return row


def scores_by_name(hits: Sequence[Hit]) -> dict[str, dict[str, Any]]:
    """`scores` of each name separately, in ascending order of mean IoU."""
    names: dict[str, list[Hit]] = {}
    for hit in hits:
        names.setdefault(hit.name, []).append(hit)
    table = {name: scores(group) for name, group in names.items()}
    return dict(sorted(table.items(), key=lambda item: (item[1]["mean_iou"], item[0])))
