"""The choice of a setting of fusion that keeps a budget, on a sample of the scene."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from gsencoder.core.settings import best_setting, within_seconds
from gsencoder.fusion.basis import Moments
from gsencoder.fusion.budget.config import BudgetConfig, exact_config
from gsencoder.fusion.budget.limits import Measure, Pace, within_megabytes
from gsencoder.fusion.budget.model import (
    UNKNOWN_SCATTER,
    Predicted,
    measure_drift,
    measure_scatter,
    sample_features,
    setting_weights,
)
from gsencoder.fusion.budget.rank import RankErrors, rank_errors, with_rank
from gsencoder.fusion.budget.settings import Setting, all_settings
from gsencoder.fusion.coverage.order import view_order
from gsencoder.fusion.coverage.sight import LatticeOf, Sight, trace_sight
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.lift import capped, distinct_rows
from gsencoder.fusion.visibility import resolve
from gsencoder.render.rays import Lattice, grid_lattice
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap, Gaussians, Views

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
        scatter: ρ, see `gsencoder.fusion.budget.model`.
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
    rays = capped(exact.blend, probe).rays_per_patch
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
