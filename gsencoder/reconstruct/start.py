"""Initial Gaussians of a reconstruction: a given splat, or seeds on every surface, since there is no densification."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.dense import DenseConfig, DenseSeeds, densify
from gsencoder.data.seeding.points import colors_or_grey, seed_from_points
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.types import Gaussians, Scene, Views

MEASURED_SOURCES = ("depth", "mesh", "tsdf")
"""Sources of seeds that were measured on surfaces; points of photographs are estimates, and a splat was optimized."""
MAX_DENSE_SPACING = 4.0
"""Spacing of dense seeds is clipped to this many medians: outliers must not become large blobs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """The first Gaussians.

    Attributes:
        gaussians: to be optimized.
        source: splat, depth, points, mesh or tsdf.
        dense: what was added to structure-from-motion points; None where nothing was.
    """

    gaussians: Gaussians
    source: str
    dense: DenseSeeds | None = None

    @property
    def measured(self) -> bool:
        """Whether the Gaussians lie on measured surfaces."""
        return self.source in MEASURED_SOURCES


class _Subset(Sequence[Any]):
    """A lazy sequence of selected entries of another."""

    def __init__(self, items: Sequence[Any], rows: Sequence[int]) -> None:
        self.items, self.rows = items, rows

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: Any) -> Any:
        return self.items[self.rows[index]]


def select_views(views: Views, rows: Sequence[int]) -> Views:
    """Selected views; pictures are decoded on access."""
    lazy = {
        name: None if getattr(views, name) is None else _Subset(getattr(views, name), rows)
        for name in ("images", "depths", "masks", "instances")
    }
    return Views(cameras=views.cameras.select(rows), names=tuple(views.names[row] for row in rows), **lazy)


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
    views = select_views(scene.views, list(training))
    source = seeds.source
    if source == "auto":
        source = "depth" if views.depths is not None else "points"
    seen = replace(scene, views=views)
    points = scene.sfm_points
    if source != "points" or points is None or dense.enough == 0:
        return Start(gaussians=seed(seen, replace(seeds, source=source)), source=source)
    colors = colors_or_grey(points, scene.sfm_colors)
    added = densify(photographs, training, points, colors, dense, track=track)
    if added is None:
        return Start(gaussians=seed(replace(seen, sfm_colors=colors), replace(seeds, source="points")), source="points")
    gaussians = seed_from_points(added.points, added.colors, views=views, largest_spacing=MAX_DENSE_SPACING)
    return Start(gaussians=gaussians, source="points", dense=added)
