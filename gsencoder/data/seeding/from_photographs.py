"""Seeds for posed photographs without depth and without points: triangulated matches, then plane sweeps.

Where few features match, as on smooth walls and in small pictures, a first sweep of small pictures over all depths that
the cameras allow finds rough points; they tell the second one at which depths to look.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.dense import (
    DenseConfig,
    DenseSeeds,
    consistent_depths,
    covered_share,
    densify,
    scaled_photographs,
    sweep_neighbors,
)
from gsencoder.data.seeding.points import seed_from_points
from gsencoder.data.seeding.stereo import back_project
from gsencoder.data.seeding.triangulate import Triangulation, triangulate
from gsencoder.data.seeding.view_pairs import depth_range_of_cameras, overlaps, typical_distance
from gsencoder.types import Cameras, Gaussians, Views

MAX_DENSE_SPACING = 4.0
"""Spacing of dense seeds is clipped to this many medians: outliers must not become large blobs."""
MIN_COVERAGE = 0.25
"""Where triangulated points reach a smaller share of the pictures' cells, a sweep over all depths finds rough points.
"""
ROUGH_SIZE = 80
"""Longer side in pixels of the pictures of that sweep."""
ROUGH_PLANES = 192
ROUGH_TOLERANCE = 0.06
"""Largest relative difference of two rough depths of one surface."""


SAME_PLACE = 1e-6
"""Cameras that are this near to each other, relative to their coordinates, differ by rounding."""
FLAT = 0.01
"""Standard deviation of colors (0 to 1) below which a photograph is of one color."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PhotographSeeds:
    """Seeds of posed photographs, and where they come from.

    Attributes:
        dense: all of them.
        triangulation: the points of matched features among them.
        rough: number of points of the sweep over all depths, which only guided the second one.
    """

    dense: DenseSeeds
    triangulation: Triangulation
    rough: int


def seeds_of_photographs(
    photographs: Photographs,
    views: Views,
    config: DenseConfig = DenseConfig(),
    *,
    training: Sequence[int] | None = None,
    track: Track = untracked,
) -> PhotographSeeds:
    """Points on the surfaces that posed photographs show.

    Args:
        photographs: of all views.
        views: that may be looked at.
        config: of the sweeps.
        training: their row numbers among the photographs; None = all.
        track: progress.

    Raises:
        InputError: fewer than two photographs, or no two that show the same surface from different places.
    """
    rows = list(range(len(photographs))) if training is None else list(training)
    if len(rows) < 2:
        raise InputError(
            f"seeds: {len(rows)} photograph without depth and points says nothing about where surfaces are; give two "
            "or more, a splat (splat=PATH), or a mesh (seeds.source=mesh seeds.mesh=PATH)"
        )
    triangulation = triangulate(views, track=track)
    points = triangulation.points
    cameras = views.cameras
    rough = np.empty((0, 3), np.float32)
    if covered_share(photographs, rows, points) < MIN_COVERAGE:
        rough = _rough_points(photographs, rows, cameras, track)
    dense = densify(
        photographs,
        rows,
        points,
        triangulation.colors,
        config,
        guide=np.concatenate((points, rough)),
        track=track,
    )
    if dense is None:
        dense = DenseSeeds(points=points, colors=triangulation.colors, swept=0, filled=0, coverage=(1.0, 1.0))
    if not len(dense.points):
        raise InputError(f"seeds: {_why_nothing(photographs, rows)}")
    return PhotographSeeds(dense=dense, triangulation=triangulation, rough=len(rough))


def _why_nothing(photographs: Photographs, rows: Sequence[int]) -> str:
    """Why photographs gave no point, for an error."""
    centers = photographs.cameras.centers[rows]
    if np.ptp(centers, axis=0).max() <= SAME_PLACE * (1 + np.abs(centers).max()):
        return (
            f"all {len(rows)} cameras stand in one place by their poses, from which photographs say nothing about "
            "depth; check the translations of the poses, or give depth, a mesh or a splat"
        )
    flat = [view for view in rows if float(photographs.at_scale(view).image.std(dim=(0, 1)).max()) < FLAT]
    if len(flat) > len(rows) / 2:
        return (
            f"{len(flat)} of {len(rows)} photographs are of one color all over (first: "
            f"{photographs.names[flat[0]]!r}), and nothing in them can be found in others"
        )
    return (
        f"no two of the {len(rows)} photographs show the same surface from different places by their poses; check the "
        "poses (axes, world_from_camera or its inverse), or take photographs with more overlap"
    )


def seed_from_photographs(views: Views, config: DenseConfig = DenseConfig(), *, track: Track = untracked) -> Gaussians:
    """Flat Gaussians at `seeds_of_photographs`, as wide as they are apart; arguments and errors are its own."""
    dense = seeds_of_photographs(Photographs(views, track=track), views, config, track=track).dense
    return seed_from_points(dense.points, dense.colors, views=views, largest_spacing=MAX_DENSE_SPACING)


def _rough_points(
    photographs: Photographs, rows: Sequence[int], cameras: Cameras, track: Track
) -> Float32[np.ndarray, "P 3"]:
    """Points of plane sweeps of small pictures over the depths that the cameras allow."""
    limits = depth_range_of_cameras(cameras)
    shares = overlaps(cameras, typical_distance(cameras))
    neighbors = {
        row: [rows[other] for other in _spread_neighbors(cameras, shares[index], index)]
        for index, row in enumerate(rows)
    }
    photos, poses = scaled_photographs(photographs, rows, ROUGH_SIZE)
    maps = {
        row: sweep_neighbors(row, neighbors[row], photos, poses, *limits, max_planes=ROUGH_PLANES)
        for row in track(rows, "sweeping planes at all depths")
        if len(neighbors[row]) >= 2
    }
    return back_project(consistent_depths(maps, photos, poses, neighbors, ROUGH_TOLERANCE), photos, poses)[0]


def _spread_neighbors(cameras: Cameras, shares: np.ndarray, view: int) -> list[int]:
    """Four views that overlap with a view, and whose centers are neither equal to its own nor far away."""
    distance = typical_distance(cameras)
    apart = np.linalg.norm(cameras.centers - cameras.centers[view], axis=1) / distance
    # A baseline of an eighth of the distance measures depth well, and windows still look alike.
    fits = np.exp(-np.square(np.log(np.maximum(apart, 1e-6) / 0.125)))
    value = shares * fits
    return [int(other) for other in np.argsort(-value, kind="stable")[:4] if value[other] > 0.01]
