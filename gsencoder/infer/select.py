"""Words to the Gaussians of the objects that they stand for.

Where an object ends, features are mixtures: fusion averages the pixels that a Gaussian covers, encoders blur. With the
feature a of the object nearby and b of its surroundings nearby, the share of the object in a feature f is

    s = ⟨f − b, a − b⟩ / |a − b|²

the least-squares solution of f = s·a + (1 − s)·b. A threshold of a word's relevancy cannot tell the same: how far the
relevancy falls towards the edge depends on what the object stands on.

With the matrix B of a view and the labels of all Gaussians, the pixels have the label that more than half of their
opacity is of. Bᵀ then sums, for each Gaussian, its blending weight over the pixels of each label. A half-transparent
Gaussian before an object, or one of a rim, has all its weight in the pixels of the object; so has the table below a
cup, in the little weight that is left behind the cup. Entries that lie behind the surface of their pixel are therefore
left out.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Track, untracked
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.fusion.cameras import with_views
from gsencoder.infer.localize import LocalizeConfig, describe_absent, localize, select_features, spacing_of
from gsencoder.render import blend
from gsencoder.text.table import TextEncoder
from gsencoder.types import Cameras, GaussianFeatures, Gaussians, Localization, Scene


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectConfig(CheckedConfig):
    """How the Gaussians of a box become those of an object. Lengths are in spacings of the scene
    (`gsencoder.data.seeding.points.scene_spacing`)."""

    grow: bool = option(
        True, "grow to the whole object; false = the Gaussians of the boxes, or above threshold=, alone"
    )
    share: float = option(
        0.5,
        "a Gaussian is taken if its feature is more than this share object and less background; smaller = more of the "
        "rims",
        gt=0,
        lt=1,
    )
    reach: float = option(
        4.0, "no Gaussian farther than this from those of a box is taken, in spacings", ge=0, lt=math.inf
    )
    views: int = option(48, "number of views, evenly spaced, that are looked at; 0 = none", ge=0)


PROBABLE = 0.5
"""Without box= those boxes of a word are taken that are at least this share as probable as the most probable one."""
ORBITS = 24
"""Cameras for a splat without views."""
MOST_WORDS = 64
"""Words that are selected at once; each needs a column of a pixel map and of a table of the Gaussians."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Selection:
    """A label for each Gaussian of a scene: 0 = none of the words, k + 1 = word k.

    Attributes:
        views: number of views that corrected them.
        placed: whether these are cameras that were placed around or inside a splat without views.
    """

    words: tuple[str, ...]
    labels: Int32[np.ndarray, " N"]
    seeds: Int32[np.ndarray, " N"]
    views: int
    placed: bool

    def rows(self, word: int) -> Int32[np.ndarray, " n"]:
        """The Gaussians of word number `word`, ascending."""
        return np.flatnonzero(self.labels == word + 1).astype(np.int32)

    @property
    def rest(self) -> Bool[np.ndarray, " N"]:
        """The Gaussians of no word."""
        return np.asarray(self.labels == 0)


Parts = tuple[tuple[Int64[np.ndarray, " _"], ...], ...]
"""For each word the rows of each of its parts, ascending; a part is a box, or all that is above a threshold."""


