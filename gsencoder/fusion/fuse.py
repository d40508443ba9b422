"""Multi-view fusion: a teacher's maps lifted onto Gaussians (SplatDistill sec. 3.2).

    sums = Σ_views Bᵀ @ maps,   weights = Σ_views Bᵀ @ 1,   features = sums / weights, divided once at the end.

Views stream one at a time; sums are kept in the coordinates of a basis, so that memory does not grow with the number
of views or with the teacher's width.
"""

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.even_indices import evenly
from gsencoder.core.runtime.clock import Clock
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.data.splats import fingerprint
from gsencoder.fusion.basis import Moments, fit_basis, table_basis
from gsencoder.fusion.checkpoint import PartialFusion
from gsencoder.fusion.lift import Sums, map_rows, view_matrix
from gsencoder.fusion.teachers import Teacher
from gsencoder.fusion.visibility import VisibilityConfig, resolve
from gsencoder.render import BlendConfig
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
        tested: the depth maps that visibility was tested against.
        seconds: by step.
        truncation: 1 − centered cosine between teacher vectors and their projections on the basis, averaged over the
            cells of all views with each cell weighted by its distance from the mean; 0 without a basis.
    """

    features: GaussianFeatures
    views: tuple[int, ...]
    tested: tuple[str, ...]
    seconds: dict[str, float]
    truncation: float


def fuse(
    scene: Scene,
    teacher: Teacher,
    config: FuseConfig = FuseConfig(),
    *,
    basis: FeatureBasis | None = None,
    work: Path | None = None,
    track: Track = untracked,
) -> Fusion:
    """Lifts a teacher's maps onto the scene's Gaussians.

    A dense teacher is passed over twice, once to find the basis and once to lift; its maps are kept as float16 files
    in `work` between the passes, because making them again costs far more than reading them (without `work`, or for
    teachers that say they are cheap, they are made twice). Where no basis is sought, one pass does.

    Args:
        scene: with Gaussians and views.
        teacher: what to lift.
        config: knobs.
        basis: fuse in the coordinates of this basis, as scenes that are trained on together are; without it the scene
            gets one of its own where `config` asks for one.
        work: folder for maps and running sums; a run that finds its own there goes on where it stopped.
        track: wraps the loop over views to show progress.

    Raises:
        InputError: nothing to lift or to lift onto, a basis of another space, no view sees anything, or `work` holds
            another run.
    """
    if basis is not None and basis.space != teacher.space:
        raise InputError(f"fuse: the basis is of ({basis.space.describe()}), the maps of ({teacher.space.describe()})")
    if scene.gaussians is None or len(scene.gaussians) == 0:
        raise InputError(f"fuse: scene {scene.name} has no Gaussians; make some from its depth or points (seeds)")
    if scene.views is None:
        raise InputError(f"fuse: scene {scene.name} has no views to fuse from")
    if len(scene.views) == 0:
        raise InputError(f"fuse: scene {scene.name} has no views left")
    config = replace(config, visibility=resolve(config.visibility, scene.views, config.lift))
    chosen = _choose(len(scene.views), config.views)
    clock = Clock()
    kept = None
    if work is not None:
        settings = {"fuse": asdict(config), "teacher": teacher.settings(), "views": list(chosen)}
        if basis is not None:
            settings["basis"] = hashlib.sha256(basis.mean.tobytes() + basis.components.tobytes()).hexdigest()[:16]
        kept = PartialFusion(work, settings | {"scene": _identity(scene.gaussians, scene.views)})
    views, cached = scene.views, teacher if kept is None else kept.cached(teacher)

    def map_of(view: int) -> FeatureMap:
        with clock("teacher"):
            return cached.feature_map(views, view)

    if basis is not None:
        mean: np.ndarray | None = basis.mean
        truncation = 1 - float(np.sqrt(basis.energy_kept))
    else:
        basis, mean, truncation = _find_basis(teacher, map_of, chosen, config, clock, track, resumable=kept is not None)
    # Where the mean alone is missing, it is found on the way; not so in a run that may start in the middle.
    moments = Moments(teacher.space.channels, second=False) if mean is None else None
    with clock("lift"):
        columns = basis.rank if basis is not None else teacher.space.channels
        sums = Sums(len(scene.gaussians), columns, basis, teacher.table)
        done = sums.restore(kept)
    for position in track(range(done, len(chosen)), "lifting views"):
        feature_map = map_of(chosen[position])
        if moments is not None:
            _add_rows(moments, feature_map, clock)
        b = view_matrix(
            scene.gaussians,
            scene.views,
            chosen[position],
            feature_map,
            clock,
            lift=config.lift,
            visibility=config.visibility,
            config=config.blend,
        )
        with clock("lift"):
            sums.add(b, feature_map, scene.views.masks[chosen[position]] if scene.views.masks is not None else None)
        if kept is not None and kept.due():
            kept.save_sums(position + 1, sums.sums, sums.weights)
    with clock("lift"):
        features, weights = sums.finish()
    if not (weights > 0).any():
        raise InputError(f"fuse: none of {len(chosen)} views of {scene.name} sees any Gaussian; check poses and units")
    if mean is None:
        assert moments is not None
        mean = moments.mean.astype(np.float32)
    fused = GaussianFeatures(features=features, weights=weights, mean=mean, space=teacher.space, basis=basis)
    return Fusion(
        features=fused, views=chosen, tested=config.visibility.against, seconds=clock.seconds, truncation=truncation
    )


def _choose(available: int, wanted: int) -> tuple[int, ...]:
    return tuple(int(view) for view in evenly(available, wanted or available))


def _identity(gaussians: Gaussians, views: Views) -> dict[str, str]:
    """What maps and sums of one scene are told from another's by; pictures count by their names alone."""
    digest = hashlib.sha256(repr(views.names).encode("utf-8", "backslashreplace"))
    for name in ("cam_from_world", "Ks", "widths", "heights"):
        digest.update(np.ascontiguousarray(getattr(views.cameras, name)).tobytes())
    return {"gaussians": fingerprint(gaussians)[:16], "views": digest.hexdigest()[:16]}


