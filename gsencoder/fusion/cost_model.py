"""The cost and the error of settings of a fusion, predicted from a sample of the scene.

The error of a setting, predicted from what views see of a sample and from how much the teacher's vectors vary.

A Gaussian's feature is a mean Σ w·f / Σ w over views. If its vectors f scatter about a common one, independently from
view to view, with a mean squared distance σ² about it, then the means with normalized weights a (the setting's) and b
(those of all views at the exact settings) differ by

    E |Δ|² = σ² c,   c = Σ_v (a_v − b_v)²,   and   1 − cosine ≈ ρ c   with   ρ = σ² / 2|f|²  (across f).

c is geometry. ρ is measured on a few views: leave some out, and see how far the mean turns.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.settings import MEGABYTE, Budget, check_governed
from gsencoder.core.threads import kernel
from gsencoder.fusion.basis import Moments
from gsencoder.fusion.errors import row_cosines
from gsencoder.fusion.fuse import FuseConfig
from gsencoder.fusion.view_coverage import Sight
from gsencoder.teachers.base import Teacher
from gsencoder.types import FeatureMap

GOVERNED = (
    "views",
    "view_share",
    "view_choice",
    "basis",
    "max_rank",
    "energy",
    "table_energy",
    "blend.rays_per_patch",
    "blend.stop_transmittance",
    "blend.min_weight",
)
"""The options of fusion that a budget sets, by key."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BudgetConfig(Budget):
    """What a fusion may cost, or must reach. Where they conflict, the one that stands first here wins.

    A budget of error alone takes the cheapest setting that keeps it; budgets of seconds and megabytes without one take
    the most exact setting that keeps them.
    """

    error: float | None = field(
        default=None,
        metadata={
            "help": "largest mean of 1 − centered cosine to the features of preset=exact, over all Gaussians that it "
            "sees; one that only it sees counts as 1"
        },
    )
    seconds: float | None = field(
        default=None, metadata={"help": "largest time from the choice of the setting to the features"}
    )
    megabytes: float | None = field(
        default=None, metadata={"help": "largest size of the file of features, in units of 1,000,000 bytes"}
    )
    check: bool = field(
        default=True,
        metadata={"help": "measure the error afterwards, which fuses at preset=exact; false = leave it unmeasured"},
    )
    seed: int = field(default=0, metadata={"help": "of the sample of Gaussians on which the setting is chosen"})


def check_budget(budget: BudgetConfig, config: FuseConfig, *, basis: bool = False) -> None:
    """Refuses what a budget cannot be combined with.

    Args:
        budget: any of its promises.
        config: the options of the fusion.
        basis: whether features are fused in a basis that was given.

    Raises:
        InputError: an option that the budget chooses is set, or a fusion that no sample of rays stands for.
    """
    if not budget.promised:
        return
    names = budget.names
    check_governed(budget, config, FuseConfig(), GOVERNED, "fusion")
    if config.lift != "blend":
        raise InputError(f"fusion.lift={config.lift}: {names} is for lift=blend alone; leave one of the two out")
    if "rendered" in config.visibility.against:
        raise InputError(
            f"fusion.visibility.against=rendered: {names} knows sensor depth alone; test against sensor or nothing, or "
            "leave the budget out"
        )
    if basis:
        raise InputError(f"basis=: {names} chooses a rank, and a basis that is given has one; leave one of the two out")


def exact_config(config: FuseConfig) -> FuseConfig:
    """The fusion that errors are measured against: the values of `preset=exact`."""
    blend = replace(config.blend, rays_per_patch=196, stop_transmittance=1e-6, min_weight=0.0)
    return replace(config, blend=blend, energy=1.0, table_energy=1.0, max_rank=0, basis=True, views=0, view_share=1.0)


UNKNOWN_SCATTER = 1.0
"""ρ where no Gaussian of the sample is seen twice: whatever is not measured counts in full."""
NEGLIGIBLE_STOP = 1e-4
"""Rays that end at no more of their light than this leave out next to nothing, whatever a sample says."""
SMALL_CHANGE = 0.1
"""ρ is also measured where c is at most this: cosines of vectors that are turned far grow more slowly than c."""
TINY = 1e-30


