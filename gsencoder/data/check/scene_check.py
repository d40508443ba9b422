"""What is wrong with a scene's poses, depth and photographs, found by holding its views against each other."""

import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import SceneWarning, listed
from gsencoder.core.process import Track, untracked
from gsencoder.data.check.color_agreement import color_correlations, grey_pictures, view_correlations
from gsencoder.data.check.depth_agreement import (
    Agreement,
    DepthViews,
    depth_views,
    pair_offsets,
    residuals,
)
from gsencoder.data.check.epipolar import EpipolarCheck, check_matches
from gsencoder.data.check.findings import ADVICE, Finding
from gsencoder.data.check.readings import Reading, other_readings, stated_reading
from gsencoder.data.check.registration_fit import RegistrationFit, fit_registration
from gsencoder.data.check.stray_views import fit_pose, surface_normals, view_spreads
from gsencoder.types import Cameras, Scene, Views

BETTER = 0.95
"""Another reading of the files is named if its spread is below this share of the files' own."""
SMALLEST_FACTOR = 1.015
"""Factors nearer to one are within what sensors are calibrated to."""
UNFIT = 0.5
"""If a smaller share of the depth agrees under every reading, poses and depth do not belong together."""
CLEAR = 0.7
"""Where the files' own reading compares nothing, another one is named if this share agrees under it."""
COMPARABLE = 0.02
"""Samples that land in another view, as a share of all pairs, below which depth says nothing about poses."""
STRAY, STRAY_SPREAD = 0.9, 0.002
"""A view is astray if moving it brings its spread below this share, and it is above what pixels alone make."""
SUSPECTS = 8
"""So many views, those that fit worst, are tried to be moved."""
OTHER_PICTURE = 0.8
"""A view whose colors correlate with the others' by less than this share of the median shows something else."""
UNRELATED = 0.3
"""Photographs whose colors correlate by less than this across views show something else than the depth."""
SAME_FACTOR = 0.03
"""Depth and photographs whose focal lengths are off by factors this near to each other share one wrong camera."""
OFF_CENTER = 1.3
"""A principal point this many times as far right and down as the middle, or more, is that of a larger picture; one that
is so many times as near to the corner, that of a smaller one …"""
EQUALLY = 0.05
"""… if it is equally far right and down, to this share."""
PHOTOGRAPHS = 4
"""So many are looked at for pictures of one color."""
SUSPICIOUS = 0.9
"""`suspicious_depth` looks for the cause where a smaller share of the depth agrees."""


