"""Depth of textured pixels by plane sweeps between neighboring photographs (Collins 1996).

For every pixel of a reference view, planes z = d of many depths carry it into a few other views; the depth at which
small windows look most alike there is kept, if they look alike enough.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64, UInt8
from torch import Tensor

from gsencoder.data.photographs import ScaledPhotograph
from gsencoder.geometry import invert_rigid, project_points, transform, unproject_points
from gsencoder.types import Cameras
from gsencoder.types.scene import pixel_centers

WINDOW = 5  # Side of the windows that are compared, in pixels of the small pictures
PLANE_STEP = 0.7  # Neighboring planes move a pixel by this many pixels in the view where it moves most
MAX_PLANES = 128
SMALLEST_DEPTH = 1e-6  # Points nearer to a camera, or behind it, are in no picture, world units
MIN_CONTRAST = 0.01  # Windows whose colors deviate less (of 1) say nothing
DEPTH_TOLERANCE = 0.02  # Largest relative difference of two depths of one surface
BEST_ANGLE = np.deg2rad(8.0)
"""Views whose rays meet at about this angle are compared: further ones look different, nearer ones measure little."""


class DepthMap(NamedTuple):
    """Depths of one view at the size of its small picture."""

    depth: Float[Tensor, "h w"]  # z in world units; 0 = not found
    score: Float[Tensor, "h w"]  # mean zero-mean normalized cross-correlation with the two most alike views, −1 to 1
    step: Float[Tensor, "h w"]  # relative distance of neighboring planes at each pixel's depth


def source_views(
    cameras: Cameras, points: Float32[np.ndarray, "P 3"], rows: Sequence[int], count: int
) -> dict[int, list[int]]:
    """For each of the chosen views the others to compare it with: views that share many points at a good angle.

    A shared point counts exp(−(ln(angle / BEST_ANGLE))²), so that both half and twice the best angle count a little
    over a half.
    """
    exact = points.astype(np.float64)
    inside = {view: cameras.in_image(*cameras.project(exact, view), view) for view in rows}
    centers = cameras.centers
    sources: dict[int, list[int]] = {}
    for view in rows:
        ranked = []
        for other in rows:
            both = np.flatnonzero(inside[view] & inside[other])
            if other == view or not both.size:
                continue
            rays = [centers[camera] - points[both] for camera in (view, other)]
            norms = np.prod([np.linalg.norm(ray, axis=1) for ray in rays], axis=0)
            cosine = np.einsum("ij,ij->i", *rays) / np.maximum(norms, 1e-12)
            angle = np.arccos(np.clip(cosine, -1, 1))
            ranked.append((float(np.exp(-np.square(np.log(np.maximum(angle, 1e-6) / BEST_ANGLE))).sum()), other))
        sources[view] = [other for value, other in sorted(ranked, reverse=True)[:count] if value > 0]
    return sources


def depth_range(cameras: Cameras, view: int, points: Float32[np.ndarray, "P 3"]) -> tuple[float, float] | None:
    """Range of depths to sweep: those of the points in the picture, without 2 % of outliers at each end, with a
    margin."""
    pixels, depths = cameras.project(points.astype(np.float64), view)
    depths = depths[cameras.in_image(pixels, depths, view)]
    if len(depths) < 10:
        return None
    near, far = np.quantile(depths, (0.02, 0.98))
    return 0.85 * float(near), 1.3 * float(far)


def _planes(
    rays: Tensor,
    relative: Sequence[Tensor],
    sources: Sequence[ScaledPhotograph],
    near: float,
    far: float,
    max_planes: int,
) -> Float[Tensor, " D"]:
    """Depths from near to far, evenly spaced in 1/depth, as close as pixels ask."""
    corners = rays[:: max(1, rays.shape[0] - 1), :: max(1, rays.shape[1] - 1)].reshape(-1, 3)
    longest = 0.0
    for source_from_reference, source in zip(relative, sources, strict=True):
        ends = [
            project_points(transform(source_from_reference, depth * corners), source.K, min_depth=1e-3 * near)
            for depth in (near, far)
        ]
        distances = (ends[0] - ends[1]).norm(dim=-1)
        longest = max(longest, float(distances.median()))
    count = int(np.clip(np.ceil(longest / PLANE_STEP), 16, max_planes))
    return 1 / torch.linspace(1 / near, 1 / far, count)


def sweep(
    reference: ScaledPhotograph,
    pose: Float[Tensor, "4 4"],
    sources: Sequence[ScaledPhotograph],
    source_poses: Sequence[Float[Tensor, "4 4"]],
    near: float,
    far: float,
    *,
    max_planes: int = MAX_PLANES,
) -> DepthMap:
    """Depths of a view by comparing it with others, at least two, so that occluded pixels are recognized."""
    height, width = reference.image.shape[:2]
    pixels = torch.from_numpy(pixel_centers(width, height)).float()
    rays = unproject_points(pixels, torch.ones(height, width), reference.K)
    relative = [other @ invert_rigid(pose) for other in source_poses]
    depths = _planes(rays, relative, sources, near, far, max_planes)
    windows = _Windows(reference.image.mean(dim=-1)[None, None])
    scores = torch.stack(
        [
            _correlations(windows, rays, source_from_reference, source, depths)
            for source_from_reference, source in zip(relative, sources, strict=True)
        ]
    )
    best = scores.topk(min(2, len(sources)), dim=0).values.mean(dim=0)
    score, plane = best.max(dim=0)
    # A parabola through the best plane and its neighbors, in 1/depth, where planes are evenly spaced.
    inner = plane.clamp(1, len(depths) - 2)
    left, middle, right = (best.gather(0, (inner + shift)[None])[0] for shift in (-1, 0, 1))
    bend = left - 2 * middle + right
    shift = torch.where(bend < -1e-6, 0.5 * (left - right) / bend.clamp(max=-1e-6), 0).clamp(-0.5, 0.5)
    inverse = 1 / depths
    spacing = inverse[1] - inverse[0]
    at = torch.where(inner == plane, inverse[plane] + shift * spacing, inverse[plane])
    textured = windows.deviation[0, 0] >= MIN_CONTRAST
    ends = (plane == 0) | (plane == len(depths) - 1)
    good = textured & ~ends
    if reference.mask is not None:
        good &= reference.mask
    return DepthMap(torch.where(good, 1 / at, 0), torch.where(good, score, -1), spacing.abs() / at)


class _Windows:
    """Means and standard deviations of the windows of pictures [n, 1, h, w]."""

    def __init__(self, pictures: Tensor) -> None:
        self.pictures = pictures
        self.mean = window_mean(pictures)
        self.deviation = (window_mean(pictures * pictures) - self.mean.square()).clamp(min=0).sqrt()


def window_mean(maps: Float[Tensor, "n c h w"], side: int = WINDOW) -> Float[Tensor, "n c h w"]:
    """Means over windows, of what lies in the picture. Pooling takes two to five times as long as shifted sums."""
    height, width = maps.shape[2:]
    sums = _window_sums(_window_sums(maps, side // 2, 2), side // 2, 3)
    rows = _window_sums(maps.new_ones(1, 1, height, 1), side // 2, 2)
    return sums / (rows * _window_sums(maps.new_ones(1, 1, 1, width), side // 2, 3))


def _window_sums(maps: Tensor, reach: int, axis: int) -> Tensor:
    """Sums over what lies at most `reach` pixels away along an axis."""
    size, sums = maps.shape[axis], maps.clone()
    for shift in range(1, min(reach, size - 1) + 1):
        rest = size - shift
        sums.narrow(axis, shift, rest).add_(maps.narrow(axis, 0, rest))
        sums.narrow(axis, 0, rest).add_(maps.narrow(axis, shift, rest))
    return sums


def _correlations(
    reference: _Windows, rays: Tensor, source_from_reference: Tensor, source: ScaledPhotograph, depths: Tensor
) -> Float[Tensor, "D h w"]:
    """Zero-mean normalized cross-correlation of each pixel's window with where each plane carries it."""
    # Turned once, and not once for each plane.
    turned = rays @ source_from_reference[:3, :3].T
    points = depths[:, None, None, None] * turned + source_from_reference[:3, 3]
    grid, inside = to_grid(points, source)
    picture = source.image.mean(dim=-1)[None, None]
    warped = torch.nn.functional.grid_sample(
        picture.expand(len(depths), -1, -1, -1), grid, align_corners=False, padding_mode="border"
    )
    other = _Windows(warped)
    covariance = window_mean(warped * reference.pictures) - other.mean * reference.mean
    correlation = covariance / (other.deviation * reference.deviation + 1e-4)
    return torch.where(inside, correlation[:, 0], -1)