Labels = Int32[np.ndarray, " N"]


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

    A selection starts with the Gaussians of the boxes of each word (`gsencoder.infer.localize.localize`), or with all
    that reach `threshold`. It grows, or shrinks, to the Gaussians around these whose features are more of the object
    than of its surroundings, and is corrected by the pixels on which the blending weight of Gaussians falls, in the
    cameras of the scene. A splat without views is looked at by cameras that are placed around or inside it.

    Args:
        scene: Gaussians with one feature set, or several of which one is of the space of `text`.
        boxes: numbers of the boxes of each word, best first from 0; empty = the most probable, and those that are
            nearly as probable.

    Returns:
        The selection, and the boxes that it started from.
    """
    if boxes and threshold is not None:
        raise InputError("box= and threshold= are two ways to choose where a selection starts; give one of them")
    if len(words) > MOST_WORDS:
        raise InputError(f"query: expected at most {MOST_WORDS} words to select, got {len(words)}")
    localized = localize(scene, words, text, localization)
    gaussians, features = select_features(scene, None)
    seen = features.seen
    _check_distinct(words, text)
    parts = box_parts(localized, boxes) if threshold is None else threshold_parts(words, localized.relevancy, threshold)
    seeds = labels = labels_of_parts(parts, localized.relevancy)
    view_count, placed = 0, False
    if config.grow and labels.any():
        # A part keeps what no other word took from it.
        parts = tuple(
            tuple(remaining for rows in groups if len(remaining := rows[labels[rows] == number + 1]))
            for number, groups in enumerate(parts)
        )
        spacing = spacing_of(gaussians)
        candidates = labels_by_features(features, gaussians.means, parts, localized.relevancy, config, spacing)
        labels, unknown = candidates.labels, ~seen
        if config.views:
            placed = scene.views is None
            cameras = _cameras(scene)
            samples = sample_views(cameras, config.views)
            by_pixels = votes(gaussians, cameras, labels, len(parts), samples, spacing=spacing, track=track)
            labels = labels_by_pixels(candidates, seen, by_pixels, config)
            unknown = unknown & (by_pixels.present.sum(axis=1) + by_pixels.removed.sum(axis=1) == 0)
            view_count = len(samples)
        labels = labels_of_hidden(gaussians.means, labels, candidates.possible, unknown, spacing)
    if labels.all():
        raise InputError(
            f"select: every one of the {len(labels):,} Gaussians of {scene.name} is selected, so nothing is left; give "
            "a higher threshold= or fewer words"
        )
    if not labels.any():
        listing = ", ".join(f"{word!r} (probability {value:.2f})" for word, value in localized.absent.items())
        why = f"absent: {listing}" if listing else "lower select.share or give select.grow=false"
        raise InputError(f"select: no Gaussian of {scene.name} is selected; {why}")
    return Selection(words=tuple(words), labels=labels, seeds=seeds, views=view_count, placed=placed), localized


def _check_distinct(words: Sequence[str], text: TextEncoder) -> None:
    """Refuses words with one vector, such as "chair" and "Chair": the first would take all Gaussians of both."""
    first: dict[bytes, str] = {}
    for word, vector in zip(words, text.encode(words), strict=True):
        other = first.setdefault(vector.tobytes(), word)
        if other != word:
            raise InputError(f"query: {other!r} and {word!r} stand for the same vector; give one of them")


def _cameras(scene: Scene) -> Cameras:
    """The scene's cameras, or some that are placed around or inside a splat without views."""
    if scene.views is None:
        warnings.warn(
            f"scene {scene.name} has no views; the selection is checked from {ORBITS} cameras around or inside it, "
            "which may not see what real photographs would",
            SceneWarning,
            stacklevel=3,
        )
        scene = with_views(replace(scene, features={}), ORBITS)[0]
    assert scene.views is not None
    return scene.views.cameras


def box_parts(localization: Localization, ranks: Sequence[int]) -> Parts:
    """The Gaussians of each word's boxes of these numbers, or without numbers of the probable ones (`PROBABLE`)."""
    parts = []
    for word in localization.queries:
        boxes = [box for box in localization.boxes if box.query == word]
        for rank in ranks:
            if not 0 <= rank < len(boxes):
                several = f"{len(boxes)} boxes, 0 to {len(boxes) - 1}"
                has = "no box" if not boxes else "one box, number 0" if len(boxes) == 1 else several
                why = "" if boxes else f": {describe_absent(localization.absent[word])}"
                raise InputError(f"box={rank}: {word!r} has {has}{why}")
        least = PROBABLE * max((box.probability for box in boxes), default=0.0)
        chosen = [boxes[rank] for rank in dict.fromkeys(ranks)] or [box for box in boxes if box.probability >= least]
        parts.append(tuple(np.sort(box.rows).astype(np.int64) for box in chosen))
    return tuple(parts)


def threshold_parts(words: Sequence[str], relevancy: Float32[np.ndarray, "Q N"], threshold: float) -> Parts:
    """All Gaussians whose relevancy for a word is at least `threshold`, a part for each word."""
    # Comparisons with NaN are false: Gaussians never seen are never taken.
    rows = [np.flatnonzero(scores >= threshold) for scores in relevancy]
    if not any(len(each) for each in rows):
        most = [max(scores[np.isfinite(scores)].tolist(), default=math.nan) for scores in relevancy]
        best = ", ".join(f"{word!r} {value:.7g}" for word, value in zip(words, most, strict=True))
        raise InputError(f"threshold={threshold:g}: no Gaussian is as relevant; the best are {best}")
    return tuple((each,) if len(each) else () for each in rows)


