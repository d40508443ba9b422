"""Whether photographs fit their poses, where there is no depth: how far matched features lie from the epipolar lines of
the poses (Hartley and Zisserman 2004, ch. 9).

Which matches are right is decided without the poses, by a fundamental matrix of each pair alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.even_indices import even_indices
from gsencoder.core.runtime.tracking import Track, untracked
from gsencoder.data.check.findings import ADVICE, Finding
from gsencoder.data.check.pose_readings import other_orders, other_poses
from gsencoder.data.readers.undistort import load_pycolmap
from gsencoder.data.seeding.feature_matches import (
    PairMatches,
    epipolar_distances,
    fundamental_matrix,
    match_photographs,
)
from gsencoder.types import Cameras, Views

PICTURE_SIZE = 640
"""Longer side in pixels of the photographs that are matched."""
FEATURES = 1000
MIN_MATCHES = 25
"""Pairs with fewer matches that fit one fundamental matrix are left out …"""
MIN_SHARE = 0.4
"""… and those where fewer than this share of all matches do."""
INLIER_ERROR = 2.0
CLIP = 20.0
"""Errors beyond this many pixels count as this much."""
TOLERANCE = 2.0
"""Matches within so many pixels of their lines agree with the poses."""
BETTER = 0.6
"""Another reading is named if its error is below this share of the files' own, and …"""
BAD = 1.0
"""… the files' own is above so many pixels."""
UNFIT = 3.0
"""Photographs whose matches lie farther than so many pixels from their lines do not fit their poses."""
FOCAL_FACTORS: tuple[float, ...] = tuple(np.round(np.geomspace(0.7, 1.43, 31), 4).tolist())
SMALLEST_FACTOR = 1.03
STRAY_ERROR = 3.0
"""A view is astray if the median error of its pairs is above so many pixels, and above …"""
STRAY_FACTOR = 3.0
"""… this many times that of the other pairs."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EpipolarCheck:
    """How matched features fit the poses.

    Attributes:
        views: rows of the views that were looked at.
        pairs: pairs of them with matches.
        matches: number of matches of all pairs.
        error: mean distance of a pair's matches from their epipolar lines, in pixels of pictures of `PICTURE_SIZE`,
            averaged over pairs; at most `CLIP`; NaN without pairs.
        share: of the matches that lie within `TOLERANCE`.
        best_error: the same under the reading that fits best.
        findings: what is wrong.
        worst: the pair with the largest error, for a picture; None without pairs.
        cameras: of the views that were looked at, at the size of the matched pictures, as the files give them.
    """

    views: Int64[np.ndarray, " V"]
    pairs: int
    matches: int
    error: float
    share: float
    best_error: float
    findings: tuple[Finding, ...]
    worst: PairMatches | None
    cameras: Cameras


def check_matches(views: Views, *, limit: int = 24, track: Track = untracked) -> EpipolarCheck:
    """Matches photographs and holds the matches against the poses, and against other readings of them.

    Args:
        views: with photographs.
        limit: largest number of views to look at: evenly spaced groups of three neighbors.
        track: progress.

    Raises:
        InputError: pycolmap is missing or refuses the photographs.
    """
    rows = _spread_triples(len(views), limit)
    cameras = views.cameras.select(rows).resized(PICTURE_SIZE, enlarge=False)
    subset = views.select(rows)
    pairs = [(first, second) for first in range(len(rows)) for second in range(first + 1, len(rows))]
    matches = consistent_matches(match_photographs(subset, cameras, pairs, features=FEATURES, track=track))
    if not matches:
        nan = float("nan")
        return EpipolarCheck(
            views=rows,
            pairs=0,
            matches=0,
            error=nan,
            share=nan,
            best_error=nan,
            findings=(),
            worst=None,
            cameras=cameras,
        )
    errors = pair_errors(cameras, matches)
    error_as_stated = float(np.mean(errors))
    findings: list[Finding] = []
    best, best_error = cameras, error_as_stated
    if error_as_stated > BAD:
        cause, factor, other, error = _best_reading(cameras, views.cameras, rows, matches)
        # One view astray among few raises the mean of all pairs, and no reading of all poses mends that.
        if error < BETTER * error_as_stated:
            findings.append(
                Finding(
                    cause=cause,
                    message=f"{ADVICE[cause].format(factor=factor)} (matches lie {error_as_stated:.1f} pixels "
                    f"from their epipolar lines, {error:.1f} if so read)",
                    factor=factor,
                )
            )
            best, best_error = other, error
    stray = _stray_views(pair_errors(best, matches), matches, subset.names)
    findings += stray
    if best_error > UNFIT and not stray and not findings:
        findings.append(
            Finding(
                cause="unknown",
                message=f"the photographs do not fit their poses: matches lie {best_error:.1f} pixels from their "
                "epipolar lines, and no other reading of the poses fits",
            )
        )
    distances = np.concatenate([_distances(cameras, match) for match in matches])
    return EpipolarCheck(
        views=rows,
        pairs=len(matches),
        matches=len(distances),
        error=error_as_stated,
        share=float((distances <= TOLERANCE).mean()),
        best_error=best_error,
        findings=tuple(findings),
        worst=matches[int(np.argmax(errors))],
        cameras=cameras,
    )


def _spread_triples(count: int, limit: int) -> Int64[np.ndarray, " n"]:
    """Rows of views: groups of three neighbors in the order of the files, which mostly overlap, spread evenly."""
    if count <= limit:
        return np.arange(count)
    first = even_indices(count - 2, max(1, limit // 3))
    return np.unique(np.concatenate((first, first + 1, first + 2)))


def consistent_matches(matches: Sequence[PairMatches]) -> list[PairMatches]:
    """The matches of each pair that fit one fundamental matrix, whatever the poses; pairs with too few are left out."""
    pycolmap = load_pycolmap()
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed, options.max_num_trials = INLIER_ERROR, 0, 2000
    consistent = []
    for pair in matches:
        if len(pair.first_pixels) < MIN_MATCHES:
            continue
        estimate = pycolmap.estimate_fundamental_matrix(pair.first_pixels, pair.second_pixels, options)
        if estimate is None:
            continue
        good = np.asarray(estimate["inlier_mask"], bool)
        if good.sum() >= max(MIN_MATCHES, MIN_SHARE * len(good)):
            consistent.append(
                replace(pair, first_pixels=pair.first_pixels[good], second_pixels=pair.second_pixels[good])
            )
    return consistent


def _distances(cameras: Cameras, pair: PairMatches) -> Float64[np.ndarray, " M"]:
    fundamental = fundamental_matrix(cameras, pair.first, pair.second)
    return epipolar_distances(fundamental, pair.first_pixels, pair.second_pixels)


def pair_errors(cameras: Cameras, matches: Sequence[PairMatches]) -> Float64[np.ndarray, " n"]:
    """The mean clipped distance of each pair's matches from their epipolar lines, pixels."""
    return np.array([np.minimum(_distances(cameras, pair), CLIP).mean() for pair in matches])


