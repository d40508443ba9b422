"""Words to the Gaussians of the objects that they stand for."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Track, untracked
from gsencoder.data.seeding.points import scene_spacing
from gsencoder.fusion.cameras import with_views
from gsencoder.infer.localize import LocalizeConfig, localize, select_features
from gsencoder.infer.selection import (
    NEIGHBORS,
    Parts,
    SelectConfig,
    Selection,
    Votes,
    box_parts,
    labels_of_parts,
    object_shares,
    threshold_parts,
)
from gsencoder.text.table import TextEncoder
from gsencoder.types import Cameras, GaussianFeatures, Gaussians, Localization, Scene

Labels = Int32[np.ndarray, " N"]
NO_SHARE = -1e9
"""Stands for the share of a Gaussian without a feature: below that of every other one."""
PARTLY, GHOST_WEIGHT = 0.7, 1.0
"""See `labels_by_pixels`. The smaller both are, the less is left of an object that is taken out, and the more of its
surroundings goes with it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidates:
    """The label of each Gaussian by its feature, and the label that it could have by its position.

    Attributes:
        labels: by the features, 0 = none.
        possible: by the position; 0 = out of reach of every word.
        shares: share of the object of the possible label in the feature; −∞ where no label is possible, `NO_SHARE`
            without a feature.
    """

    labels: Labels
    possible: Labels
    shares: Float64[np.ndarray, " N"]


def labels_by_features(
    gaussians: Gaussians,
    features: GaussianFeatures,
    parts: Parts,
    relevancy: Float32[np.ndarray, "Q N"],
    config: SelectConfig,
    spacing: float,
) -> Candidates:
    """The label of each Gaussian by its feature, and the label that it could have by its position.

    By its position a Gaussian could have a word of which a part is within reach; of several words the one with the
    largest share in its feature, or the first where it has no feature. It has that word if the share is above
    `config.share`.
    """
    count = len(gaussians)
    labels, possible = np.zeros(count, np.int32), np.zeros(count, np.int32)
    best = np.full(count, -np.inf)
    for number, groups in enumerate(parts):
        same = np.unique(np.concatenate(groups)) if groups else np.zeros(0, np.int64)
        for rows in groups:
            candidates, shares = object_shares(
                features,
                gaussians.means,
                rows,
                relevancy[number],
                spacing=spacing,
                reach=config.reach,
                same=same,
            )
            shares = np.nan_to_num(shares, nan=NO_SHARE)
            better = shares > best[candidates]
            chosen = candidates[better]
            best[chosen], possible[chosen] = shares[better], number + 1
    above_share = best > config.share
    labels[above_share] = possible[above_share]
    return Candidates(labels=labels, possible=possible, shares=best)


def labels_by_pixels(
    candidates: Candidates, seen: Bool[np.ndarray, " N"], votes: Votes, config: SelectConfig
) -> Labels:
    """Labels by features, corrected by where the blending weight of the Gaussians falls.

    A Gaussian with a good part of an object in its feature (`PARTLY` of `config.share` or more) is taken if the share
    `config.only` of its weight is on pixels that the object dominates. It is also taken if it is a ghost of the object:
    if, were the object taken out, it would have most of its weight on these pixels, and `GHOST_WEIGHT` times as much
    there as Gaussians of the object usually have. One that has the label loses it if less than 1 − `config.only` of its
    weight is there. A Gaussian without a feature has the label on whose pixels more than half of its weight is, or,
    where no view shows it, would be if the objects were taken out. Gaussians that no view would show keep their label.
    """
    labels, possible = candidates.labels, candidates.possible
    rows = np.flatnonzero(possible > 0)
    on_label, total = _weight_on_label(votes.present, rows, possible)
    on_label_removed, total_removed = _weight_on_label(votes.removed, rows, possible)
    usual = _usual_weights(votes.present, labels)[possible[rows]]
    is_in, has_feature = labels[rows] == possible[rows], seen[rows]
    partly = has_feature & (candidates.shares[rows] > PARTLY * config.share)
    ghost = (on_label_removed > 0.5) & (on_label_removed * total_removed >= GHOST_WEIGHT * usual) & (total_removed > 0)
    confirmed = (total > 0) & (on_label >= config.only)
    # What is hidden now is judged by the views in which it would appear.
    featureless = ~has_feature & (np.where(total > 0, on_label, on_label_removed) > 0.5)
    lost = is_in & (total > 0) & np.where(has_feature, on_label < 1 - config.only, on_label <= 0.5)
    corrected = labels.copy()
    added = rows[(partly & (confirmed | ghost)) | featureless]
    corrected[added] = possible[added]
    corrected[rows[lost]] = 0
    return corrected


