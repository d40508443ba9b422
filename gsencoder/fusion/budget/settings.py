"""The settings that a budget chooses among, with what is predicted of each."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64

from gsencoder.fusion.budget.model import predict_curve
from gsencoder.fusion.budget.rank import RankErrors
from gsencoder.fusion.coverage.sight import Sight

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
