"""A choice of views within a budget: the fewest views that leave little unseen, as many candidates as can be judged in
time, and pictures as large as fit.

The error is what a few views leave unseen of what all candidates show. A Gaussian counts as far as views show it as
well as the candidate that shows it best does, by its blending weight as a share of the picture; the error is 1 − the
mean over the Gaussians that any candidate shows, meaned over targets. It is predicted from the small renders that
candidates are judged by, and measured at the size of the pictures.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.budget import (
    MEGABYTE,
    Budget,
    Choice,
    Estimate,
    check_any_limit,
    choose,
    reject_options_set_by_budget,
)
from gsencoder.core.errors import InputError, counted
from gsencoder.core.files import picture_bytes
from gsencoder.core.settings import format_value, option
from gsencoder.infer.draw import Picture
from gsencoder.infer.views.candidates import FreeSpace
from gsencoder.infer.views.choose import (
    Candidates,
    CoverageObjective,
    ViewScores,
    coverage,
    greedy_order,
    score_candidates,
    view_set,
)
from gsencoder.infer.views.pictures import SUFFIX, view_pictures
from gsencoder.infer.views.targets import CONSTANTS, Target, ViewsConfig, ViewSet
from gsencoder.render import BlendConfig, blend
from gsencoder.types import Cameras, FeatureMap, FeatureSpace, Gaussians, Scene

OPTIONS_SET_BY_BUDGET: Mapping[str, tuple[str, ...]] = {
    "error": ("count",),
    "seconds": ("candidates",),
    "megabytes": ("width", "height", "frame_side"),
}
"""With a limit of error, seconds set nothing: it is one about what `choose.candidates` show, which are all judged."""
CANDIDATES = (8, 12, 16, 24, 32, 48, 64)
"""Numbers that are chosen among; the last is that of preset=exact. The first is judged in any case, and timed."""
SAMPLED = 2
"""Pictures that are rendered to predict the bytes of all, those that grow most."""
RATIO = 1.05
"""Of one side of pictures to the next smaller one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsBudget(Budget):
    """What a choice of views may cost, or must show. Where they conflict, the one that stands first here wins."""

    error: float | None = option(
        None,
        "largest share that the chosen views leave unseen of what all candidates show, mean over targets; "
        "a Gaussian counts as far as it is shown as well as by the candidate that shows it best; the fewest views "
        "are taken",
    )
    seconds: float | None = option(
        None, "largest time of choosing views; localization and the pictures come on top of it"
    )
    megabytes: float | None = option(
        None,
        "largest size of the pictures of the views (view_00.png, view_01.png, …, without sheet.png), in "
        "units of 1,000,000 bytes; they are made smaller, and at last fewer",
    )
    check: bool = option(
        True, "measure the error afterwards, which renders the targets for all candidates; false = leave it unmeasured"
    )


