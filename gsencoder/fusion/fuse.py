"""Multi-view fusion: a teacher's maps lifted onto Gaussians (SplatDistill sec. 3.2).

    sums = Σ_views Bᵀ @ maps,   weights = Σ_views Bᵀ @ 1,   features = sums / weights, divided once at the end.

Views stream one at a time; sums are kept in the coordinates of a basis, so that memory does not grow with the number
of views or with the teacher's width.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.errors import InputError
from gsencoder.fusion.basis import Moments, encode, fit_basis, table_basis
from gsencoder.fusion.store import PartialFusion
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.visibility import VisibilityConfig, row_mask, visible_entries, visible_points
from gsencoder.geometry import transform
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.lattice import grid_lattice
from gsencoder.render.rgb import depth_image
from gsencoder.types import FeatureBasis, FeatureMap, GaussianFeatures, Gaussians, Scene, Views


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig:
    """How maps become per-Gaussian features."""

    lift: Literal["blend", "center"] = field(
        default="blend",
        metadata={"help": "blend: Bᵀ, every pixel gives by its blending weights; center: the paper's nearest pixel"},
    )
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    blend: BlendConfig = field(default_factory=BlendConfig)
    energy: float = field(default=0.999, metadata={"help": "share of a dense teacher's energy that the basis keeps"})
    table_energy: float = field(default=0.9999, metadata={"help": "the same for coded maps (labels, regions)"})
    max_rank: int = field(default=128, metadata={"help": "largest rank of the basis; 0 = as many as the energy asks"})
    basis: bool = field(default=True, metadata={"help": "fuse in a low-rank basis; false = in all channels"})
    narrow: int = field(default=64, metadata={"help": "teachers with no more channels than this keep all of them"})
    views: int = field(default=0, metadata={"help": "views used, evenly spaced; 0 = all"})

    def __post_init__(self) -> None:
        for name in ("energy", "table_energy"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError(f"{name}: expected a share in (0, 1], got {getattr(self, name)}")
        for name in ("max_rank", "narrow", "views"):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fusion:
    """What `fuse` made, and what it chose.

    Attributes:
        features: on the scene's Gaussians.
        views: row numbers of the views that were used.
        seconds: by step.
        truncation: 1 − centred cosine between teacher vectors and their projections on the basis, averaged over the
            cells of all views with each cell weighted by its distance from the mean; 0 without a basis.
    """

    features: GaussianFeatures
    views: tuple[int, ...]
    seconds: dict[str, float]
    truncation: float


class _Clock:
    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[step] = self.seconds.get(step, 0.0) + time.perf_counter() - start


Track = Callable[[Iterable[int], str], Iterable[int]]


def _silent(items: Iterable[int], label: str) -> Iterable[int]:  # noqa: ARG001
    return items


def fuse(
    scene: Scene,
    teacher: Teacher,
    config: FuseConfig = FuseConfig(),
    *,
    work: Path | None = None,
    track: Track = _silent,
) -> Fusion:
    """Lifts a teacher's maps onto the scene's Gaussians.

    A dense teacher is passed over twice, once to find the basis and once to lift; its maps are kept as float16 files
    in `work` between the passes, because making them again costs far more than reading them (without `work`, or for
    teachers that say they are cheap, they are made twice).

    Args:
        scene: with Gaussians and views.
        teacher: what to lift.
        config: knobs.
        work: folder for maps and running sums; a run that finds its own there goes on where it stopped.
        track: wraps the loop over views to show progress.

    Raises:
        InputError: nothing to lift or to lift onto, no view sees anything, or `work` holds another run.
    """
    if scene.gaussians is None or len(scene.gaussians) == 0:
        raise InputError(f"fuse: scene {scene.name} has no Gaussians; make some from its depth or points (seeds)")
    if scene.views is None:
        raise InputError(f"fuse: scene {scene.name} has no views to fuse from")
    if len(scene.views) == 0:
        raise InputError(f"fuse: scene {scene.name} has no views left")
    chosen = _choose(len(scene.views), config.views)
    clock = _Clock()
    settings = {"fuse": asdict(config), "teacher": teacher.settings(), "views": list(chosen)}
    kept = PartialFusion(work, settings) if work is not None else None
    maps = _Maps(teacher, scene.views, kept, clock)
    basis, mean, truncation = _find_basis(maps, chosen, config, clock, track)
    with clock("lift"):
        columns = basis.rank if basis is not None else teacher.space.channels
        sums = _Sums(len(scene.gaussians), columns, basis, teacher.table)
        done = sums.restore(kept)
    for position in track(range(done, len(chosen)), "lifting views"):
        feature_map = maps.get(chosen[position])
        _lift_view(scene.gaussians, scene.views, chosen[position], feature_map, sums, config, clock)
        if kept is not None and kept.due():
            kept.save_sums(position + 1, sums.sums, sums.weights)
    with clock("lift"):
        features, weights = sums.finish()
    if not (weights > 0).any():
        raise InputError(f"fuse: none of {len(chosen)} views of {scene.name} sees any Gaussian; check poses and units")
    fused = GaussianFeatures(features=features, weights=weights, mean=mean, space=teacher.space, basis=basis)
    return Fusion(features=fused, views=chosen, seconds=clock.seconds, truncation=truncation)


def _choose(available: int, wanted: int) -> tuple[int, ...]:
    count = min(wanted or available, available)
    return tuple(int(view) for view in np.unique(np.linspace(0, available - 1, count).round().astype(int)))


class _Maps:
    """The teacher's maps, from disk where they have been made before."""

    def __init__(self, teacher: Teacher, views: Views, kept: PartialFusion | None, clock: _Clock) -> None:
        self.teacher, self.views, self.clock = teacher, views, clock
        self.kept = None if teacher.cheap else kept

    def get(self, view: int) -> FeatureMap:
        with self.clock("teacher"):
            if self.kept is None:
                return self.teacher.feature_map(self.views, view)
            found = self.kept.load_map(view, self.teacher.space)
            if found is not None:
                return found
            self.kept.save_map(view, self.teacher.feature_map(self.views, view))
            # What was written is what is used: a resumed run meets the same float16 values, and so the same basis.
            found = self.kept.load_map(view, self.teacher.space)
            assert found is not None
            return found