def labels_of_parts(parts: Parts, relevancy: Float32[np.ndarray, "Q N"]) -> Int32[np.ndarray, " N"]:
    """The label of each Gaussian: of the words that take it the most relevant one, the first of equal ones; or 0."""
    labels = np.zeros(relevancy.shape[1], np.int32)
    best = np.full(relevancy.shape[1], -np.inf, np.float32)
    for number, (groups, scores) in enumerate(zip(parts, relevancy, strict=True)):
        for rows in groups:
            better = rows[scores[rows] > best[rows]]
            labels[better], best[better] = number + 1, scores[better]
    return labels


CORE_QUANTILE = 0.75
"""Gaussians of a part above this quantile of their relevancy are pure enough to stand for the object."""
GAP = 1.0
"""Gaussians nearer to a part than this many spacings are rims, and do not stand for its surroundings."""
SURROUNDINGS = 2.0
"""Reach of the surroundings, in multiples of the reach."""
RIM = 2.0
"""Gaussians of a part that are farther than this many spacings from all others are inside of the object, whatever their
feature: the surface of a real table has features of many things."""
NEIGHBORS = 8
"""Number of the nearest Gaussians that give the feature of the object, or of its surroundings, at a place."""
BLOCK_BYTES = 1 << 26


def object_shares(
    features: GaussianFeatures,
    means: Float32[np.ndarray, "N 3"],
    rows: Int64[np.ndarray, " n"],
    relevancy: Float32[np.ndarray, " N"],
    *,
    spacing: float,
    reach: float,
    same: Int64[np.ndarray, " m"],
) -> tuple[Int64[np.ndarray, " c"], Float64[np.ndarray, " c"]]:
    """The share of the object in the Gaussians at and around one of its parts.

    Args:
        relevancy: of all Gaussians for the word; finite where `features` were seen.
        spacing: of the scene, world units.
        reach: candidates lie within this many spacings of `rows`.
        same: the Gaussians of all parts of the word, which are no surroundings.

    Returns:
        The candidates, ascending, and their shares: about 0 to 1, NaN for those without features. It is 1 for what is
        inside of the part, and where there are no surroundings with features: nothing else is there.
    """
    from scipy.spatial import cKDTree

    core = rows[features.weights[rows] > 0]
    if not len(core):
        return rows, np.full(len(rows), np.nan)
    points = means.astype(np.float64)
    margin = SURROUNDINGS * reach * spacing
    low, high = points[rows].min(axis=0) - margin, points[rows].max(axis=0) + margin
    near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    distances = np.asarray(cKDTree(points[rows]).query(points[near])[0])
    candidates = near[distances <= reach * spacing]
    in_ring = (distances > GAP * spacing) & (distances <= margin) & (features.weights[near] > 0)
    surroundings = np.setdiff1d(near[in_ring], same, assume_unique=True)
    # What is as relevant as the part, but too small or sparse for a box of its own, does not stand for something else.
    surroundings = surroundings[relevancy[surroundings] < relevancy[core].min()]
    shares = np.full(len(candidates), np.nan)
    with_features = np.flatnonzero(features.weights[candidates] > 0)
    if not len(surroundings):
        shares[with_features] = 1.0
        return candidates, shares
    others = np.setdiff1d(near, same, assume_unique=True)
    depths = np.asarray(cKDTree(points[others]).query(points[rows])[0])
    inside = rows[depths > RIM * spacing]
    pure = core[relevancy[core] >= np.quantile(relevancy[core], CORE_QUANTILE)]
    core = np.union1d(pure, np.intersect1d(core, inside))
    trees = [(cKDTree(points[pure]), pure) for pure in (core, surroundings)]
    step = max(1, BLOCK_BYTES // (8 * NEIGHBORS * features.features.shape[1]))
    for start in range(0, len(with_features), step):
        block = with_features[start : start + step]
        batch = candidates[block]
        a, b = (_local_mean(features, points[batch], tree, pure) for tree, pure in trees)
        between = a - b
        length = (between**2).sum(axis=1)
        along = ((features.stored(batch) - b) * between).sum(axis=1)
        # Where object and surroundings have one feature, a Gaussian is what it started as.
        alike = np.isin(batch, rows).astype(np.float64)
        shares[block] = np.divide(along, length, out=alike, where=length > 1e-12 * (a**2 + b**2).sum(axis=1))
    shares[np.isin(candidates, inside)] = 1.0
    return candidates, shares


def _local_mean(
    features: GaussianFeatures, positions: Float64[np.ndarray, "c 3"], tree: object, rows: Int64[np.ndarray, " n"]
) -> Float64[np.ndarray, "c channels"]:
    """The mean feature of the nearest of some Gaussians to each place."""
    nearest = tree.query(positions, k=min(NEIGHBORS, len(rows)))[1]  # type: ignore[attr-defined]
    nearest = np.asarray(nearest).reshape(len(positions), -1)
    values = features.stored(rows[nearest.ravel()]).astype(np.float64)
    return np.asarray(values.reshape(*nearest.shape, -1).mean(axis=1))


DOMINANT = 0.5
"""A pixel is of a label if more than this share of its opacity is."""
BEHIND = 0.02
"""Share of the depth of a pixel's surface by which an entry may lie behind it, plus one spacing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Votes:
    """Blending weight of each Gaussian over the pixels of each label, summed over views; pixels of the whole picture.

    Attributes:
        removed: as it is without the Gaussians that have a label; zeros for these. The pixels keep the labels that
            they had with them.
    """

    present: Float32[np.ndarray, "N labels"]
    removed: Float32[np.ndarray, "N labels"]


PIXELS = 100_000
"""Of views with more pixels every second, third, … in both directions counts."""


def sample_views(cameras: Cameras, views: int, pixels: int = PIXELS) -> list[tuple[int, int]]:
    """The rows of `views` views, evenly spaced, each with the step between its pixels, in both directions, that leaves
    about `pixels` of them."""
    rows = even_indices(len(cameras), views)
    areas = cameras.widths[rows].astype(np.int64) * cameras.heights[rows]
    strides = np.maximum(1, np.ceil(np.sqrt(areas / pixels))).astype(np.int64)
    return list(zip(rows.tolist(), strides.tolist(), strict=True))


def votes(
    gaussians: Gaussians,
    cameras: Cameras,
    labels: Int32[np.ndarray, " N"],
    count: int,
    samples: Sequence[tuple[int, int]],
    *,
    spacing: float,
    track: Track = untracked,
) -> Votes:
    """Where the blending weight of each Gaussian falls: sums over labels 0 to `count`, zeros for Gaussians that no
    view shows.

    Args:
        samples: of `sample_views`; a pixel of every second line and column counts four times.
        spacing: entries that lie farther behind a pixel's surface than this, and a share of its depth, do not count.
    """
    present = torch.zeros(len(gaussians), count + 1)
    left, labeled = np.flatnonzero(labels == 0), np.flatnonzero(labels)
    rest = gaussians.select(left)
    removed = torch.zeros(len(left), count + 1)
    # Gaussians of the label 0 are most of a scene, and have no column.
    one_hot = torch.zeros(len(labels), count)
    one_hot[torch.from_numpy(labeled), torch.from_numpy(labels[labeled].astype(np.int64) - 1)] = 1
    for view, stride in track(samples, "views of the objects"):
        b = blend(gaussians, cameras, view, stride=stride)
        surface = b.median_depth
        farthest = torch.where(surface > 0, surface * (1 + BEHIND) + spacing, torch.inf)
        nearest = torch.zeros_like(farthest)
        mass, best = b.render(one_hot).max(dim=1)
        codes = torch.where(mass > DOMINANT * b.alpha, best + 1, 0).int()
        seen = torch.zeros(len(labels), count + 1)
        b.keep_between(nearest, farthest).lift_codes_into(codes, seen)
        present += seen * stride**2
        if codes.any():
            without = torch.zeros_like(removed)
            blend(rest, cameras, view, stride=stride).keep_between(nearest, farthest).lift_codes_into(codes, without)
        else:
            without = seen[torch.from_numpy(left)]
        removed += without * stride**2
    spread = np.zeros_like(present.numpy())
    spread[left] = removed.numpy()
    return Votes(present=present.numpy(), removed=spread)


OPAQUE = 0.5
"""Alpha below which a pixel counts as empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hole:
    """Pixels of one view that are empty after the removal and were not before; numbers are those of the whole view.

    Attributes:
        removed: number of pixels that the removed Gaussians dominated.
        area: of the hole at the depth of the surface that was there, in world units².
    """

    view: int
    pixels: int
    removed: int
    area: float


def find_holes(
    gaussians: Gaussians,
    cameras: Cameras,
    removed: Bool[np.ndarray, " N"],
    samples: Sequence[tuple[int, int]],
    *,
    track: Track = untracked,
) -> list[Hole]:
    """The hole in each view of `sample_views` that shows what is removed.

    A pixel is a part of the hole if more than half of its opacity was of the removed Gaussians, its alpha was one half
    or more, and is less without them. It covers z² / (fx·fy) of a surface at depth z that faces the camera.
    """
    rest = gaussians.select(~removed)
    values = torch.from_numpy(removed.astype(np.float32))
    holes = []
    for view, stride in track(samples, "views without the object"):
        before = blend(gaussians, cameras, view, stride=stride)
        gone = (before.render(values) > DOMINANT * before.alpha) & (before.alpha >= OPAQUE)
        if not gone.any():
            continue
        empty = gone & (blend(rest, cameras, view, stride=stride).alpha < OPAQUE)
        K = cameras.Ks[view].astype(np.float64)
        z = before.median_depth[empty].double()
        holes.append(
            Hole(
                view=view,
                pixels=int(empty.sum()) * stride**2,
                removed=int(gone.sum()) * stride**2,
                area=float((z**2).sum()) * stride**2 / float(K[0, 0] * K[1, 1]),
            )
        )
    return holes


NO_SHARE = -1e9
"""Stands for the share of a Gaussian without a feature: below that of every other one."""
ONLY, PARTLY, GHOST_WEIGHT = 0.9, 0.7, 1.0
"""See `labels_by_pixels`. The smaller the last two are, the less is left of an object that is taken out, and the more
of its surroundings goes with it."""


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
    features: GaussianFeatures,
    means: Float32[np.ndarray, "N 3"],
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
    possible, best = np.zeros(len(means), np.int32), np.full(len(means), -np.inf)
    for number, groups in enumerate(parts):
        same = np.unique(np.concatenate(groups)) if groups else np.zeros(0, np.int64)
        for rows in groups:
            candidates, shares = object_shares(
                features, means, rows, relevancy[number], spacing=spacing, reach=config.reach, same=same
            )
            shares = np.nan_to_num(shares, nan=NO_SHARE)
            better = shares > best[candidates]
            chosen = candidates[better]
            best[chosen], possible[chosen] = shares[better], number + 1
    return Candidates(
        labels=np.where(best > config.share, possible, 0).astype(np.int32), possible=possible, shares=best
    )


def labels_by_pixels(
    candidates: Candidates, seen: Bool[np.ndarray, " N"], votes: Votes, config: SelectConfig
) -> Labels:
    """Labels by features, corrected by where the blending weight of the Gaussians falls.

    A Gaussian with a good part of an object in its feature (`PARTLY` of `config.share` or more) is taken if the share
    `ONLY` of its weight is on pixels that the object dominates. It is also taken if it is a ghost of the object:
    if, were the object taken out, it would have most of its weight on these pixels, and `GHOST_WEIGHT` times as much
    there as Gaussians of the object usually have. One that has the label loses it if less than 1 − `ONLY` of its
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
    confirmed = (total > 0) & (on_label >= ONLY)
    # What is hidden now is judged by the views in which it would appear.
    featureless = ~has_feature & (np.where(total > 0, on_label, on_label_removed) > 0.5)
    lost = is_in & (total > 0) & np.where(has_feature, on_label < 1 - ONLY, on_label <= 0.5)
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
    means: Float32[np.ndarray, "N 3"], labels: Labels, possible: Labels, unknown: Bool[np.ndarray, " N"], spacing: float
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
    points = means.astype(np.float64)
    distances, nearest = cKDTree(points[labeled]).query(points[rows], k=min(NEIGHBORS, len(labeled)))
    distances, nearest = distances.reshape(len(rows), -1), nearest.reshape(len(rows), -1)
    agreeing = (labels[labeled[nearest]] == possible[rows][:, None]).mean(axis=1)
    corrected = labels.copy()
    agrees = (agreeing > 0.5) & (distances[:, 0] <= 2 * spacing)
    corrected[rows] = np.where(agrees, possible[rows], 0)
    return corrected
