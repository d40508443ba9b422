"""Whether photographs fit their poses, where there is no depth: how far matched features lie from the epipolar lines of
the poses (Hartley and Zisserman 2004, ch. 9).

Which matches are right is decided without the poses, by a fundamental matrix of each pair alone. That is no proof: far
views of a wallpaper match well where its motif repeats, while wrong poses fit right matches nowhere. So each view is
compared in the pairs with its nearest neighbors, and it is called astray only if it has another pose that fits them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.process import Track, untracked
from gsencoder.data.check.agreement import ADVICE, Finding, other_orders, other_poses
from gsencoder.data.readers.posed import load_pycolmap
from gsencoder.data.seeding.matches import (
    PairMatches,
    epipolar_distances,
    fundamental_matrix,
    match_photographs,
    typical_distance,
)
from gsencoder.types import Cameras, Views
from gsencoder.types.scene import unproject_points

PICTURE_SIZE = 640  # Longer side in pixels of the photographs that are matched
FEATURES = 1000
MIN_MATCHES = 25  # Pairs with fewer matches that fit one fundamental matrix are left out …
MIN_SHARE = 0.4  # … and those where fewer than this share of all matches do
INLIER_ERROR = 2.0
CLIP = 20.0  # Errors beyond this many pixels count as this much
TOLERANCE = 2.0  # Matches within this many pixels of their lines agree with the poses
BETTER = 0.6  # Another reading is named if its error is below this share of the files' own, and …
BAD = 1.0  # … the files' own is above this many pixels
UNFIT = 3.0  # Photographs whose matches lie farther than this many pixels from their lines do not fit their poses
FOCAL_FACTORS: tuple[float, ...] = tuple(np.round(np.geomspace(0.7, 1.43, 31), 4).tolist())
SMALLEST_FACTOR = 1.03
NEAREST = 3  # Pairs that count are among this many of one of their views that are nearest to each other …
FEWEST_PAIRS = 3  # … and nothing is said of fewer
FIT_FACTOR, FIT_RANGE = 3.0, (1.0, 6.0)
"""A pair fits if the median error of its matches is at most this many times that of the middle pair, and a number of
pixels in this range: poses of tracked sequences are off by 3 pixels, those of structure from motion by 0.3."""
UNKNOWN_PAIRS = (
    6  # Without another reading that fits, poses are only called wrong by this many pairs, of whose matches …
)
UNKNOWN_SHARE = 0.1  # … less than this share is in pairs that fit
STRAY_ERROR = 2.0  # A view may be astray if the error of its pairs is above this many pixels, and above …
STRAY_FACTOR = 3.0  # … this many times that of the middle one of the other pairs, and less than …
STRAY_SHARE = 0.25
"""… this share of their matches is in pairs that fit. It is astray if it has another pose under which two pairs fit
and …"""
MOVED_SHARE, STRAY_GAIN = 0.5, 3.0
"""… this share of the matches is in pairs that do, and errors are this many times smaller."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EpipolarCheck:
    """How matched features fit the poses."""

    views: Int64[np.ndarray, " V"]  # rows of the views that were looked at
    pairs: int = 0  # pairs of them with matches
    matches: int = 0  # number of matches of all pairs
    # Mean distance of a pair's matches from their epipolar lines, in pixels of pictures of `PICTURE_SIZE`, averaged
    # over pairs; at most `CLIP`; NaN without pairs.
    error: float = float("nan")
    share: float = float("nan")  # of the matches that lie within `TOLERANCE`
    best_error: float = float("nan")  # the same under the reading that fits best, over the pairs that count
    findings: tuple[Finding, ...] = ()  # what is wrong
    # False if there are too few pairs to say anything, or most of the matches do not fit and it cannot be said why.
    decided: bool = False
    # Names of the views of which nothing can be said: they have no pair that fits, and are not astray.
    unmatched: tuple[str, ...] = ()
    worst: PairMatches | None = None  # the pair with the largest error, for a picture; None without pairs
    cameras: Cameras  # of the views that were looked at, at the size of the matched pictures, as the files give them


def check_matches(views: Views, *, limit: int = 24, track: Track = untracked) -> EpipolarCheck:
    """Matches photographs and holds the matches against the poses, and against other readings of them.

    Args:
        limit: largest number of views to look at: evenly spaced groups of three neighbors.
    """
    rows = _spread_triples(len(views), limit)
    cameras = views.cameras.select(rows).resized(PICTURE_SIZE, enlarge=False)
    subset = views.select(rows)
    pairs = [(first, second) for first in range(len(rows)) for second in range(first + 1, len(rows))]
    matches = consistent_matches(match_photographs(subset, cameras, pairs, features=FEATURES, track=track))
    return judge_matches(matches, cameras, views.cameras, rows, subset.names)