def _best_reading(
    cameras: Cameras, all_cameras: Cameras, rows: Int64[np.ndarray, " V"], matches: Sequence[PairMatches]
) -> tuple[str, float | None, Cameras, float]:
    """The other reading of the poses and intrinsics with the smallest error."""
    readings: list[tuple[str, float | None, Cameras]] = [
        (cause, None, replace(cameras, cam_from_world=poses.astype(np.float32)))
        for cause, poses in other_poses(cameras.cam_from_world.astype(np.float64)).items()
    ]
    readings += [
        ("order", float(shift), replace(cameras, cam_from_world=poses[rows].astype(np.float32)))
        for shift, poses in other_orders(all_cameras.cam_from_world)
    ]
    for factor in FOCAL_FACTORS:
        if abs(np.log(factor)) >= np.log(SMALLEST_FACTOR):
            Ks = cameras.Ks.copy()
            Ks[:, :2, :2] *= np.float32(factor)
            readings.append(("focal length", float(factor), replace(cameras, Ks=Ks)))
    candidates = [(*reading, float(pair_errors(reading[2], matches).mean())) for reading in readings]
    return min(candidates, key=lambda reading: reading[3])


def _stray_views(
    errors: Float64[np.ndarray, " n"], matches: Sequence[PairMatches], names: Sequence[str]
) -> list[Finding]:
    """Views whose pairs have clearly larger errors than those of the others; of fewer than four views it cannot be said
    which one it is."""
    findings: list[Finding] = []
    remaining = np.ones(len(matches), bool)
    pair_views = np.array([(pair.first, pair.second) for pair in matches])
    while True:
        worst = None
        for view in np.unique(pair_views[remaining]):
            of_view = remaining & (pair_views == view).any(axis=1)
            others = remaining & ~of_view
            if of_view.sum() < 2 or others.sum() < 3:
                continue
            error, usual = float(np.median(errors[of_view])), float(np.median(errors[others]))
            if error > max(STRAY_ERROR, STRAY_FACTOR * usual) and (worst is None or error > worst[1]):
                worst = int(view), error, usual
        if worst is None:
            return findings
        view, error, usual = worst
        message = (
            f"its photograph does not fit its pose: its matches lie {error:.1f} pixels from their epipolar lines, "
            f"those of the other views {usual:.1f}"
        )
        findings.append(Finding(cause="stray view", message=message, view=names[view]))
        remaining &= ~(pair_views == view).any(axis=1)
