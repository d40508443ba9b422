"""Multi-view fusion: a teacher's maps lifted onto Gaussians (SplatDistill sec. 3.2).

    sums = Σ_views Bᵀ @ maps,   weights = Σ_views Bᵀ @ 1,   features = sums / weights, divided once at the end.

Views stream a few at a time, and are added in their order; sums are kept in the coordinates of a basis, so that memory
does not grow with the number of views or with the teacher's width.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.arrays import even_indices
from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError
from gsencoder.core.process import Device, Track, timed, untracked
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.core.threads import ahead
from gsencoder.fusion.basis import Moments, distinct_rows, fit_basis, table_basis
from gsencoder.fusion.checkpoint import cached_maps, upright
from gsencoder.fusion.lift import FeatureSums, VisibilityConfig, covering_views, depth_sources, view_matrix
from gsencoder.render import Blend, BlendConfig
from gsencoder.types import FeatureBasis, FeatureMap, FeatureSpace, GaussianFeatures, Gaussians, Scene, Teacher, Views

VIEWS_AT_ONCE = 4
"""Largest number of views whose matrices are made at the same time, each on threads of its own: steps that have one
thread, such as sorting, run side by side. Each holds a matrix in memory."""
NARROW = 64
"""Teachers with no more channels than this keep all of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig(CheckedConfig):
    """How maps become per-Gaussian features."""

    lift: Literal["blend", "center"] = option(
        "blend", "blend: Bᵀ, every pixel gives by its blending weights; center: the paper's nearest pixel"
    )
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    blend: BlendConfig = field(default_factory=BlendConfig)
    energy: float = option(
        0.999,
        "share of the energy of a teacher's vectors that the basis keeps; maps that share a table (labels, captions) "
        "lose a tenth as much",
        gt=0,
        le=1,
    )
    max_rank: int = option(128, "largest rank of the basis; 0 = as many as the energy asks", ge=0)
    basis: bool = option(True, "fuse in a low-rank basis; false = in all channels")
    views: int = option(0, "views used; 0 = all", ge=0)
    view_share: float = option(1.0, "share of the views used; with views= the fewer of both", gt=0, le=1)
    view_choice: Literal["even", "coverage"] = option(
        "even", "which views are used: evenly spaced ones, or the ones that show most of the Gaussians"
    )

    @property
    def table_energy(self) -> float:
        """Share of the energy of a table that the basis keeps."""
        return 1 - (1 - self.energy) / 10

    def wants_basis(self, space: FeatureSpace) -> bool:
        return self.basis and space.channels > NARROW


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fusion:
    """The result of `fuse`.

    Attributes:
        views: row numbers of the views that were used.
        depth_sources: the depth maps that visibility was tested against.
        teacher: as its maps were read: upright, and from files with `work`.
    """

    features: GaussianFeatures
    views: tuple[int, ...]
    depth_sources: tuple[str, ...]
    config: FuseConfig
    teacher: Teacher

    @property
    def truncation(self) -> float:
        """1 − centered cosine of teacher vectors and their projections on the basis, as a root mean square over the
        vectors that it was fitted to, each weighted by its squared distance from the mean: √(energy kept)."""
        basis = self.features.basis
        return 0.0 if basis is None else 1 - math.sqrt(basis.energy_kept)


