"""Localization of names: Acc@k, the share of objects whose name's best box overlaps them.

The names of all small objects of a scene that are seen well enough are queried, one query per name, and each object
is one sample: its IoU is the largest that the first box for its name has with any object of that name. With the prefix
oracle_, the best of all boxes of a name counts, as in SplatDistill's tables; a user cannot know which box that is.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, SceneWarning, counted
from gsencoder.core.settings import option
from gsencoder.data.labels.scans import with_counted_views
from gsencoder.evaluate.benchmarks.protocol import Benchmark, Evaluation, Protocol, SceneResult, warn_of_gaps
from gsencoder.evaluate.tables import ScoreReport, grouped, mean_of, table_of
from gsencoder.infer.localize import LocalizeConfig, localize
from gsencoder.text.vocabulary import Words
from gsencoder.types import GaussianFeatures, Localization, Scene, SceneObject

IOU_THRESHOLDS = (0.25, 0.5)
"""IoUs from which on an object counts as localized."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationProtocol(Protocol):
    """Selection of the objects whose names are queried."""

    name: Literal["localization"] = "localization"
    min_views: int = option(5, "smallest number of views in which an object must be seen to be queried", ge=0)
    min_pixels: int = option(60, "smallest area in its best view that an object must have to be queried, pixels", ge=0)

    def start(self, evaluation: Evaluation) -> "LocalizationBenchmark":
        return LocalizationBenchmark(self, evaluation)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hit:
    """The result of querying the name of one object: the IoU of the first box, 0 if there is none, and the largest of
    all boxes for the name."""

    scene: str
    name: str
    iou: float
    oracle_iou: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneHits:
    """The hits of one scene, the number of queried names without any box, of Gaussians with features, and of columns
    of these."""

    hits: tuple[Hit, ...]
    boxless: int
    seen: int
    rank: int


class LocalizationBenchmark(Benchmark[SceneHits]):
    def __init__(self, protocol: LocalizationProtocol, evaluation: Evaluation) -> None:
        self.protocol, self.evaluation = protocol, evaluation

    def check(self, scene: Scene) -> Scene:
        return with_counted_views(scene)

    def predict(self, scene: Scene, features: GaussianFeatures) -> SceneHits:
        hits, boxless = score_queries(
            scene, features, self.evaluation.words, self.protocol, self.evaluation.localization
        )
        return SceneHits(
            hits=tuple(hits), boxless=boxless, seen=int(features.seen.sum()), rank=features.features.shape[1]
        )

    def report(self, results: Sequence[SceneResult[SceneHits]]) -> ScoreReport:
        hits = [hit for result in results for hit in result.value.hits]
        boxless = sum(result.value.boxless for result in results)
        warn_of_gaps(
            [(result.scene, len(result.value.hits)) for result in results],
            "object to query",
            "; expected placed, named objects that are seen well enough (see protocol.min_views and "
            "protocol.min_pixels), in an objects.json or in the label files of ScanNet or ScanNet++",
        )
        if boxless:
            warnings.warn(f"{boxless} names have no box ({len(hits)} objects were queried)", SceneWarning, stacklevel=2)
        overall, names = scores(hits), scores_by_name(hits)
        by_scene = [
            {
                "scene": result.scene,
                "gaussians": result.gaussians,
                "seen": result.value.seen,
                "rank": result.value.rank,
                "seconds": sum(result.seconds.values()),
                **scores(result.value.hits),
            }
            for result in results
        ]
        shares = {name: value for name, value in overall.items() if name != "objects"}
        return ScoreReport(
            results={"protocol": "localization", **overall, "boxless": boxless, "names": names, "scenes": by_scene},
            table=table_of("Localization", {self.evaluation.method: shares}),
            rows={
                "hits": [{"scene": h.scene, "name": h.name, "iou": h.iou, "oracle_iou": h.oracle_iou} for h in hits],
                "names": [{"name": name, **row} for name, row in names.items()],
                "scenes": by_scene,
            },
            line=f"{counted(len(hits), 'object')} in {counted(len(results), 'scene')}: Acc@0.25 "
            f"{overall['acc_25']:.3f}, Acc@0.5 {overall['acc_50']:.3f}, mean IoU {overall['mean_iou']:.3f} (best of "
            f"all boxes: {overall['oracle_acc_25']:.3f}, {overall['oracle_acc_50']:.3f}, "
            f"{overall['oracle_mean_iou']:.3f})",
        )


