"""What is wrong with a scene's poses, depth and photographs, found by holding its views against each other."""

import warnings
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import SceneWarning
from gsencoder.core.process import Track, untracked
from gsencoder.data.check.agreement import (
    ADVICE,
    CLIP,
    Agreement,
    DepthViews,
    Finding,
    Reading,
    RegistrationFit,
    color_correlations,
    depth_at,
    depth_views,
    fit_registration,
    grey_picture,
    other_readings,
    reading_of_files,
    residuals,
    view_correlations,
    world_samples,
)
from gsencoder.data.check.epipolar import EpipolarCheck, check_matches
from gsencoder.types import Cameras, Scene, Views
from gsencoder.types.scene import invert_rigid, transform

REACHES = (0.15,) * 4 + (0.1,) * 4 + (0.07,) * 3 + (0.05, 0.04, 0.03, 0.03, 0.03)
"""Samples are matched to the surface on their pixel's ray in another view if its depth differs by at most this share,
one for each step: at first far, then near, so that what is hidden there is left out."""
HUBER = 0.01  # Distances beyond this share of the depth count linearly


class PoseFit(NamedTuple):
    """How far a view would have to move to lie on the others' surfaces."""

    moved: float  # distance in world units
    turned: float  # angle in radians
    spread: float  # mean clipped residual of the view once it is moved, as `Agreement.spread`


def view_spreads(residual: Float64[np.ndarray, "V V n"]) -> Float64[np.ndarray, " V"]:
    """The spread of each view's comparisons in both directions; NaN for a view that nothing compares with."""
    clipped = np.minimum(np.abs(residual), CLIP)
    total = np.nansum(clipped, axis=(1, 2)) + np.nansum(clipped, axis=(0, 2))
    count = np.isfinite(residual).sum(axis=(1, 2)) + np.isfinite(residual).sum(axis=(0, 2))
    return np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)


def surface_normals(views: DepthViews, view: int) -> Float64[np.ndarray, "h w 3"]:
    """Unit normals of a depth image in the world, from differences between neighboring pixels; NaN next to pixels
    without depth."""
    depth = views.depths[view].astype(np.float64) * views.scale
    depth[depth <= 0] = np.nan
    height, width = depth.shape
    K = views.Ks[view]
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    points = np.stack(((columns - K[0, 2]) / K[0, 0] * depth, (rows - K[1, 2]) / K[1, 1] * depth, depth), axis=2)
    normals = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    with np.errstate(invalid="ignore"):
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return normals @ views.cam_from_world[view, :3, :3]


def fit_pose(views: DepthViews, view: int, normals: list[Float64[np.ndarray, "h w 3"]]) -> PoseFit:
    """Moves one view by point-to-plane steps (Chen and Medioni 1992) onto the surfaces of the others, which stay.

    `normals` are those of all views, by `surface_normals`.
    """
    from scipy.spatial.transform import Rotation

    points = world_samples(views)[view]
    points = points[views.values[view] > 0]
    centers = invert_rigid(views.cam_from_world)[:, :3, 3]
    center, motion = centers[view], np.eye(4)
    for reach in REACHES:
        here = transform(motion, points)
        normal_matrix, normal_vector = np.zeros((6, 6)), np.zeros(6)
        for other in range(len(views)):
            if other == view:
                continue
            inside, at, z, measured = depth_at(views, other, here, np.ones(len(here), bool))
            normal = normals[other][at[:, 0], at[:, 1]]
            good = (measured > 0) & (np.abs(z - measured) <= reach * measured) & np.isfinite(normal).all(axis=1)
            normal, observed, measured, z = normal[good], here[inside][good], measured[good], z[good]
            # Along the ray of the pixel the surface lies at the measured depth.
            target = centers[other] + (observed - centers[other]) * (measured / z)[:, None]
            distance = np.einsum("ni,ni->n", observed - target, normal)
            scale = HUBER * measured
            weight = np.minimum(1, scale / np.maximum(np.abs(distance), 1e-12)) / np.square(scale)
            jacobian = np.hstack((np.cross(observed - center, normal), normal))
            normal_matrix += (jacobian * weight[:, None]).T @ jacobian
            normal_vector -= jacobian.T @ (weight * distance)
        if not normal_matrix.any():
            break
        step = np.linalg.solve(normal_matrix + 1e-6 * np.trace(normal_matrix) / 6 * np.eye(6), normal_vector)
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
        turn[:3, 3] = center + step[3:] - turn[:3, :3] @ center
        motion = turn @ motion
    poses = views.cam_from_world.copy()
    poses[view] = poses[view] @ invert_rigid(motion)
    return PoseFit(
        moved=float(np.linalg.norm(transform(motion, center[None])[0] - center)),
        turned=float(np.linalg.norm(Rotation.from_matrix(motion[:3, :3]).as_rotvec())),
        spread=float(view_spreads(residuals(replace(views, cam_from_world=poses)))[view]),
    )


