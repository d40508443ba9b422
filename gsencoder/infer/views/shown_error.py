"""What a few views leave unseen of what all candidates show: the error that a budget of views promises.

A Gaussian counts as far as views show it as well as the candidate that shows it best does, by its blending weight as a
share of the picture; the error is 1 − the mean over the Gaussians that any candidate shows, meaned over targets. It is
predicted from the small renders that candidates are judged by, and measured at the size of the pictures.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.infer.views.choose import Picked
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.scores import ViewScores, coverage
from gsencoder.infer.views.targets import Target
from gsencoder.render import BlendConfig, blend
from gsencoder.types import Cameras, FeatureMap, FeatureSpace, Gaussians

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
