"""Budgets of seconds and of megabytes: what they leave of the settings."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from gsencoder.core.errors import InputError
from gsencoder.core.settings import MEGABYTE
from gsencoder.fusion.budget.config import BudgetConfig
from gsencoder.fusion.budget.rank import RankErrors, file_bytes, rank_of_bytes
from gsencoder.fusion.budget.settings import Setting
from gsencoder.fusion.coverage.sight import Sight


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
