"""A fusion within a budget: the setting is chosen on a sample of the scene, used, and measured."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from gsencoder.core.errors import InputError
from gsencoder.core.process import Device, Track, untracked
from gsencoder.core.settings import best_setting, within_seconds
from gsencoder.fusion.basis import Moments, distinct_rows
from gsencoder.fusion.checkpoint import CachedTeacher, WrappedTeacher, open_checkpoint, upright
from gsencoder.fusion.cost_model import (
    UNKNOWN_SCATTER,
    BudgetConfig,
    Measure,
    Pace,
    Predicted,
    RankErrors,
    Setting,
    all_settings,
    check_budget,
    exact_config,
    measure_drift,
    measure_scatter,
    rank_errors,
    sample_features,
    setting_weights,
    with_rank,
    within_megabytes,
)
from gsencoder.fusion.errors import FieldError, judge
from gsencoder.fusion.fuse import FuseConfig, Fusion, fuse, validate_scene
from gsencoder.fusion.lift import FeatureSums, limit_rays, resolve, view_matrix
from gsencoder.fusion.view_coverage import LatticeOf, Sight, trace_sight, view_order
from gsencoder.render.rays import Lattice, grid_lattice
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap, FeatureSpace, Gaussians, Scene, Views

FIRST_MAPS, MAPS_SHARE = 4, 8
"""The scatter of the teacher's vectors is first measured on so many views, or on one of so many if that is more."""
SAFETY = 1.5
"""Factor by which ρ is multiplied, since views are not independent of each other."""
MINIMAL_SCATTER = 1e-4
"""Lower bound of ρ: vectors that agree in a few views may differ in others."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Choice:
    """A setting that was chosen.

    Attributes:
        config: of the fusion.
        rows: numbers of its views, ascending.
        order: all views, those that are used first.
        knobs: values that were chosen, by name.
        predicted: its error.
        cost: of the fusion, in views that are blended at the exact rays.
        seconds: that are predicted; None without a budget of seconds.
        bytes: of the file of features that are predicted; None without a budget of megabytes.
        scatter: ρ of the teacher.
        drift: of the mean of its vectors.
        maps: that were made on the way, by view.
        followed: rays that were followed on the way.
        all_rays: rays of the fusion at its exact settings.
        notes: what budgets in conflict do not keep.
    """

    config: FuseConfig
    rows: tuple[int, ...]
    order: tuple[int, ...]
    knobs: Mapping[str, int | float]
    predicted: Predicted
    cost: float
    seconds: float | None
    bytes: int | None
    scatter: float
    drift: float
    maps: Mapping[int, FeatureMap]
    followed: int
    all_rays: int
    notes: tuple[str, ...]


@dataclass(slots=True, kw_only=True)
class _ProbedTeacher:
    """The maps of a teacher that were made for the choice, and what they say about it.

    Attributes:
        maps: by view.
        scatter: ρ, see `gsencoder.fusion.cost_model`.
        drift: of the mean of its vectors.
        ranks: what ranks leave out.
    """

    maps: dict[int, FeatureMap] = field(default_factory=dict)
    scatter: float = UNKNOWN_SCATTER
    drift: float = 0.0
    ranks: RankErrors = field(default_factory=RankErrors)


def choose(
    gaussians: Gaussians,
    views: Views,
    teacher: Teacher,
    base: FuseConfig,
    budget: BudgetConfig,
    *,
    map_of: Callable[[int], FeatureMap],
    measure: Measure,
    elapsed: Callable[[], float],
) -> Choice:
    """Chooses views, rays, their ends and a rank.

    Args:
        gaussians: the splat.
        views: all that there are.
        teacher: what will be lifted.
        base: options of the fusion that no budget changes.
        budget: at least one promise.
        map_of: the teacher's map of a view.
        measure: seconds of one view, asked for with a budget of seconds alone.
        elapsed: seconds since the choice began.
    """
    exact = exact_config(base)
    # Maps of a costly teacher are all used: the first one, whose cells tell where rays are, is of a view of the middle.
    spread = spread_out(len(views))
    probe = spread[0]
    probed = _ProbedTeacher(maps={probe: map_of(probe)})
    lattice_of = _lattices(views, probed.maps[probe], exact)
    visibility = resolve(base.visibility, views, base.lift)
    sight = trace_sight(gaussians, views, lattice_of, visibility, exact.blend, seed=budget.seed)
    choosing, judging = sight.halves()
    map_count = min(max(FIRST_MAPS, math.ceil(len(views) / MAPS_SHARE)), len(views))
    while True:
        for view in spread[:map_count]:
            if view not in probed.maps:
                probed.maps[view] = map_of(view)
        _measure_teacher(probed, sight, teacher, base, budget)
        first = () if teacher.cheap else spread[:map_count]
        order = view_order(choosing.weights, choosing.singles, probed.scatter, first)
        settings = all_settings(
            judging,
            order,
            probed.ranks,
            scatter=SAFETY * probed.scatter,
            drift=SAFETY * probed.drift,
            exact_stop=exact.blend.stop_transmittance,
            cheap=teacher.cheap,
            coded=teacher.table is not None,
            least=max(len(first), 1) if budget.seconds is None else 1,
        )
        chosen = best_setting(settings, budget.error)
        # More maps are made until they are half of what is needed, and never one that is not.
        if teacher.cheap or budget.error is None or chosen.views <= 2 * map_count or map_count == len(views):
            break
        map_count = min(2 * map_count, len(views))
    notes: list[str] = []
    seconds = size = None
    if budget.seconds is not None:
        of_map, lift = measure(int(order[0]))
        passes = 2 if teacher.cheap and probed.ranks.fitted else 1
        pace = Pace(map=of_map, lift=lift, passes=passes, cached=len(probed.maps), spent=elapsed())
        chosen, broken = within_seconds(settings, chosen, budget, pace.seconds)
        seconds = pace.seconds(chosen)
        notes += broken
    if budget.megabytes is not None:
        weights = setting_weights(sight, chosen.stop, exact.blend.stop_transmittance)
        basis = base.basis and teacher.space.channels > base.narrow
        chosen, size, broken = within_megabytes(
            chosen,
            _seen_share(weights[order[: chosen.views]]),
            sight,
            probed.ranks,
            teacher.space.channels,
            budget,
            basis=basis,
        )
        notes += broken
    return _choice(chosen, base, teacher, probed, sight, order, seconds, size, notes)


def _choice(
    chosen: Setting,
    base: FuseConfig,
    teacher: Teacher,
    probed: _ProbedTeacher,
    sight: Sight,
    order: np.ndarray,
    seconds: float | None,
    size: int | None,
    notes: list[str],
) -> Choice:
    rays = exact_config(base).blend.rays_per_patch
    blend = replace(base.blend, stop_transmittance=chosen.stop, rays_per_patch=rays)
    config = with_rank(replace(base, blend=blend), chosen.rank, probed.ranks, teacher)
    knobs: dict[str, int | float] = {"views": chosen.views, "stop_transmittance": chosen.stop}
    if chosen.rank or probed.ranks.fitted:
        knobs["rank"] = chosen.rank or probed.ranks.full
    return Choice(
        config=config,
        rows=tuple(sorted(order[: chosen.views].tolist())),
        order=tuple(order.tolist()),
        knobs=knobs,
        predicted=Predicted(error=chosen.error, deviation=chosen.deviation),
        cost=chosen.cost,
        seconds=seconds,
        bytes=size,
        scatter=probed.scatter,
        drift=probed.drift,
        maps=probed.maps,
        followed=sight.followed,
        all_rays=sight.all_rays,
        notes=tuple(notes),
    )


def spread_out(count: int) -> tuple[int, ...]:
    """Numbers of views, the first so many of which are spread over all of them however many that are: the middle one,
    those at a quarter and three quarters, and so on."""
    order, parts = dict.fromkeys([count // 2]), 2
    while parts < 2 * count:
        parts *= 2
        order.update(dict.fromkeys(part * count // parts for part in range(1, parts, 2)))
    return tuple({**order, **dict.fromkeys(range(count))})


def _lattices(views: Views, probe: FeatureMap, exact: FuseConfig) -> LatticeOf:
    """The rays of the exact settings in each view, by the map of one."""
    rays = limit_rays(exact.blend, probe).rays_per_patch
    lattice = grid_lattice(probe.grid_from_image, probe.width, probe.height, rays)
    cell_x, cell_y = lattice.dx * lattice.side, lattice.dy * lattice.side

    def of(view: int) -> Lattice:
        width, height = int(views.cameras.widths[view]), int(views.cameras.heights[view])
        columns, lines = width / cell_x, height / cell_y
        if abs(columns - lattice.width) < 1 and abs(lines - lattice.height) < 1:
            return lattice
        # A picture of another size: cells of as many pixels.
        return replace(lattice, width=max(1, round(columns)), height=max(1, round(lines)))

    return of


def _measure_teacher(
    probed: _ProbedTeacher, sight: Sight, teacher: Teacher, base: FuseConfig, budget: BudgetConfig
) -> None:
    """Measures ρ, and what ranks leave out, on the maps that were made."""
    fits = teacher.table is None and (budget.megabytes is not None or teacher.space.channels > base.narrow)
    moments = Moments(teacher.space.channels, second=fits)
    means = []
    for _, feature_map in sorted(probed.maps.items()):
        rows = distinct_rows(feature_map)
        moments.add(rows)
        if len(rows):
            means.append(rows.mean(axis=0, dtype=np.float64))
    if moments.count == 0:
        return
    features = sample_features(sight, probed.maps)
    stated_mean = teacher.table.mean(axis=0) if teacher.mean is None and teacher.table is not None else teacher.mean
    mean = np.asarray(moments.mean if stated_mean is None else stated_mean, np.float64)
    probed.scatter = max(measure_scatter(features, mean), MINIMAL_SCATTER)
    probed.drift = measure_drift(features, np.stack(means)) if stated_mean is None else 0.0
    probed.ranks = rank_errors(teacher, moments, features, mean, base, needed=budget.megabytes is not None)


def _seen_share(weights: np.ndarray) -> float:
    """Share of the sample that has any weight."""
    return float((weights > 0).any(axis=0).mean()) if weights.size else 1.0


DEPTH_CACHE_BYTES = 1 << 28
"""Depth maps that the choice reads stay in memory up to this size, for the fusion."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetFusion:
    """A fusion within a budget.

    Attributes:
        fusion: the features.
        choice: the setting, and what was predicted of it.
        choosing: seconds of the choice.
        seconds: from its beginning to the features.
        scene: with the views that the fusion read, some of whose depth maps are in memory.
        teacher: whose maps of some views are, too.
    """

    fusion: Fusion
    choice: Choice
    choosing: float
    seconds: float
    scene: Scene
    teacher: Teacher