def _find_basis(
    teacher: Teacher,
    map_of: Callable[[int], FeatureMap],
    chosen: tuple[int, ...],
    config: FuseConfig,
    clock: Clock,
    track: Track,
    *,
    resumable: bool,
) -> tuple[FeatureBasis | None, Float32[np.ndarray, " D"] | None, float]:
    """The basis, the space's mean (None: not known without a pass of its own), and what the basis costs."""
    space = teacher.space
    wanted = config.basis and space.channels > config.narrow
    if teacher.table is not None:
        mean = teacher.mean if teacher.mean is not None else teacher.table.mean(axis=0)
        if not wanted:
            return None, mean, 0.0
        basis = table_basis(teacher.table, mean, space, energy=config.table_energy)
        return basis, mean, _truncation(basis, teacher.table)
    if not wanted and (teacher.mean is not None or not resumable):
        return None, teacher.mean, 0.0
    moments = Moments(space.channels, second=wanted)
    for view in track(chosen, "finding the basis"):
        _add_rows(moments, map_of(view), clock)
    mean = teacher.mean if teacher.mean is not None else moments.mean.astype(np.float32)
    if not wanted:
        return None, mean, 0.0
    with clock("basis"):
        basis = fit_basis(moments.mean, moments.covariance(), space, energy=config.energy, max_rank=config.max_rank)
    # For cells weighted by squared distance from the mean, the mean squared cosine is exactly the energy kept.
    return basis, mean, 1 - float(np.sqrt(basis.energy_kept))


def _add_rows(moments: Moments, feature_map: FeatureMap, clock: Clock) -> None:
    rows = map_rows(feature_map)
    with clock("basis"):
        moments.add(rows[np.isfinite(rows[:, 0])])


def _truncation(basis: FeatureBasis, table: Float32[np.ndarray, "C D"]) -> float:
    centered = table - basis.mean
    inside = (centered @ basis.components.T) @ basis.components
    return 1 - float(np.sqrt((inside**2).sum() / max((centered**2).sum(), 1e-30)))
