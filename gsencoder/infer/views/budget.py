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
from gsencoder.core.settings import option, shown_value
from gsencoder.infer.draw import Picture
from gsencoder.infer.views.candidates import FreeSpace
from gsencoder.infer.views.choose import Judged, Picked, checked_gaussians, chosen_views, judge_candidates
from gsencoder.infer.views.pictures import SUFFIX, view_pictures
from gsencoder.infer.views.scores import ViewScores, coverage
from gsencoder.infer.views.targets import CONSTANTS, Target, ViewsConfig, ViewSet
from gsencoder.render import BlendConfig, blend
from gsencoder.types import Cameras, FeatureMap, FeatureSpace, Gaussians, Scene

Window = tuple[int, int, int, int]
"""Left, upper, right and lower edge in pixels; the last two are not part of it."""


def order_by_error(scores: Sequence[ViewScores]) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Candidates in the order in which each leaves least unseen beside those before it, and by how much each lowers the
    error. Ties go to the first candidate; those that show nothing more are left out, except the first.

    Args:
        scores: of each target.
    """
    shown = [coverage(each.target) for each in scores]
    # Weights in the mean over the Gaussians of a target that any candidate shows, and over targets.
    counts = [max(int(np.count_nonzero(each.any(axis=0))), 1) for each in shown]
    parts = [each / (count * len(shown)) for each, count in zip(shown, counts, strict=True)]
    best = [np.zeros(each.shape[1]) for each in parts]
    order: list[int] = []
    gains: list[float] = []
    for _ in range(len(parts[0])):
        gain = np.sum(
            [np.maximum(part - level, 0).sum(axis=1) for part, level in zip(parts, best, strict=True)], axis=0
        )
        view = int(gain.argmax())
        if order and gain[view] <= 0:
            break
        order.append(view)
        gains.append(float(gain[view]))
        best = [np.maximum(level, part[view]) for part, level in zip(parts, best, strict=True)]
    return np.array(order, np.int64), np.array(gains)


def errors_after(gains: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """The errors of the first one, two, … candidates of an order by what each lowers it; the last is exactly 0."""
    return np.append(np.cumsum(gains[:0:-1])[::-1], 0.0)


def fewest_views(scores: Sequence[ViewScores], budget: Budget) -> tuple[Picked, Choice[int]]:
    """The fewest candidates that keep a limit of error in all likelihood, and their number with its error by the small
    renders. The order is that of any error, so that a looser one never takes more views.

    Args:
        scores: of each target.
    """
    order, gains = order_by_error(scores)
    errors = errors_after(gains)
    # Small renders err, and of targets of few Gaussians, which are few pixels, they err most.
    seen = [max(int(np.count_nonzero(each.target.any(axis=0))), 1) for each in scores]
    margin = CONSTANTS.unsure_gaussians * float(np.mean(1 / np.array(seen)))

    def measure(count: int) -> Estimate:
        error = float(errors[count - 1])
        return Estimate(error=error, bound=CONSTANTS.error_safety * error + margin)

    choice = choose(range(1, len(order) + 1), measure, budget)
    return Picked(order[: choice.setting], gains[: choice.setting]), choice


def measured_errors(
    gaussians: Gaussians,
    targets: Sequence[Target],
    cameras: Cameras,
    choices: Sequence[Int64[np.ndarray, " n"]],
    *,
    config: BlendConfig = BlendConfig(),
) -> tuple[float, ...]:
    """The errors of choices of views over all Gaussians of the targets, by renders at the cameras' sizes.

    Args:
        cameras: of all candidates, in the sizes of their pictures.
        choices: which of them are chosen, once or several times.
    """
    most = [np.zeros(len(target.rows)) for target in targets]
    most_chosen = [[np.zeros(len(target.rows)) for target in targets] for _ in choices]
    together = gaussians.select(np.unique(np.concatenate([target.rows for target in targets])))
    for view in range(len(cameras)):
        window = _window_around(together, cameras, view, config.near)
        if window is None:
            continue
        weights = _weights_in_window(gaussians, cameras, view, window, config)
        for levels in (most, *(each for each, chosen in zip(most_chosen, choices, strict=True) if view in chosen)):
            for target, level in zip(targets, levels, strict=True):
                np.maximum(level, weights[target.rows], out=level)
    return tuple(float(np.mean(list(map(_unseen, most, each)))) for each in most_chosen)


def _unseen(most: Float64[np.ndarray, " n"], chosen: Float64[np.ndarray, " n"]) -> float:
    """Mean share that is left unseen, over what any candidate shows; 0 where that is nothing."""
    seen = most > 0
    return float(1 - (chosen[seen] / most[seen]).mean()) if seen.any() else 0.0


def _window_around(gaussians: Gaussians, cameras: Cameras, view: int, near: float) -> Window | None:
    """The part of a picture that Gaussians may reach into; None where they do not."""
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
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _weights_in_window(
    gaussians: Gaussians, cameras: Cameras, view: int, window: Window, config: BlendConfig
) -> Float64[np.ndarray, " N"]:
    """The weight of each Gaussian in a window of a picture, as a share of a square of the picture's longer side."""
    left, upper, right, lower = window
    # A blend takes its rays from a map: one through the center of each pixel.
    cells = np.zeros((lower - upper, right - left, 1), np.float32)
    like = FeatureMap(
        grid_from_image=np.array([[1.0, 0, -left], [0, 1, -upper]]),
        space=FeatureSpace(name="pixels", channels=1),
        features=cells,
    )
    b = blend(gaussians, cameras, view, like=like, config=replace(config, rays_per_patch=1))
    weights = np.bincount(b.col.numpy(), b.weight.numpy(), minlength=len(gaussians))
    return np.asarray(weights / float(max(cameras.widths[view], cameras.heights[view])) ** 2)


