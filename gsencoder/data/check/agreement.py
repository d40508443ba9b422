"""How well the depth images and photographs of posed views agree, under the poses and intrinsics given.

A view's depth pixels are points in the world. Where such a point projects into another view with depth z, and that
view's own depth image says d there, r = z / d − 1 is zero up to noise and the size of a pixel, unless something hides
the point there. Wrong axes, poses, scales and intrinsics spread r.

Pixels whose depth two views agree on are one place. A color camera next to the depth camera sees it at
f (X + t) / Z + c; with the right focal length f and shift t both photographs have the same details there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.data.readers.images import ray_lengths
from gsencoder.data.readers.posed import CameraModel, PosedImage, PosedImages, focal_count
from gsencoder.types import Cameras, Views
from gsencoder.types.scene import OPENCV_FROM_OPENGL, invert_rigid, pixel_centers, project_points, transform

MAX_SIDE = 320  # Longer side in pixels of the depth images that are compared; larger ones are sampled
SAMPLES = 400  # Pixels of each view that are carried into the others
TOLERANCE = 0.02  # Depths agree within this share
CLIP = 0.05  # Residuals beyond this share count as this much, since what is hidden there is further away by any amount
MIN_SAMPLES = 30  # Pairs of views that share fewer samples have no offset of their own
COMPARABLE = 0.02  # Samples that land in another view, as a share of all pairs, below which depth says nothing
EDGE = 0.05
"""Pixels next to a step of the depth by more than this share are not carried over: a pixel's size decides there."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthViews:
    """Depth images of posed views, small, and what their numbers are taken to mean."""

    depths: Float32[np.ndarray, "V h w"]  # as the files say, 0 = none
    pixels: Float64[np.ndarray, "V n 2"]  # samples of each view at pixel centers, (u, v) in its small image
    values: Float64[np.ndarray, "V n"]  # the depth there; 0 where a view has fewer samples
    cam_from_world: Float64[np.ndarray, "V 4 4"]  # poses of the depth cameras
    Ks: Float64[np.ndarray, "V 3 3"]  # intrinsics of the small images
    scale: float = 1.0  # world units for each unit of `depths`

    def __len__(self) -> int:
        return len(self.depths)

    @property
    def min_compared(self) -> float:
        """The number of samples that must land in other views before their depth says anything."""
        return COMPARABLE * len(self) * (len(self) - 1) * self.values.shape[1]

    def select(self, rows: Sequence[int]) -> "DepthViews":
        """Some of the views."""
        arrays = ("depths", "pixels", "values", "cam_from_world", "Ks")
        return replace(self, **{name: getattr(self, name)[list(rows)] for name in arrays})

    def with_focal_times(self, factor: float) -> "DepthViews":
        """The same images by a sensor of another focal length."""
        Ks = self.Ks.copy()
        Ks[:, :2, :2] *= factor
        return replace(self, Ks=Ks)

    def of_rays(self) -> "DepthViews":
        """The same images if their numbers are lengths of rays: the coordinates z of these."""
        lengths = np.stack([ray_lengths(K, *self.depths.shape[:0:-1]) for K in self.Ks])
        columns, rows = np.floor(self.pixels).astype(np.int64).transpose(2, 0, 1)
        at_samples = lengths[np.arange(len(self))[:, None], rows, columns]
        return replace(self, depths=(self.depths / lengths).astype(np.float32), values=self.values / at_samples)


