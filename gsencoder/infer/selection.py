"""What a selection is: its settings, and what seeds, votes of views and shares of features say of Gaussians.

How much of a Gaussian's feature is the object's, and how much that of what is around it.

Where an object ends, features are mixtures: fusion averages the pixels that a Gaussian covers, encoders blur. With the
feature a of the object nearby and b of its surroundings nearby, the share of the object in a feature f is

    s = ⟨f − b, a − b⟩ / |a − b|²

the least-squares solution of f = s·a + (1 − s)·b. A threshold of a word's relevancy cannot tell the same: how far the
relevancy falls towards the edge depends on what the object stands on.

On whose pixels the blending weight of each Gaussian falls.

With the matrix B of a view and the labels of all Gaussians, the pixels have the label that more than half of their
opacity is of. Bᵀ then sums, for each Gaussian, its blending weight over the pixels of each label. A half-transparent
Gaussian before an object, or one of a rim, has all its weight in the pixels of the object; so has the table below a
cup, in the little weight that is left behind the cup. Entries that lie behind the surface of their pixel are therefore
left out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.fusion.cameras import check_orbits
from gsencoder.infer.localize import describe_absent
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.types import Box, Cameras, GaussianFeatures, Gaussians, Localization


@dataclass(frozen=True, slots=True, kw_only=True)
class SelectConfig:
    """How the Gaussians of a box become those of an object. Lengths are in spacings of the scene
    (`gsencoder.data.seeding.points.scene_spacing`)."""

    grow: bool = field(
        default=True,
        metadata={"help": "grow to the whole object; false = the Gaussians of the boxes, or above threshold=, alone"},
    )
    probable: float = field(
        default=0.5,
        metadata={
            "help": "without box= those boxes of a word are taken whose probability is at least this share of the "
            "most probable one's"
        },
    )
    share: float = field(
        default=0.5,
        metadata={
            "help": "a Gaussian is taken if its feature is more than this share object and less background; smaller = "
            "more of the rims"
        },
    )
    reach: float = field(
        default=4.0, metadata={"help": "no Gaussian farther than this from those of a box is taken, in spacings"}
    )
    only: float = field(
        default=0.9,
        metadata={
            "help": "a Gaussian whose feature is partly object is taken if so much of its blending weight over the "
            "views falls on pixels that the object dominates, and lost if no more than the rest of 1 does"
        },
    )
    views: int = field(default=48, metadata={"help": "so many views, evenly spaced, are looked at; 0 = none"})
    pixels: int = field(
        default=100_000, metadata={"help": "of views with more pixels every second, third, … in both directions counts"}
    )
    orbits: int = field(default=24, metadata={"help": "cameras for a splat without views"})

    def __post_init__(self) -> None:
        if not 0 <= self.probable <= 1:
            raise InputError(f"probable: expected a share in [0, 1], got {self.probable}")
        if not 0.5 <= self.only <= 1:
            raise InputError(f"only: expected a share in [0.5, 1], got {self.only}")
        if not 0 < self.share < 1:
            raise InputError(f"share: expected a share between 0 and 1, got {self.share}")
        if not 0 <= self.reach < math.inf:
            raise InputError(f"reach: expected zero or a positive number, got {self.reach}")
        for name, least in (("views", 0), ("pixels", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: expected {least} or more, got {getattr(self, name)}")
        check_orbits(self.orbits)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Selection:
    """A label for each Gaussian of a scene: 0 = none of the words, k + 1 = word k.

    Attributes:
        seeds: the labels before they grew.
        views: how many views were looked at.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Votes:
    """Blending weight of each Gaussian over the pixels of each label, summed over views; pixels of the whole picture.

    Attributes:
        present: as the scene is.
        removed: as it is without the Gaussians that have a label; zeros for these. The pixels keep the labels that
            they had with them.
    """

    present: Float32[np.ndarray, "N labels"]
    removed: Float32[np.ndarray, "N labels"]


Parts = tuple[tuple[Int64[np.ndarray, " _"], ...], ...]
"""For each word the rows of each of its parts, ascending; a part is a box, or all that is above a threshold."""