def _usual_weights(present: Float32[np.ndarray, "N labels"], labels: Labels) -> Float64[np.ndarray, " labels"]:
    """The median weight that the Gaussians of each label have on the pixels of their label."""
    usual = np.zeros(present.shape[1])
    for label in range(1, present.shape[1]):
        members = present[labels == label, label]
        usual[label] = np.median(members) if len(members) else 0.0
    return usual


def _weight_on_label(
    weights: Float32[np.ndarray, "N labels"], rows: np.ndarray, possible: Labels
) -> tuple[np.ndarray, np.ndarray]:
    """The share of the weight that is on the pixels of the label that is possible, 0 without weight; and the weight."""
    total = weights[rows].sum(axis=1)
    on_label = weights[rows, possible[rows]]
    return np.divide(on_label, total, out=np.zeros_like(on_label), where=total > 0), total


def labels_of_hidden(
    gaussians: Gaussians, labels: Labels, possible: Labels, unknown: Bool[np.ndarray, " N"], spacing: float
) -> Labels:
    """Labels in which Gaussians that have no feature and that no view shows take the label of their neighbors.

    A Gaussian of `unknown` within reach of a word gets the word if more than half of its nearest Gaussians that are
    known have it and the nearest of these is within two spacings.
    """
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(unknown & (possible > 0))
    labeled = np.flatnonzero(~unknown)
    if not len(rows) or not len(labeled):
        return labels
    points = gaussians.means.astype(np.float64)
    distances, nearest = cKDTree(points[labeled]).query(points[rows], k=min(NEIGHBORS, len(labeled)))
    distances, nearest = distances.reshape(len(rows), -1), nearest.reshape(len(rows), -1)
    agreeing = (labels[labeled[nearest]] == possible[rows][:, None]).mean(axis=1)
    corrected = labels.copy()
    agrees = (agreeing > 0.5) & (distances[:, 0] <= 2 * spacing)
    corrected[rows] = np.where(agrees, possible[rows], 0)
    return corrected


def grow(
    gaussians: Gaussians,
    features: GaussianFeatures,
    cameras: Cameras | None,
    parts: Parts,
    relevancy: Float32[np.ndarray, "Q N"],
    config: SelectConfig,
    spacing: float,
    *,
    track: Track = untracked,
) -> tuple[Labels, int]:
    """The labels of all Gaussians, and the number of views that corrected them.

    Args:
        features: of the space in which the words were asked.
        cameras: of the views that correct the labels; None = features and positions alone decide.
        parts: what each word's selection starts with.
        spacing: of the scene, world units.
    """
    candidates = labels_by_features(gaussians, features, parts, relevancy, config, spacing)
    labels = candidates.labels
    unknown = ~features.seen
    view_count = 0
    if cameras is not None and config.views and len(cameras):
        # The matrix of a view needs torch, which all else does without.
        from gsencoder.infer.selection import sampling, votes

        chosen = sampling(cameras, views=config.views, pixels=config.pixels)
        by_pixels = votes(gaussians, cameras, labels, len(parts), chosen, spacing=spacing, track=track)
        labels = labels_by_pixels(candidates, features.seen, by_pixels, config)
        unknown = unknown & (by_pixels.present.sum(axis=1) + by_pixels.removed.sum(axis=1) == 0)
        view_count = len(chosen.views)
    return labels_of_hidden(gaussians, labels, candidates.possible, unknown, spacing), view_count


MOST_WORDS = 64
"""Words that are selected at once; each needs a column of a pixel map and of a table of the Gaussians."""


