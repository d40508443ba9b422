"""Initial Gaussians of a reconstruction: a given splat, or seeds on every surface, since there is no densification."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gsencoder.core.process import Track, untracked
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.from_photographs import (
    MAX_DENSE_SPACING,
    DenseConfig,
    DenseSeeds,
    densify,
    seeds_of_photographs,
)
from gsencoder.data.seeding.points import colors_or_grey, seed_from_points
from gsencoder.data.seeding.seed import SeedConfig, choose_source, seed
from gsencoder.types import Gaussians, Scene

MEASURED_SOURCES = ("depth", "mesh", "tsdf")
"""Sources of seeds that were measured on surfaces; points of photographs are estimates, and a splat was optimized."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """The first Gaussians.

    Attributes:
        gaussians: to be optimized.
        source: splat, depth, points, photographs, mesh or tsdf.
        dense: what was added to structure-from-motion or triangulated points; None where nothing was.
        triangulated: number of points that were triangulated, for the source photographs.
    """

    gaussians: Gaussians
    source: str
    dense: DenseSeeds | None = None
    triangulated: int | None = None

    @property
    def measured(self) -> bool:
        """Whether the Gaussians lie on measured surfaces."""
        return self.source in MEASURED_SOURCES


def initial_gaussians(
    scene: Scene,
    photographs: Photographs,
    training: Sequence[int],
    seeds: SeedConfig = SeedConfig(),
    dense: DenseConfig = DenseConfig(),
    *,
    track: Track = untracked,
) -> Start:
    """The first Gaussians of a scene: its own splat, else seeds from what its training views hold.

    Args:
        scene: with views.
        photographs: of all its views.
        training: the views that may be looked at.
        seeds: which source, and how large the grid is.
        dense: when points are added to those of structure from motion.
        track: progress.

    Raises:
        InputError: there is nothing to begin with.
    """
    if scene.gaussians is not None:
        return Start(gaussians=scene.gaussians, source="splat")
    assert scene.views is not None
    views = scene.views.select(training)
    seen = replace(scene, views=views)
    source = choose_source(seen, seeds)
    if source == "photographs":
        from_photographs = seeds_of_photographs(photographs, views, dense, training=training, track=track)
        added: DenseSeeds | None = from_photographs.dense
        triangulated = len(from_photographs.triangulation.points)
    elif source == "points" and scene.sfm_points is not None and dense.enough > 0:
        colors = colors_or_grey(scene.sfm_points, scene.sfm_colors)
        added = densify(photographs, training, scene.sfm_points, colors, dense, track=track)
        seen, triangulated = replace(seen, sfm_colors=colors), None
    else:
        added = triangulated = None
    if added is None:
        return Start(gaussians=seed(seen, replace(seeds, source=source), track=track), source=source)
    gaussians = seed_from_points(added.points, added.colors, views=views, largest_spacing=MAX_DENSE_SPACING)
    return Start(gaussians=gaussians, source=source, dense=added, triangulated=triangulated)