def depth_views(views: Views, numbers: Int64[np.ndarray, " V"]) -> DepthViews:
    """Small depth images of some views and samples on their surfaces."""
    assert views.depths is not None
    rng = np.random.default_rng(0)
    cameras = views.cameras.select(numbers)
    shrink = min(1.0, MAX_SIDE / int(max(cameras.widths[0], cameras.heights[0])))
    width, height = (max(3, round(shrink * int(size[0]))) for size in (cameras.widths, cameras.heights))
    small = cameras.resized_to(np.full(len(numbers), width, np.int32), np.full(len(numbers), height, np.int32))
    maps, pixels, values = [], [], []
    for view in numbers:
        full = views.depths[int(view)]
        rows, columns = (
            ((np.arange(n) + 0.5) * size / n).astype(np.int64)
            for n, size in zip((height, width), full.shape, strict=True)
        )
        depth = full[rows][:, columns]
        maps.append(depth)
        rows, columns = np.nonzero(on_surface(depth))
        sample = rng.permutation(len(rows))[:SAMPLES]
        at, value = np.zeros((SAMPLES, 2)), np.zeros(SAMPLES)
        at[: len(sample)] = np.stack((columns[sample], rows[sample]), axis=1) + 0.5
        value[: len(sample)] = depth[rows[sample], columns[sample]]
        pixels.append(at)
        values.append(value)
    return DepthViews(
        depths=np.stack(maps),
        pixels=np.stack(pixels),
        values=np.stack(values),
        cam_from_world=cameras.cam_from_world.astype(np.float64),
        Ks=small.Ks.astype(np.float64),
    )