def check_views_budget(budget: ViewsBudget, config: ViewsConfig) -> None:
    """Refuses options that a budget chooses, and views that are not chosen from candidates."""
    for name in budget.limits:
        if name != "seconds" or budget.error is None:
            reject_options_set_by_budget(budget, config, ViewsConfig(), OPTIONS_SET_BY_BUDGET[name], "choose")
    if budget.limits and config.method != "greedy":
        raise InputError(
            f"choose.method={config.method}: {budget.options} is for method=greedy, which judges candidates; leave one "
            "of the two out"
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetViews:
    """Views that were chosen within a budget.

    Attributes:
        candidates: may be fewer than there was time for where the scene has no more.
        pictures: of the views, with a limit of megabytes.
        order: which candidates the views are, with a limit of error.
        chosen: values that were chosen, by name.
        seconds: from the beginning to the choice, without the pictures.
        notes: warnings about limits that are expected to be broken.
    """

    views: ViewSet
    candidates: Candidates
    pictures: list[Picture] | None = None
    order: Int64[np.ndarray, " n"] | None = None
    chosen: Mapping[str, int]
    predicted: Mapping[str, float]
    seconds: float
    notes: tuple[str, ...]

    def realised_error(self, gaussians: Gaussians, targets: Sequence[Target]) -> float:
        """The error of the chosen views at the size of their pictures, over all Gaussians of the targets."""
        assert self.order is not None
        side = longest_side(self.views)
        cameras = self.candidates.cameras.resized(side, enlarge=False)
        return measured_errors(gaussians, targets, cameras, [self.order], near=self.views.near)[0]


def choose_views_within(
    scene: Scene,
    targets: Sequence[Target],
    config: ViewsConfig,
    budget: ViewsBudget,
    *,
    clock: Callable[[], float] = time.perf_counter,
) -> BudgetViews:
    """The views that show targets best, of as many candidates as can be judged in time, or the fewest that keep an
    error; and their pictures, as large as megabytes allow.

    Args:
        config: options that the budget does not choose.
    """
    check_views_budget(budget, config)
    check_any_limit(budget)
    start = clock()
    free = FreeSpace(scene.gaussians) if scene.gaussians is not None else None
    chosen: dict[str, int] = {}
    predicted: dict[str, float] = {}
    notes: tuple[str, ...] = ()
    order, gains = None, None
    if budget.error is None and budget.seconds is not None:
        numbers = sorted({max(number, config.count, len(targets)) for number in CANDIDATES})
        begun = clock()
        candidates = score_candidates(scene, targets, replace(config, candidates=numbers[0]), free)
        each, spent = (clock() - begun) / numbers[0], clock() - start

        def measure(number: int) -> Estimate:
            # Placing candidates takes some of that time whatever their number, so that this is on the safe side.
            return Estimate(seconds=spent + number * each if number > numbers[0] else spent)

        choice = choose(numbers, measure, replace(budget, megabytes=None))
        if choice.setting > numbers[0]:
            candidates = score_candidates(scene, targets, replace(config, candidates=choice.setting), free)
        predicted["seconds"], notes = choice.estimate.seconds, choice.notes
        chosen["candidates"] = len(candidates.cameras)
    else:
        candidates = score_candidates(scene, targets, config, free)
    objective = CoverageObjective(candidates.cameras, targets, candidates.scores, config.count)
    if budget.error is not None:
        fewest, gains = fewest_views(candidates.scores, budget)
        order = fewest.setting
        chosen["count"], predicted["error"] = len(order), fewest.estimate.error
        views = view_set(targets, candidates, objective, order, gains)
    else:
        views = view_set(targets, candidates, objective, *objective.greedy(config.count))
    seconds = clock() - start
    if budget.error is not None and budget.seconds is not None and seconds > budget.seconds:
        notes = (budget.conflict("seconds", seconds),)
    pictures = None
    if budget.megabytes is not None:
        views, pictures, predicted["megabytes"], note = pictures_within(scene, views, budget)
        chosen |= {"count": len(views), "side": longest_side(views)}
        notes += note
    return BudgetViews(
        views=views,
        candidates=candidates,
        pictures=pictures,
        order=order,
        chosen=chosen,
        predicted=predicted,
        seconds=seconds,
        notes=notes,
    )


def order_by_error(scores: Sequence[ViewScores]) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Candidates in the order in which each leaves least unseen, and by how much each lowers the error; those that show
    nothing more than the ones before are left out, except the first."""
    parts = []
    for each in scores:
        # Only Gaussians that any candidate shows count.
        shown = max(int(np.count_nonzero(each.target.any(axis=0))), 1)
        parts.append((each.target.shape[1] / (shown * len(scores)), coverage(each.target)))
    count = len(scores[0].target)
    return greedy_order(parts, np.zeros(count), count)


def errors_after(gains: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """The errors of the first one, two, … candidates of an order by what each lowers it; the last is exactly 0."""
    return np.append(np.cumsum(gains[:0:-1])[::-1], 0.0)


def fewest_views(
    scores: Sequence[ViewScores], budget: ViewsBudget
) -> tuple[Choice[Int64[np.ndarray, " n"]], Float64[np.ndarray, " n"]]:
    """The fewest candidates that keep a limit of error in all likelihood, and by how much each lowers the error. The
    order is that of any error, so that a looser one never takes more views."""
    order, gains = order_by_error(scores)
    errors = errors_after(gains)
    # Small renders err, and of targets of few Gaussians, which are few pixels, they err most.
    seen = [max(int(np.count_nonzero(each.target.any(axis=0))), 1) for each in scores]
    margin = CONSTANTS.unsure_gaussians * float(np.mean(1 / np.array(seen)))

    def measure(chosen: Int64[np.ndarray, " n"]) -> Estimate:
        error = float(errors[len(chosen) - 1])
        return Estimate(error=error, bound=CONSTANTS.error_safety * error + margin)

    choice = choose([order[: n + 1] for n in range(len(order))], measure, ViewsBudget(error=budget.error))
    return choice, gains[: len(choice.setting)]


def measured_errors(
    gaussians: Gaussians,
    targets: Sequence[Target],
    cameras: Cameras,
    choices: Sequence[Int64[np.ndarray, " n"]],
    *,
    near: float = BlendConfig().near,
) -> tuple[float, ...]:
    """The errors of choices of views over all Gaussians of the targets, by renders of all candidates' cameras in the
    sizes of their pictures."""
    config = BlendConfig(rays_per_patch=1, near=min(BlendConfig().near, near))
    most = [np.zeros(len(target.rows)) for target in targets]
    most_chosen = [[np.zeros(len(target.rows)) for target in targets] for _ in choices]
    together = gaussians.select(np.unique(np.concatenate([target.rows for target in targets])))
    for view in range(len(cameras)):
        if (window := _window_around(together, cameras, view, config.near)) is None:
            continue
        # Only the rays of a window are blended: one through the center of each pixel.
        left, upper, right, lower = window
        like = FeatureMap(
            grid_from_image=np.array([[1.0, 0, -left], [0, 1, -upper]]),
            space=FeatureSpace(name="pixels", channels=1),
            features=np.zeros((lower - upper, right - left, 1), np.float32),
        )
        b = blend(gaussians, cameras, view, like=like, config=config)
        area = float(max(cameras.widths[view], cameras.heights[view])) ** 2
        weights = np.bincount(b.col.numpy(), b.weight.numpy(), minlength=len(gaussians)) / area
        for levels in (most, *(each for each, chosen in zip(most_chosen, choices, strict=True) if view in chosen)):
            for target, level in zip(targets, levels, strict=True):
                np.maximum(level, weights[target.rows], out=level)
    return tuple(float(np.mean(list(map(_unseen, most, each)))) for each in most_chosen)


def _unseen(most: Float64[np.ndarray, " n"], chosen: Float64[np.ndarray, " n"]) -> float:
    """Mean share that is left unseen, over what any candidate shows; 0 where that is nothing."""
    seen = most > 0
    return float(1 - (chosen[seen] / most[seen]).mean()) if seen.any() else 0.0


def _window_around(gaussians: Gaussians, cameras: Cameras, view: int, near: float) -> tuple[int, ...] | None:
    """Left, upper, right and lower edge of what Gaussians may reach into, pixels, the last two exclusive; or None."""
    means = gaussians.means.astype(np.float64)
    pixels, depths = cameras.project(means, view, min_depth=near)
    reach = CONSTANTS.window_sigmas * gaussians.scales.max(axis=1).astype(np.float64)
    front = depths + reach > near
    if not front.any():
        return None
    size = np.array([cameras.widths[view], cameras.heights[view]])
    radii = (reach * float(np.diag(cameras.Ks[view])[:2].max()) / np.maximum(depths, near) + 2)[front, None]
    low = np.clip(np.floor((pixels[front] - radii).min(axis=0)), 0, size).astype(int)
    high = np.clip(np.ceil((pixels[front] + radii).max(axis=0)), 0, size).astype(int)
    if (high <= low).any():
        return None
    return (*low.tolist(), *high.tolist())


def pictures_within(
    scene: Scene, views: ViewSet, budget: ViewsBudget
) -> tuple[ViewSet, list[Picture], float, tuple[str, ...]]:
    """The largest pictures of views whose files keep a limit of megabytes.

    All are encoded at the least side; by how much the bytes of larger ones grow a few tell. A side that takes more than
    was predicted is made smaller. Where the least side takes too much, the views that were chosen last are left out,
    or, with a limit of error, none.

    Returns:
        The views that are kept, with cameras in the sizes of the pictures; the pictures; the megabytes that were
        predicted; and warnings about a limit that is broken, or views that are left out.
    """
    limit, largest = budget.limit("megabytes"), longest_side(views)
    least = min(CONSTANTS.least_picture_side, largest)
    smallest = _resized(views, least)
    pictures, _ = view_pictures(scene, smallest)
    sizes = _megabytes(pictures)
    if sizes.sum() > limit:
        count, total = len(views), np.cumsum(sizes)
        if budget.error is not None:
            note = budget.conflict("megabytes", total[-1])
        elif sizes[0] > limit:
            raise InputError(
                f"{budget.option('megabytes')}: one picture of {least} pixels in scene {scene.name} takes "
                f"{math.ceil(1e5 * sizes[0]) / 1e5:.6g} MB; give more"
            )
        else:
            count = int((total <= limit).sum())
            note = (
                f"{budget.option('megabytes')}: {count} of {counted(len(views), 'view')} fit in pictures of {least} "
                f"pixels, the least; all take {format_value(math.ceil(1e4 * total[-1]) / 1e4)} MB"
            )
        return _selected(smallest, np.arange(count)), pictures[:count], float(total[count - 1]), (note,)
    sample = np.argsort(-_pixels(views) / _pixels(smallest), kind="stable")[:SAMPLED]
    sides = [least]
    while sides[-1] < largest:
        sides.append(min(largest, max(sides[-1] + 1, round(RATIO * sides[-1]))))

    def measure(side: int) -> Estimate:
        """Bytes grow with pixels, times what they grow more or less by in the sample."""
        if side == least:
            return Estimate(megabytes=float(sizes.sum()))
        sampled = _megabytes(view_pictures(scene, _resized(_selected(views, sample), side))[0])
        growth = _pixels(_resized(views, side)) / _pixels(smallest)
        correction = sampled.sum() / (sizes * growth)[sample].sum()
        return Estimate(megabytes=float((sizes * growth * np.where(growth > 1, correction, 1)).sum()))

    while True:
        choice = choose(sides, measure, ViewsBudget(megabytes=limit))
        sized = _resized(views, choice.setting)
        if choice.setting > least:
            pictures, _ = view_pictures(scene, sized)
        if choice.setting == least or _megabytes(pictures).sum() <= limit:
            return sized, pictures, choice.estimate.megabytes, ()
        sides = sides[: sides.index(choice.setting)]


def _selected(views: ViewSet, rows: Int64[np.ndarray, " n"]) -> ViewSet:
    return replace(views, cameras=views.cameras.select(rows), chosen=tuple(views.chosen[row] for row in rows))


def _resized(views: ViewSet, side: int) -> ViewSet:
    """The same views in pictures whose longer side has at most this many pixels."""
    return replace(views, cameras=views.cameras.resized(side, enlarge=False))


def longest_side(views: ViewSet) -> int:
    return int(max(views.cameras.widths.max(), views.cameras.heights.max()))


def _pixels(views: ViewSet) -> Float64[np.ndarray, " n"]:
    return views.cameras.widths.astype(np.float64) * views.cameras.heights


def _megabytes(pictures: Sequence[Picture]) -> Float64[np.ndarray, " n"]:
    return np.array([len(picture_bytes(picture, SUFFIX)) for picture in pictures], np.float64) / MEGABYTE
