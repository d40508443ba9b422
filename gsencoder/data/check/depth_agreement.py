"""How well the depth images of posed views agree: each carried into the others, under the poses and intrinsics given.

A view's depth pixels are points in the world. Where such a point projects into another view with depth z, and that
view's own depth image says d there, r = z / d − 1 is zero up to noise and the size of a pixel, unless something hides
the point there. Wrong axes, poses, scales and intrinsics spread r.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from gsencoder.data.readers.depth_images import ray_lengths
from gsencoder.types import Views
from gsencoder.types.checks import invert_rigid, transform
from gsencoder.types.scene import pixel_centers, project_points

MAX_SIDE = 320
"""Longer side in pixels of the depth images that are compared; larger ones are sampled."""
SAMPLES = 400
"""Pixels of each view that are carried into the others."""
TOLERANCE = 0.02
"""Depths agree within this share."""
CLIP = 0.05
"""Residuals beyond this share count as this much, since what is hidden there is further away by any amount."""
MIN_SAMPLES = 30
"""Pairs of views that share fewer samples have no offset of their own."""
EDGE = 0.05
"""Pixels beside a step of the depth by more than this share are not carried over: a pixel's size decides there."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthViews:
    """Depth images of posed views, small, and what their numbers are taken to mean.

    Attributes:
        depths: as the files say, 0 = none.
        pixels: samples of each view at pixel centers, (u, v) in its small image.
        values: the depth there; 0 where a view has fewer samples.
        cam_from_world: poses of the depth cameras.
        Ks: intrinsics of the small images.
        scale: world units for each unit of `depths`.
    """

    depths: Float32[np.ndarray, "V h w"]
    pixels: Float64[np.ndarray, "V n 2"]
    values: Float64[np.ndarray, "V n"]
    cam_from_world: Float64[np.ndarray, "V 4 4"]
    Ks: Float64[np.ndarray, "V 3 3"]
    scale: float = 1.0

    def __len__(self) -> int:
        return len(self.depths)

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


def depth_views(views: Views, numbers: Int64[np.ndarray, " V"], *, seed: int = 0) -> DepthViews:
    """Small depth images of some views and samples on their surfaces.

    Args:
        views: with depth.
        numbers: their row numbers.
        seed: of the choice of samples.
    """
    assert views.depths is not None
    rng = np.random.default_rng(seed)
    cameras = views.cameras.select(numbers)
    shrink = min(1.0, MAX_SIDE / int(max(cameras.widths[0], cameras.heights[0])))
    width, height = (max(3, round(shrink * int(size[0]))) for size in (cameras.widths, cameras.heights))
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
    small = cameras.resized_to(np.full(len(numbers), width, np.int32), np.full(len(numbers), height, np.int32))
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


def _depth_ratio(
    views: DepthViews, other: int, points: Float64[np.ndarray, "n 3"], valid: Bool[np.ndarray, " n"]
) -> Float64[np.ndarray, " n"]:
    """The depth of world points in a view, divided by the view's own depth there; NaN where there is none."""
    height, width = views.depths.shape[1:]
    local = transform(views.cam_from_world[other], points)
    pixels = project_points(local, views.Ks[other])
    with np.errstate(invalid="ignore"):
        inside = valid & (local[:, 2] > 0) & (pixels >= 0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    columns, rows = np.floor(pixels[inside]).astype(np.int64).T
    measured = views.depths[other][rows, columns].astype(np.float64) * views.scale
    ratio = np.full(len(points), np.nan)
    ratio[inside] = np.divide(local[inside, 2], measured, out=np.full(len(measured), np.nan), where=measured > 0)
    return ratio


def shared_samples(
    views: DepthViews, least: int
) -> Iterator[tuple[int, int, Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]]:
    """The samples of one view on which the depth of another agrees within `TOLERANCE`, for each ordered pair of views
    that shares at least so many: both rows, and the points in the axes of both cameras."""
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
    """What residuals say.

    Attributes:
        share: of the samples that another view sees, those whose depth agrees with it within `TOLERANCE`. Samples that
            lie further away than the other view's surface by more than `CLIP` are hidden there, and do not count.
        spread: mean of |r|, clipped at `CLIP`.
        offset: median of r among those within `CLIP`.
        compared: number of comparisons.
    """

    share: float
    spread: float
    offset: float
    compared: int


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


def pair_offsets(residual: Float64[np.ndarray, "V V n"]) -> tuple[float, float]:
    """The median size of the offset (median r) of pairs of views: of those up to three places apart in the order of the
    files, and of those at least half the views apart; NaN where there are no such pairs. Poses that drift have a second
    number well above the first."""
    count = len(residual)
    near: list[float] = []
    far: list[float] = []
    for view, other in np.ndindex(count, count):
        distance = abs(view - other)
        inliers = residual[view, other][np.abs(residual[view, other]) <= CLIP]
        if len(inliers) >= MIN_SAMPLES and (distance <= 3 or distance >= count / 2):
            (near if distance <= 3 else far).append(abs(float(np.median(inliers))))
    return tuple(float(np.median(each)) if each else float("nan") for each in (near, far))  # type: ignore[return-value]
