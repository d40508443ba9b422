"""Lifting: the matrix that carries a view's map to the Gaussians, sums over all views, and which views show most."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.core.process import timed
from gsencoder.core.settings import check_limits, option
from gsencoder.core.threads import kernel, parallel
from gsencoder.fusion.basis import Moments, distinct_rows
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.blend_cpu import Lattice, grid_lattice
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, Gaussians, Views

Source = Literal["auto", "sensor", "rendered"]


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilityConfig:
    """Which depth maps a Gaussian is held against, and how near it must be; all chosen tests must pass."""

    against: tuple[Source, ...] = option(
        ("auto",), "depth maps to test against: sensor, rendered; auto = sensor if there, else rendered if lift=center"
    )
    relative: float = option(0.02, "largest |d − z| as a share of d; 0 = not tested", ge=0, le=1e12)
    absolute: float = option(0.0, "largest |d − z| in world units; 0 = not tested", ge=0, le=1e12)

    def __post_init__(self) -> None:
        check_limits(self)
        if self.against and not (self.relative or self.absolute):
            raise InputError("against: a test against a depth map needs relative or absolute above 0; [] = no test")


def depth_sources(config: VisibilityConfig, views: Views, lift: str) -> tuple[Source, ...]:
    """The depth maps to test against. "auto" is sensor depth where there is one; else rendered depth for centers, which
    see through walls without a test, and none for B, whose weights are what is left behind other Gaussians."""
    has_depth = views.depths is not None
    if "sensor" in config.against and not has_depth:
        raise InputError(
            "visibility.against=sensor: the scene has no sensor depth; test against rendered depth instead"
        )
    automatic: tuple[Source, ...] = ("sensor",) if has_depth else ("rendered",) if lift == "center" else ()
    sources = [name for source in config.against for name in (automatic if source == "auto" else (source,))]
    return tuple(dict.fromkeys(sources))


def _interval(
    low: np.ndarray, high: np.ndarray, config: VisibilityConfig
) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
    """The depths that pass where `low` to `high` were measured.

    Depth 0 means none: such rays say nothing was measured there, and nothing passes (as in OpenScene).
    """
    least, most = np.zeros(low.shape), np.full(low.shape, np.inf)
    if config.relative:
        least, most = low * (1.0 - config.relative), high * (1.0 + config.relative)
    if config.absolute:
        least, most = np.maximum(least, low - config.absolute), np.minimum(most, high + config.absolute)
    most = np.where(high > 0, most, -np.inf)
    return least.astype(np.float32), most.astype(np.float32)


def visible_points(
    z: Float32[np.ndarray, " n"],
    pixels: Int64[np.ndarray, "n 2"],
    depth: Float32[np.ndarray, "H W"],
    config: VisibilityConfig,
) -> Bool[np.ndarray, " n"]:
    """Tests Gaussians' centers at their own pixel (x, y), which must lie inside the map."""
    d = depth[pixels[:, 1], pixels[:, 0]]
    least, most = _interval(d, d, config)
    return (z >= least) & (z <= most)


@timed("visibility")
def depth_interval(
    depths: Sequence[Float32[np.ndarray, "H W"]], lattice: Lattice, config: VisibilityConfig
) -> tuple[Float32[np.ndarray, " P"], Float32[np.ndarray, " P"]]:
    """The smallest and the largest depth that pass in each row: those between the nearest and the farthest depth that
    the row's rays meet, widened by the tolerances, in all of the maps."""
    least, most = np.full(lattice.rows, -np.inf, np.float32), np.full(lattice.rows, np.inf, np.float32)
    for depth in depths:
        y, x = ray_pixels(lattice, depth.shape[1], depth.shape[0])
        nearest, farthest = np.empty(lattice.rows, np.float32), np.empty(lattice.rows, np.float32)
        _measured_range(depth, y, x, lattice.width, lattice.side, nearest, farthest)
        low, high = _interval(nearest, farthest, config)
        least, most = np.maximum(least, low), np.minimum(most, high)
    return least, most


def keep_visible(b: Blend, depth: Float32[np.ndarray, "H W"], config: VisibilityConfig) -> Blend:
    """B without the entries that a depth map hides."""
    least, most = (torch.from_numpy(each).to(b.weight.device) for each in depth_interval([depth], b.lattice, config))
    return b.keep_between(least, most)


def ray_pixels(lattice: Lattice, width: int, height: int) -> tuple[Int32[np.ndarray, " j"], Int32[np.ndarray, " i"]]:
    """Pixel row and column that each line of rays falls into, clipped to the image."""
    y = np.floor(lattice.y0 + lattice.dy * np.arange(lattice.height * lattice.side)).clip(0, height - 1)
    x = np.floor(lattice.x0 + lattice.dx * np.arange(lattice.width * lattice.side)).clip(0, width - 1)
    return y.astype(np.int32), x.astype(np.int32)