def box_parts(localization: Localization, ranks: Sequence[int], *, probable: float) -> Parts:
    """The Gaussians of each word's boxes.

    Args:
        ranks: numbers of the boxes of every word, as in boxes.json; empty = the boxes that are at least `probable`
            times as probable as the most probable box of their word.
    """
    parts = []
    for word in localization.queries:
        boxes = [box for box in localization.boxes if box.query == word]
        for rank in ranks:
            if not 0 <= rank < len(boxes):
                several = f"{len(boxes)} boxes, 0 to {len(boxes) - 1}"
                has = "no box" if not boxes else "one box, number 0" if len(boxes) == 1 else several
                why = "" if boxes else f": {describe_absent(localization.absent[word])}"
                raise InputError(f"box={rank}: {word!r} has {has}{why}")
        chosen = [boxes[rank] for rank in dict.fromkeys(ranks)] if ranks else _probable(boxes, probable)
        parts.append(tuple(np.sort(box.rows).astype(np.int64) for box in chosen))
    return tuple(parts)


def _probable(boxes: Sequence[Box], share: float) -> list[Box]:
    most = max((box.probability for box in boxes), default=0.0)
    return [box for box in boxes if box.probability >= share * most]


def threshold_parts(words: Sequence[str], relevancy: Float32[np.ndarray, "Q N"], threshold: float) -> Parts:
    """All Gaussians whose relevancy for a word is at least `threshold`, a part for each word."""
    # Comparisons with NaN are false: Gaussians never seen are never taken.
    rows = [np.flatnonzero(scores >= threshold) for scores in relevancy]
    if not any(len(each) for each in rows):
        best = ", ".join(f"{word!r} {_best(scores):.7g}" for word, scores in zip(words, relevancy, strict=True))
        raise InputError(f"threshold={threshold:g}: no Gaussian is as relevant; the best are {best}")
    return tuple((each,) if len(each) else () for each in rows)


def _best(scores: Float32[np.ndarray, " N"]) -> float:
    seen = scores[np.isfinite(scores)]
    return float(seen.max()) if seen.size else float("nan")


def labels_of_parts(parts: Parts, relevancy: Float32[np.ndarray, "Q N"]) -> Int32[np.ndarray, " N"]:
    """The label of each Gaussian: of the words that take it the most relevant one, the first of equal ones; 0 = none.

    The contrast of one word with the others, as in `gsencoder.infer.relevancy.relevancy`, is above one half
    for the most relevant word alone, so that no Gaussian is given to a word that loses against another one that
    takes it.
    """
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
"""Gaussians nearer to a part than so many spacings are rims, and do not stand for its surroundings."""
SURROUNDINGS = 2.0
"""Surroundings go as far as so many times the reach."""
RIM = 2.0
"""Gaussians of a part that are farther than so many spacings from all others are inside of the object, whatever their
feature: the surface of a real table has features of many things."""
NEIGHBORS = 8
"""So many nearest Gaussians give the feature of the object, or of its surroundings, at a place."""
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
        reach: candidates lie within so many spacings of `rows`.
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
"""Share of the depth of a pixel's surface by which an entry may lie behind it, beside one spacing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sampling:
    """Which pixels of a scene are looked at.

    Attributes:
        views: row numbers of the views.
        pixels: most pixels of a view.
    """

    views: tuple[int, ...]
    pixels: int

    def stride(self, cameras: Cameras, view: int) -> int:
        """The step between pixels of a view, in both directions."""
        return max(1, math.ceil(math.sqrt(int(cameras.widths[view]) * int(cameras.heights[view]) / self.pixels)))

    def blend(self, gaussians: Gaussians, cameras: Cameras, view: int, config: BlendConfig = BlendConfig()) -> Blend:
        """B of a view's pixels."""
        return blend(gaussians, cameras, view, stride=self.stride(cameras, view), config=config)


def sampling(cameras: Cameras, *, views: int, pixels: int) -> Sampling:
    """`views` views, evenly spaced, with at most about `pixels` pixels each."""
    rows = even_indices(len(cameras), views) if views and len(cameras) else np.zeros(0, np.int64)
    return Sampling(views=tuple(int(row) for row in rows), pixels=pixels)