def fuse(
    scene: Scene,
    teacher: Teacher,
    config: FuseConfig = FuseConfig(),
    *,
    basis: FeatureBasis | None = None,
    rows: Sequence[int] | None = None,
    work: Path | None = None,
    device: Device | torch.device = "auto",
    track: Track = untracked,
) -> Fusion:
    """Lifts a teacher's maps onto the scene's Gaussians.

    A dense teacher is passed over twice, once to fit the basis and once to lift. Where no basis is needed, one pass is
    enough.

    Args:
        basis: fuse in the coordinates of this basis, which scenes that are trained on together share; None = one of the
            scene's own, where `config` asks for one.
        rows: numbers of the views that are lifted, in this order; None = as `config` chooses.
        work: folder where maps of a costly teacher are cached as float16 files, because computing them again costs far
            more than reading them: an interrupted run continues from it with the same bits.
        device: where B is made, held against depth maps, and multiplied; "auto" = a GPU if torch sees one. Features of
            two devices are equal within rounding, so that `work` may be continued on another one.

    Raises:
        InputError: nothing to lift or to lift onto, no view sees anything, or `work` holds another run.
    """
    gaussians, views = validate_scene(scene)
    teacher = upright(teacher)
    rows = select_views(gaussians, views, config) if rows is None else tuple(rows)
    if work is not None:
        teacher = cached_maps(work, asdict(config), teacher, gaussians, views, rows, basis)
    target = choose_device(device) if isinstance(device, str) else device

    if basis is None:
        basis, mean = find_basis(teacher, views, rows, config, track)
    elif basis.space != teacher.space:
        raise InputError(f"fuse: the basis is of ({basis.space.describe()}), the maps of ({teacher.space.describe()})")
    else:
        mean = basis.mean
    sources = depth_sources(config.visibility, views, config.lift)
    sums = FeatureSums(len(gaussians), teacher.space, basis, teacher.table, target, with_mean=mean is None)

    def prepare(view: int) -> tuple[FeatureMap, Blend]:
        feature_map = map_of(teacher, views, view)
        matrix = view_matrix(
            gaussians,
            views,
            view,
            feature_map,
            lift=config.lift,
            visibility=config.visibility,
            config=config.blend,
            device=target,
        )
        return feature_map, matrix

    # A costly teacher has threads of its own and may have large maps: its views are prepared one after the other.
    side_by_side = teacher.cheap and target.type == "cpu"
    prepared = ahead(prepare, rows, VIEWS_AT_ONCE) if side_by_side else map(prepare, rows)
    for view, (feature_map, matrix) in zip(track(rows, "lifting views"), prepared, strict=True):
        sums.add(matrix, feature_map, views.masks[view] if views.masks is not None else None)
    features, weights = sums.finish()
    if not (weights > 0).any():
        none = f"none of {len(rows)} views of {scene.name} sees any Gaussian"
        raise InputError(f"fuse: {none}; check poses, units, masks and opacities")
    return Fusion(
        features=GaussianFeatures(
            features=features,
            weights=weights,
            mean=sums.mean if mean is None else mean,
            space=teacher.space,
            basis=basis,
        ),
        views=rows,
        depth_sources=sources,
        config=config,
        teacher=teacher,
    )


def validate_scene(scene: Scene) -> tuple[Gaussians, Views]:
    """The Gaussians and views of a scene that can be fused."""
    if scene.gaussians is None or len(scene.gaussians) == 0:
        raise InputError(f"fuse: scene {scene.name} has no Gaussians; make some from its depth or points (seeds)")
    if scene.views is None or len(scene.views) == 0:
        raise InputError(f"fuse: scene {scene.name} has no views to fuse from")
    return scene.gaussians, scene.views


def select_views(gaussians: Gaussians, views: Views, config: FuseConfig) -> tuple[int, ...]:
    """Row numbers of the views that are used."""
    share = max(1, math.ceil(config.view_share * len(views) - 1e-9))
    count = min(config.views or len(views), share, len(views))
    if count == len(views):
        return tuple(range(count))
    if config.view_choice == "coverage":
        return covering_views(gaussians, views, config.visibility, config.blend, count)
    return tuple(even_indices(len(views), count).tolist())


@timed("teacher")
def map_of(teacher: Teacher, views: Views, view: int) -> FeatureMap:
    return teacher.feature_map(views, view)


def find_basis(
    teacher: Teacher, views: Views, rows: Sequence[int], config: FuseConfig, track: Track
) -> tuple[FeatureBasis | None, Float32[np.ndarray, " D"] | None]:
    """The basis of a teacher's vectors, where `config` asks for one, and their mean, where it is known before views are
    lifted. Maps of all views are made where neither a table nor a small number of channels makes that unnecessary."""
    space, table, mean = teacher.space, teacher.table, teacher.mean
    if mean is None and table is not None:
        mean = table.mean(axis=0)
    if not config.wants_basis(space):
        return None, mean
    if table is not None:
        assert mean is not None
        energy = config.table_energy
        return timed("basis")(table_basis)(table, mean, space, energy=energy), mean
    moments = Moments(space.channels)
    for view in track(rows, "finding the basis"):
        timed("basis")(moments.add)(distinct_rows(map_of(teacher, views, view)))
    basis = timed("basis")(fit_basis)(
        moments.mean, moments.covariance(), space, energy=config.energy, max_rank=config.max_rank
    )
    return basis, basis.mean if mean is None else mean