def _find_basis(
    maps: _Maps, chosen: tuple[int, ...], config: FuseConfig, clock: _Clock, track: Track
) -> tuple[FeatureBasis | None, Float32[np.ndarray, " D"], float]:
    teacher, space = maps.teacher, maps.teacher.space
    wanted = config.basis and space.channels > config.narrow
    if teacher.table is not None:
        mean = teacher.mean if teacher.mean is not None else teacher.table.mean(axis=0)
        if not wanted:
            return None, mean, 0.0
        basis = table_basis(teacher.table, mean, space, energy=config.table_energy)
        return basis, mean, _truncation(basis, teacher.table)
    moments = Moments(space.channels)
    for view in track(chosen, "finding the basis"):
        vectors = _vectors(maps.get(view))
        with clock("basis"):
            moments.add(vectors[np.isfinite(vectors[:, 0])])
    mean = teacher.mean if teacher.mean is not None else moments.mean.astype(np.float32)
    if not wanted:
        return None, mean, 0.0
    with clock("basis"):
        basis = fit_basis(moments.mean, moments.covariance(), space, energy=config.energy, max_rank=config.max_rank)
    # For cells weighted by squared distance from the mean, the mean squared cosine is exactly the energy kept.
    return basis, mean, 1 - float(np.sqrt(basis.energy_kept))


def _vectors(feature_map: FeatureMap) -> Float32[np.ndarray, "P D"]:
    """A map as rows; cells of code −1 are NaN."""
    if feature_map.features is not None:
        return feature_map.features.reshape(-1, feature_map.space.channels)
    assert feature_map.codes is not None
    assert feature_map.table is not None
    codes = feature_map.codes.ravel()
    return np.where((codes >= 0)[:, None], feature_map.table[codes], np.float32(np.nan))


def _truncation(basis: FeatureBasis, table: Float32[np.ndarray, "C D"]) -> float:
    centred = table - basis.mean
    inside = (centred @ basis.components.T) @ basis.components
    return 1 - float(np.sqrt((inside**2).sum() / max((centred**2).sum(), 1e-30)))


class _Sums:
    """Running sums over views: coordinates (or channels), or for coded maps the weight of each code."""

    def __init__(
        self, gaussians: int, columns: int, basis: FeatureBasis | None, table: Float32[np.ndarray, "C D"] | None
    ) -> None:
        self.basis, self.table = basis, table
        # numpy, not torch, allocates what is large: its arrays lie in huge pages, which fill many times faster.
        width = columns if table is None else len(table)
        self.sums: Float32[np.ndarray, "N columns"] = np.zeros((gaussians, width), np.float32)
        self.weights: Float32[np.ndarray, " N"] = np.zeros(gaussians, np.float32)

    def restore(self, kept: PartialFusion | None) -> int:
        """Takes up the sums of an earlier run; returns how many views they hold."""
        found = kept.load_sums() if kept is not None else None
        if found is None:
            return 0
        done, self.sums, self.weights = found
        return done

    def add(self, b: Blend, feature_map: FeatureMap, mask: Float32[np.ndarray, " P"] | None) -> None:
        """One view's share: sums += Bᵀ @ (mask · maps), weights += Bᵀ @ mask."""
        if self.table is not None:
            assert feature_map.codes is not None
            codes = feature_map.codes.ravel()
            if mask is not None:
                codes = np.where(mask > 0.5, codes, np.int32(-1))
            b.lift_codes_into(torch.from_numpy(codes), torch.from_numpy(self.sums))
            return
        vectors = _vectors(feature_map)
        scale = np.isfinite(vectors[:, 0]).astype(np.float32)
        if not scale.all():
            vectors = np.where(scale[:, None] > 0, vectors, np.float32(0))
        if mask is not None:
            scale *= mask
        maps = encode(self.basis, vectors) if self.basis is not None else vectors
        if scale.min() < 1:
            maps = maps * scale[:, None]
        b.lift_into(torch.from_numpy(maps), torch.from_numpy(self.sums))
        b.lift_into(torch.from_numpy(scale[:, None]), torch.from_numpy(self.weights[:, None]))

    def finish(self) -> tuple[Float32[np.ndarray, "N columns"], Float32[np.ndarray, " N"]]:
        """Divides once: (features, weights); rows without weight are zero."""
        if self.table is None:
            weights, sums = self.weights, self.sums
        else:
            weights = self.sums.sum(axis=1)
            sums = self.sums @ (encode(self.basis, self.table) if self.basis is not None else self.table)
        # A row whose whole weight is below the smallest normal number would divide into noise or infinity.
        seen = weights > np.finfo(np.float32).tiny
        features = np.divide(sums, weights[:, None], where=seen[:, None], out=np.zeros_like(sums))
        return features, np.where(seen, weights, 0).astype(np.float32)