@kernel
@no_type_check
def _measured_range(depth, y, x, width, side, low, high):
    """The nearest and the farthest depth that was measured on the rays of each row; 0 where none was."""
    for row in range(len(low)):
        first_y, first_x = row // width * side, row % width * side
        nearest, farthest = np.float32(np.inf), np.float32(0)
        for i in range(first_y, first_y + side):
            for j in range(first_x, first_x + side):
                d = depth[y[i], x[j]]
                if d > 0:
                    nearest, farthest = min(nearest, d), max(farthest, d)
        low[row], high[row] = nearest if farthest > 0 else np.float32(0), farthest


def row_mask(mask: Bool[np.ndarray, "H W"], lattice: Lattice) -> Float32[np.ndarray, " P"]:
    """Share of each row's rays that a pixel mask lets through."""
    y, x = ray_pixels(lattice, mask.shape[1], mask.shape[0])
    rays = mask[np.ix_(y, x)].reshape(lattice.height, lattice.side, lattice.width, lattice.side)
    return rays.mean(axis=(1, 3), dtype=np.float32).ravel()


MAX_CODES = 256
"""Up to this many codes are summed by code, however few coordinates there are."""


class FeatureSums:
    """Sums over views of weighted features and of weights; for maps that share a table, of the weight of each of its
    rows.

    Attributes:
        sums: Σ Bᵀ @ maps in coordinates of the basis (or channels); of maps that share a table Σ Bᵀ @ shares, where the
            shares of a code are one_hot(code).
        weights: Σ Bᵀ @ 1; zero where sums are by rows of a table, since their weights are the row sums.
        table: by whose rows maps are summed; None where sums are of vectors.
    """

    def __init__(
        self,
        gaussians: int,
        space: FeatureSpace,
        basis: FeatureBasis | None,
        table: Float32[np.ndarray, "C D"] | None,
        device: torch.device = torch.device("cpu"),
        *,
        with_mean: bool = False,
    ) -> None:
        """Args:
        basis: whose coordinates are summed; None = channels.
        table: that all maps share; None = dense maps, or maps with a table each. Sums are by its rows, unless it
            has many more than there are coordinates.
        device: where sums are, and the matrices of the views that are added.
        with_mean: whether the mean of the maps' vectors is computed on the way.
        """
        columns = space.channels if basis is None else len(basis.components)
        self.basis, self.device = basis, device
        self.table = table if table is not None and _few_codes(len(table), columns) else None
        self.moments = Moments(space.channels, second=False) if with_mean else None
        width = columns if self.table is None else len(self.table)
        self._sums, self._weights = self._zeros(gaussians, width), self._zeros(gaussians, 1)

    @property
    def sums(self) -> Float32[np.ndarray, "N columns"]:
        return self._sums.cpu().numpy()

    @property
    def weights(self) -> Float32[np.ndarray, " N"]:
        return self._weights[:, 0].cpu().numpy()

    @property
    def mean(self) -> Float32[np.ndarray, " D"]:
        """Mean of the vectors of all maps, with `with_mean`."""
        assert self.moments is not None
        return self.moments.mean.astype(np.float32)

    def _zeros(self, rows: int, columns: int) -> torch.Tensor:
        """Zeros on the device; on a CPU allocated by numpy, whose large arrays lie in huge pages that fill many times
        faster."""
        if self.device.type == "cpu":
            return torch.from_numpy(np.zeros((rows, columns), np.float32))
        return torch.zeros(rows, columns, device=self.device)

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.device)

    def _product(self, sums: torch.Tensor, table: Float32[np.ndarray, "C D"]) -> torch.Tensor:
        """Sums by code as sums of the vectors of a table, in columns."""
        table = self._in_columns(table)
        if self.device.type == "cpu":
            return torch.from_numpy(sums.numpy() @ table)
        return sums @ self._tensor(table)

    @timed("lift")
    def add(self, b: Blend, feature_map: FeatureMap, mask: Bool[np.ndarray, "H W"] | None) -> None:
        """Adds a view: sums += Bᵀ @ (share · maps), weights += Bᵀ @ share, with the share of each row in the mask."""
        if self.moments is not None:
            self.moments.add(distinct_rows(feature_map))
        share = row_mask(mask, b.lattice) if mask is not None else None
        own = feature_map.table
        if self.table is not None:
            _lift_shares_into(b, feature_map, share, self._sums)
        elif feature_map.codes is not None and own is not None and _few_codes(len(own), self._sums.shape[1]):
            if len(own):
                sums = self._zeros(len(self._weights), len(own))
                _lift_shares_into(b, feature_map, share, sums)
                self._sums += self._product(sums, own)
                self._weights += sums.sum(dim=1, keepdim=True)
        else:
            maps, scale = self._vectors(feature_map, share)
            b.lift_into(self._tensor(maps), self._sums)
            b.lift_into(self._tensor(scale[:, None]), self._weights)

    def _vectors(
        self, feature_map: FeatureMap, share: Float32[np.ndarray, " P"] | None
    ) -> tuple[Float32[np.ndarray, "P columns"], Float32[np.ndarray, " P"]]:
        """What each row gives, and with which weight."""
        table = feature_map.table
        if feature_map.codes is not None and table is not None:
            codes = _codes_in_mask(feature_map, share)
            # The row behind the last one is what code −1 takes.
            padded = self._in_columns(np.concatenate([table, np.zeros_like(table[:1])]))
            padded[-1] = 0
            return padded[codes], (codes >= 0).astype(np.float32)
        if feature_map.shares is not None and table is not None:
            shares = feature_map.shares.reshape(-1, len(table))
            shares = shares if share is None else shares * share[:, None]
            return shares @ self._in_columns(table), shares.sum(axis=1)
        vectors = feature_map.rows()
        scale = np.isfinite(vectors[:, 0]).astype(np.float32)
        if not scale.all():
            vectors = np.where(scale[:, None] > 0, vectors, np.float32(0))
        if share is not None:
            scale *= share
        maps = self._in_columns(vectors)
        return maps if scale.min() == 1 else maps * scale[:, None], scale

    def _in_columns(self, table: Float32[np.ndarray, "C D"]) -> Float32[np.ndarray, "C columns"]:
        return self.basis.coordinates(table) if self.basis is not None else table

    @timed("lift")
    def finish(self) -> tuple[Float32[np.ndarray, "N columns"], Float32[np.ndarray, " N"]]:
        """Divides, once: (features, weights); rows without weight are zero."""
        if self.table is None:
            weights, sums = self.weights, self.sums
        else:
            weights = self.sums.sum(axis=1)
            sums = self._product(self._sums, self.table).cpu().numpy()
        # A row whose whole weight is below the smallest normal number would divide into noise or infinity.
        seen = weights > np.finfo(np.float32).tiny
        features = np.divide(sums, weights[:, None], where=seen[:, None], out=np.zeros_like(sums))
        return features, np.where(seen, weights, 0).astype(np.float32)


