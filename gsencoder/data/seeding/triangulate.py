"""Points for posed photographs that came without any: SIFT features matched by pycolmap, triangulated with poses held.

Matches are verified by the epipolar lines of the given poses; nothing is estimated but the points.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Track, untracked
from gsencoder.data.readers.undistort import load_pycolmap
from gsencoder.data.seeding.feature_matches import (
    detect_features,
    epipolar_distances,
    fundamental_matrix,
    image_ids,
    match_pairs,
)
from gsencoder.data.seeding.view_pairs import choose_pairs
from gsencoder.types import Cameras, Views

MAX_EPIPOLAR_ERROR = 2.0
"""Largest distance of a match from the epipolar line, in pixels of the pictures that are matched."""
MIN_MATCHES = 15
"""Pairs of views with fewer verified matches are not used."""
FITTING_SHARE, ENOUGH_MATCHES = 0.1, 100
"""Of this many matches or more, a smaller share lies on the epipolar lines only where poses are wrong: 0.18 to 0.9 of
those of eight choices of views, and 0.00 to 0.11 (once 0.20) with other axes, inverse or exchanged poses."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Triangulation:
    """Points that were triangulated.

    Attributes:
        points: world units, in the world of the cameras; sorted, so that a rerun gives the same array.
        colors: RGB.
        pairs: pairs of views with verified matches.
        error: mean reprojection error in pixels of the pictures that were matched; NaN without points.
    """

    points: Float32[np.ndarray, "P 3"]
    colors: UInt8[np.ndarray, "P 3"]
    pairs: int
    error: float


def triangulate(
    views: Views, *, size: int = 1000, features: int = 4096, neighbors: int = 16, track: Track = untracked
) -> Triangulation:
    """Points that several photographs show, seen from the given poses.

    Args:
        views: posed photographs, without distortion; features on masked pixels are not used.
        size: longer side in pixels at which features are detected; smaller photographs keep theirs.
        features: largest number of features of a photograph.
        neighbors: other photographs that each is matched with.
        track: progress.

    Raises:
        InputError: no photographs, fewer than two views, or pycolmap is missing or refuses.

    Warns:
        SceneWarning: hardly a match lies on the epipolar lines of the poses.
    """
    if views.images is None or len(views) < 2:
        raise InputError(f"triangulate: expected two posed photographs or more, got {len(views)}")
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    cameras = views.cameras.resized(size, enlarge=False)
    with TemporaryDirectory(prefix="gsencoder_triangulate_") as name:
        folder = Path(name)
        database_path, pictures = folder / "database.db", folder / "images"
        pictures.mkdir()
        try:
            detect_features(pycolmap, database_path, pictures, views, cameras, features, track)
            pairs = choose_pairs(cameras, neighbors)
            match_pairs(pycolmap, database_path, folder / "pairs.txt", pairs)
            verified = _verify(pycolmap, database_path, cameras, pairs)
            if not verified:
                return _result(None, verified)
            model = _posed_model(pycolmap, database_path, cameras)
            options = pycolmap.IncrementalPipelineOptions()
            options.random_seed = 0
            options.num_threads = 1
            model = pycolmap.triangulate_points(model, database_path, pictures, folder, options=options)
            model.extract_colors_for_all_images(pictures)
        except (RuntimeError, ValueError) as error:
            message = " ".join(str(error).split())[:160]
            raise InputError(f"triangulate: pycolmap cannot use these photographs: {message}") from error
        return _result(model, verified)


def _verify(
    pycolmap: Any, database_path: Path, cameras: Cameras, pairs: Sequence[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Writes the matches that lie on the epipolar lines of the poses; returns the pairs that have enough of them."""
    verified, total, fitting = [], 0, 0
    with pycolmap.Database.open(database_path) as database:
        ids = image_ids(database, len(cameras))
        keypoints = [database.read_keypoints(number)[:, :2].astype(np.float64) for number in ids]
        for first, second in pairs:
            if not database.exists_matches(ids[first], ids[second]):
                continue
            matches = database.read_matches(ids[first], ids[second])
            good = on_epipolar_lines(
                cameras, first, second, keypoints[first][matches[:, 0]], keypoints[second][matches[:, 1]]
            )
            count = int(good.sum())
            if len(good) >= MIN_MATCHES:
                total, fitting = total + len(good), fitting + count
            if count < MIN_MATCHES:
                continue
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = matches[good]
            database.write_two_view_geometry(ids[first], ids[second], geometry)
            verified.append((first, second))
    if total >= ENOUGH_MATCHES and fitting < FITTING_SHARE * total:
        warnings.warn(
            f"the photographs do not seem to fit their poses: of {total:,} matched features {fitting:,} lie on their "
            "epipolar lines; `gsencoder inspect` says what is wrong, as far as it can be told",
            SceneWarning,
            stacklevel=3,
        )
    return verified


def on_epipolar_lines(
    cameras: Cameras,
    first: int,
    second: int,
    first_pixels: Float64[np.ndarray, "M 2"],
    second_pixels: Float64[np.ndarray, "M 2"],
) -> Bool[np.ndarray, " M"]:
    """Which pairs of pixels may show one point: each lies near the epipolar line of the other."""
    fundamental = fundamental_matrix(cameras, first, second)
    return epipolar_distances(fundamental, first_pixels, second_pixels) <= MAX_EPIPOLAR_ERROR


def _posed_model(pycolmap: Any, database_path: Path, cameras: Cameras) -> Any:
    """A COLMAP model of the cameras, with the numbers that they have in the database, and no points."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database_path) as database:
        for view, number in enumerate(image_ids(database, len(cameras))):
            image = database.read_image(number)
            camera = database.read_camera(image.camera_id)
            K = cameras.Ks[view].astype(np.float64)
            camera.params = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
            database.update_camera(camera)
            pose = cameras.cam_from_world[view, :3].astype(np.float64)
            model.add_camera_with_trivial_rig(camera)
            image.points2D = pycolmap.Point2DList(
                [pycolmap.Point2D(pixel) for pixel in database.read_keypoints(number)[:, :2].astype(np.float64)]
            )
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    return model


def _result(model: Any, verified: Sequence[tuple[int, int]]) -> Triangulation:
    points = [] if model is None else list(model.points3D.values())
    positions = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
    colors = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
    order = np.lexsort(positions.T)
    error = float(model.compute_mean_reprojection_error()) if len(points) else float("nan")
    return Triangulation(points=positions[order], colors=colors[order], pairs=len(verified), error=error)
