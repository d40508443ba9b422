"""Grounding in pictures, as M3 measures it (sec. 4.1, table 2): Otsu's threshold on a name's map, IoU with a mask.

In each view of a labeled scene the names of the objects that it shows are looked for in the features, rendered at its
pixels. The ground truth is the union of all instances of a name. M3 prints the share of pairs whose IoU reaches 0.5 or
0.6 as AP50 and AP60. It is no average precision, and is called a precision here.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float32, Int32

from gsencoder.core.errors import InputError, counted
from gsencoder.core.settings import option
from gsencoder.evaluate.benchmarks.protocol import Benchmark, Evaluation, Protocol, SceneResult, warn_of_gaps
from gsencoder.evaluate.tables import ScoreReport, grouped, mean_of, table_of
from gsencoder.infer.pictures import pixel_features
from gsencoder.infer.relevancy import GaussianProducts, word_directions
from gsencoder.render import blend
from gsencoder.text.table import TextEncoder, check_space
from gsencoder.types import GaussianFeatures, QueryMemory, Scene, SceneObject

BINS = 256
"""Bins of the histogram, as in scikit-image, which M3's released code calls."""
PRECISION_IOUS = (0.5, 0.6)
"""IoUs from which on a pair counts in the precision."""
SHARES = ("miou", "ciou", "p50", "p60")


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundingProtocol(Protocol):
    """Selection of the pairs of a view and a name."""

    name: Literal["grounding"] = "grounding"
    min_pixels: int = option(60, "smallest area that the objects of a name must have in a view to be looked for", ge=1)

    def start(self, evaluation: Evaluation) -> "GroundingBenchmark":
        return GroundingBenchmark(self, evaluation)


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundedPair:
    """One phrase in one view: pixels of its mask that were found, pixels of the mask or found, and whether the map was
    finite; nothing is found in one that was not."""

    view: str
    phrase: str
    intersection: int
    union: int
    finite: bool = True

    @property
    def iou(self) -> float:
        return self.intersection / self.union


Grounded = tuple[list[GroundedPair], int, int]
"""The pairs of a scene, view by view, the number that were left out because they have too few pixels, and that of its
views."""


class GroundingBenchmark(Benchmark[Grounded]):
    def __init__(self, protocol: GroundingProtocol, evaluation: Evaluation) -> None:
        self.protocol, self.evaluation = protocol, evaluation

    def check(self, scene: Scene) -> Scene:
        if scene.views is None or scene.views.instances is None or not scene.objects:
            raise InputError(
                f"grounding: scene {scene.name} needs views with instance maps (instance_file_path in "
                "transforms.json) and an objects.json that names them, or the label files of ScanNet or ScanNet++"
            )
        return scene

    def predict(self, scene: Scene, features: GaussianFeatures) -> Grounded:
        memory = self.evaluation.memory_of(scene)
        return ground_scene(scene, features, self.evaluation.words, self.protocol, memory=memory)

    def report(self, results: Sequence[SceneResult[Grounded]]) -> ScoreReport:
        small = sum(result.value[1] for result in results)
        warn_of_gaps(
            [(result.scene, len(result.value[0])) for result in results],
            f"view that shows a named object with {self.protocol.min_pixels} pixels",
            f" ({small} pairs have fewer); lower protocol.min_pixels, or name objects",
        )
        pairs = [pair for result in results for pair in result.value[0]]
        scores = grounding_scores(pairs)
        names = {name: grounding_scores(each) for name, each in grouped(pairs, "phrase").items()}
        names = dict(sorted(names.items(), key=lambda item: (item[1]["miou"], item[0])))
        # Each name counts the same, in however many views it is.
        miou_names = mean_of([row["miou"] for row in names.values()])
        by_scene = [
            {
                "scene": result.scene,
                "views": result.value[2],
                "gaussians": result.gaussians,
                "small": result.value[1],
                **grounding_scores(result.value[0]),
            }
            for result in results
        ]
        shares = {name: scores[name] for name in SHARES}
        faults = f", {counted(scores['not_finite'], 'map')} not finite" if scores["not_finite"] else ""
        return ScoreReport(
            results={
                "protocol": "grounding",
                **scores,
                "miou_names": miou_names,
                "small": small,
                "names": names,
                "scenes": by_scene,
            },
            table=table_of(
                "Grounding", {self.evaluation.method: shares}, published="m3_2_grounding_and_retrieval", columns=SHARES
            ),
            rows={
                "names": [{"name": name, **row} for name, row in names.items()],
                "pairs": [
                    {"scene": each.scene, "view": p.view, "name": p.phrase, "iou": p.iou, "finite": p.finite}
                    for each in results
                    for p in each.value[0]
                ],
                "scenes": by_scene,
            },
            line=f"{counted(len(pairs), 'pair')} of a view and a name in {counted(len(results), 'scene')}: mIoU "
            f"{scores['miou']:.3f} (averaged over names {miou_names:.3f}), cIoU {scores['ciou']:.3f}, P@0.5 "
            f"{scores['p50']:.3f}, P@0.6 {scores['p60']:.3f}; {counted(small, 'pair')} too small{faults}",
        )