def to_grid(points: Float[Tensor, "*n 3"], photo: ScaledPhotograph) -> tuple[Float[Tensor, "*n 2"], Bool[Tensor, "*n"]]:
    """Where points in a camera lie in its picture, as grid_sample counts (−1 to 1), and whether they are in it."""
    # The intrinsics of an image whose pixels run from −1 to 1.
    height, width = photo.image.shape[:2]
    scale = photo.K.new_tensor([2 / width, 2 / height, 1.0])
    K = scale[:, None] * photo.K
    K[:2, 2] -= 1
    grid = project_points(points, K, min_depth=SMALLEST_DEPTH)
    u, v = grid.unbind(-1)
    return grid, (points[..., 2] > SMALLEST_DEPTH) & (u.abs() < 1) & (v.abs() < 1)


def sample_depth(
    points: Float[Tensor, "n 3"], depth: Float[Tensor, "h w"], photo: ScaledPhotograph, pose: Float[Tensor, "4 4"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
    """Depths of world points in a view, and the depths that were found where they project: 0 = none, or outside."""
    camera = transform(pose, points)
    grid, inside = to_grid(camera, photo)
    nearest = torch.nn.functional.grid_sample(
        depth[None, None], grid[None, None], mode="nearest", align_corners=False, padding_mode="zeros"
    )[0, 0, 0]
    return camera[:, 2], torch.where(inside, nearest, 0)


def confirms(z: Float[Tensor, " n"], measured: Float[Tensor, " n"], tolerance: float) -> Bool[Tensor, " n"]:
    """Whether a depth map confirms points: its depth, by `sample_depth`, equals theirs within a share of it."""
    return (measured > 0) & ((z - measured).abs() <= tolerance * measured)


def sees_through(z: Float[Tensor, " n"], measured: Float[Tensor, " n"], tolerance: float) -> Bool[Tensor, " n"]:
    """Whether a depth map sees through points: its surface is behind them by more than twice the tolerance."""
    return (measured > 0) & (z < (1 - 2 * tolerance) * measured)


def count_agreeing(
    depth: Float[Tensor, "h w"],
    photo: ScaledPhotograph,
    pose: Float[Tensor, "4 4"],
    others: Sequence[tuple[DepthMap, ScaledPhotograph, Float[Tensor, "4 4"]]],
    tolerance: float,
) -> Int64[Tensor, "h w"]:
    """Number of other depth maps that have a surface at each pixel's point; 0 where its depth is 0, unknown."""
    points = world_points(depth, photo, pose).reshape(-1, 3)
    votes = torch.zeros(len(points), dtype=torch.int64)
    for depth_map, other, other_pose in others:
        z, measured = sample_depth(points, depth_map.depth, other, other_pose)
        votes += confirms(z, measured, tolerance)
    return torch.where(depth.reshape(-1) > 0, votes, 0).reshape(depth.shape)


def world_points(
    depth: Float[Tensor, "h w"], photo: ScaledPhotograph, pose: Float[Tensor, "4 4"]
) -> Float[Tensor, "h w 3"]:
    """The world points that the pixels of a view show."""
    pixels = torch.from_numpy(pixel_centers(*reversed(depth.shape))).float()
    return transform(invert_rigid(pose), unproject_points(pixels, depth, photo.K))


def back_project(
    depths: Mapping[int, Float[Tensor, "h w"]], photos: Mapping[int, ScaledPhotograph], poses: Mapping[int, Tensor]
) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """The points and colors (RGB) of the pixels of all views whose depth is known (above 0)."""
    points, colors = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.uint8)]
    for view, depth in depths.items():
        has_depth = depth > 0
        points.append(world_points(depth, photos[view], poses[view])[has_depth].numpy())
        colors.append((photos[view].image[has_depth] * 255 + 0.5).to(torch.uint8).numpy())
    return np.concatenate(points), np.concatenate(colors)
