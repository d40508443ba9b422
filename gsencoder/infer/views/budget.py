"""A choice of views within a budget: the fewest views that leave little unseen.

What a few views leave unseen of what all candidates show: the error that a budget of views promises.

A Gaussian counts as far as views show it as well as the candidate that shows it best does, by its blending weight as a
share of the picture; the error is 1 − the mean over the Gaussians that any candidate shows, meaned over targets. It is
predicted from the small renders that candidates are judged by, and measured at the size of the pictures.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.errors import InputError, counted
from gsencoder.core.files import picture_bytes
from gsencoder.core.settings import MEGABYTE, PLANNED, Budget, check_governed, shown_value
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


def fewest_views(scores: Sequence[ViewScores], error: float) -> tuple[Picked, float]:
    """The fewest candidates that keep an error in all likelihood, and their error by the small renders.

    The order is that of any error, so that a looser one never takes more views.

    Args:
        scores: of each target.
        error: that is promised, 0 to 1.
    """
    order, gains = order_by_error(scores)
    errors = errors_after(gains)
    # Small renders err, and of targets of few Gaussians, which are few pixels, they err most.
    shown = [max(int(np.count_nonzero(each.target.any(axis=0))), 1) for each in scores]
    margin = CONSTANTS.unsure_gaussians * float(np.mean(1 / np.array(shown)))
    bounds = np.where(errors > 0, CONSTANTS.error_safety * errors + margin, 0)
    count = int(np.flatnonzero(bounds <= error)[0]) + 1
    return Picked(order[:count], gains[:count]), float(errors[count - 1])


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
        gaussians: the splat.
        targets: what is looked at.
        cameras: of all candidates, in the sizes of their pictures.
        choices: which of them are shown, once or several times.
        config: accuracy of the renders.
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


GOVERNED: Mapping[str, tuple[str, ...]] = {
    "error": ("count",),
    "seconds": ("candidates",),
    "megabytes": ("width", "height", "frame_side"),
}
"""The options of the choice that each promise sets. Beside a promised error, seconds set nothing: it is one about what
`choose.candidates` show, which are all judged."""
CANDIDATES = (8, 12, 16, 24, 32, 48, 64)
"""Numbers that are chosen among; the last is that of preset=exact. The first is judged in any case, and timed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewsBudget(Budget):
    """What a choice of views may cost, or must show. Where they conflict, the one that stands first here wins."""

    error: float | None = field(
        default=None,
        metadata={
            "help": "largest share that the chosen views leave unseen of what all candidates show, mean over targets; "
            "a Gaussian counts as far as it is shown as well as by the candidate that shows it best; the fewest views "
            "are taken"
        },
    )
    seconds: float | None = field(
        default=None,
        metadata={"help": "largest time of choosing views; localization and the pictures come on top of it"},
    )
    megabytes: float | None = field(
        default=None,
        metadata={
            "help": "largest size of the pictures of the views (view_00.png, view_01.png, …, without sheet.png), in "
            "units of 1,000,000 bytes; they are made smaller, and at last fewer"
        },
    )
    check: bool = field(
        default=True,
        metadata={
            "help": "measure the error afterwards, which renders the targets for all candidates; false = leave it "
            "unmeasured"
        },
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BudgetViews:
    """Views that were chosen within a budget.

    Attributes:
        views: these.
        picked: which of the candidates they are, with a budget of error.
        cameras: of all candidates, which may be fewer than there was time for where the scene has no more.
        knobs: values that were chosen, by name.
        predicted: by promise.
        seconds: from the beginning to the choice.
        notes: for the user, about a promise that is not kept.
    """

    views: ViewSet
    picked: Picked | None
    cameras: Cameras
    knobs: Mapping[str, int]
    predicted: Mapping[str, float]
    seconds: float
    notes: tuple[str, ...]

    def realised_error(self, scene: Scene, targets: Sequence[Target], *, largest_side: int) -> float:
        """The error of the chosen views at the size of their pictures, over all Gaussians of the targets.

        Args:
            scene: in which they were chosen.
            targets: that they were chosen for.
            largest_side: of the pictures that are shown, pixels; candidates are compared in no larger ones.
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
    """Refuses what a budget cannot be combined with.

    Raises:
        InputError: `GOVERNED` options are set, or views are not chosen from candidates.
    """
    for name in budget.promised:
        if name != "seconds" or budget.error is None:
            check_governed(budget, config, ViewsConfig(), GOVERNED[name], "choose")
    if budget.promised and config.method != "greedy":
        raise InputError(
            f"choose.method={config.method}: {budget.names} is for method=greedy, which judges candidates; leave one "
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
    error.

    Args:
        scene: see `choose_views`.
        targets: see `choose_views`.
        config: options that the budget does not choose.
        budget: at least one promise; one of megabytes chooses nothing here.
        clock: seconds.

    Raises:
        InputError: no budget, or what `choose_views` refuses.
    """
    check_views_budget(budget, config)
    if not budget.promised:
        raise InputError("budget: expected budget.error=, budget.seconds= or budget.megabytes=, got none of them")
    start = clock()
    gaussians = checked_gaussians(scene, targets, config)
    free = FreeSpace(gaussians)
    predicted: dict[str, float] = {}
    knobs: dict[str, int] = {}
    notes: tuple[str, ...] = ()

    def judged(number: int) -> Judged:
        return judge_candidates(scene, gaussians, targets, free, replace(config, candidates=number))

    if budget.seconds is None or budget.error is not None:
        judgment = judged(config.candidates)
    else:
        numbers = sorted({max(number, config.count, len(targets)) for number in CANDIDATES})
        begun = clock()
        judgment, number = judged(numbers[0]), numbers[0]
        seconds_each = (clock() - begun) / number
        spent = predicted["seconds"] = clock() - start
        # Placing candidates takes some of that time whatever their number, so that this is on the safe side.
        fitting = [more for more in numbers[1:] if spent + more * seconds_each <= PLANNED * budget.seconds]
        if fitting:
            number = fitting[-1]
            predicted["seconds"], judgment = spent + number * seconds_each, judged(number)
        elif spent > budget.seconds:
            notes = (f"{budget.shown('seconds')}: judging {number} candidates took {spent:.3g} s; they are used",)
    cameras = judgment.candidates.cameras
    picked = None
    if budget.error is not None:
        picked, predicted["error"] = fewest_views(judgment.scores, budget.error)
        knobs["count"] = len(picked.order)
    elif budget.seconds is not None:
        knobs["candidates"] = len(cameras)
    views = chosen_views(scene, targets, judgment, free, config, picked=picked)
    seconds = clock() - start
    if budget.error is not None and budget.seconds is not None and seconds > budget.seconds:
        notes = (budget.conflict("error", "seconds", seconds),)
    return BudgetViews(
        views=views, picked=picked, cameras=cameras, knobs=knobs, predicted=predicted, seconds=seconds, notes=notes
    )


PLANNED_BYTES = 0.95
"""Share of promised bytes that is planned with, since they are predicted from few pictures."""
SAMPLED, CORRECTIONS = 2, 2
"""Pictures that are rendered in full to tell how bytes grow with pixels, and how often a side that took too many bytes
is lowered before the least one is taken."""
EXPONENTS, BISECTIONS = (0.3, 1.5), 20
"""Between which powers of pixels bytes are taken to grow, and by how many halvings one is solved for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SizedPictures:
    """Views whose pictures fit into a budget of megabytes.

    Attributes:
        views: with cameras in the sizes of the pictures; fewer than there were where not all fit.
        pictures: of these.
        side: largest longer side, pixels.
        predicted: megabytes.
        notes: for the user, about a promise that is not kept or views that are left out.
    """

    views: ViewSet
    pictures: list[Picture]
    side: int
    predicted: float
    notes: tuple[str, ...]


def pictures_within(scene: Scene, views: ViewSet, budget: ViewsBudget) -> SizedPictures:
    """The largest pictures of views whose files keep a budget.

    All are encoded at the least side, and few in full; what lies between is predicted, encoded, and made smaller where
    it takes more than was promised. Where the least side takes too much, the views that were chosen last are left out,
    or, beside a promised error, none.

    Args:
        scene: see `view_pictures`.
        views: as chosen, in the sizes that their pictures would have without a budget.
        budget: that promises megabytes.

    Raises:
        InputError: no error is promised, and not even the first view fits at the least side.
    """
    limit = budget.promise("megabytes") * MEGABYTE
    largest = _longest(views)
    least = min(CONSTANTS.least_picture_side, largest)
    smallest = _capped(views, least)
    pictures, _ = view_pictures(scene, smallest)
    sizes = _sizes(pictures)
    if sizes.sum() > limit:
        return _least(scene, smallest, pictures, sizes, budget)
    exponent = _exponent(scene, views, smallest, sizes)
    for _ in range(1 + CORRECTIONS):
        # The largest side that is predicted to fit; the least one does.
        low, high = least, largest
        while low < high:
            middle = (low + high + 1) // 2
            fits = _predicted(views, smallest, sizes, exponent, middle) <= PLANNED_BYTES * limit
            low, high = (middle, high) if fits else (low, middle - 1)
        side, predicted = low, _predicted(views, smallest, sizes, exponent, low)
        sized = _capped(views, side)
        pictures, _ = view_pictures(scene, sized)
        taken = float(_sizes(pictures).sum())
        if taken <= limit:
            return SizedPictures(views=sized, pictures=pictures, side=side, predicted=predicted / MEGABYTE, notes=())
        exponent, largest = _refitted(views, smallest, sizes, side, taken), side - 1
    pictures, _ = view_pictures(scene, smallest)
    return SizedPictures(
        views=smallest, pictures=pictures, side=least, predicted=float(sizes.sum()) / MEGABYTE, notes=()
    )


def _least(
    scene: Scene, views: ViewSet, pictures: list[Picture], sizes: Float64[np.ndarray, " n"], budget: ViewsBudget
) -> SizedPictures:
    """Views whose pictures take too much at the least side: as many as fit, or all where an error is promised."""
    total = np.cumsum(sizes) / MEGABYTE
    side, count, notes = _longest(views), len(views), tuple[str, ...]()
    if budget.error is not None:
        notes = (budget.conflict("error", "megabytes", total[-1]),)
    else:
        count = int((total <= budget.promise("megabytes")).sum())
        if count == 0:
            raise InputError(
                f"{budget.shown('megabytes')}: one picture of {side} pixels in scene {scene.name} takes "
                f"{math.ceil(sizes[0] / 10) / 1e5:.6g} MB; give more"
            )
        notes = (
            f"{budget.shown('megabytes')}: {count} of {counted(len(views), 'view')} fit in pictures of {side} pixels, "
            f"the least; all take {shown_value(math.ceil(1e4 * total[-1]) / 1e4)} MB",
        )
    kept = replace(views, cameras=views.cameras.select(slice(count)), chosen=views.chosen[:count])
    return SizedPictures(
        views=kept, pictures=pictures[:count], side=side, predicted=float(total[count - 1]), notes=notes
    )


def _exponent(scene: Scene, views: ViewSet, smallest: ViewSet, sizes: Float64[np.ndarray, " n"]) -> float:
    """The power of pixels that bytes grow with, by a few pictures in full, those that grow most of them."""
    growth = _pixels(views) / _pixels(smallest)
    sample = np.argsort(-growth, kind="stable")[:SAMPLED]
    sample = sample[growth[sample] > 1]
    if not len(sample):
        return 1.0
    pictures, _ = view_pictures(scene, _selected(views, sample))
    powers = np.log(_sizes(pictures) / sizes[sample]) / np.log(growth[sample])
    return float(np.clip(powers.max(), *EXPONENTS))


def _refitted(views: ViewSet, smallest: ViewSet, sizes: Float64[np.ndarray, " n"], side: int, taken: float) -> float:
    """The power at which pictures of a side would take the bytes that they took."""
    low, high = EXPONENTS
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if _predicted(views, smallest, sizes, middle, side) < taken else (low, middle)
    return high


def _predicted(
    views: ViewSet, smallest: ViewSet, sizes: Float64[np.ndarray, " n"], exponent: float, side: int
) -> float:
    """Bytes of all pictures whose longer side is no larger than `side`."""
    growth = _pixels(_capped(views, side)) / _pixels(smallest)
    return float((sizes * growth**exponent).sum())


def _capped(views: ViewSet, side: int) -> ViewSet:
    """The same views in pictures whose longer side has at most so many pixels."""
    return replace(views, cameras=views.cameras.resized(side, enlarge=False))


def _selected(views: ViewSet, rows: np.ndarray) -> ViewSet:
    return replace(views, cameras=views.cameras.select(rows), chosen=tuple(views.chosen[row] for row in rows))


def _longest(views: ViewSet) -> int:
    return int(max(views.cameras.widths.max(), views.cameras.heights.max()))


def _pixels(views: ViewSet) -> Float64[np.ndarray, " n"]:
    return views.cameras.widths.astype(np.float64) * views.cameras.heights


def _sizes(pictures: Sequence[Picture]) -> Float64[np.ndarray, " n"]:
    """Bytes of the files."""
    return np.array([len(picture_bytes(picture, SUFFIX)) for picture in pictures], np.float64)