def _lift_view(
    gaussians: Gaussians,
    views: Views,
    view: int,
    feature_map: FeatureMap,
    sums: _Sums,
    config: FuseConfig,
    clock: _Clock,
) -> None:
    if config.lift == "center":
        with clock("blend"):
            depths = _depth_maps(gaussians, views, view, config, None)
        with clock("lift"):
            b = _center_matrix(gaussians, views, view, feature_map, depths, config)
    else:
        with clock("blend"):
            b = blend(gaussians, views.cameras, view, like=feature_map, config=_capped(config.blend, feature_map))
        with clock("visibility"):
            for depth in _depth_maps(gaussians, views, view, config, b):
                b = b.keep(visible_entries(b, depth, config.visibility))
    with clock("lift"):
        mask = row_mask(views.masks[view], b.lattice) if views.masks is not None else None
        sums.add(b, feature_map, mask)


def _capped(config: BlendConfig, feature_map: FeatureMap) -> BlendConfig:
    """No more rays than pixels: the map of a labels teacher has one cell a pixel, and one ray is enough for it."""
    side = max(1, round(1 / float(np.sqrt(feature_map.grid_from_image[0, 0] * feature_map.grid_from_image[1, 1]))))
    if config.rays_per_patch <= side * side:
        return config
    values = {name: getattr(config, name) for name in config.__dataclass_fields__}
    return BlendConfig(**{**values, "rays_per_patch": side * side})


def _depth_maps(
    gaussians: Gaussians, views: Views, view: int, config: FuseConfig, b: Blend | None
) -> list[Float32[np.ndarray, "H W"]]:
    maps = []
    for source in config.visibility.against:
        if source == "sensor":
            if views.depths is None:
                raise InputError("visibility: the scene has no sensor depth; test against rendered depth instead")
            maps.append(views.depths[view])
        else:
            size = int(views.cameras.heights[view]), int(views.cameras.widths[view])
            pixels = b if b is not None and b.lattice.side == 1 and b.shape == size else None
            pixels = pixels or blend(gaussians, views.cameras, view, config=config.blend)
            maps.append(depth_image(pixels))
    return maps


def _center_matrix(
    gaussians: Gaussians, views: Views, view: int, feature_map: FeatureMap, depths: list[np.ndarray], config: FuseConfig
) -> Blend:
    """The paper's lift as a matrix: one entry of weight 1 for each visible centre, in the cell that it falls into."""
    cameras = views.cameras
    pose, K = torch.from_numpy(cameras.cam_from_world[view]), cameras.Ks[view]
    points = transform(pose, torch.from_numpy(gaussians.means)).numpy()
    z = points[:, 2]
    safe = np.where(z > config.blend.near, z, 1)
    x = K[0, 0] * points[:, 0] / safe + K[0, 2]
    y = K[1, 1] * points[:, 1] / safe + K[1, 2]
    width, height = int(cameras.widths[view]), int(cameras.heights[view])
    rows = np.flatnonzero((z > config.blend.near) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
    pixels = np.stack((x[rows], y[rows]), axis=1).astype(np.int64)
    for depth in depths:
        kept = visible_points(z[rows], pixels, depth, config.visibility)
        rows, pixels = rows[kept], pixels[kept]
    affine = feature_map.grid_from_image
    column = np.floor(affine[0, 0] * x[rows] + affine[0, 2]).astype(np.int64)
    line = np.floor(affine[1, 1] * y[rows] + affine[1, 2]).astype(np.int64)
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
        config.blend,
    )