def otsu_threshold(values: Float32[np.ndarray, "*shape"]) -> float:
    """The threshold that separates two classes of values with the largest variance between them (Otsu 1979).

    Of the histogram of the values in 256 bins between their extremes, a split after bin k has the variance
    n₁(k) · n₂(k) · (m₁(k) − m₂(k))², with the numbers and mean values of both classes, where a bin stands for its
    center. The threshold is the center of bin k; of equal splits the first is taken.

    Returns:
        The threshold; values above it are the upper class. The value itself where all are equal, so that none is above.
    """
    if not values.size or not np.isfinite(values).all():
        wrong = f"{int((~np.isfinite(values)).sum()):,} of {values.size:,} that are not" if values.size else "none"
        raise InputError(f"otsu_threshold: expected finite values, got {wrong}")
    # The bins of a narrow range of float32 values are distinct in float64 only.
    flat = values.ravel().astype(np.float64)
    if flat.min() == flat.max():
        return float(flat[0])
    counts, edges = np.histogram(flat, bins=BINS)
    centers = (edges[:-1] + edges[1:]) / 2
    lower, upper = np.cumsum(counts), np.cumsum(counts[::-1])[::-1]
    lower_mean = np.cumsum(counts * centers) / lower
    upper_mean = (np.cumsum((counts * centers)[::-1]) / np.cumsum(counts[::-1]))[::-1]
    between = lower[:-1].astype(np.float64) * upper[1:] * (lower_mean[:-1] - upper_mean[1:]) ** 2
    return float(centers[np.argmax(between)])


def ground(
    relevancy: Float32[np.ndarray, "H W"], truth: Bool[np.ndarray, "_h _w"], *, view: str, phrase: str
) -> GroundedPair:
    """Compares what lies above Otsu's threshold of a map with a mask.

    Args:
        truth: pixels of what the phrase means, one or more.
    """
    if relevancy.shape != truth.shape or not truth.any():
        raise InputError(
            f"grounding: {phrase!r} in view {view!r}: expected a mask with pixels of the map's size {relevancy.shape}, "
            f"got {int(truth.sum())} pixels of {truth.shape}"
        )
    finite = bool(np.isfinite(relevancy).all())
    above = relevancy > otsu_threshold(relevancy) if finite else np.zeros_like(truth)
    intersection, union = int((above & truth).sum()), int((above | truth).sum())
    return GroundedPair(view=view, phrase=phrase, intersection=intersection, union=union, finite=finite)


def grounding_scores(pairs: Sequence[GroundedPair]) -> dict[str, Any]:
    """The scores of pairs of any views and phrases; NaN without pairs.

    Returns:
        pairs, and of them not_finite: those whose map was not finite. Their IoU is 0, so that no method gains by
        failing. miou: mean IoU of the pairs. ciou: sum of the intersections by that of the unions: each pixel counts
        the same, and large masks most. p50, p60: shares of the pairs with an IoU of 0.5, or 0.6, or more.
    """
    ious = np.array([pair.iou for pair in pairs], np.float64)
    half, more = (mean_of((ious >= least).astype(np.float64)) for least in PRECISION_IOUS)
    return {
        "pairs": len(pairs),
        "not_finite": sum(not pair.finite for pair in pairs),
        "miou": mean_of(ious),
        "ciou": sum(pair.intersection for pair in pairs) / sum(pair.union for pair in pairs) if pairs else math.nan,
        "p50": half,
        "p60": more,
    }


def ground_scene(
    scene: Scene,
    features: GaussianFeatures,
    words: TextEncoder,
    protocol: GroundingProtocol = GroundingProtocol(),
    *,
    memory: QueryMemory | None = None,
) -> Grounded:
    """Looks for the names of a scene's objects in features of its Gaussians, in each view that shows them.

    Pixels that show no Gaussian with a feature have a relevancy of 0.
    """
    assert scene.gaussians is not None
    assert scene.views is not None
    assert scene.views.instances is not None
    check_space(features.space, words.space)
    ids = ids_by_name(scene.objects)
    if not ids:
        return [], 0, len(scene.views)
    directions = dict(zip(ids, word_directions(words.encode(list(ids)), words.mean), strict=True))
    products = GaussianProducts(features)
    pairs, small = [], 0
    for view, name in enumerate(scene.views.names):
        masks, left_out = masks_of(scene.views.instances[view], ids, protocol.min_pixels)
        small += left_out
        if not masks:
            continue
        b = blend(scene.gaussians, scene.views.cameras, view)
        pixels = pixel_features(products, b, memory=memory)
        cosines = np.clip(pixels.cosines(np.stack([directions[phrase] for phrase in masks])), -1, 1)
        maps = np.where(pixels.alpha > 0, cosines, 0).reshape(-1, *b.shape)
        pairs += [
            ground(relevancy, mask, view=name, phrase=phrase)
            for (phrase, mask), relevancy in zip(masks.items(), maps, strict=True)
        ]
    return pairs, small, len(scene.views)


def ids_by_name(objects: Sequence[SceneObject]) -> dict[str, list[int]]:
    """The values in instance maps of the objects of each name, in alphabetical order of the names."""
    with_names = grouped([each for each in objects if each.name], "name")
    return {name: [each.id for each in same] for name, same in sorted(with_names.items())}


def masks_of(
    instances: Int32[np.ndarray, "H W"], ids: dict[str, list[int]], min_pixels: int
) -> tuple[dict[str, Bool[np.ndarray, "H W"]], int]:
    """The mask of each name in a view, and the number of names that it shows with fewer pixels."""
    masks = {name: np.isin(instances, values) for name, values in ids.items()}
    pixels = {name: int(mask.sum()) for name, mask in masks.items()}
    large = {name: mask for name, mask in masks.items() if pixels[name] >= min_pixels}
    return large, sum(0 < count < min_pixels for count in pixels.values())