UNRELATED_MESSAGE = (
    "the photographs do not show what the depth does: colors at the same places correlate by {color:.2f} across views"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthCheck:
    """How the depth images and photographs of a scene agree.

    Attributes:
        views: rows of the views that were looked at.
        stated: agreement of depth as the files have it.
        best: that of the reading that fits best; `stated` unless a finding names another.
        offsets: see `pair_offsets`, under the reading that fits best.
        findings: what is wrong, causes that concern all views first.
        color: median correlation of the photographs' intensities at the same places; NaN without photographs.
        registration: of photographs and depth; None without photographs.
        depth: the depth images, as the files have them.
    """

    views: Int64[np.ndarray, " V"]
    stated: Agreement
    best: Agreement
    offsets: tuple[float, float]
    findings: tuple[Finding, ...]
    color: float
    registration: RegistrationFit | None
    depth: DepthViews

    @property
    def comparable(self) -> bool:
        """Whether enough of the depth lands in other views for a judgement."""
        return self.best.compared >= _needed(self.depth)


def check_scene(
    views: Views, *, limit: int = 0, track: Track = untracked
) -> tuple[DepthCheck | None, EpipolarCheck | None]:
    """Holds the views of a scene against each other: by their depth and, where that says nothing, by matched features.

    Args:
        views: posed.
        limit: largest number of views to look at; 0 = 32 of depth images, 24 of photographs.
        track: progress.

    Raises:
        InputError: a file is damaged, or photographs need matching and pycolmap is missing.
    """
    depth = check_depth(views, limit=limit or 32) if views.depths is not None and len(views) > 1 else None
    if depth is not None and depth.comparable:
        return depth, None
    if views.images is None or len(views) < 2:
        return depth, None
    return depth, check_matches(views, limit=limit or 24, track=track)


def findings_of(views: Views, depth: DepthCheck | None, matches: EpipolarCheck | None) -> list[Finding]:
    """All findings of both checks; intrinsics of another size are the cause of any other, unless the views fit."""
    found = [finding for check in (depth, matches) if check is not None for finding in check.findings]
    size = None if is_decided(depth, matches) and not found else wrong_size(views.cameras)
    return found if size is None else [size]


def is_decided(depth: DepthCheck | None, matches: EpipolarCheck | None) -> bool:
    """Whether enough could be compared to say that nothing is wrong."""
    return (depth is not None and depth.comparable) or (matches is not None and matches.decided)


def wrong_size(cameras: Cameras) -> Finding | None:
    """A principal point near the corner, or beyond it, is that of intrinsics for pictures of another size."""
    if not len(cameras):
        return None
    right, down = 2 * np.median(cameras.Ks[:, :2, 2] / np.stack((cameras.widths, cameras.heights), axis=1), axis=0)
    if not min(right, down) > 0 or abs(np.log(right / down)) > EQUALLY or abs(np.log(right)) < np.log(OFF_CENTER):
        return None
    (cx, cy), width, height = cameras.Ks[0, :2, 2], cameras.widths[0], cameras.heights[0]
    message = (
        f"{ADVICE['picture size'].format(factor=1 / right)} (the principal point {cx:g}, {cy:g} lies off the middle of "
        f"{width}×{height} pixels); state the w and h that they are of, scale them, or, if these are corners cut out "
        "of larger pictures, leave them"
    )
    return Finding(cause="picture size", message=message, factor=float(1 / right))


def fit_of(depth: DepthCheck | None, matches: EpipolarCheck | None) -> float:
    """The share of what views share that agrees: of depth if it can be compared, else of matches; NaN of neither."""
    if depth is not None and depth.comparable:
        return depth.stated.share
    return matches.share if matches is not None else float("nan")


def warn_of_faults(scene: Scene) -> None:
    """Warns if a quick look at a scene's photographs and depth images says that they, or the poses, are wrong."""
    views = scene.views
    if views is None:
        return
    plain, checked = plain_photographs(views)
    if plain:
        warnings.warn(
            f"scene {scene.name}: {len(plain)} of {checked} photographs that were looked at are of one color all "
            f"over: {listed(plain)}",
            SceneWarning,
            stacklevel=2,
        )
    finding = wrong_size(views.cameras)
    if finding is None and views.depths is not None and len(views) > 1:
        finding = suspicious_depth(views)[1]
    if finding is not None:
        mends = "" if finding.cause == "unknown" else ", and gsencoder repair can mend it"
        warnings.warn(
            f"scene {scene.name}: {finding.message}; gsencoder inspect says more{mends}",
            SceneWarning,
            stacklevel=2,
        )


def plain_photographs(views: Views) -> tuple[list[str], int]:
    """The names of photographs whose pixels all have one color, of up to four, and how many were looked at."""
    if views.images is None or not len(views):
        return [], 0
    rows = even_indices(len(views), PHOTOGRAPHS)
    plain = [int(view) for view in rows if (views.images[int(view)] == views.images[int(view)][:1, :1]).all()]
    return [views.names[view] for view in plain], len(rows)


def check_depth(views: Views, *, limit: int = 32) -> DepthCheck:
    """Holds the depth images of a scene against each other, and its photographs against each other through depth.

    Args:
        views: with depth.
        limit: largest number of views to look at, evenly spaced.
    """
    rows = even_indices(len(views), limit)
    names = tuple(views.names[int(view)] for view in rows)
    small = depth_views(views, rows)
    stated = stated_reading(small)
    best = _best_reading(stated, small, rows, views)
    comparable = best.agreement.compared >= _needed(small)
    findings = _reading_findings(stated, best) if comparable else []
    fits = comparable and best.agreement.share >= UNFIT
    stray = _stray_views(best.views, names) if fits else []
    color, registration = float("nan"), None
    other: list[Finding] = []
    if views.images is not None and fits:
        registration = fit_registration(views, rows, best.views)
        findings = _with_registration(findings, registration)
        grey = grey_pictures(views, rows, small.depths.shape[1:])
        Ks = small.Ks.copy()
        if registration.differs:
            Ks[:, :2, :2] *= registration.focal_factor
        correlation = view_correlations(color_correlations(best.views, grey, Ks))
        if np.isfinite(correlation).any():
            color = float(np.nanmedian(correlation))
            excluded = {str(finding.view) for finding in stray}
            other = (
                _other_pictures(correlation, color, names, excluded)
                if color >= UNRELATED
                else [Finding(cause="photographs", message=UNRELATED_MESSAGE.format(color=color))]
            )
    return DepthCheck(
        views=rows,
        stated=stated.agreement,
        best=best.agreement,
        offsets=pair_offsets(residuals(best.views)),
        findings=(*findings, *stray, *other),
        color=color,
        registration=registration,
        depth=small,
    )


def suspicious_depth(views: Views, *, limit: int = 10) -> tuple[Agreement, Finding | None]:
    """A quick look at few views: how well their depth agrees and, if not well, the likely cause.

    Args:
        views: with depth, two or more.
        limit: largest number of views to look at.
    """
    rows = even_indices(len(views), limit)
    small = depth_views(views, rows)
    stated = stated_reading(small)
    if stated.agreement.compared >= _needed(small) and stated.agreement.share >= SUSPICIOUS:
        return stated.agreement, None
    best = _best_reading(stated, small, rows, views)
    if best.agreement.compared < _needed(small):
        return stated.agreement, None
    return stated.agreement, next(iter(_reading_findings(stated, best)), None)


def _needed(views: DepthViews) -> float:
    """So many samples must land in other views before their depth says anything."""
    return COMPARABLE * len(views) * (len(views) - 1) * views.values.shape[1]


def _best_reading(stated: Reading, depth: DepthViews, rows: Int64[np.ndarray, " V"], views: Views) -> Reading:
    """The files' own reading, or another one that fits clearly better."""
    candidates = [
        reading
        for reading in other_readings(depth, rows, views.cameras.cam_from_world)
        if reading.agreement.compared >= _needed(depth)
        and (reading.cause == "order" or reading.factor is None or _differs(reading.factor))
    ]
    best = min(candidates, key=lambda reading: reading.agreement.spread, default=stated)
    if stated.agreement.compared < _needed(depth):
        # Views that share nothing are no fault; only a reading under which they agree says that they should.
        return best if best.agreement.share >= CLEAR else stated
    return best if best.agreement.spread < BETTER * stated.agreement.spread else stated


def _differs(factor: float) -> bool:
    return abs(float(np.log(factor))) >= float(np.log(SMALLEST_FACTOR))


def _reading_findings(stated: Reading, best: Reading) -> list[Finding]:
    """What the reading that fits best says about the files."""
    share = best.agreement.share
    if share < UNFIT:
        message = (
            f"poses and depth do not belong together: {stated.agreement.share:.0%} of the depth agrees across views, "
            f"and no other reading of the files has more than {share:.0%}"
        )
        return [Finding(cause="unknown", message=message)]
    if best is stated:
        return []
    message = ADVICE[best.cause].format(factor=best.factor)
    shares = f"{stated.agreement.share:.0%} of the depth agrees across views, {share:.0%} if so read"
    return [Finding(cause=best.cause, message=f"{message} ({shares})", factor=best.factor)]


def _with_registration(findings: list[Finding], fit: RegistrationFit) -> list[Finding]:
    """The findings, and that depth and photographs are not registered; a focal length that is wrong for both is one
    finding."""
    if not fit.differs:
        return findings
    correlations = f"details of the photographs correlate by {fit.stated:.2f} across views, {fit.best:.2f} if so"
    focal = next((finding for finding in findings if finding.cause == "depth focal length"), None)
    if focal is not None and focal.factor and abs(np.log(fit.focal_factor / focal.factor)) < SAME_FACTOR:
        message = f"{ADVICE['focal length'].format(factor=focal.factor)}, and so is that of the depth ({correlations})"
        return [Finding(cause="focal length", message=message, factor=focal.factor)]
    x, y = fit.shift
    message = (
        f"color and depth are not registered: the photographs have {fit.focal_factor:.4g} times the stated focal "
        f"length, and their camera stands {np.hypot(x, y):.3g} units beside the depth camera ({correlations})"
    )
    return [*findings, Finding(cause="color registration", message=message, factor=fit.focal_factor)]


def _stray_views(views: DepthViews, names: tuple[str, ...]) -> list[Finding]:
    """Views that fit clearly better once they are moved; those that fit worst are judged first, and others without
    those that are astray."""
    spreads = view_spreads(residuals(views))
    suspects = np.argsort(-np.nan_to_num(spreads))[:SUSPECTS]
    normals = [surface_normals(views, view) for view in range(len(views))]
    findings, rows = [], list(range(len(views)))
    for view in map(int, suspects):
        fit = fit_pose(views.select(rows), rows.index(view), [normals[row] for row in rows])
        if fit.before > STRAY_SPREAD and fit.after < STRAY * fit.before:
            rows.remove(view)
            message = (
                f"its pose does not fit the other views: {fit.moved:.3g} units and {np.rad2deg(fit.turned):.2f}° off"
            )
            findings.append(Finding(cause="stray view", message=message, view=names[view]))
    return sorted(findings, key=lambda finding: names.index(str(finding.view)))


def _other_pictures(
    correlation: Float64[np.ndarray, " V"], usual: float, names: tuple[str, ...], excluded: set[str]
) -> list[Finding]:
    """Views whose photographs show something else than their depth."""
    return [
        Finding(
            cause="other picture",
            message=f"its photograph does not show what its depth does (correlation with other views "
            f"{correlation[view]:.2f}, median {usual:.2f})",
            view=names[view],
        )
        for view in np.flatnonzero(correlation < OTHER_PICTURE * usual)
        if names[view] not in excluded
    ]
