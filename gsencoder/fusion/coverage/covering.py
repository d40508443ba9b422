"""The views that show most of a splat, by geometry alone."""

import numpy as np

from gsencoder.fusion.coverage.order import view_order
from gsencoder.fusion.coverage.sight import pixels_of, trace_sight
from gsencoder.fusion.visibility import VisibilityConfig
from gsencoder.render import BlendConfig
from gsencoder.types import Gaussians, Views

SCATTER = 0.05
"""ρ of no teacher in particular: once a Gaussian is seen, seeing it again is worth a twentieth as much."""


def covering_views(
    gaussians: Gaussians, views: Views, visibility: VisibilityConfig, config: BlendConfig, count: int
) -> tuple[int, ...]:
    """Row numbers of `count` views, ascending, chosen on a sample of Gaussians: each is the view that shows most of
    what those before it do not.

    Args:
        gaussians: the splat.
        views: to choose from.
        visibility: resolved; a test against rendered depth does not count.
        config: of the fusion.
        count: how many.
    """
    if count >= len(views):
        return tuple(range(len(views)))
    against = VisibilityConfig(
        against=tuple(source for source in visibility.against if source == "sensor"),
        relative=visibility.relative,
        absolute=visibility.absolute,
    )
    sight = trace_sight(gaussians, views, pixels_of(views), against, config)
    order = view_order(sight.weights, sight.singles, SCATTER)
    return tuple(int(view) for view in np.sort(order[:count]))
