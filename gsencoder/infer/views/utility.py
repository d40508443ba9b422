"""The utility of views, by themselves and as a set.

The utility of a set is a sum with diminishing returns: of what each view shows by itself (`view_utility`), of how well
the targets' Gaussians and their surroundings are covered, and of how spread the directions are. The greedy choice is
then within 1 − 1/e of the best one (Nemhauser, Wolsey and Fisher 1978).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.scores import ViewScores, coverage, directions
from gsencoder.infer.views.selection import ViewsConfig
from gsencoder.infer.views.targets import Target
from gsencoder.types import Cameras


def view_utility(scores: ViewScores, config: ViewsConfig) -> Float64[np.ndarray, " V"]:
    """Utility of each view for one target by itself, 0 to 1.

    Half comes from filling at least `least_share` of the picture, in proportion below it, half from filling up to half
    of `most_share`; a target that fills more than `most_share` counts less. All of it is scaled by how much of the
    target is in the picture and not hidden, by the opacity around it, and by its sharpness: Gaussians of
    `ViewConstants.half_blur` halve it.
    """
    share = scores.share
    size = np.minimum(share / config.least_share, 1) * (0.5 + 0.5 * np.minimum(share / (config.most_share / 2), 1))
    size *= np.clip((1 - share) / (1 - config.most_share), 0, 1)
    alpha = np.clip(scores.alpha / CONSTANTS.full_alpha, 0, 1)
    sharp = 1 / (1 + (scores.blur / CONSTANTS.half_blur) ** 2)
    return np.asarray(size * sharp * scores.visible * (0.5 + 0.5 * scores.inside) * alpha**2)


class CoverageObjective:
    """The utility of sets of candidates, and its greedy maximization."""

    def __init__(
        self, cameras: Cameras, targets: Sequence[Target], scores: Sequence[ViewScores], config: ViewsConfig
    ) -> None:
        self.utilities = [view_utility(each, config) for each in scores]
        self._count = config.count
        self._weights = (config.cover_weight, config.context_weight, config.spread_weight)
        self._terms = []
        for target, each, value in zip(targets, scores, self.utilities, strict=True):
            # How well a view sees something counts as far as it is a good view.
            good = (value / max(float(value.max(initial=0)), CONSTANTS.min_best_utility))[:, None]
            away = directions(cameras, target)
            towards = np.clip(away @ away.T, 0, 1)
            self._terms.append((coverage(each.target) * good, coverage(each.context) * good, towards * good))
        self._coverages = [coverage(each.target) for each in scores]

    def covered(self, views: Int64[np.ndarray, " n"]) -> float | None:
        """How well views show the targets' Gaussians together; see `SelectedView`."""
        if not self._coverages:
            return None
        return float(np.mean([values[views].max(axis=0).mean() for values in self._coverages]))

    def value_of(self, views: Sequence[int] | Int64[np.ndarray, " n"]) -> float:
        """The utility of a set of views, which `greedy` maximizes."""
        chosen = list(views)
        value = float(np.mean([view_utility[chosen].sum() for view_utility in self.utilities]) / self._count)
        for parts in self._terms:
            for weight, part in zip(self._weights, parts, strict=True):
                if part.shape[1]:
                    value += weight / len(self._terms) * float(part[chosen].max(axis=0).mean())
        return value

    def greedy(self, count: int) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Views in the order in which they are chosen, and their gains; ties go to the first candidate. Views that add
        nothing are left out, except the first."""
        modular = np.mean(self.utilities, axis=0) / self._count
        best = [[np.zeros(part.shape[1]) for part in parts] for parts in self._terms]
        order: list[int] = []
        gains: list[float] = []
        for _ in range(min(count, len(modular))):
            gain = modular.copy()
            for parts, now in zip(self._terms, best, strict=True):
                for weight, part, level in zip(self._weights, parts, now, strict=True):
                    if weight and part.shape[1]:
                        gain += weight / len(self._terms) * np.maximum(part - level, 0).mean(axis=1)
            gain[order] = -np.inf
            view = int(gain.argmax())
            if order and gain[view] <= max(CONSTANTS.min_relative_gain * gains[0], CONSTANTS.min_gain / self._count):
                break
            order.append(view)
            gains.append(float(gain[view]))
            best = [
                [np.maximum(level, part[view]) for part, level in zip(parts, now, strict=True)]
                for parts, now in zip(self._terms, best, strict=True)
            ]
        return np.array(order, np.int64), np.array(gains)