def fuse_within(
    scene: Scene,
    teacher: Teacher,
    config: FuseConfig,
    budget: BudgetConfig,
    *,
    work: Path | None = None,
    device: Device | torch.device = "auto",
    track: Track = untracked,
    clock: Callable[[], float] = time.perf_counter,
) -> BudgetFusion:
    """Lifts a teacher's maps by the setting that keeps a budget.

    Args:
        scene: with Gaussians and views.
        teacher: whose maps are lifted.
        config: options that the budget does not choose.
        budget: at least one promise.
        work: folder for the maps of a costly teacher, which are then made once, in interrupted runs too.
        device: see `fuse`.
        track: see `fuse`.
        clock: seconds.

    Raises:
        InputError: no budget, one that cannot be combined with the options, megabytes into which not even one
            coordinate of each Gaussian fits, or what `fuse` refuses.
    """
    if not budget.promised:
        raise InputError("budget: expected budget.error=, budget.seconds= or budget.megabytes=, got none of them")
    check_budget(budget, config)
    start, teacher = clock(), upright(teacher)
    gaussians, views = validate_scene(scene)
    if views.depths is not None:
        views = replace(views, depths=_CachedDepths(views.depths))
    if work is not None and not teacher.cheap:
        settings = {"budget": "maps", "lift": config.lift}
        teacher = open_checkpoint(work, settings, teacher, gaussians, views, range(len(views)), None).cached(teacher)
    maps: dict[int, FeatureMap] = {}

    def map_of(view: int) -> FeatureMap:
        maps[view] = teacher.feature_map(views, view)
        return maps[view]

    def measure(view: int) -> tuple[float, float]:
        visibility = resolve(config.visibility, views, config.lift)
        blend = exact_config(config).blend
        begun = clock()
        # The time of a map is measured even where it is in memory.
        maker = teacher.teacher if isinstance(teacher, CachedTeacher) else teacher
        feature_map = maker.feature_map(views, view) if view in maps else map_of(view)
        between = clock()
        matrix = view_matrix(gaussians, views, view, feature_map, lift=config.lift, visibility=visibility, config=blend)
        ones = _one_channel(feature_map)
        FeatureSums(len(gaussians), ones.space, None, None).add(matrix, ones, None)
        return between - begun, clock() - between

    choice = choose(
        gaussians,
        views,
        teacher,
        config,
        budget,
        map_of=map_of,
        measure=measure,
        elapsed=lambda: clock() - start,
    )
    choice_end = clock()
    scene = replace(scene, views=views)
    cached = _CachedMaps(teacher, maps)
    fusion = fuse(scene, cached, choice.config, rows=choice.rows, device=device, track=track)
    return BudgetFusion(
        fusion=fusion,
        choice=choice,
        choosing=choice_end - start,
        seconds=clock() - start,
        scene=scene,
        teacher=cached,
    )