OPTIONS_SET_BY_BUDGET: Mapping[str, tuple[str, ...]] = {
    "error": ("count",),
    "seconds": ("candidates",),
    "megabytes": ("width", "height", "frame_side"),
}
"""Beside a limit of error, seconds set nothing: it is one about what `choose.candidates` show, which are all judged."""
CANDIDATES = (8, 12, 16, 24, 32, 48, 64)
"""Numbers that are chosen among; the last is that of preset=exact. The first is judged in any case, and timed."""


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetViews:
    """Views that were chosen within a budget.

    Attributes:
        picked: which of the candidates they are, with a limit of error.
        cameras: of all candidates, which may be fewer than there was time for where the scene has no more.
        chosen: values that were chosen, by name.
        predicted: by limit.
        seconds: from the beginning to the choice.
        notes: warnings about limits that are expected to be broken.
    """

    views: ViewSet
    picked: Picked | None
    cameras: Cameras
    chosen: Mapping[str, int]
    predicted: Mapping[str, float]
    seconds: float
    notes: tuple[str, ...]

    def realised_error(self, scene: Scene, targets: Sequence[Target], *, largest_side: int) -> float:
        """The error of the chosen views at the size of their pictures, over all Gaussians of the targets.

        Args:
            largest_side: of the pictures, pixels; candidates are compared in no larger ones.
        """
        assert scene.gaussians is not None
        assert self.picked is not None
        config = BlendConfig()
        (error,) = measured_errors(
            scene.gaussians,
            targets,
            self.cameras.resized(largest_side, enlarge=False),
            [self.picked.order],
            config=replace(config, near=min(config.near, self.views.near)),
        )
        return error


def check_views_budget(budget: ViewsBudget, config: ViewsConfig) -> None:
    """Refuses what a budget cannot be combined with: options that it chooses, and views that are not chosen from
    candidates."""
    for name in budget.limits:
        if name != "seconds" or budget.error is None:
            reject_options_set_by_budget(budget, config, ViewsConfig(), OPTIONS_SET_BY_BUDGET[name], "choose")
    if budget.limits and config.method != "greedy":
        raise InputError(
            f"choose.method={config.method}: {budget.options} is for method=greedy, which judges candidates; leave one "
            "of the two out"
        )


def choose_views_within(
    scene: Scene,
    targets: Sequence[Target],
    config: ViewsConfig,
    budget: ViewsBudget,
    *,
    clock: Callable[[], float] = time.perf_counter,
) -> BudgetViews:
    """The views that show targets best, of as many candidates as can be judged in time; or the fewest that keep an
    error. A limit of megabytes chooses nothing here.

    Args:
        scene: see `choose_views`.
        targets: see `choose_views`.
        config: options that the budget does not choose.
    """
    check_views_budget(budget, config)
    check_any_limit(budget)
    start = clock()
    gaussians = checked_gaussians(scene, targets, config)
    free = FreeSpace(gaussians)

    def judged(number: int) -> Judged:
        return judge_candidates(scene, gaussians, targets, free, replace(config, candidates=number))

    picked, choice, chosen = None, Choice(setting=config.candidates, estimate=Estimate()), dict[str, int]()
    if budget.error is not None:
        judgment = judged(config.candidates)
        picked, choice = fewest_views(judgment.scores, replace(budget, seconds=None, megabytes=None))
        chosen["count"] = choice.setting
    elif budget.seconds is not None:
        numbers = sorted({max(number, config.count, len(targets)) for number in CANDIDATES})
        begun = clock()
        judgment, least = judged(numbers[0]), numbers[0]
        each, spent = (clock() - begun) / least, clock() - start

        def measure(number: int) -> Estimate:
            # Placing candidates takes some of that time whatever their number, so that this is on the safe side.
            return Estimate(seconds=spent + number * each if number > least else spent)

        choice = choose(numbers, measure, replace(budget, megabytes=None))
        if choice.setting > least:
            judgment = judged(choice.setting)
        chosen["candidates"] = len(judgment.candidates.cameras)
    else:
        judgment = judged(config.candidates)
    views = chosen_views(scene, targets, judgment, free, config, picked=picked)
    seconds, notes = clock() - start, choice.notes
    if budget.error is not None and budget.seconds is not None and seconds > budget.seconds:
        notes = (budget.conflict("seconds", seconds),)
    return BudgetViews(
        views=views,
        picked=picked,
        cameras=judgment.candidates.cameras,
        chosen=chosen,
        predicted={"error": choice.estimate.error, "seconds": choice.estimate.seconds},
        seconds=seconds,
        notes=notes,
    )