def label_masses(b: Blend, labels: Int32[np.ndarray, " N"], count: int) -> torch.Tensor:
    """How much of each pixel's opacity is of each label from 1 to `count`: [P, count]."""
    # Gaussians of the label 0 are most of a scene, and have no column.
    one_hot = torch.zeros(len(labels), count)
    labeled = np.flatnonzero(labels)
    one_hot[torch.from_numpy(labeled), torch.from_numpy(labels[labeled].astype(np.int64) - 1)] = 1
    return b.render(one_hot)


def pixel_labels(b: Blend, labels: Int32[np.ndarray, " N"], count: int) -> Int32[torch.Tensor, " P"]:
    """The label that dominates each pixel of a view, 0 = none of them."""
    mass, best = label_masses(b, labels, count).max(dim=1)
    return torch.where(mass > DOMINANT * b.alpha, best + 1, 0).int()


def votes(
    gaussians: Gaussians,
    cameras: Cameras,
    labels: Int32[np.ndarray, " N"],
    count: int,
    chosen: Sampling,
    *,
    spacing: float,
    track: Track = untracked,
) -> Votes:
    """Where the blending weight of each Gaussian falls.

    Args:
        labels: of the Gaussians, 0 to `count`.
        chosen: which pixels are looked at; a pixel of every second line and column counts four times.
        spacing: entries that lie farther behind a pixel's surface than this, and a share of its depth, do not count.

    Returns:
        Weights over labels 0 to `count`; rows of zeros for Gaussians that no view shows.
    """
    left = np.flatnonzero(labels == 0)
    rest = gaussians.select(left)
    present = torch.zeros(len(gaussians), count + 1)
    removed = torch.zeros(len(rest), count + 1)
    for view in track(chosen.views, "views of the objects"):
        b = chosen.blend(gaussians, cameras, view)
        surface = b.median_depth
        farthest = torch.where(surface > 0, surface * (1 + BEHIND) + spacing, torch.inf)
        codes = pixel_labels(b, labels, count)
        seen = _lifted(b, farthest, codes, count) * chosen.stride(cameras, view) ** 2
        present += seen
        if codes.any():
            without = chosen.blend(rest, cameras, view)
            removed += _lifted(without, farthest, codes, count) * chosen.stride(cameras, view) ** 2
        else:
            removed += seen[torch.from_numpy(left)]
    spread = np.zeros_like(present.numpy())
    spread[left] = removed.numpy()
    return Votes(present=present.numpy(), removed=spread)


def _lifted(b: Blend, farthest: torch.Tensor, codes: torch.Tensor, count: int) -> torch.Tensor:
    sums = torch.zeros(b.gaussians, count + 1)
    b.keep_between(torch.zeros_like(farthest), farthest).lift_codes_into(codes, sums)
    return sums


OPAQUE = 0.5
"""Alpha below which a pixel counts as empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Hole:
    """Pixels of one view that are empty after the removal and were not before.

    Attributes:
        removed: how many pixels the removed Gaussians dominated.
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
    chosen: Sampling,
    *,
    track: Track = untracked,
) -> list[Hole]:
    """The hole in each view that shows what is removed.

    A pixel is a part of the hole if more than half of its opacity was of the removed Gaussians, its alpha was one half
    or more, and is less without them. It covers z² / (fx·fy) of a surface at depth z that faces the camera.

    Args:
        removed: which Gaussians are taken out.
        chosen: which pixels are looked at; numbers are those of the whole view.
    """
    rest = gaussians.select(~removed)
    values = torch.from_numpy(removed.astype(np.float32))
    holes = []
    for view in track(chosen.views, "views without the object"):
        before = chosen.blend(gaussians, cameras, view)
        gone = (before.render(values) > DOMINANT * before.alpha) & (before.alpha >= OPAQUE)
        if not gone.any():
            continue
        after = chosen.blend(rest, cameras, view)
        empty = gone & (after.alpha < OPAQUE)
        each = chosen.stride(cameras, view) ** 2
        K = cameras.Ks[view].astype(np.float64)
        z = before.median_depth[empty].double()
        holes.append(
            Hole(
                view=view,
                pixels=int(empty.sum()) * each,
                removed=int(gone.sum()) * each,
                area=float((z**2).sum()) * each / float(K[0, 0] * K[1, 1]),
            )
        )
    return holes