@dataclass(frozen=True, slots=True, kw_only=True)
class Predicted:
    """A predicted error.

    Attributes:
        error: mean over the Gaussians that the exact settings see.
        deviation: its standard error, from the size of the sample.
    """

    error: float
    deviation: float


def setting_weights(sight: Sight, stop: float, exact_stop: float) -> Float32[np.ndarray, "V n"]:
    """The blending weights of the sample where rays end at `stop`: of those that were followed to a Gaussian, the ones
    count that still reach it."""
    if stop <= exact_stop:
        return np.where(sight.remains > exact_stop, sight.weights, np.float32(0))
    weights, m = sight.weights.copy(), len(sight.groups)
    for view, rays in enumerate(sight.rays):
        totals = np.bincount(rays.owners, rays.weights, m)
        reached = np.bincount(rays.owners, np.where(rays.remains > stop, rays.weights, 0), m)
        weights[view, sight.singles :] *= reached / np.maximum(totals, TINY)
    return weights


@kernel
@no_type_check
def _curve(order, setting, exact, scatter, out):
    """out[k, g]: the predicted error of each Gaussian with the first k + 1 views; NaN where the exact settings see
    nothing."""
    count, n = exact.shape
    for g in range(n):
        total, squares = 0.0, 0.0
        for v in range(count):
            x = np.float64(exact[v, g])
            total += x
            squares += x * x
        s, q, mixed, reachable = 0.0, 0.0, 0.0, 0.0
        for k in range(len(order)):
            if total <= 0:
                out[k, g] = np.nan
                continue
            x = np.float64(setting[order[k], g])
            s += x
            q += x * x
            mixed += x * np.float64(exact[order[k], g])
            reachable += np.float64(exact[order[k], g])
            out[k, g] = 1.0
            if s > 0:
                c = q / (s * s) - 2 * mixed / (s * total) + squares / (total * total)
                # The share of the weight that is lost within the views scatters like what is left.
                lost = 1 - s / reachable
                out[k, g] = min(1.0, scatter * (max(c, 0.0) + 2 * lost * lost))


def predict_curve(
    sight: Sight,
    order: Int64[np.ndarray, " V"],
    *,
    stop: float,
    exact_stop: float,
    scatter: float,
    drift: float = 0.0,
) -> list[Predicted]:
    """The error with the first 1, 2, … views of an order.

    Single Gaussians tell which share no view sees, were there nothing in front of them; the groups, to which rays were
    followed, what that leaves out, and how the features of those that are seen differ. The mean of the space, which
    centered cosines take off, adds `drift` (`measure_drift`) times 1/n − 1/V with n of V views.
    """
    exact, setting = setting_weights(sight, exact_stop, exact_stop), setting_weights(sight, stop, exact_stop)
    errors = np.empty((len(order), exact.shape[1]), np.float32)
    _curve(order, setting, exact, scatter, errors)
    n = sight.singles
    single = np.where(np.isnan(errors[:, :n]), np.nan, errors[:, :n] >= 1) if n else errors[:, :0]
    alone = np.empty_like(errors[:, n:])
    _curve(order, sight.areas[:, n:], sight.areas[:, n:], 0.0, alone)
    beyond = errors[:, n:] - alone
    numbers = sight.groups
    # What so many groups show nothing of may still be in the rest of the scene.
    unknown = 1 / max(len(np.unique(numbers)), 1) ** 2 if stop > NEGLIGIBLE_STOP else 0.0
    for k in range(len(order)):
        beyond[k] += np.where(errors[k, n:] < 1, drift * (1 / (k + 1) - 1 / len(order)), 0)
    return [_mean(single[k], beyond[k], numbers, sight, unknown) for k in range(len(order))]