def score_queries(
    scene: Scene, features: GaussianFeatures, words: Words, protocol: LocalizationProtocol, localization: LocalizeConfig
) -> tuple[list[Hit], int]:
    """One hit for each object that is queried in features of the scene's Gaussians, and the number of names without a
    box."""
    targets = queryable_objects(scene.objects, min_views=protocol.min_views, min_pixels=protocol.min_pixels)
    names = list(dict.fromkeys(target.name for target in targets if target.name))
    if not names:
        return [], 0
    with warnings.catch_warnings():
        # The report warns once, with the counts of all scenes.
        warnings.filterwarnings("ignore", ".*words have no box", SceneWarning)
        result = localize(replace(scene, features={features.space.name: features}), names, words, localization)
    return score_boxes(scene, result, targets), len(set(names) - {box.query for box in result.boxes})


def aabb_iou(
    min_a: Float64[np.ndarray, "3"],
    max_a: Float64[np.ndarray, "3"],
    min_b: Float64[np.ndarray, "3"],
    max_b: Float64[np.ndarray, "3"],
) -> float:
    """Intersection over union of two axis-aligned boxes; 0 if either has no volume.

    It is exact, in any unit. Benchmarks add 1e-8 cubic metres to the union, which lowers the IoU of small boxes, by a
    percent for a cube of 1 cm; `box_ious` of `gsencoder.evaluate.benchmarks.referring` does so where results must equal
    theirs.
    """
    overlap = np.prod(np.clip(np.minimum(max_a, max_b) - np.maximum(min_a, min_b), 0, None))
    union = np.prod(max_a - min_a) + np.prod(max_b - min_b) - overlap
    return float(overlap / union) if union > 0 else 0.0


def queryable_objects(objects: Sequence[SceneObject], *, min_views: int = 5, min_pixels: int = 60) -> list[SceneObject]:
    """The objects to query: small ones that have a name and are seen well enough."""
    return [o for o in objects if o.placed and o.name and is_seen(o, min_views=min_views, min_pixels=min_pixels)]


def is_seen(scene_object: SceneObject, *, min_views: int, min_pixels: int) -> bool:
    """Whether an object shows in `min_views` views or more, and in one of them with `min_pixels` pixels or more."""
    if scene_object.views is None or scene_object.max_pixels is None:
        raise InputError(
            f"object {scene_object.id}: the views that show it were not counted; with_counted_views of "
            "gsencoder.data.labels.scans counts them"
        )
    return scene_object.views >= min_views and scene_object.max_pixels >= min_pixels


def score_boxes(scene: Scene, localization: Localization, targets: Sequence[SceneObject]) -> list[Hit]:
    """Compares the boxes for each target's name with all objects of that name; one hit per target."""
    boxes = grouped(localization.boxes, "query")
    hits = []
    for target in targets:
        assert target.name is not None
        same = [o for o in scene.objects if o.name == target.name]
        ranked = sorted(boxes.get(target.name, []), key=lambda box: box.rank)
        ious = [max(aabb_iou(b.aabb_min, b.aabb_max, o.aabb_min, o.aabb_max) for o in same) for b in ranked]
        first, best = ious[0] if ious else 0.0, max(ious, default=0.0)
        hits.append(Hit(scene=scene.name, name=target.name, iou=first, oracle_iou=best))
    return hits


def scores(hits: Sequence[Hit]) -> dict[str, Any]:
    """Number of objects, accuracy at each threshold and mean IoU: of first boxes, and with oracle_ of the best; NaN
    without hits."""
    row: dict[str, Any] = {"objects": len(hits)}
    for prefix, ious in (("", [hit.iou for hit in hits]), ("oracle_", [hit.oracle_iou for hit in hits])):
        for least in IOU_THRESHOLDS:
            row[f"{prefix}acc_{round(100 * least)}"] = mean_of([float(iou >= least) for iou in ious])
        row[f"{prefix}mean_iou"] = mean_of(ious)
    return row


def scores_by_name(hits: Sequence[Hit]) -> dict[str, dict[str, Any]]:
    """`scores` of each name separately, in ascending order of mean IoU."""
    table = {name: scores(each) for name, each in grouped(hits, "name").items()}
    return dict(sorted(table.items(), key=lambda item: (item[1]["mean_iou"], item[0])))
