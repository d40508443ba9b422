"""Open-vocabulary localization: words to 3D boxes by relevancy, threshold and DBSCAN (SplatDistill, sec. 3.4)."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.seeding.spacing import scene_spacing
from gsencoder.infer.localize.boxes import box_around, score_clusters
from gsencoder.infer.localize.cluster import cluster
from gsencoder.infer.localize.relevancy import ThresholdConfig, relevancy, threshold
from gsencoder.text.encoder import TextEncoder, check_space
from gsencoder.types import Box, GaussianFeatures, Gaussians, Localization, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizeConfig:
    """How words become boxes. Relative lengths are in units of the scene's spacing
    (`gsencoder.data.seeding.spacing.scene_spacing`)."""

    mode: Literal["centred", "raw"] = field(
        default="centred", metadata={"help": "cosines after removing each side's mean, or as they are"}
    )
    contrast: bool = field(
        default=False,
        metadata={
            "help": "score by contrast with negative words and the other queries (LERF), not by cosine; use "
            "threshold.fixed=0.9"
        },
    )
    negatives: tuple[str, ...] = field(
        default=("object", "things", "stuff", "texture"), metadata={"help": "negative words for contrast"}
    )
    temperature: float = field(default=0.1, metadata={"help": "temperature of the contrast's softmax"})
    threshold: ThresholdConfig = field(
        default_factory=ThresholdConfig, metadata={"help": "relevancy from which Gaussians are selected"}
    )
    min_weight: float = field(
        default=0.0,
        metadata={"help": "Gaussians whose weight (summed blending weight, in pixels) is not above this are left out"},
    )
    eps: float | None = field(
        default=None, metadata={"help": "DBSCAN radius in world units; empty = eps_spacings times the spacing"}
    )
    eps_spacings: float = field(default=1.5, metadata={"help": "DBSCAN radius in spacings, where eps is not given"})
    min_samples: int = field(
        default=3, metadata={"help": "Gaussians within the radius that make a core point of a cluster"}
    )
    min_share: float = field(
        default=0.05, metadata={"help": "clusters with less than this share of the best cluster's weight are dropped"}
    )
    extent: Literal["means", "sigma"] = field(
        default="means", metadata={"help": "boxes around Gaussian means, or around their ellipsoids"}
    )
    sigmas: float = field(default=1.0, metadata={"help": "size of the ellipsoids for extent=sigma"})
    upright: bool = field(
        default=True,
        metadata={"help": "one axis of oriented boxes follows the scene's up direction, where it is known"},
    )
    max_boxes: int = field(default=10, metadata={"help": "largest number of boxes for each word"})

    def __post_init__(self) -> None:
        if self.mode not in ("centred", "raw"):
            raise InputError(f"mode: expected centered or raw, got {self.mode!r}")
        if self.extent not in ("means", "sigma"):
            raise InputError(f"extent: expected means or sigma, got {self.extent!r}")
        for name in ("temperature", "eps_spacings", *(("eps",) if self.eps is not None else ())):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("min_weight", "sigmas"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected zero or a positive number, got {getattr(self, name)}")
        for name in ("min_samples", "max_boxes"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected 1 or more, got {getattr(self, name)}")
        if not 0 <= self.min_share <= 1:
            raise InputError(f"min_share: expected a share in [0, 1], got {self.min_share}")


_DEFAULT = LocalizeConfig()


def localize(
    scene: Scene,
    queries: Sequence[str],
    text: TextEncoder,
    config: LocalizeConfig = _DEFAULT,
    *,
    space: str | None = None,
) -> Localization:
    """Finds words in a scene.

    Each word's Gaussians at or above the threshold are clustered (DBSCAN); every cluster becomes a box with the
    score that `gsencoder.infer.localize.boxes.score_clusters` defines. Axis-aligned and oriented boxes are drawn
    around Gaussian means, unless `config.extent` says "sigma", and have
    the scene's origin added back in float64. A word's boxes do not depend on the other queries, unless
    `config.contrast` is on.

    Args:
        scene: Gaussians with features.
        queries: words that `text` knows.
        text: turns words into the features' space.
        config: see there.
        space: name of the feature set; None where the scene has only one.

    Returns:
        Relevancy, thresholds, and the boxes best first within each word.

    Warns:
        SceneWarning: words without a box (one warning that names them); negative words unknown to `text`.

    Raises:
        InputError: no Gaussians or features, no or unknown words, words of another space.
    """
    gaussians, features = select_features(scene, space)
    if isinstance(queries, str) or not queries or any(not word.strip() for word in queries):
        raise InputError(f"localize: expected a list of one or more words, got {queries!r}")
    check_space(features.space, text.space)
    scores = relevancy(
        features,
        text.encode(list(queries)),
        text.mean,
        negatives=_negatives(text, config.negatives) if config.contrast else None,
        temperature=config.temperature,
        mode=config.mode,
    )
    spacing = scene_spacing(gaussians.means)
    if spacing == 0:
        spacing = float(np.median(gaussians.scales)) if len(gaussians) else 1.0
    boxes_by_word, thresholds = [], []
    for word, row in zip(queries, scores, strict=True):
        cutoff = threshold(row, config.threshold)
        thresholds.append(cutoff)
        boxes_by_word.append(_boxes_for_word(word, row, cutoff, gaussians, features, spacing, scene, config))
    without_box = [word for word, boxes in zip(queries, boxes_by_word, strict=True) if not boxes]
    if without_box:
        listing = ", ".join(map(repr, without_box[:5])) + (", …" if len(without_box) > 5 else "")
        warnings.warn(
            f"scene {scene.name}: {len(without_box)} of {len(queries)} words have no box ({listing}): no cluster of "
            "Gaussians reaches the threshold",
            SceneWarning,
            stacklevel=2,
        )
    return Localization(
        queries=tuple(queries),
        relevancy=scores,
        thresholds=np.array(thresholds, np.float32),
        boxes=tuple(box for boxes in boxes_by_word for box in boxes),
    )


def select_features(scene: Scene, space: str | None) -> tuple[Gaussians, GaussianFeatures]:
    """A scene's Gaussians and one of its feature sets.

    Args:
        scene: with both.
        space: name of the feature set; None where the scene has only one.

    Raises:
        InputError: no feature set of that name, or several and no name.
    """
    if scene.gaussians is None or not scene.features:
        missing = "Gaussians" if scene.gaussians is None else "features"
        raise InputError(f"localize: scene {scene.name} has no {missing}; run `gsencoder fuse` on it first")
    if space is None and len(scene.features) == 1:
        return scene.gaussians, next(iter(scene.features.values()))
    if space not in scene.features:
        raise InputError(
            f"localize: scene {scene.name} has features of {', '.join(sorted(scene.features))}; "
            + ("name one with space=" if space is None else f"none of {space!r}")
        )
    return scene.gaussians, scene.features[space]


def _negatives(text: TextEncoder, words: Sequence[str]) -> Float32[np.ndarray, "M D"]:
    """Vectors of the negative words that the encoder knows; the mean of the text side where it knows none."""
    known, unknown = [], []
    for word in words:
        try:
            known.append(text.encode([word]))
        except InputError:
            unknown.append(word)
    if unknown:
        instead = "" if known else "; the mean of its words stands for them"
        warnings.warn(
            f"{len(unknown)} of {len(words)} negative words are unknown to {text.space.text_encoder} "
            f"({', '.join(unknown[:5])}) and left out{instead}",
            SceneWarning,
            stacklevel=3,
        )
    if unknown and not known:
        known = [(text.mean / max(float(np.linalg.norm(text.mean)), 1e-12))[None].astype(np.float32)]
    return np.concatenate(known) if known else np.zeros((0, text.space.channels), np.float32)


def _boxes_for_word(
    word: str,
    scores: Float32[np.ndarray, " N"],
    cutoff: float,
    gaussians: Gaussians,
    features: GaussianFeatures,
    spacing: float,
    scene: Scene,
    config: LocalizeConfig,
) -> list[Box]:
    """The boxes of one word, best first."""
    # Comparisons with NaN are false: Gaussians never seen are never taken.
    rows = np.flatnonzero((scores >= cutoff) & (features.weights > config.min_weight))
    eps = config.eps if config.eps is not None else config.eps_spacings * spacing
    labels = cluster(gaussians.means[rows], eps, config.min_samples)
    ranked = score_clusters(labels, rows, scores[rows], features.weights[rows], min_share=config.min_share)
    boxes = []
    for rank, candidate in enumerate(ranked[: config.max_boxes]):
        extents = box_around(
            gaussians,
            candidate.rows,
            extent=config.extent,
            sigmas=config.sigmas,
            up=scene.up if config.upright else None,
        )
        boxes.append(
            Box(
                query=word,
                rank=rank,
                score=candidate.score,
                aabb_min=extents.aabb_min + scene.origin,
                aabb_max=extents.aabb_max + scene.origin,
                obb_center=extents.center + scene.origin,
                obb_rotation=extents.rotation,
                obb_size=extents.size,
                rows=candidate.rows,
            )
        )
    return boxes


def localization_to_json(localization: Localization) -> list[dict[str, Any]]:
    """The boxes as JSON values, best first within each word; see `box_to_json`."""
    return [box_to_json(box) for box in localization.boxes]


def box_to_json(box: Box) -> dict[str, Any]:
    """A box as JSON values, in world coordinates with the origin added back.

    It has query, rank, score, aabb_min, aabb_max, center, count (of its Gaussians) and obb: center, rotation (rows of
    the matrix whose columns are the box's axes) and size.
    """
    return {
        "query": box.query,
        "rank": box.rank,
        "score": box.score,
        "aabb_min": box.aabb_min.tolist(),
        "aabb_max": box.aabb_max.tolist(),
        "center": box.center.tolist(),
        "count": len(box.rows),
        "obb": {
            "center": box.obb_center.tolist(),
            "rotation": box.obb_rotation.tolist(),
            "size": box.obb_size.tolist(),
        },
    }