def _mean(single: np.ndarray, beyond: np.ndarray, numbers: np.ndarray, sight: Sight, unknown: float) -> Predicted:
    seen, of_group = single[np.isfinite(single)], np.isfinite(beyond)
    error, variance = 0.0, 0.0
    if len(seen):
        error += float(seen.mean())
        left = 1 - len(single) / max(sight.gaussians, 1)
        variance += max(error * (1 - error), 1 / len(seen)) / len(seen) * left
    if of_group.any():
        error += float(beyond[of_group].mean())
        counts = np.bincount(numbers[of_group])
        means = np.bincount(numbers[of_group], beyond[of_group]) / np.maximum(counts, 1)
        means = means[counts > 0]
        variance += float(means.var()) / len(means)
    elif not len(seen):
        return Predicted(error=0.0, deviation=0.0)
    return Predicted(error=min(max(error, 0.0), 1.0), deviation=float(np.sqrt(variance)) + unknown)


def rows_at(feature_map: FeatureMap, rows: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n D"]:
    """The vectors of some cells of a map; NaN where a cell has none."""
    if feature_map.features is not None:
        return feature_map.features.reshape(-1, feature_map.space.channels)[rows].astype(np.float64)
    assert feature_map.table is not None
    table = feature_map.table.astype(np.float64)
    if feature_map.codes is not None:
        codes = feature_map.codes.ravel()[rows]
        return np.where((codes >= 0)[:, None], table[np.maximum(codes, 0)] if len(table) else np.nan, np.nan)
    assert feature_map.shares is not None
    shares = feature_map.shares.reshape(-1, len(table))[rows].astype(np.float64)
    total = shares.sum(axis=1, keepdims=True)
    return shares @ table / np.where(total > 0, total, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SampleFeatures:
    """What some views show at the Gaussians of the groups.

    Attributes:
        vectors: of each of these views and each Gaussian; 0 where it is not seen.
        weights: blending weights; 0 where it is not seen.
    """

    vectors: Float64[np.ndarray, "M m D"]
    weights: Float64[np.ndarray, "M m"]

    def fused(self) -> tuple[Float64[np.ndarray, "m D"], Bool[np.ndarray, " m"]]:
        """Their weighted means, and which Gaussians have one."""
        total = self.weights.sum(axis=0)
        sums = np.einsum("vm,vmd->md", self.weights, self.vectors)
        return sums / np.maximum(total, TINY)[:, None], total > 0


def sample_features(sight: Sight, maps: Mapping[int, FeatureMap]) -> SampleFeatures:
    """Reads maps where the rays to the Gaussians of the groups meet them."""
    m = len(sight.groups)
    vectors, weights = [], []
    for view, feature_map in sorted(maps.items()):
        rays = sight.rays[view]
        cells = rows_at(feature_map, rays.rows)
        weight = np.where(np.isfinite(cells[:, 0]), rays.weights, 0).astype(np.float64)
        total = np.bincount(rays.owners, weight, m)
        sums = np.zeros((m, cells.shape[1]))
        np.add.at(sums, rays.owners, np.where(weight[:, None] > 0, cells, 0) * weight[:, None])
        vectors.append(sums / np.maximum(total, TINY)[:, None])
        weights.append(np.where(total > 0, sight.weights[view, sight.singles :], 0))
    return SampleFeatures(vectors=np.stack(vectors), weights=np.stack(weights).astype(np.float64))


def measure_scatter(features: SampleFeatures, mean: Float64[np.ndarray, " D"]) -> float:
    """ρ: over all Gaussians, how far the mean turns if some of the views are left out, per c. Each view is left out for
    itself, and then each half of a recording at once; the larger ρ counts: neighboring views are alike, so that leaving
    out one of them hides how much lies between views that are far apart.

    Args:
        features: of views in ascending order.
        mean: of the teacher's vectors.
    """
    parts = _parts(len(features.weights))
    sums = [_scatter(features, mean, subsets, largest) for subsets in parts for largest in (SMALL_CHANGE, np.inf)]
    ratios = [turned / geometry for turned, geometry in sums if geometry > 0]
    return max(ratios) if ratios else UNKNOWN_SCATTER


def _parts(count: int) -> list[list[Bool[np.ndarray, " M"]]]:
    """Views that are left, where each is left out in turn, and the first and the second half of them."""
    views, half = np.arange(count), (count + 1) // 2
    return [[views != view for view in views], [views < half], [views >= count - half]]


def _scatter(
    features: SampleFeatures, mean: Float64[np.ndarray, " D"], subsets: list[Bool[np.ndarray, " M"]], largest: float
) -> tuple[float, float]:
    """Sums of 1 − cosine and of c, where c is at most `largest`, of the means over some views with those over all."""
    weights, vectors = features.weights, features.vectors
    total, squares = weights.sum(axis=0), np.square(weights).sum(axis=0)
    fused, _ = features.fused()
    turned, geometry = 0.0, 0.0
    for subset in subsets:
        part = weights[subset].sum(axis=0)
        rows = np.flatnonzero((part > 1e-6 * total) & (part < (1 - 1e-6) * total))
        if not len(rows):
            continue
        w, s, all_ = weights[subset][:, rows], part[rows], total[rows]
        some = np.einsum("vm,vmd->md", w, vectors[subset][:, rows]) / s[:, None]
        q = np.square(w).sum(axis=0)
        c = q * (1 / s**2 - 2 / (s * all_)) + squares[rows] / all_**2
        small = c <= largest
        turned += float((1 - row_cosines(some - mean, fused[rows] - mean))[small].sum())
        geometry += float(c[small].sum())
    return turned, geometry


def measure_drift(features: SampleFeatures, means: Float64[np.ndarray, "M D"]) -> float:
    """How far centered features turn if the mean of the space is that of the maps of fewer views, per 1/n − 1/M; those
    that `measure_scatter` leaves out are left out.

    Args:
        features: of the sample.
        means: of the map of each view.
    """
    count = len(means)
    all_fused, seen = features.fused()
    if count < 2 or not seen.any():
        return UNKNOWN_SCATTER
    fused, mean = all_fused[seen], means.mean(axis=0)
    ratios = []
    for subsets in _parts(count):
        turned = [
            float((1 - row_cosines(fused - means[subset].mean(axis=0), fused - mean)).mean()) for subset in subsets
        ]
        geometry = [1 / subset.sum() - 1 / count for subset in subsets]
        ratios.append(sum(turned) / sum(geometry))
    return max(ratios)


RANKS = (8, 16, 32, 64, 128)
"""Ranks worth trying; 0 stands for all channels."""
HEADER_BYTES = 4096
"""Of a file of features: names, the space, padding, and the settings."""
ROW_BYTES, COORDINATE_BYTES = 8, 2
"""A stored row has its number and weight, and each coordinate is a float16."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RankErrors:
    """Ranks and the error that each adds.

    Attributes:
        full: largest rank that says anything.
        cumulative: shares of the energy of the teacher's vectors that the first 1, 2, … components keep.
        left_out: error of the sample's features with the first 1, 2, … components.
        choices: ranks that are worth trying; 0 = all.
        fitted: whether the fusion goes over the maps once more to fit a basis.
    """

    full: int = 1
    cumulative: Float64[np.ndarray, " R"] = field(default_factory=lambda: np.ones(1))
    left_out: Float64[np.ndarray, " R"] = field(default_factory=lambda: np.zeros(1))
    choices: tuple[int, ...] = (0,)
    fitted: bool = False

    def error_of(self, rank: int) -> float:
        """The error that a rank adds; 0 = all."""
        return 0.0 if rank == 0 or rank >= self.full else float(self.left_out[rank - 1])

    @property
    def errors(self) -> Mapping[int, float]:
        return {rank: self.error_of(rank) for rank in self.choices}


def rank_errors(
    teacher: Teacher,
    moments: Moments,
    features: SampleFeatures,
    mean: Float64[np.ndarray, " D"],
    config: FuseConfig,
    *,
    needed: bool,
) -> RankErrors:
    """Ranks of a teacher's vectors, with what each leaves out.

    Args:
        teacher: whose table, if it has one, is all that its vectors can be.
        moments: of the vectors of its maps, for teachers without a table.
        features: of the sample.
        mean: of the teacher's vectors.
        config: of the fusion.
        needed: whether a rank is wanted even where the fusion would keep all channels.
    """
    channels = teacher.space.channels
    fitted = teacher.table is None and config.basis and channels > config.narrow
    if not fitted and not needed:
        return RankErrors(full=channels)
    if teacher.table is not None:
        _, lengths, components = np.linalg.svd(teacher.table - mean, full_matrices=False)
        energies = lengths**2
    else:
        values, vectors = np.linalg.eigh(moments.covariance())
        energies, components = np.maximum(values[::-1], 0), vectors[:, ::-1].T
    full = max(int((energies > energies.max(initial=0) * 1e-7).sum()), 1)
    fused, seen = features.fused()
    centered = fused[seen] - mean
    energy = np.square(centered @ components[:full].T).cumsum(axis=1)
    total = np.square(centered).sum(axis=1, keepdims=True)
    shares = np.sqrt(np.minimum(energy / np.maximum(total, 1e-30), 1)) if seen.any() else np.ones((1, full))
    choices = (*(rank for rank in RANKS if rank < full), 0) if fitted else (0,)
    return RankErrors(
        full=full,
        cumulative=energies[:full].cumsum() / max(energies.sum(), 1e-30),
        left_out=1 - shares.mean(axis=0),
        choices=choices,
        fitted=fitted,
    )


def with_rank(config: FuseConfig, rank: int, ranks: RankErrors, teacher: Teacher) -> FuseConfig:
    """The fusion with so many components; 0 = all of them."""
    if teacher.table is not None:
        # The basis of a table has the components that keep a share of its energy.
        energy = 1.0 if rank == 0 else float(ranks.cumulative[rank - 1])
        return replace(config, table_energy=min(energy, 1.0), narrow=config.narrow if rank == 0 else 0)
    if rank == 0:
        return replace(config, energy=1.0, max_rank=0)
    return replace(config, energy=1.0, max_rank=rank, narrow=0)


def file_bytes(rows: int, rank: int, channels: int, *, basis: bool) -> int:
    """Bytes of a file of features of so many seen Gaussians."""
    shared = 4 * rank + 4 * channels + (4 * rank * channels if basis else 0)
    return HEADER_BYTES + rows * (ROW_BYTES + COORDINATE_BYTES * rank) + shared


def rank_of_bytes(size: float, rows: int, channels: int) -> int:
    """The largest rank whose file has at most so many bytes; 0 where there is none."""
    fixed, with_one = file_bytes(rows, 0, channels, basis=True), file_bytes(rows, 1, channels, basis=True)
    return max(int((size - fixed) // (with_one - fixed)), 0)


STOPS = {1e-6: 1.05, 1e-4: 1.0, 1e-3: 0.95, 1e-2: 0.88, 0.1: 0.75}
"""Transmittances at which rays end, and what following them costs, relative to the default; as measured in rooms."""
FIXED = 0.3
"""Share of the cost of a view that does not depend on its rays: projection and sorting."""
TEACHER_COST, CHEAP_COST = 30.0, 0.1
"""Cost of a map, in views that are blended, of teachers that are costly and cheap. Stated and not measured, so that one
scene makes one choice, on a busy machine too."""
COORDINATE_COST = 0.002
"""Cost of lifting one coordinate of a view, in views that are blended."""
DEVIATIONS = 2.0
"""A predicted error plus so many of its standard errors must be within the budget."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """A number of views, an end of rays and a rank, with what is predicted of them.

    Attributes:
        views: the first so many of the order.
        stop: transmittance at which rays end.
        rank: of the basis; 0 = all channels.
        error: predicted.
        deviation: its standard error.
        lifting: cost of blending and lifting a view, in views that are blended at the exact rays.
        cost: of all views with their maps.
    """

    views: int
    stop: float
    rank: int
    error: float
    deviation: float
    lifting: float
    cost: float

    @property
    def bound(self) -> float:
        """What the error stays below in all likelihood."""
        return self.error + DEVIATIONS * self.deviation


def all_settings(
    sight: Sight,
    order: Int64[np.ndarray, " V"],
    ranks: RankErrors,
    *,
    scatter: float,
    drift: float,
    exact_stop: float,
    cheap: bool,
    coded: bool,
    least: int,
) -> list[Setting]:
    """All settings; the last is the exact one, of which no error is predicted.

    Args:
        sight: of the sample.
        order: of the views.
        ranks: worth trying.
        scatter: ρ of the teacher.
        drift: of the mean of its vectors.
        exact_stop: where rays end at the exact settings.
        cheap: whether the teacher is.
        coded: whether sums are by the rows of a table, so that a rank costs nothing.
        least: smallest number of views.
    """
    map_cost = CHEAP_COST if cheap else TEACHER_COST

    def setting(views: int, stop: float, rank: int, error: float, deviation: float) -> Setting:
        lifting = FIXED + (1 - FIXED) * STOPS[stop]
        lifting += 0.0 if coded else COORDINATE_COST * (rank or ranks.full)
        cost = views * (map_cost + lifting)
        return Setting(views=views, stop=stop, rank=rank, error=error, deviation=deviation, lifting=lifting, cost=cost)

    settings = []
    for stop in STOPS:
        curve = predict_curve(sight, order, stop=stop, exact_stop=exact_stop, scatter=scatter, drift=drift)
        for number, predicted in enumerate(curve, 1):
            for rank, error in ranks.errors.items():
                if number >= least:
                    total = min(predicted.error + error, 1.0)
                    settings.append(setting(number, stop, rank, total, predicted.deviation))
    return [*settings, setting(len(order), min(STOPS), 0, 0.0, 0.0)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pace:
    """Seconds of one view, as measured.

    Attributes:
        map: of making its map.
        lift: of blending and lifting it at `Setting.lifting` = 1.
        passes: number of times that each map is made: twice by cheap teachers whose basis is fitted first.
        cached: number of maps that are made already.
        spent: seconds since the choice began.
    """

    map: float
    lift: float
    passes: int
    cached: int
    spent: float

    def seconds(self, setting: Setting) -> float:
        """Seconds of a fusion by a setting, from the beginning of the choice to the features."""
        maps = max(setting.views * self.passes - self.cached, 0)
        return self.spent + maps * self.map + setting.views * setting.lifting * self.lift


def within_megabytes(
    chosen: Setting, share: float, sight: Sight, ranks: RankErrors, channels: int, budget: BudgetConfig, *, basis: bool
) -> tuple[Setting, int, tuple[str, ...]]:
    """The setting with the largest rank whose file is small enough; where an error is promised, with what that needs.

    Args:
        chosen: the setting so far.
        share: of the Gaussians that are seen.
        sight: of the sample.
        ranks: of the teacher.
        channels: of the teacher.
        budget: of megabytes, and perhaps of error.
        basis: whether the fusion has a basis without a limit of its rank.

    Returns:
        The setting, bytes of its file, and notes about a promise that is not kept.

    Raises:
        InputError: not even one coordinate of each Gaussian fits, and no error is promised.
    """
    assert budget.megabytes is not None
    rows = math.ceil(min(share, 1.0) * sight.gaussians)
    rank = chosen.rank or (ranks.full if basis else channels)
    size = file_bytes(rows, rank, channels, basis=basis or chosen.rank > 0)
    if size <= budget.megabytes * MEGABYTE:
        return chosen, size, ()
    if budget.error is not None:
        return chosen, size, (budget.conflict("error", "megabytes", size / MEGABYTE),)
    fitting = rank_of_bytes(budget.megabytes * MEGABYTE, rows, channels)
    if not fitting:
        least = file_bytes(rows, 1, channels, basis=True)
        raise InputError(
            f"{budget.shown('megabytes')}: one coordinate of each Gaussian takes about {least / MEGABYTE:.3g} MB; give "
            "more"
        )
    rank = max(min(fitting, ranks.full), 1)
    error = min(chosen.error + ranks.error_of(rank), 1.0)
    return replace(chosen, rank=rank, error=error), file_bytes(rows, rank, channels, basis=True), ()


Measure = Callable[[int], tuple[float, float]]
"""Seconds of making the map of a view, and of blending and lifting it at the exact rays."""