def _few_codes(codes: int, columns: int) -> bool:
    """Whether to sum by code, which takes one product with the table at the end instead of one for each view: only
    where the table has few rows, so that the sums are not much wider than sums of vectors."""
    return codes <= max(MAX_CODES, 2 * columns)


def _codes_in_mask(feature_map: FeatureMap, share: Float32[np.ndarray, " P"] | None) -> Int32[np.ndarray, " P"]:
    """The codes of a map's cells; −1 where at most half of a cell is in the mask."""
    assert feature_map.codes is not None
    codes = feature_map.codes.ravel()
    return codes if share is None else np.where(share > 0.5, codes, np.int32(-1))


def _lift_shares_into(
    b: Blend,
    feature_map: FeatureMap,
    share: Float32[np.ndarray, " P"] | None,
    sums: Float[torch.Tensor, "N C"],
) -> None:
    """Adds Bᵀ @ shares of a coded or mixed map, with the share of each row in the mask."""
    if feature_map.shares is not None:
        shares = feature_map.shares.reshape(-1, sums.shape[1])
        if share is not None:
            shares = shares * share[:, None]
        b.lift_into(torch.from_numpy(shares).to(sums.device), sums)
        return
    b.lift_codes_into(torch.from_numpy(_codes_in_mask(feature_map, share)).to(sums.device), sums)


def view_matrix(
    gaussians: Gaussians,
    views: Views,
    view: int,
    feature_map: FeatureMap,
    *,
    lift: Literal["blend", "center"],
    visibility: VisibilityConfig,
    config: BlendConfig,
    device: str | torch.device = "cpu",
) -> Blend:
    """The matrix that a view's map is lifted with: B of its cells, or one entry for each visible center.

    Args:
        device: where B is made and held against depth maps; centers are tested on the CPU, and go there as a matrix.
    """
    depths = depth_maps(gaussians, views, view, depth_sources(visibility, views, lift), config, device)
    if lift == "center":
        return center_matrix(gaussians, views, view, feature_map, depths, visibility, config).to(device)
    config = limit_rays(config, feature_map)
    lattice = grid_lattice(feature_map.grid_from_image, feature_map.width, feature_map.height, config.rays_per_patch)
    between = depth_interval(depths, lattice, visibility) if depths else None
    return timed("blend")(blend)(
        gaussians, views.cameras, view, like=feature_map, between=between, config=config, device=device
    )


