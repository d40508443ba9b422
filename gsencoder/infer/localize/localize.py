"""Words to boxes: relevancy, threshold, clusters, boxes, scores."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.seeding.spacing import scene_spacing
from gsencoder.infer.localize.boxes import box_around, cluster, score_clusters
from gsencoder.infer.localize.relevancy import ThresholdConfig, relevancy, threshold
from gsencoder.text.encoder import TextEncoder, check_space
from gsencoder.types import Box, GaussianFeatures, Gaussians, Localization, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizeConfig:
    """How words become boxes. Lengths in units of the scene's spacing (`gsencoder.data.seeding.spacing.scene_spacing`)."""

    mode: Literal["centred", "raw"] = field(
        default="centred", metadata={"help": "cosines after removing each side's mean, or as they are"}
    )
    contrast: bool = field(
        default=False,
        metadata={
            "help": "score against negative and other asked words (LERF), not by cosine; set threshold.fixed=0.9"
        },
    )
    negatives: tuple[str, ...] = field(
        default=("object", "things", "stuff", "texture"), metadata={"help": "negative words for contrast"}
    )
    temperature: float = field(default=0.1, metadata={"help": "temperature of the contrast's softmax"})
    threshold: ThresholdConfig = field(default_factory=ThresholdConfig, metadata={"help": "which Gaussians are taken"})
    min_weight: float = field(default=0.0, metadata={"help": "Gaussians seen no more than this (pixels) are left out"})
    eps: float | None = field(
        default=None, metadata={"help": "DBSCAN radius in world units; left out: eps_spacings times the spacing"}
    )
    eps_spacings: float = field(default=1.5, metadata={"help": "DBSCAN radius in spacings, where eps is not given"})
    min_samples: int = field(default=3, metadata={"help": "Gaussians within the radius that make a core of a cluster"})
    min_share: float = field(default=0.05, metadata={"help": "clusters with less of the best one's weight are dropped"})
    extent: Literal["means", "sigma"] = field(
        default="means", metadata={"help": "boxes around Gaussian means, or around their ellipsoids"}
    )
    sigmas: float = field(default=1.0, metadata={"help": "size of the ellipsoids for extent=sigma"})
    margin: float = field(default=0.0, metadata={"help": "added on every side of a box, in spacings"})
    upright: bool = field(
        default=True, metadata={"help": "oriented boxes stand along the scene's up, where it is known"}
    )
    max_boxes: int = field(default=10, metadata={"help": "boxes kept for each word"})

    def __post_init__(self) -> None:
        if self.mode not in ("centred", "raw"):
            raise InputError(f"mode: expected centred or raw, got {self.mode!r}")
        if self.extent not in ("means", "sigma"):
            raise InputError(f"extent: expected means or sigma, got {self.extent!r}")
        for name in ("temperature", "eps_spacings", *(("eps",) if self.eps is not None else ())):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("min_weight", "sigmas", "margin"):
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
    score that `gsencoder.infer.localize.boxes.score_clusters` defines. Axis-aligned and oriented boxes are drawn around Gaussian means,
    with `config.margin` spacings on every side, unless `config.extent` says "sigma", and have the scene's origin
    added back in float64. A word's boxes do not depend on the other words asked, unless `config.contrast` is on.

    Args:
        scene: Gaussians with features.
        queries: words that `text` knows.
        text: turns words into the features' space.
        config: see there.
        space: which of the scene's feature sets to ask; may be left out where there is one.

    Returns:
        Relevancy, thresholds, and the boxes best first within each word.

    Warns:
        SceneWarning: words without a box (one warning that names them); negative words unknown to `text`.

    Raises:
        InputError: no Gaussians or features, no or unknown words, words of another space.
    """
    gaussians, features = asked_features(scene, space)
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
    found, thresholds = [], []
    for word, row in zip(queries, scores, strict=True):
        level = threshold(row, config.threshold)
        thresholds.append(level)
        found.append(_boxes_of(word, row, level, gaussians, features, spacing, scene, config))
    empty = [word for word, boxes in zip(queries, found, strict=True) if not boxes]
    if empty:
        named = ", ".join(map(repr, empty[:5])) + (", …" if len(empty) > 5 else "")
        warnings.warn(
            f"scene {scene.name}: {len(empty)} of {len(queries)} words have no box ({named}): no cluster of Gaussians "
            "reaches the threshold",
            SceneWarning,
            stacklevel=2,
        )
    return Localization(
        queries=tuple(queries),
        relevancy=scores,
        thresholds=np.array(thresholds, np.float32),
        boxes=tuple(box for boxes in found for box in boxes),
    )


def asked_features(scene: Scene, space: str | None) -> tuple[Gaussians, GaussianFeatures]:
    """A scene's Gaussians and the features that are meant.

    Args:
        scene: with both.
        space: the name of the features; may be left out where there is one.

    Raises:
        InputError: there are none of that name, or several and no name.
    """
    if scene.gaussians is None or not scene.features:
        missing = "Gaussians" if scene.gaussians is None else "features"
        raise InputError(f"localize: scene {scene.name} has no {missing}; run `gsencoder fuse` on it first")
    if space is None and len(scene.features) == 1:
        return scene.gaussians, next(iter(scene.features.values()))
    if space not in scene.features:
        raise InputError(
            f"localize: scene {scene.name} has features of {', '.join(sorted(scene.features))}; "
            + ("say which with space=" if space is None else f"none of {space!r}")
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


def _boxes_of(
    word: str,
    scores: Float32[np.ndarray, " N"],
    level: float,
    gaussians: Gaussians,
    features: GaussianFeatures,
    spacing: float,
    scene: Scene,
    config: LocalizeConfig,
) -> list[Box]:
    """The boxes of one word, best first."""
    # Comparisons with NaN are false: Gaussians never seen are never taken.
    rows = np.flatnonzero((scores >= level) & (features.weights > config.min_weight))
    eps = config.eps if config.eps is not None else config.eps_spacings * spacing
    labels = cluster(gaussians.means[rows], eps, config.min_samples)
    ranked = score_clusters(labels, rows, scores[rows], features.weights[rows], min_share=config.min_share)
    boxes = []
    for rank, one in enumerate(ranked[: config.max_boxes]):
        extents = box_around(
            gaussians,
            one.rows,
            extent=config.extent,
            sigmas=config.sigmas,
            margin=config.margin * spacing,
            up=scene.up if config.upright else None,
        )
        boxes.append(
            Box(
                query=word,
                rank=rank,
                score=one.score,
                aabb_min=extents.aabb_min + scene.origin,
                aabb_max=extents.aabb_max + scene.origin,
                obb_center=extents.center + scene.origin,
                obb_rotation=extents.rotation,
                obb_size=extents.size,
                rows=one.rows,
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