def _one_channel(feature_map: FeatureMap) -> FeatureMap:
    """A map of the same grid with one channel."""
    space = FeatureSpace(name="ones", channels=1)
    ones = np.ones((feature_map.height, feature_map.width, 1), np.float32)
    return FeatureMap(features=ones, grid_from_image=feature_map.grid_from_image, space=space)


def realised_error(
    fused: BudgetFusion,
    config: FuseConfig,
    *,
    seed: int = 0,
    device: Device | torch.device = "auto",
    track: Track = untracked,
) -> FieldError:
    """The error of the features against those of the exact settings, on a tenth of the Gaussians that these see, drawn
    now. Maps of views that the setting left out are made for it."""
    exact = fuse(fused.scene, fused.teacher, exact_config(config), device=device, track=track).features
    return judge(fused.fusion.features, exact, seed=seed)


class _CachedDepths(Sequence[Float32[np.ndarray, "_ _"]]):
    """Depth maps that are read once, up to a limit of memory."""

    def __init__(self, depths: Sequence[Float32[np.ndarray, "_ _"]]) -> None:
        self._depths, self._read, self._bytes = depths, dict[int, np.ndarray](), 0

    def __len__(self) -> int:
        return len(self._depths)

    def __getitem__(self, index: Any) -> Any:
        if index in self._read:
            return self._read[index]
        depth = self._depths[index]
        if self._bytes + depth.nbytes <= DEPTH_CACHE_BYTES:
            self._read[index] = depth
            self._bytes += depth.nbytes
        return depth


class _CachedMaps(WrappedTeacher):
    """A teacher some of whose maps are in memory."""

    def __init__(self, teacher: Teacher, maps: dict[int, FeatureMap]) -> None:
        super().__init__(teacher)
        self._maps = maps

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The map of a view, from memory where the choice made it."""
        return self._maps[view] if view in self._maps else self.teacher.feature_map(views, view)
