"""What is wrong with a scene's poses, depth and photographs, found by holding its views against each other."""

from dataclasses import dataclass

import numpy as np

from gsencoder.data.check.color_agreement import color_correlations, grey_pictures, view_correlations
from gsencoder.data.check.depth_agreement import Agreement, DepthViews, chosen_views, depth_views, residuals
from gsencoder.data.check.readings import Reading, as_given, other_readings
from gsencoder.data.check.stray_views import fit_pose, surface_normals, view_spreads
from gsencoder.types import Views

BETTER = 0.95
"""Another reading of the files is named if its spread is below this share of the files' own."""
SMALLEST_FACTOR = 1.015
"""Factors nearer to one are within what sensors are calibrated to."""
STRAY = 0.9
"""A view is astray if moving it brings its spread below this share."""
SUSPECTS = 8
"""So many views, those that fit worst, are tried to be moved."""
OTHER_PICTURE = 0.8
"""A view whose colors correlate with the others' by less than this share of the median shows something else."""

ADVICE = {
    "axes": "the poses are in OpenGL's camera axes where OpenCV's are expected, or the reverse",
    "inverse": "the matrices are cam_from_world where world_from_cam is expected, or the reverse",
    "inverse and axes": "the matrices are the inverse of what is expected, in the other camera axes",
    "ray length": "depth is the length of the ray where the coordinate z is expected",
    "depth scale": "the depth scale is wrong: depths should be {factor:.4g} times as large",
    "depth focal length": "depth has the focal length of another sensor: {factor:.4g} times the stated one",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Something that is wrong.

    Attributes:
        cause: a key of `ADVICE`, "stray view" or "other picture".
        message: for people.
        view: name of the view, if it is one alone.
        factor: of the depth scale or the focal length, where the cause has one.
    """

    cause: str
    message: str
    view: str | None = None
    factor: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthCheck:
    """How the depth images and photographs of a scene agree.

    Attributes:
        views: names of the views that were looked at.
        given: agreement of depth as the files have it.
        best: that of the reading that fits best; `given` unless a finding names another.
        findings: what is wrong, causes that concern all views first.
        color: median correlation of the photographs' intensities at the same places; NaN without photographs.
    """

    views: tuple[str, ...]
    given: Agreement
    best: Agreement
    findings: tuple[Finding, ...]
    color: float


def check_depth(views: Views, *, limit: int = 32) -> DepthCheck:
    """Holds the depth images of a scene against each other, and its photographs against each other through depth.

    Args:
        views: with depth.
        limit: largest number of views to look at, evenly spaced.
    """
    chosen = chosen_views(len(views), limit)
    names = tuple(views.names[int(view)] for view in chosen)
    small = depth_views(views, chosen)
    given = as_given(small)
    best = _best_reading(given, small)
    findings = []
    if best is not given:
        message = ADVICE[best.cause].format(factor=best.factor)
        shares = f"{given.agreement.share:.0%} of the depth agrees across views, {best.agreement.share:.0%} if so read"
        findings.append(Finding(cause=best.cause, message=f"{message} ({shares})", factor=best.factor))
    stray = _stray_views(best.views, names)
    findings += stray
    color = float("nan")
    if views.images is not None:
        grey = grey_pictures(views, chosen, small.depths.shape[1:])
        correlation = view_correlations(color_correlations(best.views, grey, small.Ks))
        if np.isfinite(correlation).any():
            color = float(np.nanmedian(correlation))
            findings += [
                Finding(
                    cause="other picture",
                    message=f"its photograph does not show what its depth does (correlation with other views "
                    f"{correlation[view]:.2f}, median {color:.2f})",
                    view=names[view],
                )
                for view in np.flatnonzero(correlation < OTHER_PICTURE * color)
                if names[view] not in {finding.view for finding in stray}
            ]
    return DepthCheck(views=names, given=given.agreement, best=best.agreement, findings=tuple(findings), color=color)


def _best_reading(given: Reading, views: DepthViews) -> Reading:
    """The files' own reading, or another one that fits clearly better."""
    needed = 0.02 * len(views) * (len(views) - 1) * views.values.shape[1]
    candidates = [
        reading
        for reading in other_readings(views)
        if reading.agreement.compared >= needed
        and (reading.factor is None or abs(np.log(reading.factor)) >= np.log(SMALLEST_FACTOR))
    ]
    best = min(candidates, key=lambda reading: reading.agreement.spread, default=given)
    if not np.isfinite(given.agreement.spread):
        return best
    return best if best.agreement.spread < BETTER * given.agreement.spread else given


def _stray_views(views: DepthViews, names: tuple[str, ...]) -> list[Finding]:
    """Views that fit clearly better once they are moved."""
    spreads = view_spreads(residuals(views))
    suspects = np.argsort(-np.nan_to_num(spreads))[:SUSPECTS]
    normals = [surface_normals(views, view) for view in range(len(views))]
    findings = []
    for view in sorted(int(suspect) for suspect in suspects):
        fit = fit_pose(views, view, normals)
        if fit.after < STRAY * fit.before:
            message = (
                f"its pose does not fit the other views: {fit.moved:.3g} units and {np.rad2deg(fit.turned):.2f}° off"
            )
            findings.append(Finding(cause="stray view", message=message, view=names[view]))
    return findings
