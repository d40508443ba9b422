"""Targets of a choice of views: the Gaussians of boxes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Integer

from gsencoder.core.errors import InputError
from gsencoder.infer.views.constants import CONSTANTS
from gsencoder.types import Box, Gaussians, Localization


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """Something to look at.

    Attributes:
        name: for people, such as "mug" or "mug 2".
        rows: its Gaussians.
        center: the middle of their means, relative to the scene's origin.
        radius: of the ball around it that holds their means, world units, > 0.
    """

    name: str
    rows: Integer[np.ndarray, " n"]
    center: Float64[np.ndarray, "3"]
    radius: float


def target_of(name: str, gaussians: Gaussians, rows: Integer[np.ndarray, " n"]) -> Target:
    """A target of some Gaussians.

    Raises:
        InputError: no rows.
    """
    if not len(rows):
        raise InputError(f"views: {name!r} has no Gaussians to look at")
    means = gaussians.means[rows].astype(np.float64)
    center = (means.min(axis=0) + means.max(axis=0)) / 2
    # A single Gaussian is as large as it is drawn.
    least = CONSTANTS.point_radius_scales * float(np.median(gaussians.scales[rows].max(axis=1)))
    radius = max(float(np.linalg.norm(means - center, axis=1).max()), least)
    return Target(name=name, rows=np.asarray(rows), center=center, radius=radius)


def best_boxes(localization: Localization, per_word: int) -> tuple[Box, ...]:
    """So many boxes of each word, best first within it."""
    return tuple(box for box in localization.boxes if box.rank < per_word)


def targets_of(gaussians: Gaussians, localization: Localization, per_word: int = 1) -> tuple[Target, ...]:
    """The best boxes of each word as targets; words without a box give none.

    Args:
        gaussians: the scene's.
        localization: relevancy and boxes of the words.
        per_word: boxes taken of each word, best first.
    """
    boxes = best_boxes(localization, per_word)
    names = [box.query if box.rank == 0 else f"{box.query} {box.rank + 1}" for box in boxes]
    return tuple(target_of(name, gaussians, box.rows) for name, box in zip(names, boxes, strict=True))


def check_targets(targets: Sequence[Target], gaussians: Gaussians) -> None:
    """Complains about targets of another splat.

    Raises:
        InputError: no targets, or rows that the splat does not have.
    """
    if not targets:
        raise InputError("views: there is nothing to look at; give one target or more")
    for target in targets:
        if target.rows.min() < 0 or target.rows.max() >= len(gaussians):
            raise InputError(f"views: {target.name!r} has Gaussians beyond the {len(gaussians):,} of the splat")