def on_surface(depth: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels with depth whose eight neighbors have nearly the same; none at the border."""
    use = np.zeros(depth.shape, bool)
    middle = depth[1:-1, 1:-1]
    height, width = middle.shape
    close = middle > 0
    for down in range(3):
        for right in range(3):
            other = depth[down : down + height, right : right + width]
            close &= (other > 0) & (np.abs(other - middle) <= EDGE * middle)
    use[1:-1, 1:-1] = close
    return use


def residuals(views: DepthViews) -> Float64[np.ndarray, "V V n"]:
    """r of the samples of view i (first axis) in view j (second axis); NaN where nothing can be compared, and on the
    diagonal."""
    points = world_samples(views)
    count = len(views)
    flat, measured = points.reshape(-1, 3), (views.values > 0).reshape(-1)
    result = np.stack(
        [_depth_ratio(views, other, flat, measured).reshape(count, -1) - 1 for other in range(count)], axis=1
    )
    result[np.arange(count), np.arange(count)] = np.nan
    return result


def agreement_map(views: DepthViews, view: int) -> Float32[np.ndarray, "h w"]:
    """For each pixel of a small depth image, the share of the views that see its place whose depth agrees within
    `TOLERANCE`; NaN where it has no depth, or no other view sees the place.

    A view in which something nearer hides the place is not counted.
    """
    count, height, width = views.depths.shape
    here = slice(view, view + 1)
    pixels = pixel_centers(width, height).reshape(1, -1, 2)
    points = world_samples(
        replace(
            views,
            depths=views.depths[here],
            pixels=pixels,
            values=views.depths[here].reshape(1, -1).astype(np.float64),
            cam_from_world=views.cam_from_world[here],
            Ks=views.Ks[here],
        )
    )[0]
    agree, comparisons = np.zeros(len(points)), np.zeros(len(points))
    measured = views.depths[view].reshape(-1) > 0
    for other in range(count):
        if other == view:
            continue
        ratio = _depth_ratio(views, other, points, measured)
        compared = np.isfinite(ratio) & (ratio < 1 + CLIP)
        comparisons += compared
        agree += compared & (np.abs(ratio - 1) <= TOLERANCE)
    share = np.divide(agree, comparisons, out=np.full(len(points), np.nan), where=comparisons > 0)
    return share.reshape(height, width).astype(np.float32)


def depth_at(
    views: DepthViews, other: int, points: Float64[np.ndarray, "n 3"], valid: Bool[np.ndarray, " n"]
) -> tuple[Bool[np.ndarray, " n"], Int64[np.ndarray, "m 2"], Float64[np.ndarray, " m"], Float64[np.ndarray, " m"]]:
    """Which valid world points project into a view, and of these row and column, their depth, and the view's own."""
    height, width = views.depths.shape[1:]
    local = transform(views.cam_from_world[other], points)
    pixels = project_points(local, views.Ks[other])
    with np.errstate(invalid="ignore"):
        inside = valid & (local[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    at = np.floor(pixels[inside]).astype(np.int64)[:, ::-1]
    measured = views.depths[other][at[:, 0], at[:, 1]].astype(np.float64) * views.scale
    return inside, at, local[inside, 2], measured


def _depth_ratio(
    views: DepthViews, other: int, points: Float64[np.ndarray, "n 3"], valid: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """The depth of world points in a view, divided by the view's own depth there; NaN where there is none."""
    inside, _, z, measured = depth_at(views, other, points, valid)
    ratio = np.full(len(points), np.nan)
    ratio[inside] = np.divide(z, measured, out=np.full(len(measured), np.nan), where=measured > 0)
    return ratio


def shared_samples(
    views: DepthViews, least: int
) -> Iterator[tuple[int, int, Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]]:
    """The samples of one view on which the depth of another agrees within `TOLERANCE`, for each ordered pair of views
    that shares at least `least`: both rows, and the points in the axes of both cameras."""
    points = world_samples(views)
    for view, other in np.ndindex(len(views), len(views)):
        if view == other:
            continue
        ratio = _depth_ratio(views, other, points[view], views.values[view] > 0)
        same = points[view][np.abs(ratio - 1) <= TOLERANCE]
        if len(same) >= least:
            yield view, other, transform(views.cam_from_world[view], same), transform(views.cam_from_world[other], same)


def world_samples(views: DepthViews) -> Float64[np.ndarray, "V n 3"]:
    """Where the samples lie in the world, under what their numbers are taken to mean."""
    K = views.Ks
    rays = np.ones((*views.pixels.shape[:2], 3))
    for axis in range(2):
        rays[..., axis] = (views.pixels[..., axis] - K[:, axis, 2, None]) / K[:, axis, axis, None]
    local = rays * (views.scale * views.values)[..., None]
    world_from_cam = invert_rigid(views.cam_from_world)
    return np.einsum("vij,vnj->vni", world_from_cam[:, :3, :3], local) + world_from_cam[:, None, :3, 3]


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """What residuals say."""

    # Of the samples that another view sees, those whose depth agrees with it within `TOLERANCE`. Samples that lie
    # further away than the other view's surface by more than `CLIP` are hidden there, and do not count.
    share: float
    spread: float  # mean of |r|, clipped at `CLIP`
    offset: float  # median of r among those within `CLIP`
    compared: int  # number of comparisons


def agreement(residual: Float64[np.ndarray, "*n"]) -> Agreement:
    """Summary of residuals; NaN where nothing was compared."""
    finite = residual[np.isfinite(residual)]
    if not len(finite):
        return Agreement(share=float("nan"), spread=float("nan"), offset=float("nan"), compared=0)
    size = np.abs(finite)
    near = finite[size <= CLIP]
    return Agreement(
        share=float((size <= TOLERANCE).sum() / max(1, (finite <= CLIP).sum())),
        spread=float(np.minimum(size, CLIP).mean()),
        offset=float(np.median(near)) if len(near) else float("nan"),
        compared=len(finite),
    )


def grey_picture(views: Views, row: int, width: int, height: int) -> Float64[np.ndarray, "h w"]:
    """A photograph in grey, 0 to 1."""
    from PIL import Image

    assert views.images is not None
    grey = Image.fromarray(views.images[row]).convert("L").resize((width, height), Image.Resampling.BOX)
    return np.asarray(grey, np.float64) / 255


def color_correlations(
    views: DepthViews, grey: Float[np.ndarray, "V h w"], Ks: Float64[np.ndarray, "V 3 3"]
) -> Float64[np.ndarray, "V V"]:
    """Correlation of the intensities of one place in view i and view j; NaN where they share too few places.

    A place is shared where the depth of both agrees within `TOLERANCE`. `grey` has the size of the depth images.
    """
    result = np.full((len(views), len(views)), np.nan)
    height, width = grey.shape[1:]
    for view, other, here, there in shared_samples(views, MIN_SAMPLES):
        pixels = np.stack((project_points(here, Ks[view]), project_points(there, Ks[other])))
        in_both = ((pixels >= 0) & (pixels < (width, height))).all(axis=(0, 2))
        columns, rows = np.floor(pixels[:, in_both]).astype(np.int64).transpose(2, 0, 1)
        pair = grey[[[view], [other]], rows, columns]
        if len(pair[0]) >= MIN_SAMPLES and pair.std(axis=1).min() > 1e-3:
            result[view, other] = np.corrcoef(pair)[0, 1]
    return result


def view_correlations(correlations: Float64[np.ndarray, "V V"]) -> Float64[np.ndarray, " V"]:
    """The median correlation of each view with the others, in both directions; NaN for a view that shares nothing."""
    both = np.ma.masked_invalid(np.concatenate((correlations, correlations.T), axis=1))
    return np.asarray(np.ma.median(both, axis=1).filled(np.nan))


PICTURE_SIZE = 640  # Longer side in pixels of the photographs that are compared; smaller ones keep theirs
FINE, COARSE = 1.0, 12.0  # Details are the difference of two Gaussian blurs of these widths in pixels
MIN_SHARED = 60  # Pairs of views that share fewer samples say nothing
MAX_PAIRS = 160
SMALLEST_DETAIL = 1e-4
"""Standard deviation of details, of an intensity from 0 to 1, below which a pair of views shows none."""
FOCAL_FACTORS: tuple[float, ...] = tuple(np.round(np.geomspace(0.8, 1.25, 13), 4).tolist())
SHIFTS = (-0.02, -0.01, 0.0, 0.01, 0.02)  # Shifts that are tried first, as shares of the median depth
REFINEMENTS = 5
BETTER = 0.1  # A registration is named if it raises the correlation of details by this much, and to `LEAST` or more
LEAST = 0.2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RegistrationFit:
    """The color camera that fits best."""

    focal_factor: float  # its focal length, as a multiple of the given one
    # What is added to x and y in the depth camera's axes to have them in its own, world units.
    shift: Float64[np.ndarray, "2"]
    given: float  # mean correlation of details of pairs of views with the given camera
    best: float  # the same with the best one
    pairs: int  # pairs of views that were compared

    @property
    def differs(self) -> bool:
        """Whether the given camera is wrong."""
        return self.pairs > 0 and self.best >= LEAST and self.best >= self.given + BETTER


def fit_registration(views: Views, rows: Int64[np.ndarray, " V"], depth: DepthViews) -> RegistrationFit:
    """The color camera under which photographs show the same details where their depth agrees.

    Args:
        rows: of the views whose depth images are given, under the reading that fits best.
    """
    pairs = sorted(shared_samples(depth, MIN_SHARED), key=lambda pair: -len(pair[2]))[:MAX_PAIRS]
    nothing = RegistrationFit(focal_factor=1.0, shift=np.zeros(2), given=np.nan, best=np.nan, pairs=len(pairs))
    if not pairs:
        return nothing
    sizes = [len(pair[2]) for pair in pairs]
    # Of both views of each pair the row and the places in its axes, side by side, and the number of the pair.
    ends = np.stack([np.repeat([pair[side] for pair in pairs], sizes) for side in (0, 1)])
    places = np.stack([np.concatenate([pair[side] for pair in pairs]) for side in (2, 3)])
    numbers = np.repeat(np.arange(len(pairs)), sizes)
    cameras = views.cameras.select(rows).resized(PICTURE_SIZE, enlarge=False)
    details = np.zeros((len(rows), int(cameras.heights.max()), int(cameras.widths.max())))
    for index in np.unique(ends):
        width, height = int(cameras.widths[index]), int(cameras.heights[index])
        details[index, :height, :width] = _details(views, int(rows[index]), width, height)
    typical = float(np.median(places[0, :, 2]))
    scores: dict[tuple[float, ...], float] = {}

    def score(factor: float, shift: Float64[np.ndarray, "2"]) -> float:
        key = (round(factor, 6), *np.round(shift / typical, 6))
        if key not in scores:
            Ks = cameras.Ks.astype(np.float64)
            Ks[:, :2, :2] *= factor
            scores[key] = _correlation(details, Ks, cameras, ends, places + np.append(shift, 0.0), numbers)
        return scores[key]

    score_as_given = score(1.0, np.zeros(2))
    if not np.isfinite(score_as_given):
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
        focal_factor=best[0], shift=best[1], given=score_as_given, best=score(*best), pairs=len(pairs)
    )


def _details(views: Views, row: int, width: int, height: int) -> Float64[np.ndarray, "h w"]:
    from scipy.ndimage import gaussian_filter

    grey = grey_picture(views, row, width, height)
    return np.asarray(gaussian_filter(grey, FINE) - gaussian_filter(grey, COARSE))


def _correlation(
    details: Float64[np.ndarray, "V h w"],
    Ks: Float64[np.ndarray, "V 3 3"],
    cameras: Cameras,
    ends: Int64[np.ndarray, "2 n"],
    places: Float64[np.ndarray, "2 n 3"],
    numbers: Int64[np.ndarray, " n"],
) -> float:
    """Mean correlation of the details of pairs of views at places that they share."""
    from scipy.ndimage import map_coordinates

    pairs = int(numbers[-1]) + 1
    u, v = (places[..., axis] / places[..., 2] * Ks[ends, axis, axis] + Ks[ends, axis, 2] - 0.5 for axis in (0, 1))
    use = ((u >= 0) & (v >= 0) & (u <= cameras.widths[ends] - 1) & (v <= cameras.heights[ends] - 1)).all(axis=0)
    number = numbers[use]
    values = map_coordinates(details, (ends[:, use], v[:, use], u[:, use]), order=1, mode="nearest")
    count = np.bincount(number, minlength=pairs)

    def mean(products: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " p"]:
        return np.asarray(np.bincount(number, products, minlength=pairs) / np.maximum(count, 1))

    first, second = (each - mean(each)[number] for each in values)
    variances = mean(np.square(first)), mean(np.square(second))
    clear = (count >= MIN_SHARED // 2) & (np.minimum(*variances) > SMALLEST_DETAIL**2)
    if clear.sum() < max(1, pairs // 2):
        return float("nan")
    correlations = mean(first * second)[clear] / np.sqrt(variances[0] * variances[1])[clear]
    return float(correlations.mean())


ADVICE = {
    "axes": "the poses are in OpenGL's camera axes where OpenCV's are expected, or the reverse",
    "inverse": "the matrices are cam_from_world where world_from_cam is expected, or the reverse",
    "inverse and axes": "the matrices are the inverse of what is expected, in the other camera axes",
    "order": "the poses belong to other photographs: each is that of the photograph {factor:+.0f} places away",
    "ray length": "depth is the length of the ray where the coordinate z is expected",
    "depth scale": "the depth scale is wrong: depths should be {factor:.4g} times as large",
    "depth focal length": "depth has the focal length of another sensor: {factor:.4g} times the given one",
    "focal length": "the focal length of the photographs is {factor:.4g} times the given one",
    "picture size": "the intrinsics are those of pictures of another size: times {factor:.4g} they would fit these",
}
"""Causes that concern all views."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that is wrong."""

    cause: str  # a key of `ADVICE`, "color registration", "stray view", "other picture", "photographs" or "unknown"
    message: str  # for people
    view: str | None = None  # name of the view, if it is one alone
    # Of the depth scale or a focal length, or how many places the poses are moved by, where the cause has one.
    factor: float | None = None


PLACES = (-2, -1, 1, 2)  # Places in the order of the views by which poses may be moved


def other_poses(cam_from_world: Float64[np.ndarray, "V 4 4"]) -> dict[str, Float64[np.ndarray, "V 4 4"]]:
    """cam_from_world if the files' matrices mean something else, by the cause in `ADVICE`."""
    inverse = invert_rigid(cam_from_world)
    return {
        "axes": OPENCV_FROM_OPENGL @ cam_from_world,
        "inverse": inverse,
        "inverse and axes": OPENCV_FROM_OPENGL @ inverse,
    }


def other_orders(poses: Float[np.ndarray, "V 4 4"]) -> Iterator[tuple[int, Float[np.ndarray, "V 4 4"]]]:
    """The poses if each belongs to the photograph some places further on, and by how many places; ends are wrapped."""
    if len(poses) > 2:
        for shift in PLACES:
            yield shift, np.roll(poses, shift, axis=0)


SCALES = (1e-3, 1e-2, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 1e2, 1e3)
"""Depth scales that files are mistaken by: other units, and steps of other sensors."""
NEAR_FACTORS: tuple[float, ...] = tuple(np.round(np.geomspace(0.8, 1.25, 25), 4).tolist())
"""Factors of the depth scale and of the focal length that are tried first; the best is refined."""
FACTOR_REFINEMENTS = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reading:
    """One way to take the numbers of a scene."""

    cause: str  # what would be wrong with the files if this reading is right; empty for the files' own
    views: DepthViews  # the depth images under this reading
    agreement: Agreement  # of them
    # Of the depth scale or of the focal length, or the places that poses are moved by, where the cause has one.
    factor: float | None = None


def reading_of_files(views: DepthViews) -> Reading:
    """The files' own reading."""
    return Reading(cause="", views=views, agreement=agreement(residuals(views)))


def other_readings(
    views: DepthViews, rows: Int64[np.ndarray, " V"], all_poses: Float[np.ndarray, "n 4 4"]
) -> list[Reading]:
    """Every other reading, those with a factor at the factor where depths agree best."""
    fixed: list[tuple[str, float | None, DepthViews]] = [
        (cause, None, replace(views, cam_from_world=poses))
        for cause, poses in other_poses(views.cam_from_world).items()
    ]
    fixed += [
        ("order", float(shift), replace(views, cam_from_world=poses[rows].astype(np.float64)))
        for shift, poses in other_orders(all_poses)
    ]
    fixed.append(("ray length", None, views.of_rays()))
    readings = [
        Reading(cause=cause, views=other, agreement=agreement(residuals(other)), factor=factor)
        for cause, factor, other in fixed
    ]
    readings.append(_best_factor("depth scale", lambda factor: replace(views, scale=factor), (*SCALES, *NEAR_FACTORS)))
    readings.append(_best_factor("depth focal length", views.with_focal_times, NEAR_FACTORS))
    return readings


def _best_factor(cause: str, apply: Callable[[float], DepthViews], factors: Sequence[float]) -> Reading:
    """The reading of the factor with the smallest spread, refined by golden sections between its neighbors."""

    def spread(factor: float) -> float:
        measured = agreement(residuals(apply(factor)))
        return measured.spread if measured.compared >= apply(factor).min_compared else np.inf

    spreads = {factor: spread(factor) for factor in sorted(factors)}
    best = min(spreads, key=lambda factor: spreads[factor])
    step = 1.02
    for _ in range(FACTOR_REFINEMENTS):
        for factor in (best / step, best * step):
            spreads.setdefault(factor, spread(factor))
        best = min(spreads, key=lambda factor: spreads[factor])
        step = step**0.5
    corrected = apply(best)
    return Reading(cause=cause, views=corrected, agreement=agreement(residuals(corrected)), factor=best)


LEFT_OUT = ("stray view", "other picture")
CHANGES = {
    "axes": "poses: axes exchanged",
    "inverse": "poses: inverse exchanged",
    "inverse and axes": "poses: inverse and axes exchanged",
    "order": "poses moved by {0:+.0f} places",
    "ray length": 'depth_measure is "ray"',
    "depth scale": "depth_unit_scale_factor times {0:.4g}",
    "depth focal length": "focal length of the depth times {0:.4g}",
    "focal length": "focal length times {0:.4g}",
    "picture size": "intrinsics times {0:.4g}",
    "color registration": "focal length of photographs times {0:.4g}, depth_from_color with a shift of {1:.3g} units",
}


def repair_posed(
    posed: PosedImages, findings: Sequence[Finding], registration: RegistrationFit | None = None
) -> tuple[PosedImages, list[str]]:
    """Posed images read as the findings say they should be, without the views that do not fit, and what was changed.

    Args:
        registration: of the same check, for the finding "color registration".
    """
    if not findings:
        raise InputError(f"{posed.source}: nothing wrong was seen, so there is nothing to repair")
    images, changes = list(posed.images), []
    for finding in findings:
        cause, factor = finding.cause, finding.factor or 1.0
        if cause in LEFT_OUT:
            continue
        if cause not in CHANGES or (cause == "color registration" and registration is None):
            raise InputError(f"{posed.source}: {finding.message}; this cannot be repaired here")
        if cause == "color registration" and any(image.depth_from_color is not None for image in images):
            raise InputError(
                f"{posed.source}: depth is carried over by a depth_from_color of the files that does not fit; "
                "calibrate the cameras again, or give data.depth_from_color="
            )
        poses = np.stack([image.cam_from_world for image in images])
        poses = other_poses(poses).get(cause, poses)
        if cause == "order":
            poses = np.roll(poses, round(factor), axis=0)
        images = [
            _mended(replace(image, cam_from_world=pose), cause, factor, registration)
            for image, pose in zip(images, poses, strict=True)
        ]
        changes.append(CHANGES[cause].format(factor, 0.0 if registration is None else np.hypot(*registration.shift)))
    astray = {str(finding.view) for finding in findings if finding.cause in LEFT_OUT}
    if astray:
        changes.append(f"left out, since they do not fit: {', '.join(sorted(astray))}")
    return replace(posed, images=tuple(image for image in images if image.name not in astray)), changes


def _mended(image: PosedImage, cause: str, factor: float, fit: RegistrationFit | None) -> PosedImage:
    depth_camera = image.depth_camera or image.camera
    if cause == "ray length":
        return replace(image, depth_measure="ray")
    if cause == "depth scale":
        return replace(image, depth_scale=image.depth_scale * factor)
    if cause == "depth focal length":
        return replace(image, depth_camera=focal_times(depth_camera, factor))
    if cause == "picture size":
        return replace(image, camera=focal_times(image.camera, factor, principal_point=True))
    if cause == "focal length":
        depth = None if image.depth_camera is None else focal_times(depth_camera, factor)
        return replace(image, camera=focal_times(image.camera, factor), depth_camera=depth)
    if cause == "color registration" and fit is not None:
        # The poses were the depth camera's; the photograph's stands next to it.
        color_from_depth, depth_from_color = np.eye(4), np.eye(4)
        color_from_depth[:2, 3], depth_from_color[:2, 3] = fit.shift, -fit.shift
        return replace(
            image,
            depth_camera=depth_camera,
            depth_from_color=depth_from_color,
            camera=focal_times(image.camera, fit.focal_factor),
            cam_from_world=color_from_depth @ image.cam_from_world,
        )
    return image


def focal_times(camera: CameraModel, factor: float, *, principal_point: bool = False) -> CameraModel:
    """A camera with its focal lengths multiplied; its distortion is that of directions, and stays."""
    count = focal_count(camera) + 2 * principal_point
    params = tuple(value * factor if index < count else value for index, value in enumerate(camera.params))
    return replace(camera, params=params)
