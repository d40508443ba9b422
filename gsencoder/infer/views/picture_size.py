"""Pictures of views within megabytes: they are made smaller, down to a least side, and then fewer."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError, counted
from gsencoder.core.files import picture_bytes
from gsencoder.core.settings import MEGABYTE, shown_value
from gsencoder.infer.draw.pictures import Picture
from gsencoder.infer.views.budget import ViewsBudget
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.infer.views.pictures import view_pictures
from gsencoder.infer.views.selection import ViewSet
from gsencoder.infer.views.write import SUFFIX
from gsencoder.types import Scene

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