BETTER = 0.95  # Another reading of the files is named if its spread is below this share of the files' own
SMALLEST_FACTOR = 1.015  # Factors nearer to one are within what sensors are calibrated to
UNFIT = 0.5  # If a smaller share of the depth agrees under every reading, poses and depth do not belong together
CLEAR = 0.7  # Where the files' own reading compares nothing, another one is named if this share agrees under it
STRAY, STRAY_SPREAD = 0.9, 0.002
"""A view is astray if moving it brings its spread below this share, and it is above what pixels alone make."""
SUSPECTS = 8  # Views, of the worst fit, that are tried to be moved
OTHER_PICTURE = 0.8
"""A view whose colors correlate with the others' by less than this share of the median shows something else."""
UNRELATED = 0.3  # Photographs whose colors correlate by less than this across views show something else than the depth
SAME_FACTOR = 0.03
"""Depth and photographs whose focal lengths are off by factors this near to each other share one wrong camera."""
OFF_CENTER = 1.3
"""A principal point this many times as far right and down as the middle, or more, is that of a larger picture; one that
is this many times as near to the corner, that of a smaller one …"""
EQUALLY = 0.05  # … if it is equally far right and down, to this share
SUSPICIOUS = 0.9  # `suspicious_depth` looks for the cause where a smaller share of the depth agrees


UNRELATED_MESSAGE = (
    "the photographs do not show what the depth does: colors at the same places correlate by {color:.2f} across views"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthCheck:
    """How the depth images and photographs of a scene agree."""

    views: Int64[np.ndarray, " V"]  # rows of the views that were looked at
    given: Agreement  # agreement of depth as the files have it
    best: Agreement  # that of the reading that fits best; `given` unless a finding names another
    findings: tuple[Finding, ...]  # what is wrong, causes that concern all views first
    color: float  # median correlation of the photographs' intensities at the same places; NaN without photographs
    registration: RegistrationFit | None  # of photographs and depth; None without photographs
    depth: DepthViews  # the depth images, as the files have them

    @property
    def comparable(self) -> bool:
        """Whether enough of the depth lands in other views for a judgement."""
        return self.best.compared >= self.depth.min_compared


def check_scene(
    views: Views, *, limit: int = 0, track: Track = untracked
) -> tuple[DepthCheck | None, EpipolarCheck | None]:
    """Holds the views of a scene against each other: by their depth and, where that says nothing, by matched features.

    Args:
        limit: largest number of views to look at; 0 = 32 of depth images, 24 of photographs.
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
        return depth.given.share
    return matches.share if matches is not None else float("nan")


def warn_of_faults(scene: Scene) -> None:
    """Warns if a quick look at a scene's intrinsics and depth images says that they, or the poses, are wrong."""
    views = scene.views
    if views is None:
        return
    finding = wrong_size(views.cameras)
    if finding is None and views.depths is not None and len(views.names) > 1:
        finding = suspicious_depth(views)[1]
    if finding is not None:
        mends = "" if finding.cause == "unknown" else ", and gsencoder repair can mend it"
        warnings.warn(
            f"scene {scene.name}: {finding.message}; gsencoder inspect says more{mends}", SceneWarning, stacklevel=2
        )


def check_depth(views: Views, *, limit: int = 32) -> DepthCheck:
    """Holds the depth images of a scene against each other, and its photographs against each other through depth.

    Args:
        limit: largest number of views to look at, evenly spaced.
    """
    rows = even_indices(len(views), limit)
    names = tuple(views.names[int(view)] for view in rows)
    small = depth_views(views, rows)
    given = reading_of_files(small)
    best = _best_reading(given, small, rows, views)
    comparable = best.agreement.compared >= small.min_compared
    findings = _reading_findings(given, best) if comparable else []
    fits = comparable and best.agreement.share >= UNFIT
    stray = _stray_views(best.views, names) if fits else []
    color, registration = float("nan"), None
    other: list[Finding] = []
    if views.images is not None and fits:
        registration = fit_registration(views, rows, best.views)
        findings = _with_registration(findings, registration)
        height, width = small.depths.shape[1:]
        grey = np.stack([grey_picture(views, int(row), width, height) for row in rows])
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
        given=given.agreement,
        best=best.agreement,
        findings=(*findings, *stray, *other),
        color=color,
        registration=registration,
        depth=small,
    )