def select(
    scene: Scene,
    words: Sequence[str],
    text: TextEncoder,
    config: SelectConfig = SelectConfig(),
    *,
    boxes: Sequence[int] = (),
    threshold: float | None = None,
    localization: LocalizeConfig = LocalizeConfig(),
    track: Track = untracked,
) -> tuple[Selection, Localization]:
    """Gives each Gaussian a word or none.

    A selection starts with the Gaussians of the boxes of each word (`gsencoder.infer.localize.localize`), or
    with all that reach `threshold`. It grows, or shrinks, to the Gaussians around these whose features are more of the
    object than of its surroundings (`gsencoder.infer.selection`), and is corrected by the pixels on which the
    blending weight of Gaussians falls, in the cameras of the scene (`gsencoder.infer.selection`). A splat without
    views is looked at by cameras that are placed around or inside it.

    Args:
        scene: Gaussians with one feature set, or several of which one is of the space of `text`.
        text: turns words into the features' space.
        boxes: numbers of the boxes of each word, best first from 0; empty = the most probable, and those that are
            nearly as probable.

    Returns:
        The selection, and the boxes that it started from.
    """
    if boxes and threshold is not None:
        raise InputError("box= and threshold= are two ways to choose where a selection starts; give one of them")
    if threshold is not None and not -1 <= threshold <= 1:
        raise InputError(f"threshold: expected a relevancy in [-1, 1], got {threshold}")
    if len(words) > MOST_WORDS:
        raise InputError(f"query: expected at most {MOST_WORDS} words to select, got {len(words)}")
    gaussians, features = select_features(scene, None)
    _check_distinct(words, text)
    localized = localize(scene, words, text, localization)
    if threshold is None:
        parts = box_parts(localized, boxes, probable=config.probable)
    else:
        parts = threshold_parts(words, localized.relevancy, threshold)
    seeds = labels = labels_of_parts(parts, localized.relevancy)
    view_count, placed = 0, False
    if config.grow and labels.any():
        # A part keeps what no other word took from it.
        parts = tuple(
            tuple(remaining for rows in groups if len(remaining := rows[labels[rows] == number + 1]))
            for number, groups in enumerate(parts)
        )
        seen_by, placed = _with_cameras(scene, config)
        cameras = None if seen_by.views is None else seen_by.views.cameras
        spacing = scene_spacing(gaussians.means) or float(np.median(gaussians.scales))
        labels, view_count = grow(
            gaussians, features, cameras, parts, localized.relevancy, config, spacing, track=track
        )
    _check_some(scene, localized, labels)
    return Selection(words=tuple(words), labels=labels, seeds=seeds, views=view_count, placed=placed), localized


def _check_distinct(words: Sequence[str], text: TextEncoder) -> None:
    """Refuses words with one vector, such as "chair" and "Chair": the first would take all Gaussians of both."""
    first: dict[bytes, str] = {}
    for word, vector in zip(words, text.encode(words), strict=True):
        other = first.setdefault(vector.tobytes(), word)
        if other != word:
            raise InputError(f"query: {other!r} and {word!r} stand for the same vector; give one of them")


def _with_cameras(scene: Scene, config: SelectConfig) -> tuple[Scene, bool]:
    if scene.views is not None or not config.views:
        return scene, False
    warnings.warn(
        f"scene {scene.name} has no views; the selection is checked from {config.orbits} cameras around or inside it, "
        "which may not see what real photographs would",
        SceneWarning,
        stacklevel=4,
    )
    return with_views(replace(scene, features={}), config.orbits), True


def _check_some(scene: Scene, localized: Localization, labels: np.ndarray) -> None:
    if labels.all():
        raise InputError(
            f"select: every one of the {len(labels):,} Gaussians of {scene.name} is selected, so nothing is left; give "
            "a higher threshold= or fewer words"
        )
    if not labels.any():
        listing = ", ".join(f"{word!r} (probability {value:.2f})" for word, value in localized.absent.items())
        raise InputError(
            f"select: no Gaussian of {scene.name} is selected; absent: {listing}"
            if listing
            else f"select: no Gaussian of {scene.name} is selected; lower select.share or give select.grow=false"
        )
