"""Whether depth and photographs belong to one camera: the focal length and place of a color camera under which the
photographs show the same details at the same places.

Pixels whose depth two views agree on are one place. A color camera beside the depth camera sees it at
f (X + t) / Z + c; with the right f and t both photographs have the same details there.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.data.check.depth_agreement import DepthViews, shared_samples
from gsencoder.types import Views
from gsencoder.types.scene import project_points

PICTURE_SIZE = 640
"""Longer side in pixels of the photographs that are compared; smaller ones keep theirs."""
FINE, COARSE = 1.0, 12.0
"""Details are the difference of two Gaussian blurs of these widths in pixels."""
MIN_SHARED = 60
"""Pairs of views that share fewer samples say nothing."""
MAX_PAIRS = 160
SMALLEST_DETAIL = 1e-4
"""Standard deviation of details, of an intensity from 0 to 1, below which a pair of views shows none."""
FOCAL_FACTORS: tuple[float, ...] = tuple(np.round(np.geomspace(0.8, 1.25, 13), 4).tolist())
SHIFTS = (-0.02, -0.01, 0.0, 0.01, 0.02)
"""Shifts that are tried first, as shares of the median depth."""
REFINEMENTS = 5
BETTER = 0.1
"""A registration is named if it raises the correlation of details by this much, and to `LEAST` or more."""
LEAST = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegistrationFit:
    """The color camera that fits best.

    Attributes:
        focal_factor: its focal length, as a multiple of the stated one.
        shift: what is added to x and y in the depth camera's axes to have them in its own, world units.
        stated: mean correlation of details of pairs of views with the stated camera.
        best: the same with the best one.
        pairs: pairs of views that were compared.
    """

    focal_factor: float
    shift: Float64[np.ndarray, "2"]
    stated: float
    best: float
    pairs: int

    @property
    def differs(self) -> bool:
        """Whether the stated camera is wrong."""
        return self.pairs > 0 and self.best >= LEAST and self.best >= self.stated + BETTER


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Pair:
    """Places that two views share, in the axes of both depth cameras."""

    views: tuple[int, int]
    points: tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]


def fit_registration(views: Views, rows: Int64[np.ndarray, " V"], depth: DepthViews) -> RegistrationFit:
    """The color camera under which photographs show the same details where their depth agrees.

    Args:
        views: with photographs and depth.
        rows: the rows of the views that are compared.
        depth: their depth images, under the reading that fits best.
    """
    pairs = _shared_samples(depth)
    nothing = RegistrationFit(
        focal_factor=1.0, shift=np.zeros(2), stated=float("nan"), best=float("nan"), pairs=len(pairs)
    )
    if not pairs:
        return nothing
    samples = [_samples_of_view(pairs, view, views, rows) for view in range(len(rows))]
    samples = [each for each in samples if len(each.points)]

    def score(factor: float, shift: Float64[np.ndarray, "2"]) -> float:
        key = (round(factor, 6), *np.round(shift / typical, 6))
        if key not in scores:
            scores[key] = _correlation(samples, len(pairs), factor, shift)
        return scores[key]

    typical = float(np.median(np.concatenate([pair.points[0][:, 2] for pair in pairs])))
    scores: dict[tuple[float, ...], float] = {}
    score_as_stated = score(1.0, np.zeros(2))
    if not np.isfinite(score_as_stated):
        return nothing
    best = max(
        ((factor, np.array((shift * typical, 0.0))) for factor in FOCAL_FACTORS for shift in SHIFTS),
        key=lambda candidate: score(*candidate),
    )
    steps = 1.02, 0.006 * typical
    for _ in range(REFINEMENTS):
        for _ in range(2):
            factor, shift = best
            around = [(factor * steps[0] ** sign, shift) for sign in (-1, 1)]
            around += [(factor, shift + sign * steps[1] * axis) for axis in np.eye(2) for sign in (-1, 1)]
            best = max([best, *around], key=lambda candidate: score(*candidate))
        steps = steps[0] ** 0.5, steps[1] / 2
    return RegistrationFit(
        focal_factor=best[0], shift=best[1], stated=score_as_stated, best=score(*best), pairs=len(pairs)
    )


def _shared_samples(depth: DepthViews) -> list[_Pair]:
    """The pairs of views with the most samples on which their depth agrees."""
    pairs = [
        _Pair(views=(view, other), points=(here, there))
        for view, other, here, there in shared_samples(depth, MIN_SHARED)
    ]
    return sorted(pairs, key=lambda pair: -len(pair.points[0]))[:MAX_PAIRS]


class _ViewSamples(NamedTuple):
    """What the correlation needs to know about one view.

    Attributes:
        details: of its photograph.
        K: intrinsics of the photograph at that size.
        points: places that it shares with others, in the axes of its depth camera, pair by pair.
        entries: where each of them stands among the places of all pairs, first those of the pairs' first views.
        pairs: number of the pair of each.
    """

    details: Float64[np.ndarray, "h w"]
    K: Float64[np.ndarray, "3 3"]
    points: Float64[np.ndarray, "n 3"]
    entries: Int64[np.ndarray, " n"]
    pairs: Int64[np.ndarray, " n"]


def _samples_of_view(pairs: list[_Pair], view: int, views: Views, rows: Int64[np.ndarray, " V"]) -> _ViewSamples:
    sizes = np.array([len(pair.points[0]) for pair in pairs])
    starts = np.concatenate(([0], np.cumsum(sizes)))
    points, entries, numbers = [np.empty((0, 3))], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for number, pair in enumerate(pairs):
        for side in range(2):
            if pair.views[side] == view:
                points.append(pair.points[side])
                entries.append(side * starts[-1] + np.arange(starts[number], starts[number + 1]))
                numbers.append(np.full(sizes[number], number))
    row = int(rows[view])
    small = views.cameras.select([row]).resized(PICTURE_SIZE, enlarge=False)
    everything = np.concatenate(points)
    details = _details(views, row, int(small.widths[0]), int(small.heights[0])) if len(everything) else np.zeros((1, 1))
    return _ViewSamples(
        details, small.Ks[0].astype(np.float64), everything, np.concatenate(entries), np.concatenate(numbers)
    )


def _details(views: Views, row: int, width: int, height: int) -> Float64[np.ndarray, "h w"]:
    from PIL import Image
    from scipy.ndimage import gaussian_filter

    assert views.images is not None
    grey = Image.fromarray(views.images[row]).convert("L").resize((width, height), Image.Resampling.BOX)
    values = np.asarray(grey, np.float64) / 255
    return np.asarray(gaussian_filter(values, FINE) - gaussian_filter(values, COARSE))


def _correlation(positions: list[_ViewSamples], pairs: int, factor: float, shift: Float64[np.ndarray, "2"]) -> float:
    """Mean correlation of the details of pairs of views with a color camera."""
    from scipy.ndimage import map_coordinates

    total = sum(len(each.points) for each in positions)
    values, numbers = np.full(total, np.nan), np.zeros(total, np.int64)
    for details, K, points, entries, pair in positions:
        focal = K.copy()
        focal[0, 0] *= factor
        focal[1, 1] *= factor
        shifted_points = points.copy()
        shifted_points[:, :2] += shift
        columns, rows = project_points(shifted_points, focal).T - 0.5
        height, width = details.shape
        inside = (columns >= 0) & (rows >= 0) & (columns <= width - 1) & (rows <= height - 1)
        values[entries[inside]] = map_coordinates(details, (rows[inside], columns[inside]), order=1, mode="nearest")
        numbers[entries] = pair
    first, second = values.reshape(2, -1)
    use = np.isfinite(first) & np.isfinite(second)
    first, second, number = first[use], second[use], numbers[: total // 2][use]
    count = np.bincount(number, minlength=pairs)

    def mean(products: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " p"]:
        return np.asarray(np.bincount(number, products, minlength=pairs) / np.maximum(count, 1))

    centered = first - mean(first)[number], second - mean(second)[number]
    variances = mean(np.square(centered[0])), mean(np.square(centered[1]))
    clear = (count >= MIN_SHARED // 2) & (np.minimum(*variances) > SMALLEST_DETAIL**2)
    if clear.sum() < max(1, pairs // 2):
        return float("nan")
    correlations = mean(centered[0] * centered[1])[clear] / np.sqrt(variances[0] * variances[1])[clear]
    return float(correlations.mean())
