"""Multi-view fusion: a teacher's maps lifted onto Gaussians (SplatDistill sec. 3.2).

    sums = Σ_views Bᵀ @ maps,   weights = Σ_views Bᵀ @ 1,   features = sums / weights, divided once at the end.

Views stream a few at a time, and are added in their order; sums are kept in the coordinates of a basis, so that memory
does not grow with the number of views or with the teacher's width.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.arrays import even_indices
from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError
from gsencoder.core.process import Clock, Device, Track, timed, untracked
from gsencoder.core.threads import ahead, thread_count
from gsencoder.fusion.basis import Moments, fit_basis, table_basis
from gsencoder.fusion.checkpoint import open_checkpoint, upright
from gsencoder.fusion.errors import CellSample, ProjectionSums
from gsencoder.fusion.lift import FeatureSums, VisibilityConfig, distinct_rows, resolve, view_matrix
from gsencoder.fusion.view_coverage import covering_views
from gsencoder.render import Blend, BlendConfig
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureBasis, FeatureMap, GaussianFeatures, Gaussians, Scene, Views

VIEWS_AT_ONCE = 4
"""Largest number of views whose matrices are made at the same time, each on threads of its own: steps that have one
thread, such as sorting, run side by side. Each holds a matrix in memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FuseConfig:
    """How maps become per-Gaussian features."""

    lift: Literal["blend", "center"] = field(
        default="blend",
        metadata={"help": "blend: Bᵀ, every pixel gives by its blending weights; center: the paper's nearest pixel"},
    )
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    blend: BlendConfig = field(default_factory=BlendConfig)
    energy: float = field(
        default=0.999, metadata={"help": "share of the energy of a teacher's vectors that the basis keeps"}
    )
    table_energy: float = field(
        default=0.9999, metadata={"help": "the same for maps that share a table (labels, captions)"}
    )
    max_rank: int = field(default=128, metadata={"help": "largest rank of the basis; 0 = as many as the energy asks"})
    basis: bool = field(default=True, metadata={"help": "fuse in a low-rank basis; false = in all channels"})
    narrow: int = field(default=64, metadata={"help": "teachers with no more channels than this keep all of them"})
    views: int = field(default=0, metadata={"help": "views used; 0 = all"})
    view_share: float = field(default=1.0, metadata={"help": "share of the views used; with views= the fewer of both"})
    view_choice: Literal["even", "coverage"] = field(
        default="even",
        metadata={"help": "which views are used: evenly spaced ones, or those that show most of the Gaussians"},
    )

    def __post_init__(self) -> None:
        for name in ("energy", "table_energy", "view_share"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError(f"{name}: expected a share in (0, 1], got {getattr(self, name)}")
        for name in ("max_rank", "narrow", "views"):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fusion:
    """The result of `fuse`, and the choices that it made.

    Attributes:
        features: on the scene's Gaussians.
        views: row numbers of the views that were used.
        tested: the depth maps that visibility was tested against.
        seconds: of the wall clock by step; where steps ran at the same time, each has its share.
        truncation: 1 − centered cosine between teacher vectors and their projections on the basis, averaged over the
            cells of all views with each cell weighted by its distance from the mean; 0 without a basis.
        projections: how well a basis that was given represents the teacher's vectors in the views that this call added;
            None if the scene has a basis of its own, or none.
        sample: cells of the teacher's maps of all views; None without `sample_cells`.
        config: the settings as they were given, before `visibility` was resolved.
    """

    features: GaussianFeatures
    views: tuple[int, ...]
    tested: tuple[str, ...]
    seconds: dict[str, float]
    truncation: float
    projections: ProjectionSums | None = None
    sample: CellSample | None = None
    config: FuseConfig = FuseConfig()


def fuse(
    scene: Scene,
    teacher: Teacher,
    config: FuseConfig = FuseConfig(),
    *,
    basis: FeatureBasis | None = None,
    rows: Sequence[int] | None = None,
    work: Path | None = None,
    sample_cells: bool = False,
    device: Device | torch.device = "auto",
    track: Track = untracked,
) -> Fusion:
    """Lifts a teacher's maps onto the scene's Gaussians.

    A dense teacher is passed over twice, once to fit the basis and once to lift; its maps are cached as float16 files
    in `work` between the passes, because computing them again costs far more than reading them (without `work`, or for
    cheap teachers, they are computed twice). Where no basis is needed, one pass is enough.

    Args:
        scene: with Gaussians and views.
        teacher: whose maps are lifted.
        config: settings.
        basis: fuse in the coordinates of this basis, which scenes that are trained on together share; None = one of the
            scene's own, where `config` asks for one.
        rows: numbers of the views that are lifted, in this order; None = those that `config` chooses.
        work: folder for maps and running sums; an interrupted run is continued from it.
        sample_cells: whether cells of the maps of all views are collected, for `Fusion.sample`.
        device: where B is made, held against depth maps, and multiplied; "auto" = a GPU if torch sees one. Features of
            two devices are equal within rounding, so that `work` may be continued on another one.
        track: wraps the loops over views to show progress.

    Raises:
        InputError: nothing to lift or to lift onto, a basis of another space, no view sees anything, no such device, or
            `work` holds another run.
    """
    requested, teacher = config, upright(teacher)
    chosen_device = device if isinstance(device, torch.device) else choose_device(device)
    gaussians, views = checked_scene(scene, teacher, basis)
    config = replace(config, visibility=resolve(config.visibility, views, config.lift))
    if rows is None and config.view_choice == "coverage":
        rows = covering_views(gaussians, views, config.visibility, config.blend, number_of_views(len(views), config))
    rows = chosen_views(len(views), config) if rows is None else tuple(rows)
    checkpoint = None
    if work is not None:
        checkpoint = open_checkpoint(work, asdict(config), teacher, gaussians, views, rows, basis)
    source = teacher if checkpoint is None else checkpoint.cached(teacher)
    maps = timed("teacher")(partial(source.feature_map, views))

    with Clock().running() as clock:
        if basis is not None:
            subspace = Subspace.of_basis(basis)
        else:
            subspace = find_subspace(teacher, maps, rows, config, track, one_pass=checkpoint is None)
        # Where only the mean is unknown, it is computed while views are lifted. A run with a checkpoint, which may
        # start with a later view, has computed it before.
        moments = Moments(teacher.space.channels, second=False) if subspace.mean is None else None
        sample = CellSample(len(rows))
        projections = ProjectionSums() if basis is not None else None
        columns = subspace.basis.rank if subspace.basis is not None else teacher.space.channels
        sums = FeatureSums(len(gaussians), columns, subspace.basis, teacher.table, chosen_device)
        if checkpoint is not None:
            checkpoint.resume(sums)
        remaining = rows[sums.views :]

        def prepare(view: int) -> tuple[FeatureMap, Blend, Mapping[str, float]]:
            with Clock().running() as of_view:
                feature_map = maps(view)
                matrix = view_matrix(
                    gaussians,
                    views,
                    view,
                    feature_map,
                    lift=config.lift,
                    visibility=config.visibility,
                    config=config.blend,
                    device=chosen_device,
                )
            return feature_map, matrix, of_view.seconds

        # A costly teacher has threads of its own and may have large maps: its views are prepared one after the other.
        workers = min(thread_count(), VIEWS_AT_ONCE)
        side_by_side = teacher.cheap and chosen_device.type == "cpu"
        prepared = ahead(prepare, remaining, workers) if side_by_side else map(prepare, remaining)
        start, parts = time.perf_counter(), []
        with Clock().running() as of_sums:
            for view, (feature_map, matrix, seconds) in zip(track(remaining, "lifting views"), prepared, strict=True):
                parts.append(seconds)
                sums.add(matrix, feature_map, views.masks[view] if views.masks is not None else None)
                if moments is not None:
                    _add_cells(moments, feature_map)
                if projections is not None and basis is not None:
                    timed("basis")(projections.add_map)(basis, feature_map)
                if sample_cells and checkpoint is None:
                    sample.add(feature_map)
                if checkpoint is not None:
                    checkpoint.save_if_due(sums)
        clock.share_out(time.perf_counter() - start, [*parts, of_sums.seconds])
        if sample_cells and checkpoint is not None:
            # A run that was continued has lifted some views before; their maps are read from their files.
            for view in rows:
                sample.add(maps(view))
        features, weights = sums.finish()
    mean = subspace.mean if moments is None else moments.mean.astype(np.float32)
    assert mean is not None
    if not (weights > 0).any():
        none = f"none of {len(rows)} views of {scene.name} sees any Gaussian"
        raise InputError(f"fuse: {none}; check poses, units, masks and opacities")

    return Fusion(
        features=GaussianFeatures(
            features=features, weights=weights, mean=mean, space=teacher.space, basis=subspace.basis
        ),
        config=requested,
        views=rows,
        tested=config.visibility.against,
        seconds=clock.seconds,
        truncation=subspace.truncation,
        projections=projections,
        sample=sample if sample_cells else None,
    )


def chosen_views(count: int, config: FuseConfig) -> tuple[int, ...]:
    """Row numbers of the views that are used, out of so many, where they are evenly spaced."""
    return tuple(int(view) for view in even_indices(count, number_of_views(count, config)))


def number_of_views(count: int, config: FuseConfig) -> int:
    """How many views are used, out of so many."""
    share = max(1, math.ceil(config.view_share * count - 1e-9))
    return min(config.views or count, share, count)


def checked_scene(scene: Scene, teacher: Teacher, basis: FeatureBasis | None = None) -> tuple[Gaussians, Views]:
    """The Gaussians and views of a scene that can be fused.

    Raises:
        InputError: it lacks them, or the basis is of another space than the teacher's maps.
    """
    if basis is not None and basis.space != teacher.space:
        raise InputError(f"fuse: the basis is of ({basis.space.describe()}), the maps of ({teacher.space.describe()})")
    if scene.gaussians is None or len(scene.gaussians) == 0:
        raise InputError(f"fuse: scene {scene.name} has no Gaussians; make some from its depth or points (seeds)")
    if scene.views is None:
        raise InputError(f"fuse: scene {scene.name} has no views to fuse from")
    if len(scene.views) == 0:
        raise InputError(f"fuse: scene {scene.name} has no views left")
    return scene.gaussians, scene.views


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Subspace:
    """The coordinates in which features are summed.

    Attributes:
        basis: features are summed as coordinates in it; None = in all channels.
        mean: of the teacher's vectors; None where it is known only after a pass over all views.
        truncation: see `Fusion`.
    """

    basis: FeatureBasis | None = None
    mean: Float32[np.ndarray, " D"] | None = None
    truncation: float = 0.0

    @classmethod
    def of_basis(cls, basis: FeatureBasis) -> "Subspace":
        # For cells weighted by squared distance from the mean, the mean squared cosine is exactly the energy kept.
        return cls(basis=basis, mean=basis.mean, truncation=1 - float(np.sqrt(basis.energy_kept)))


def find_subspace(
    teacher: Teacher,
    maps: Callable[[int], FeatureMap],
    rows: tuple[int, ...],
    config: FuseConfig,
    track: Track,
    *,
    one_pass: bool,
) -> Subspace:
    """Fits a basis to a teacher's vectors, where `config` asks for one.

    Args:
        teacher: whose table, if it has one, makes a pass over the maps unnecessary.
        maps: the map of a view.
        rows: of the views.
        config: settings.
        track: progress.
        one_pass: whether the mean, where nothing else is needed, may be computed while views are lifted.
    """
    space = teacher.space
    needs_basis = config.basis and space.channels > config.narrow
    if teacher.table is not None:
        mean = teacher.mean if teacher.mean is not None else teacher.table.mean(axis=0)
        if not needs_basis:
            return Subspace(mean=mean)
        basis = timed("basis")(table_basis)(teacher.table, mean, space, energy=config.table_energy)
        return Subspace(basis=basis, mean=mean, truncation=_truncation(basis, teacher.table))
    if not needs_basis and (teacher.mean is not None or one_pass):
        return Subspace(mean=teacher.mean)
    moments = Moments(space.channels, second=needs_basis)
    for view in track(rows, "finding the basis"):
        _add_cells(moments, maps(view))
    if not needs_basis:
        return Subspace(mean=moments.mean.astype(np.float32))
    basis = timed("basis")(fit_basis)(
        moments.mean, moments.covariance(), space, energy=config.energy, max_rank=config.max_rank
    )
    subspace = Subspace.of_basis(basis)
    return subspace if teacher.mean is None else replace(subspace, mean=teacher.mean)


@timed("basis")
def _add_cells(moments: Moments, feature_map: FeatureMap) -> None:
    """Adds the vectors of a map: each cell of a dense one, each region of a coded one."""
    moments.add(distinct_rows(feature_map))


def _truncation(basis: FeatureBasis, table: Float32[np.ndarray, "C D"]) -> float:
    """1 − the root mean square cosine of a table's centered rows and their projections."""
    centered = table - basis.mean
    projected = (centered @ basis.components.T) @ basis.components
    return 1 - float(np.sqrt((projected**2).sum() / max((centered**2).sum(), 1e-30)))