def suspicious_depth(views: Views) -> tuple[Agreement, Finding | None]:
    """A quick look at few views: how well their depth agrees and, if not well, the likely cause."""
    rows = even_indices(len(views), 10)
    small = depth_views(views, rows)
    given = reading_of_files(small)
    if given.agreement.compared >= small.min_compared and given.agreement.share >= SUSPICIOUS:
        return given.agreement, None
    best = _best_reading(given, small, rows, views)
    if best.agreement.compared < small.min_compared:
        return given.agreement, None
    return given.agreement, next(iter(_reading_findings(given, best)), None)


def _best_reading(given: Reading, depth: DepthViews, rows: Int64[np.ndarray, " V"], views: Views) -> Reading:
    """The files' own reading, or another one that fits clearly better."""
    candidates = [
        reading
        for reading in other_readings(depth, rows, views.cameras.cam_from_world)
        if reading.agreement.compared >= depth.min_compared
        and (
            reading.cause == "order" or reading.factor is None or abs(np.log(reading.factor)) >= np.log(SMALLEST_FACTOR)
        )
    ]
    best = min(candidates, key=lambda reading: reading.agreement.spread, default=given)
    if given.agreement.compared < depth.min_compared:
        # Views that share nothing are no fault; only a reading under which they agree says that they should.
        return best if best.agreement.share >= CLEAR else given
    return best if best.agreement.spread < BETTER * given.agreement.spread else given


def _reading_findings(given: Reading, best: Reading) -> list[Finding]:
    """What the reading that fits best says about the files."""
    share = best.agreement.share
    if share < UNFIT:
        message = (
            f"poses and depth do not belong together: {given.agreement.share:.0%} of the depth agrees across views, "
            f"and no other reading of the files has more than {share:.0%}"
        )
        return [Finding(cause="unknown", message=message)]
    if best is given:
        return []
    message = ADVICE[best.cause].format(factor=best.factor)
    shares = f"{given.agreement.share:.0%} of the depth agrees across views, {share:.0%} if so read"
    return [Finding(cause=best.cause, message=f"{message} ({shares})", factor=best.factor)]


def _with_registration(findings: list[Finding], fit: RegistrationFit) -> list[Finding]:
    """The findings with that of the registration; a focal length that is wrong for both is one finding."""
    if not fit.differs:
        return findings
    correlations = f"details of the photographs correlate by {fit.given:.2f} across views, {fit.best:.2f} if so"
    focal = next((finding for finding in findings if finding.cause == "depth focal length"), None)
    if focal is not None and focal.factor and abs(np.log(fit.focal_factor / focal.factor)) < SAME_FACTOR:
        message = f"{ADVICE['focal length'].format(factor=focal.factor)}, and so is that of the depth ({correlations})"
        return [Finding(cause="focal length", message=message, factor=focal.factor)]
    x, y = fit.shift
    message = (
        f"color and depth are not registered: the photographs have {fit.focal_factor:.4g} times the given focal "
        f"length, and their camera stands {np.hypot(x, y):.3g} units from the depth camera ({correlations})"
    )
    return [*findings, Finding(cause="color registration", message=message, factor=fit.focal_factor)]


def _stray_views(views: DepthViews, names: tuple[str, ...]) -> list[Finding]:
    """Views that fit clearly better once they are moved, worst first; others are tried without those."""
    suspects = np.argsort(-np.nan_to_num(view_spreads(residuals(views))))[:SUSPECTS]
    normals = [surface_normals(views, view) for view in range(len(views))]
    findings, rows = [], list(range(len(views)))
    for view in map(int, suspects):
        others, index = views.select(rows), rows.index(view)
        before = float(view_spreads(residuals(others))[index])
        if not before > STRAY_SPREAD:
            continue
        fit = fit_pose(others, index, [normals[row] for row in rows])
        if fit.spread < STRAY * before:
            rows.remove(view)
            off = f"{fit.moved:.3g} units and {np.rad2deg(fit.turned):.2f}° off"
            message = f"its pose does not fit the other views: {off}"
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