SAMPLED = 2
"""Pictures that are rendered to predict the bytes of all, those that grow most."""
RATIO = 1.05
"""Of one side of pictures to the next smaller one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SizedPictures:
    """Views whose pictures fit into a budget of megabytes.

    Attributes:
        views: with cameras in the sizes of the pictures; fewer than there were where not all fit.
        side: largest longer side, pixels.
        predicted: megabytes.
        notes: warnings about a limit that is broken, or views that are left out.
    """

    views: ViewSet
    pictures: list[Picture]
    side: int
    predicted: float
    notes: tuple[str, ...]


def pictures_within(scene: Scene, views: ViewSet, budget: ViewsBudget) -> SizedPictures:
    """The largest pictures of views whose files keep a limit of megabytes.

    All are encoded at the least side; by how much the bytes of larger ones grow a few tell. A side that takes more than
    was predicted is made smaller. Where the least side takes too much, the views that were chosen last are left out,
    or, beside a limit of error, none.

    Args:
        views: as chosen, in the sizes that their pictures would have without a budget.

    Raises:
        InputError: no error is limited, and not even the first view fits at the least side.
    """
    limit, largest = budget.limit("megabytes"), _longest(views)
    least = min(CONSTANTS.least_picture_side, largest)
    smallest = _resized(views, least)
    pictures, _ = view_pictures(scene, smallest)
    sizes = _megabytes(pictures)
    if sizes.sum() > limit:
        return _least(scene, smallest, pictures, sizes, budget)
    sample = np.argsort(-_pixels(views) / _pixels(smallest), kind="stable")[:SAMPLED]
    sampled = replace(views, cameras=views.cameras.select(sample), chosen=tuple(views.chosen[row] for row in sample))
    sides = [least]
    while sides[-1] < largest:
        sides.append(min(largest, max(sides[-1] + 1, round(RATIO * sides[-1]))))
    predicted = {least: float(sizes.sum())}

    def measure(side: int) -> Estimate:
        if side not in predicted:
            growth = _pixels(_resized(views, side)) / _pixels(smallest)
            larger = sizes * growth
            larger *= np.where(growth > 1, _megabytes(view_pictures(scene, _resized(sampled, side))[0]).sum(), 1)
            larger /= np.where(growth > 1, (sizes * growth)[sample].sum(), 1)
            predicted[side] = float(larger.sum())
        return Estimate(megabytes=predicted[side])

    of_bytes = ViewsBudget(megabytes=limit)
    while True:
        side = choose(sides, measure, of_bytes).setting
        sized = _resized(views, side)
        if side > least:
            pictures, _ = view_pictures(scene, sized)
        if side == least or _megabytes(pictures).sum() <= limit:
            return SizedPictures(views=sized, pictures=pictures, side=side, predicted=predicted[side], notes=())
        sides = sides[: sides.index(side)]


def _least(
    scene: Scene, views: ViewSet, pictures: list[Picture], sizes: Float64[np.ndarray, " n"], budget: ViewsBudget
) -> SizedPictures:
    """Views whose pictures take too much at the least side: as many as fit, or all where an error is limited."""
    total = np.cumsum(sizes)
    side, count = _longest(views), len(views)
    if budget.error is not None:
        note = budget.conflict("megabytes", total[-1])
    else:
        count = int((total <= budget.limit("megabytes")).sum())
        if count == 0:
            raise InputError(
                f"{budget.option('megabytes')}: one picture of {side} pixels in scene {scene.name} takes "
                f"{math.ceil(1e5 * sizes[0]) / 1e5:.6g} MB; give more"
            )
        note = (
            f"{budget.option('megabytes')}: {count} of {counted(len(views), 'view')} fit in pictures of {side} pixels, "
            f"the least; all take {shown_value(math.ceil(1e4 * total[-1]) / 1e4)} MB"
        )
    kept = replace(views, cameras=views.cameras.select(slice(count)), chosen=views.chosen[:count])
    return SizedPictures(
        views=kept, pictures=pictures[:count], side=side, predicted=float(total[count - 1]), notes=(note,)
    )


def _resized(views: ViewSet, side: int) -> ViewSet:
    """The same views in pictures whose longer side has at most so many pixels."""
    return replace(views, cameras=views.cameras.resized(side, enlarge=False))


def _longest(views: ViewSet) -> int:
    return int(max(views.cameras.widths.max(), views.cameras.heights.max()))


def _pixels(views: ViewSet) -> Float64[np.ndarray, " n"]:
    return views.cameras.widths.astype(np.float64) * views.cameras.heights


def _megabytes(pictures: Sequence[Picture]) -> Float64[np.ndarray, " n"]:
    return np.array([len(picture_bytes(picture, SUFFIX)) for picture in pictures], np.float64) / MEGABYTE
