"""What can be wrong with the files of a scene, and how it is said."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64, Int64

from gsencoder.data.check.agreement import Agreement, DepthViews, agreement, residuals
from gsencoder.types.checks import OPENCV_FROM_OPENGL, invert_rigid

ADVICE = {
    "axes": "the poses are in OpenGL's camera axes where OpenCV's are expected, or the reverse",
    "inverse": "the matrices are cam_from_world where world_from_cam is expected, or the reverse",
    "inverse and axes": "the matrices are the inverse of what is expected, in the other camera axes",
    "order": "the poses belong to other photographs: each is that of the photograph {factor:+.0f} places away",
    "ray length": "depth is the length of the ray where the coordinate z is expected",
    "depth scale": "the depth scale is wrong: depths should be {factor:.4g} times as large",
    "depth focal length": "depth has the focal length of another sensor: {factor:.4g} times the stated one",
    "focal length": "the focal length of the photographs is {factor:.4g} times the stated one",
    "picture size": "the intrinsics are those of pictures of another size: times {factor:.4g} they would fit these",
}
"""Causes that concern all views."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that is wrong.

    Attributes:
        cause: a key of `ADVICE`, "color registration", "stray view", "other picture", "photographs" or
            "unknown".
        message: for people.
        view: name of the view, if it is one alone.
        factor: of the depth scale or a focal length, or how many places the poses are moved by, where the cause has
            one.
    """

    cause: str
    message: str
    view: str | None = None
    factor: float | None = None


PLACES = (-2, -1, 1, 2)
"""So many places in the order of the views poses may be moved by."""


def other_poses(cam_from_world: Float64[np.ndarray, "V 4 4"]) -> dict[str, Float64[np.ndarray, "V 4 4"]]:
    """cam_from_world if the files' matrices mean something else, by the cause in `ADVICE`."""
    inverse = invert_rigid(cam_from_world)
    return {
        "axes": OPENCV_FROM_OPENGL @ cam_from_world,
        "inverse": inverse,
        "inverse and axes": OPENCV_FROM_OPENGL @ inverse,
    }


def other_orders(poses: Float[np.ndarray, "V 4 4"]) -> Iterator[tuple[int, Float[np.ndarray, "V 4 4"]]]:
    """The poses if each belongs to the photograph some places further on, and by how many places; ends are wrapped."""
    if len(poses) > 2:
        for shift in PLACES:
            yield shift, np.roll(poses, shift, axis=0)


SCALES = (1e-3, 1e-2, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 1e2, 1e3)
"""Depth scales that files are mistaken by: other units, and steps of other sensors."""
NEAR_FACTORS: tuple[float, ...] = tuple(np.round(np.geomspace(0.8, 1.25, 25), 4).tolist())
"""Factors of the depth scale and of the focal length that are tried first; the best is refined."""
REFINEMENTS = 6
MIN_COMPARED = 0.02
"""A reading under which fewer samples than this share of all pairs can be compared says nothing."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reading:
    """One way to take the numbers of a scene.

    Attributes:
        cause: what would be wrong with the files if this reading is right; empty for the files' own.
        factor: of the depth scale or of the focal length, or the places that poses are moved by, where the cause has
            one.
        views: the depth images under this reading.
        agreement: of them.
    """

    cause: str
    views: DepthViews
    agreement: Agreement
    factor: float | None = None


def stated_reading(views: DepthViews) -> Reading:
    """The files' own reading."""
    return Reading(cause="", views=views, agreement=agreement(residuals(views)))


def other_readings(
    views: DepthViews, rows: Int64[np.ndarray, " V"], all_poses: Float[np.ndarray, "n 4 4"]
) -> list[Reading]:
    """Every other reading, those with a factor at the factor where depths agree best.

    Args:
        all_poses: cam_from_world of all views.
    """
    fixed: list[tuple[str, float | None, DepthViews]] = [
        (cause, None, replace(views, cam_from_world=poses))
        for cause, poses in other_poses(views.cam_from_world).items()
    ]
    fixed += [
        ("order", float(shift), replace(views, cam_from_world=poses[rows].astype(np.float64)))
        for shift, poses in other_orders(all_poses)
    ]
    fixed.append(("ray length", None, views.of_rays()))
    readings = [
        Reading(cause=cause, views=other, agreement=agreement(residuals(other)), factor=factor)
        for cause, factor, other in fixed
    ]
    readings.append(_best_factor("depth scale", lambda factor: replace(views, scale=factor), (*SCALES, *NEAR_FACTORS)))
    readings.append(_best_factor("depth focal length", views.with_focal_times, NEAR_FACTORS))
    return readings


def _best_factor(cause: str, apply: Callable[[float], DepthViews], factors: Sequence[float]) -> Reading:
    """The reading of the factor with the smallest spread, refined by golden sections between its neighbors."""

    def spread(factor: float) -> float:
        measured = agreement(residuals(apply(factor)))
        return measured.spread if measured.compared >= min_compared else np.inf

    min_compared = MIN_COMPARED * len(apply(1.0)) * (len(apply(1.0)) - 1) * apply(1.0).values.shape[1]
    spreads = {factor: spread(factor) for factor in sorted(factors)}
    best = min(spreads, key=lambda factor: spreads[factor])
    step = 1.02
    for _ in range(REFINEMENTS):
        for factor in (best / step, best * step):
            spreads.setdefault(factor, spread(factor))
        best = min(spreads, key=lambda factor: spreads[factor])
        step = step**0.5
    corrected = apply(best)
    return Reading(cause=cause, views=corrected, agreement=agreement(residuals(corrected)), factor=best)
