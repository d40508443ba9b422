"""A fusion within a budget: how many views, and how many coordinates are written.

The error of leaving out views has two parts. What they do not show is counted on a few rays of the views. What they
show is a mean Σ w·f / Σ w over fewer views; like any mean of n of V samples it differs from that over all by
τ (1/n − 1/V), and τ is measured by leaving out maps that were made.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.sparse import csr_array

from gsencoder.core.arrays import even_indices
from gsencoder.core.budget import (
    Budget,
    Choice,
    Estimate,
    check_any_limit,
    choose,
    error_bound,
    reject_options_set_by_budget,
)
from gsencoder.core.errors import InputError
from gsencoder.core.process import Device, Track, untracked
from gsencoder.core.settings import option
from gsencoder.core.threads import parallel
from gsencoder.fusion.basis import FieldError, distinct_rows, judge, row_cosines
from gsencoder.fusion.checkpoint import CachedTeacher, WrappedTeacher, cached_maps, upright
from gsencoder.fusion.folder import reduce_to_fit
from gsencoder.fusion.fuse import FuseConfig, Fusion, fuse, validate_scene
from gsencoder.fusion.lift import SAMPLE, VisibilityConfig, coverage_order, sample_view
from gsencoder.render import BlendConfig
from gsencoder.render.blend_cpu import Lattice
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap, Gaussians, Scene, Views

OPTIONS_SET_BY_BUDGET = (
    "views",
    "view_share",
    "view_choice",
    "basis",
    "max_rank",
    "energy",
    "blend.rays_per_patch",
    "blend.stop_transmittance",
    "blend.min_weight",
)
ALL_VIEWS, VIEWS_SHARE = 24, 2
"""The smallest number of views that are looked at on a few rays, and of how many one is, if that is more. A scene of
fewer views and a cheap teacher is fused exactly: looking at a view costs half as much as fusing it."""
FIRST_MAPS, MAPS_SHARE = 4, 4
"""The number of a costly teacher's maps that are made to choose by: one of `MAPS_SHARE` views, and at least
`FIRST_MAPS`; all of them are lifted."""
CHEAP_MAPS = 8
"""The same of a cheap teacher, whose maps are made again."""
DIRECTIONS = 1024
"""Gaussians on which means over maps are compared."""
LEFT_OUT = 4
"""Maps that are left out one at a time."""
UNKNOWN_TURN = 1.0
"""τ where no Gaussian of the sample is seen twice: whatever is not measured counts in full."""
PARTS = 16
"""Parts of the sample, by neighborhoods, whose scatter says how far an error is known."""
SAFETY = 2.0
"""Factor of a predicted error, since views are not independent of each other."""
BASIS_SHARE = 0.25
"""Share of the limit of error that is left to the basis of a dense teacher."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionBudget(Budget):
    """What a fusion may cost, or must reach. Where they conflict, the one that stands first here wins.

    A budget of error alone takes the cheapest setting that keeps it; budgets of seconds and megabytes without one take
    the most exact setting that keeps them.
    """

    error: float | None = option(
        None,
        "largest mean of 1 − centered cosine to the features of preset=exact, over all Gaussians that it "
        "sees; one that only it sees counts as 1",
    )
    seconds: float | None = option(None, "largest time from the choice of the setting to the features")
    megabytes: float | None = option(None, "largest size of the file of features, in units of 1,000,000 bytes")
    check: bool = option(True, "measure the error afterwards, which fuses at preset=exact; false = leave it unmeasured")


def check_budget(budget: FusionBudget, config: FuseConfig, *, basis: bool = False) -> None:
    """Refuses what a budget cannot be combined with.

    Args:
        basis: whether features are fused in a basis that was given.
    """
    if not budget.limits:
        return
    reject_options_set_by_budget(budget, config, FuseConfig(), OPTIONS_SET_BY_BUDGET, "fusion")
    if config.lift != "blend":
        raise InputError(
            f"fusion.lift={config.lift}: {budget.options} is for lift=blend alone; leave one of the two out"
        )
    if "rendered" in config.visibility.against:
        raise InputError(
            f"fusion.visibility.against=rendered: {budget.options} knows sensor depth alone; test against sensor or "
            "nothing, or leave the budget out"
        )
    if basis:
        raise InputError(
            f"basis=: {budget.options} chooses a rank, and a basis that is given has one; leave one of the two out"
        )