def judge_matches(
    matches: Sequence[PairMatches],
    cameras: Cameras,
    all_cameras: Cameras,
    rows: Int64[np.ndarray, " V"],
    names: Sequence[str],
) -> EpipolarCheck:
    """Holds consistent matches of views against their poses, and against other readings of them.

    Args:
        cameras: of the views, at the size of the matched pictures.
    """
    if not matches:
        return EpipolarCheck(views=rows, cameras=cameras)
    near = near_pairs(cameras, matches)
    best, best_error = cameras, mean_error(cameras, near)
    findings: list[Finding] = []
    limit = _fit_limit(cameras, near)
    enough = len(near) >= FEWEST_PAIRS
    if enough and best_error > BAD:
        cause, factor, other, error = _best_reading(cameras, all_cameras, rows, near)
        # One view astray among few raises the mean of all pairs, and no reading of all poses mends that.
        if error < BETTER * best_error and inlier_share(other, near, _fit_limit(other, near)) >= 0.5:
            findings.append(
                Finding(
                    cause=cause,
                    message=f"{ADVICE[cause].format(factor=factor)} (matches lie {best_error:.1f} pixels "
                    f"from their epipolar lines, {error:.1f} if so read)",
                    factor=factor,
                )
            )
            best, best_error, limit = other, error, _fit_limit(other, near)
    findings += _stray_views(best, matches, names, limit)
    fitting = inlier_share(best, near, limit)
    if best_error > UNFIT and not findings and len(near) >= UNKNOWN_PAIRS and fitting < UNKNOWN_SHARE:
        findings.append(
            Finding(
                cause="unknown",
                message=f"the photographs do not fit their poses: matches lie {best_error:.1f} pixels from their "
                "epipolar lines, and no other reading of the poses fits",
            )
        )
    matched = {view for pair in matches if _fits(best, pair, limit) for view in (pair.first, pair.second)}
    astray = {finding.view for finding in findings}
    distances = [_distances(cameras, pair) for pair in matches]
    all_distances = np.concatenate(distances)
    return EpipolarCheck(
        views=rows,
        pairs=len(matches),
        matches=len(all_distances),
        error=float(np.mean([_clipped(each) for each in distances])),
        share=float((all_distances <= TOLERANCE).mean()),
        best_error=best_error,
        findings=tuple(findings),
        decided=bool(findings) or (enough and fitting >= 0.5),
        unmatched=tuple(name for view, name in enumerate(names) if view not in matched and name not in astray),
        worst=max(zip(distances, matches, strict=True), key=lambda pair: _clipped(pair[0]))[1],
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
    candidates = [(*reading, mean_error(reading[2], matches)) for reading in readings]
    return min(candidates, key=lambda reading: reading[3])


def near_pairs(cameras: Cameras, matches: Sequence[PairMatches], view: int | None = None) -> list[PairMatches]:
    """The pairs that are among the `NEAREST` of one of their views, or of one view: the turn between them in radians
    and their distance, as a share of the distance to what they look at, are smallest together."""
    forward, centers = cameras.cam_from_world[:, 2, :3], cameras.centers
    first, second = np.array([(pair.first, pair.second) for pair in matches], np.int64).reshape(-1, 2).T
    turns = np.arccos(np.einsum("pi,pi->p", forward[first], forward[second]).clip(-1, 1))
    apart = turns + np.linalg.norm(centers[first] - centers[second], axis=1) / typical_distance(cameras)
    near: set[int] = set()
    for each in np.unique((first, second)) if view is None else (view,):
        own = np.flatnonzero((first == each) | (second == each))
        near |= set(own[np.argsort(apart[own], kind="stable")[:NEAREST]].tolist())
    return [matches[row] for row in sorted(near)]


def mean_error(cameras: Cameras, matches: Sequence[PairMatches]) -> float:
    """The mean clipped distance of all matches from their epipolar lines, pixels."""
    return _clipped(np.concatenate([_distances(cameras, pair) for pair in matches]))


def _clipped(distances: Float64[np.ndarray, " n"]) -> float:
    return float(np.minimum(distances, CLIP).mean())


def _usual_error(cameras: Cameras, matches: Sequence[PairMatches]) -> float:
    """The median error in pixels of the middle pair."""
    return float(np.median([np.median(_distances(cameras, pair)) for pair in matches]))


def _fit_limit(cameras: Cameras, matches: Sequence[PairMatches]) -> float:
    """The largest median error in pixels of a pair that fits."""
    return float(np.clip(FIT_FACTOR * _usual_error(cameras, matches), *FIT_RANGE))


def inlier_share(cameras: Cameras, matches: Sequence[PairMatches], limit: float) -> float:
    """The share of matches that are in pairs that fit."""
    counts = np.array([len(pair.first_pixels) for pair in matches])
    return float(counts[[_fits(cameras, pair, limit) for pair in matches]].sum() / counts.sum())


def _fits(cameras: Cameras, pair: PairMatches, limit: float) -> bool:
    return float(np.median(_distances(cameras, pair))) <= limit


def _stray_views(cameras: Cameras, matches: Sequence[PairMatches], names: Sequence[str], limit: float) -> list[Finding]:
    """Views, of four or more, whose nearest pairs do not fit, and which have another pose that does."""
    findings: list[Finding] = []
    remaining = [(pair, _fits(cameras, pair, limit)) for pair in matches]
    views = {view for pair in matches for view in (pair.first, pair.second)}
    while True:
        suspects = []
        for view in views:
            others = [(pair, fits) for pair, fits in remaining if view not in (pair.first, pair.second)]
            # A neighbor that fits no other may itself be the one that is astray.
            trusted = {end for pair, fits in others if fits for end in (pair.first, pair.second)}
            own = [
                pair
                for pair, fits in remaining
                if view in (pair.first, pair.second) and (fits or trusted & {pair.first, pair.second})
            ]
            own = near_pairs(cameras, own, view)
            if len(own) < 2 or len(others) < 3 or inlier_share(cameras, own, limit) >= STRAY_SHARE:
                continue
            # A second view that is astray is in few of the others' pairs.
            usual = _usual_error(cameras, near_pairs(cameras, [pair for pair, _ in others]))
            if (error := mean_error(cameras, own)) > max(STRAY_ERROR, STRAY_FACTOR * usual):
                suspects.append((error, usual, view, own))
        for error, usual, view, own in sorted(suspects, key=lambda suspect: -suspect[0]):
            moved = fit_pose_to_matches(cameras, view, own)
            fitting, after = sum(_fits(moved, pair, limit) for pair in own), mean_error(moved, own)
            if fitting >= 2 and inlier_share(moved, own, limit) >= MOVED_SHARE and after < error / STRAY_GAIN:
                message = (
                    f"its photograph does not fit its pose: its matches lie {error:.1f} pixels from their epipolar "
                    f"lines, {after:.1f} if it is moved, and those of the other views {usual:.1f}"
                )
                findings.append(Finding(cause="stray view", message=message, view=names[view]))
                remaining = [(pair, fits) for pair, fits in remaining if view not in (pair.first, pair.second)]
                views -= {view}
                break
        else:
            return findings


def fit_pose_to_matches(cameras: Cameras, view: int, matches: Sequence[PairMatches]) -> Cameras:
    """The cameras with the pose of one view under which the rays of its matches lie nearest to their epipolar planes.

    It begins at the generalized relative pose between the other views, as one rig, and this one, or at the pose that it
    has, whichever ends at smaller distances. The poses of the others stay.
    """
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    ends = [((each.first, each.first_pixels), (each.second, each.second_pixels)) for each in matches]
    there, here = zip(*(sorted(end, key=lambda one: one[0] == view) for end in ends), strict=True)
    pixels_there, pixels_here = (np.concatenate([pixels for _, pixels in side]) for side in (there, here))
    others = [other for other, pixels in there for _ in pixels]
    Ks, reach = cameras.Ks.astype(np.float64), typical_distance(cameras)
    rays = unproject_points(pixels_here, np.ones(len(others)), Ks[view])
    directions = np.concatenate([_directions(cameras, other, pixels) for other, pixels in there])
    centers = cameras.centers[others]

    def distances(pose: np.ndarray) -> np.ndarray:
        """In pixels, by a rotation vector and a translation in units of `reach`."""
        rotation = Rotation.from_rotvec(pose[:3])
        normals = np.cross(rotation.apply(centers) + reach * pose[3:], rotation.apply(directions))
        sines = np.einsum("mi,mi->m", normals, rays) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
        return np.asarray(Ks[view, 0, 0] * sines)

    pycolmap = load_pycolmap()
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = INLIER_ERROR, 0
    # All matches fit one fundamental matrix, so that few are wrong here.
    options.min_num_trials, options.max_num_trials = 20, 200
    rig = [pycolmap.Rigid3d(pose[:3].astype(np.float64)) for pose in cameras.cam_from_world]
    rig[view] = pycolmap.Rigid3d()
    models = [
        pycolmap.Camera(model="PINHOLE", width=int(width), height=int(height), params=K[(0, 1, 0, 1), (0, 1, 2, 2)])
        for K, width, height in zip(Ks, cameras.widths, cameras.heights, strict=True)
    ]
    found = pycolmap.estimate_generalized_relative_pose(
        pixels_there, pixels_here, others, [view] * len(others), rig, models, options
    )
    starts = [cameras.cam_from_world[view, :3].astype(np.float64)]
    # Of others in one place it gives no distance.
    if found is not None and found.get("rig2_from_rig1") is not None:
        starts.append(found["rig2_from_rig1"].matrix())
    fitted = []
    for start in starts:
        pose = np.concatenate((Rotation.from_matrix(start[:, :3]).as_rotvec(), start[:, 3] / reach))
        pose = least_squares(distances, pose, loss="cauchy", max_nfev=30).x
        poses = cameras.cam_from_world.copy()
        poses[view, :3, :3], poses[view, :3, 3] = Rotation.from_rotvec(pose[:3]).as_matrix(), reach * pose[3:]
        fitted.append(replace(cameras, cam_from_world=poses))
    return min(fitted, key=lambda candidate: mean_error(candidate, matches))


def _directions(cameras: Cameras, view: int, pixels: Float64[np.ndarray, "M 2"]) -> Float64[np.ndarray, "M 3"]:
    """Of the rays of pixels, in the world."""
    local = unproject_points(pixels, np.ones(len(pixels)), cameras.Ks[view].astype(np.float64))
    return np.asarray(local @ cameras.cam_from_world[view, :3, :3].astype(np.float64))
