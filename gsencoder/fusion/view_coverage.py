"""What views show of a splat, by a few of their rays, and the order of views in which the first ones show most."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.threads import parallel
from gsencoder.fusion.lift import VisibilityConfig, row_mask, view_matrix
from gsencoder.render import Blend, BlendConfig
from gsencoder.types import FeatureMap, FeatureSpace, Gaussians, Views

RAYS = 8000
"""About the number of rays of a view that are followed; projecting and sorting Gaussians costs as much as these."""
SAMPLE = 20_000
"""Gaussians by which views are ordered."""


def sample_view(
    gaussians: Gaussians, views: Views, view: int, visibility: VisibilityConfig, config: BlendConfig
) -> Blend:
    """B of every k-th pixel of a view in both directions, one ray a row, with `visibility` resolved."""
    width, height = int(views.cameras.widths[view]), int(views.cameras.heights[view])
    # Odd, so that rays pass through the centers of pixels.
    step = 2 * max(round((math.sqrt(width * height / RAYS) - 1) / 2), 0) + 1
    cells = FeatureMap(
        features=np.zeros((max(height // step, 1), max(width // step, 1), 1), np.float32),
        grid_from_image=np.array([[1 / step, 0, 0], [0, 1 / step, 0]]),
        space=FeatureSpace(name="rays", channels=1),
    )
    values = {name: getattr(config, name) for name in config.__dataclass_fields__}
    one_ray = BlendConfig(**{**values, "rays_per_patch": 1})
    b = view_matrix(gaussians, views, view, cells, lift="blend", visibility=visibility, config=one_ray)
    if views.masks is not None:
        share = np.repeat(row_mask(views.masks[view], b.lattice), np.diff(b.crow.numpy()))
        b.weight.numpy()[:] *= share
    return b


def coverage_order(seen: Bool[np.ndarray, "V n"], first: Sequence[int] = ()) -> Int64[np.ndarray, " V"]:
    """All views, each the one that shows most Gaussians that those before it do not; of equal ones the first. Once all
    are seen, it is counted which are seen a second time, and so on.

    Args:
        seen: which Gaussians each view shows.
        first: views that come before any other.
    """
    order, left = list[int](), list(range(len(seen)))
    missing = np.ones(seen.shape[1], bool)
    while left:
        gains = seen[:, missing].sum(axis=1)
        if not gains[left].any() and not missing.all():
            missing[:] = True
            continue
        view = first[len(order)] if len(order) < len(first) else max(left, key=lambda each: gains[each])
        order.append(view)
        left.remove(view)
        missing &= ~seen[view]
    return np.array(order, np.int64)


def covering_views(
    gaussians: Gaussians, views: Views, visibility: VisibilityConfig, config: BlendConfig, count: int
) -> tuple[int, ...]:
    """Row numbers of `count` views, ascending, each of which shows most of what those before it do not.

    Args:
        visibility: resolved; a test against rendered depth does not count.
    """
    if count >= len(views):
        return tuple(range(len(views)))
    against = VisibilityConfig(
        against=tuple(source for source in visibility.against if source == "sensor"),
        relative=visibility.relative,
        absolute=visibility.absolute,
    )
    sample = even_indices(len(gaussians), SAMPLE)

    def seen(view: int) -> Bool[np.ndarray, " n"]:
        b = sample_view(gaussians, views, view, against, config)
        return np.bincount(b.col.numpy(), b.weight.numpy(), len(gaussians))[sample] > 0

    order = coverage_order(np.stack(parallel(seen, range(len(views)))))
    return tuple(int(view) for view in np.sort(order[:count]))