def exact_config(config: FuseConfig) -> FuseConfig:
    """The fusion that errors are measured against: the values of `preset=exact`."""
    blend = replace(config.blend, rays_per_patch=196, stop_transmittance=1e-6, min_weight=0.0)
    return replace(config, blend=blend, energy=1.0, max_rank=0, basis=True, views=0, view_share=1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetFusion:
    """A fusion within a budget.

    Attributes:
        fusion: the features, with as few coordinates as a limit of megabytes asks for.
        choosing: seconds of the choice.
        seconds: from its beginning to the features.
        teacher: with the maps of a costly one that the choice made.
        notes: warnings about limits that are expected to be broken.
    """

    fusion: Fusion
    choice: Choice[int]
    predicted: Mapping[str, float]
    choosing: float
    seconds: float
    teacher: "RecordedMaps"
    notes: tuple[str, ...]


def fuse_within(
    scene: Scene,
    teacher: Teacher,
    config: FuseConfig,
    budget: FusionBudget,
    *,
    header: Mapping[str, Any] = {},
    work: Path | None = None,
    device: Device | torch.device = "auto",
    track: Track = untracked,
    clock: Callable[[], float] = time.perf_counter,
) -> BudgetFusion:
    """Lifts a teacher's maps by the setting that keeps a budget.

    Args:
        config: options that the budget does not choose.
        header: the settings that are written with the features, which take bytes.
        work: folder for the maps of a costly teacher, which are then made once, in interrupted runs too.
    """
    check_any_limit(budget)
    check_budget(budget, config)
    start, teacher = clock(), upright(teacher)
    gaussians, views = validate_scene(scene)
    exact = exact_config(config)
    if work is not None and not teacher.cheap:
        settings = {"budget": "maps", "lift": config.lift}
        teacher = cached_maps(work, settings, teacher, gaussians, views, range(len(views)), None)
    maps, count = RecordedMaps(teacher), len(views)
    order, sampled = bisection_order(count), None
    if budget.error is not None and not (teacher.cheap and count <= ALL_VIEWS):
        sampled = sample_views(gaussians, views, maps, config.visibility, exact.blend)
        order = sampled.order

    @cache
    def seconds_of_view() -> float:
        """Seconds of fusing one view alone."""
        begun = clock()
        uncached = teacher.teacher if isinstance(teacher, CachedTeacher) else teacher
        with suppress(InputError):  # It sees nothing, which is known at the end.
            fuse(scene, uncached, exact, rows=order[:1], device=device)
        return clock() - begun

    def measure(number: int) -> Estimate:
        error = bound = seconds = math.nan
        if number == count:
            error = bound = 0.0
        elif sampled is not None:
            error, bound = sampled.error(number)
        if budget.seconds is not None:
            # Of views whose maps are kept it is on the safe side.
            seconds = seconds_of_view() * number + clock() - start
        return Estimate(error=error, bound=bound + BASIS_SHARE * (budget.error or 0), seconds=seconds)

    of_views = replace(budget, megabytes=None)
    choice = Choice(setting=count, estimate=Estimate())
    if of_views.limits:
        # All maps of a costly teacher that were made are used.
        least = 1 if sampled is None or teacher.cheap else sampled.maps
        choice = choose(range(least, count + 1), measure, of_views)
    choosing = clock() - start
    chosen, rows = exact, sorted(order[: choice.setting])
    if budget.error is not None and choice.setting < count:
        # What is kept of the energy of vectors about their mean is about 1 − 2 (1 − cosine).
        chosen = replace(exact, energy=1 - BASIS_SHARE * budget.error)
    fusion = fuse(scene, maps, chosen, rows=rows, device=device, track=track)
    predicted = {"error": choice.estimate.error, "seconds": choice.estimate.seconds}
    notes = choice.notes
    if budget.megabytes is not None:
        name, spare = fusion.features.space.name, (budget.error or 0.0) - choice.estimate.bound
        reduced = reduce_to_fit({name: fusion.features}, budget, header, error=max(spare, 0.0))
        fusion = replace(fusion, features=reduced.features[name])
        predicted |= {"megabytes": reduced.megabytes, "error": choice.estimate.error + reduced.error}
        if reduced.megabytes > budget.megabytes:
            notes += (budget.conflict("megabytes", reduced.megabytes),)
    return BudgetFusion(
        fusion=fusion,
        choice=choice,
        predicted={name: value for name, value in predicted.items() if math.isfinite(value)},
        choosing=choosing,
        seconds=clock() - start,
        teacher=maps,
        notes=notes,
    )


class RecordedMaps(WrappedTeacher):
    """A teacher whose maps are kept in memory where it is costly, while a setting is chosen."""

    def __init__(self, teacher: Teacher) -> None:
        super().__init__(teacher)
        self.maps = dict[int, FeatureMap]()

    def keep(self, views: Views, view: int) -> FeatureMap:
        """The map of a view, which is not made again."""
        feature_map = self.feature_map(views, view)
        if not self.cheap:
            self.maps[view] = feature_map
        return feature_map

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        return self.maps[view] if view in self.maps else self.teacher.feature_map(views, view)


def bisection_order(count: int) -> tuple[int, ...]:
    """Numbers of views, the first of which are spread over all of them however many are taken: the middle one, those at
    a quarter and three quarters, and so on."""
    order, parts = dict.fromkeys([count // 2]), 2
    while parts < 2 * count:
        parts *= 2
        order.update(dict.fromkeys(part * count // parts for part in range(1, parts, 2)))
    return tuple({**order, **dict.fromkeys(range(count))})


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampledViews:
    """What views show on a few rays, and the error of leaving some of them out.

    Attributes:
        order: of all views, those that are used first.
        maps: how many maps of a costly teacher were made, of the views that the order begins with.
        errors: of Gaussians of the sample with the first 1, 2, … of the views that were looked at; 1 where these do
            not show one.
    """

    order: tuple[int, ...]
    maps: int
    errors: Float64[np.ndarray, "S n"]
    beyond: float
    views: int

    def error(self, number: int) -> tuple[float, float]:
        """The error with the first `number` views of the order, and what it stays below."""
        if not self.errors.size:
            return 0.0, 0.0
        share = number / self.views
        errors = self.errors[max(int(share * len(self.errors)), 1) - 1]
        parts = [float(part.mean()) for part in np.array_split(errors, PARTS) if len(part)]
        beyond = self.beyond * (1 - share)
        return float(errors.mean()) + beyond, error_bound(parts, SAFETY) + SAFETY * beyond


def sample_views(
    gaussians: Gaussians, views: Views, teacher: RecordedMaps, visibility: VisibilityConfig, config: BlendConfig
) -> SampledViews:
    """Looks at views on a few rays, and makes some maps."""
    count, spread = len(views), bisection_order(len(views))
    looked_at = spread[: max(ALL_VIEWS, math.ceil(count / VIEWS_SHARE))]
    maps = min(CHEAP_MAPS if teacher.cheap else max(FIRST_MAPS, math.ceil(count / MAPS_SHARE)), len(looked_at))
    sample, compared = even_indices(len(gaussians), SAMPLE), even_indices(len(gaussians), DIRECTIONS)

    def look(number: int) -> tuple[np.ndarray, ...]:
        """Which Gaussians of the sample a view shows; of maps also sums and weights of vectors, and their mean."""
        view = looked_at[number]
        b = sample_view(gaussians, views, view, visibility, config)
        crow, columns, weight = b.crow.numpy(), b.col.numpy(), b.weight.numpy()
        of_map: tuple[np.ndarray, ...] = ()
        if teacher.cheap or number < maps:
            feature_map = teacher.keep(views, view)
            at_rays = map_at_rays(feature_map, b.lattice)
            has_vector = at_rays.has_vector.ravel()
            weight = weight * np.repeat(has_vector, np.diff(crow))
            if number < maps:
                vectors = np.where(has_vector[:, None], at_rays.rows(), np.float32(0))
                matrix = csr_array((weight, columns, crow), shape=(b.rows, b.gaussians))[:, compared].T
                distinct = distinct_rows(feature_map)
                mean = distinct.mean(axis=0) if len(distinct) else np.zeros(vectors.shape[1])
                of_map = matrix @ vectors, matrix.sum(axis=1), mean
        return (np.bincount(columns, weight, len(gaussians))[sample] > 0, *of_map)

    # A costly teacher has threads of its own.
    numbers = range(len(looked_at))
    looks = parallel(look, numbers) if teacher.cheap else [look(number) for number in numbers]
    sums, weights, means = (np.stack([each[kind] for each in looks[:maps]]) for kind in (1, 2, 3))
    mean = teacher.table.mean(axis=0) if teacher.mean is None and teacher.table is not None else teacher.mean
    turn = mean_turn(sums, weights, means if mean is None else np.stack([mean] * maps), looked_at)
    # Views that are chosen by a sample show more of it than of the scene: they are judged by another one.
    by_view = np.stack([each[0] for each in looks])
    choosing, judging = (by_view[:, ::2], by_view[:, 1::2]) if by_view.shape[1] > 2 * PARTS else (by_view, by_view)
    order = coverage_order(choosing, () if teacher.cheap else range(maps))
    counts = judging[order][:, judging.any(axis=0)].cumsum(axis=0)
    turned = turn * (1 / np.maximum(counts, 1) - 1 / counts[-1]) * len(looked_at) / count
    others = [view for view in spread if view not in looked_at]
    # Views that were not looked at come evenly between those that were.
    places = {view: (place + 1) / len(looked_at) for place, view in enumerate(np.array(looked_at)[order].tolist())}
    places |= {view: (place + 1) / len(others) for place, view in enumerate(others)}
    return SampledViews(
        order=tuple(sorted(places, key=lambda view: places[view])),
        maps=maps,
        errors=np.where(counts > 0, np.minimum(turned, 1), 1.0),
        beyond=float((counts[-1] == 1).mean()) * len(others) / len(looked_at) if counts.size else 0.0,
        views=count,
    )


def mean_turn(
    sums: Float[np.ndarray, "M n D"],
    weights: Float[np.ndarray, "M n"],
    means: Float[np.ndarray, "M D"],
    views: Sequence[int],
) -> float:
    """τ: how far centered means over k of K views turn from those over all, 1 − cosine, per 1/k − 1/K. The larger of
    two counts: single views are left out, and each half of a recording, since neighbors are alike.

    Args:
        sums: weighted sums of the vectors that each map shows at each Gaussian.
        means: of the vectors of each map.
    """
    maps, all_counts, all_weights = len(sums), (weights > 0).sum(axis=0), weights.sum(axis=0)
    total = sums.sum(axis=0, dtype=np.float64)
    rank = np.argsort(np.argsort(views[:maps]))
    halves, singles = [rank < maps // 2, rank >= maps // 2], [rank != left for left in even_indices(maps, LEFT_OUT)]
    turns = []
    for subsets in (halves, singles):
        turned = change = 0.0
        for subset in subsets:
            counts, part = (weights[subset] > 0).sum(axis=0), weights[subset].sum(axis=0)
            rows = np.flatnonzero((counts > 0) & (counts < all_counts))
            if len(rows):
                some = sums[subset][:, rows].sum(axis=0, dtype=np.float64) / part[rows, None] - means[subset].mean(
                    axis=0
                )
                every = total[rows] / all_weights[rows, None] - means.mean(axis=0)
                turned += float((1 - row_cosines(some, every)).sum())
                change += float((1 / counts[rows] - 1 / all_counts[rows]).sum())
        turns.append(turned / change if change else UNKNOWN_TURN)
    return max(turns)


def map_at_rays(feature_map: FeatureMap, lattice: Lattice) -> FeatureMap:
    """What a map shows where single rays meet it; nothing outside."""
    affine = feature_map.grid_from_image
    x = affine[0, 0] * (lattice.x0 + lattice.dx * np.arange(lattice.width)) + affine[0, 2]
    y = affine[1, 1] * (lattice.y0 + lattice.dy * np.arange(lattice.height)) + affine[1, 2]
    column, line = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    height, width = feature_map.height, feature_map.width
    outside = ((line < 0) | (line >= height))[:, None] | (column < 0) | (column >= width)
    cells = np.ix_(line.clip(0, height - 1), column.clip(0, width - 1))
    nothing = {"features": np.nan, "codes": -1, "shares": 0}
    forms = {name: getattr(feature_map, name)[cells] for name in nothing if getattr(feature_map, name) is not None}
    for name, values in forms.items():
        values[outside] = nothing[name]
    return replace(feature_map, **forms)


def realised_error(
    fused: BudgetFusion,
    scene: Scene,
    config: FuseConfig,
    *,
    device: Device | torch.device = "auto",
    track: Track = untracked,
) -> FieldError:
    """The error of the features against those of the exact settings, on a tenth of the Gaussians that these see, drawn
    now. Maps of views that the setting left out are made for it."""
    exact = fuse(scene, fused.teacher, exact_config(config), device=device, track=track).features
    return judge(fused.fusion.features, exact)