def limit_rays(config: BlendConfig, feature_map: FeatureMap) -> BlendConfig:
    """No more rays than pixels: the map of a labels teacher has one cell a pixel, and one ray is enough for it."""
    side = max(1, round(1 / float(np.sqrt(feature_map.grid_from_image[0, 0] * feature_map.grid_from_image[1, 1]))))
    return replace(config, rays_per_patch=min(config.rays_per_patch, side * side))


@timed("visibility")
def depth_maps(
    gaussians: Gaussians,
    views: Views,
    view: int,
    sources: Sequence[Source],
    config: BlendConfig,
    device: str | torch.device = "cpu",
) -> list[Float32[np.ndarray, "H W"]]:
    """The depth maps that entries are held against, world units, 0 = none."""
    maps = []
    for source in sources:
        if source == "sensor":
            assert views.depths is not None
            maps.append(views.depths[view])
        else:
            maps.append(blend(gaussians, views.cameras, view, config=config, device=device).depth_map())
    return maps


@timed("lift")
def center_matrix(
    gaussians: Gaussians,
    views: Views,
    view: int,
    feature_map: FeatureMap,
    depths: list[np.ndarray],
    visibility: VisibilityConfig,
    config: BlendConfig,
) -> Blend:
    """The paper's lift as a matrix: one entry of weight 1 for each visible center, in the cell that it falls into."""
    cameras = views.cameras
    pixels, z = cameras.project(gaussians.means, view)
    rows = np.flatnonzero(cameras.in_image(pixels, z, view, near=config.near))
    for depth in depths:
        rows = rows[visible_points(z[rows], pixels[rows].astype(np.int64), depth, visibility)]
    affine, (x, y) = feature_map.grid_from_image, pixels[rows].T
    column = np.floor(affine[0, 0] * x + affine[0, 2]).astype(np.int64)
    line = np.floor(affine[1, 1] * y + affine[1, 2]).astype(np.int64)
    inside = (column >= 0) & (column < feature_map.width) & (line >= 0) & (line < feature_map.height)
    rows, cell = rows[inside], (line * feature_map.width + column)[inside]
    order = np.argsort(cell, kind="stable")
    crow = np.concatenate(([0], np.bincount(cell, minlength=feature_map.height * feature_map.width).cumsum()))
    lattice = grid_lattice(affine, feature_map.width, feature_map.height, 1)
    return Blend(
        torch.from_numpy(crow.astype(np.int64)),
        torch.from_numpy(rows[order].astype(np.int32)),
        torch.ones(len(rows)),
        torch.from_numpy(z.copy()),
        lattice,
        config,
    )


RAYS = 8000
"""About the number of rays of a view that are followed; projecting and sorting Gaussians costs as much as these."""
SAMPLE = 20_000
"""Gaussians by which views are ordered."""


def sample_view(
    gaussians: Gaussians, views: Views, view: int, visibility: VisibilityConfig, config: BlendConfig
) -> Blend:
    """B of every k-th pixel of a view in both directions, one ray a row."""
    width, height = int(views.cameras.widths[view]), int(views.cameras.heights[view])
    # Odd, so that rays pass through the centers of pixels.
    step = 2 * max(round((math.sqrt(width * height / RAYS) - 1) / 2), 0) + 1
    cells = FeatureMap(
        features=np.zeros((max(height // step, 1), max(width // step, 1), 1), np.float32),
        grid_from_image=np.array([[1 / step, 0, 0], [0, 1 / step, 0]]),
        space=FeatureSpace(name="rays", channels=1),
    )
    one_ray = replace(config, rays_per_patch=1)
    b = view_matrix(gaussians, views, view, cells, lift="blend", visibility=visibility, config=one_ray)
    if views.masks is not None:
        share = np.repeat(row_mask(views.masks[view], b.lattice), np.diff(b.crow.numpy()))
        b.weight.numpy()[:] *= share
    return b


def coverage_order(seen: Bool[np.ndarray, "V n"], first: Sequence[int] = ()) -> Int64[np.ndarray, " V"]:
    """All views, those of `first` before any other, each the one that shows most Gaussians that those before it do not;
    of equal ones the first. Once all are seen, it is counted which are seen a second time, and so on."""
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
    """Row numbers of `count` views, ascending, each of which shows most of what those before it do not; a test against
    rendered depth does not count."""
    against = replace(visibility, against=tuple(source for source in visibility.against if source != "rendered"))
    sample = even_indices(len(gaussians), SAMPLE)

    def seen(view: int) -> Bool[np.ndarray, " n"]:
        b = sample_view(gaussians, views, view, against, config)
        return np.bincount(b.col.numpy(), b.weight.numpy(), len(gaussians))[sample] > 0

    order = coverage_order(np.stack(parallel(seen, range(len(views)))))
    return tuple(int(view) for view in np.sort(order[:count]))
