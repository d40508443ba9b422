"""Features of photographs and their matches (SIFT by pycolmap, in a database of its own), and the points that are
triangulated from them with the given poses held: matches are verified by the epipolar lines of these."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.process import Track, untracked
from gsencoder.data.readers.posed import load_pycolmap
from gsencoder.types import Cameras, Views
from gsencoder.types.scene import invert_rigid

DATABASE = "database.db"


def picture_name(view: int) -> str:
    """The name of a view in the database."""
    return f"{view:06d}.png"


def image_ids(database: Any, count: int) -> list[int]:
    """The numbers that the database gives to views."""
    return [database.read_image_with_name(picture_name(view)).image_id for view in range(count)]


def fundamental_matrix(cameras: Cameras, first: int, second: int) -> Float64[np.ndarray, "3 3"]:
    """F with x₂ᵀ F x₁ = 0 for the homogeneous pixels of one point in both views (Hartley and Zisserman, eq. 9.2)."""
    poses = cameras.cam_from_world.astype(np.float64)
    relative = poses[second] @ invert_rigid(poses[first])
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = [np.linalg.inv(cameras.Ks[view].astype(np.float64)) for view in (first, second)]
    return inverse[1].T @ cross @ relative[:3, :3] @ inverse[0]


def epipolar_distances(
    fundamental: Float64[np.ndarray, "3 3"],
    first_pixels: Float64[np.ndarray, "M 2"],
    second_pixels: Float64[np.ndarray, "M 2"],
) -> Float64[np.ndarray, " M"]:
    """The larger of the distances in pixels of each pixel from the epipolar line of the other; 0 where there is no such
    line, as for views from one place."""
    largest = np.zeros(len(first_pixels))
    for pixels, other, matrix in (
        (second_pixels, first_pixels, fundamental),
        (first_pixels, second_pixels, fundamental.T),
    ):
        lines = np.column_stack((other, np.ones(len(other)))) @ matrix.T
        distance = np.abs(np.einsum("mi,mi->m", lines[:, :2], pixels) + lines[:, 2])
        length = np.linalg.norm(lines[:, :2], axis=1)
        largest = np.maximum(largest, np.divide(distance, length, out=np.zeros_like(distance), where=length > 0))
    return largest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairMatches:
    """Pixels of two views that look alike."""

    first: int  # row of a view
    second: int  # row of another
    first_pixels: Float64[np.ndarray, "M 2"]  # (u, v) in the first
    second_pixels: Float64[np.ndarray, "M 2"]  # the same features in the second


@contextmanager
def _matched(
    views: Views, cameras: Cameras, pairs: Sequence[tuple[int, int]], features: int, track: Track
) -> Iterator[tuple[Any, Path]]:
    """pycolmap, and a folder with pictures at the size of `cameras` and the database of their unchecked matches."""
    from PIL import Image

    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    assert views.images is not None
    with TemporaryDirectory(prefix="gsencoder_match_") as name:
        folder = Path(name)
        database, pictures, masks = folder / DATABASE, folder / "images", folder / "masks"
        pictures.mkdir()
        masks.mkdir()
        names = [picture_name(view) for view in range(len(views))]
        for view in track(range(len(views)), "reading photographs"):
            size = int(cameras.widths[view]), int(cameras.heights[view])
            picture = Image.fromarray(views.images[view]).resize(size, Image.Resampling.BOX)
            picture.save(pictures / names[view], compress_level=1)
            if views.masks is not None:
                mask = Image.fromarray(views.masks[view].astype(np.uint8) * 255).resize(size, Image.Resampling.NEAREST)
                mask.save(masks / f"{names[view]}.png", compress_level=1)
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.max_image_size = max(int(cameras.widths.max()), int(cameras.heights.max()))
        extraction.use_gpu = False
        extraction.sift.max_num_features = features
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "PINHOLE"
        if views.masks is not None:
            reader.mask_path = masks
        matching = pycolmap.FeatureMatchingOptions()
        matching.use_gpu = False
        matching.skip_geometric_verification = True
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = listed = folder / "pairs.txt"
        lines = [f"{names[first]} {names[second]}\n" for first, second in pairs]
        listed.write_text("".join(lines), encoding="utf-8")
        try:
            pycolmap.extract_features(
                database,
                pictures,
                image_names=names,
                camera_mode=pycolmap.CameraMode.PER_IMAGE,
                reader_options=reader,
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
            )
            pycolmap.match_image_pairs(
                database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu
            )
            yield pycolmap, folder
        except (RuntimeError, ValueError) as error:
            message = " ".join(str(error).split())[:160]
            raise InputError(f"pycolmap cannot match these photographs: {message}") from error


def _matches_in(
    database: Any, count: int, pairs: Sequence[tuple[int, int]]
) -> Iterator[tuple[tuple[int, int], np.ndarray, PairMatches]]:
    """Of each pair of views with matches their numbers in the database, the rows of matched features, and pixels."""
    ids = image_ids(database, count)
    keypoints = [database.read_keypoints(number)[:, :2].astype(np.float64) for number in ids]
    for first, second in pairs:
        if database.exists_matches(ids[first], ids[second]):
            rows = database.read_matches(ids[first], ids[second])
            pixels = keypoints[first][rows[:, 0]], keypoints[second][rows[:, 1]]
            pair = PairMatches(first=first, second=second, first_pixels=pixels[0], second_pixels=pixels[1])
            yield (ids[first], ids[second]), rows, pair


def match_photographs(
    views: Views, cameras: Cameras, pairs: Sequence[tuple[int, int]], *, features: int, track: Track = untracked
) -> list[PairMatches]:
    """Matched features of pairs of photographs, unverified; pairs without any are left out.

    `cameras` are those of the views at the size in which features, `features` a photograph at most, are detected.
    """
    matched = _matched(views, cameras, pairs, features, track)
    with matched as (pycolmap, folder), pycolmap.Database.open(folder / DATABASE) as database:
        return [pair for _, _, pair in _matches_in(database, len(views), pairs)]


DEPTHS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Depths of the points that stand for what a view may show, as multiples of the typical distance."""
RAYS = 5  # Rows and columns of the rays on which these points lie
MAX_ANGLE = np.deg2rad(75.0)
"""Views of a surface from directions that differ more are not matched: their features look different."""
FORWARD_BASELINES = 10.0
"""Parallel cameras are taken to look at something this many times as far away as the nearest other camera."""


def typical_distance(cameras: Cameras) -> float:
    """How far away what the cameras look at may be, world units; 1 for one camera and for cameras at one point.

    Cameras around something look at one point, the nearest one to all optical axes, and the result is their median
    distance from it along the axes. Where the axes run parallel or apart it is ten times the median distance between
    neighboring cameras.
    """
    centers = cameras.centers.astype(np.float64)
    forward = cameras.cam_from_world[:, 2, :3].astype(np.float64)
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    normal_matrix = across.sum(axis=0)
    if len(cameras) > 1 and np.linalg.eigvalsh(normal_matrix)[0] > 1e-3 * len(cameras):
        point = np.linalg.solve(normal_matrix, np.einsum("vij,vj->i", across, centers))
        along = np.einsum("vi,vi->v", point - centers, forward)
        if np.mean(along > 0) > 0.75 and np.median(along) > 0:
            return float(np.median(along))
    apart = nearest_distances(centers)
    return FORWARD_BASELINES * float(np.median(apart)) if len(apart) and np.median(apart) > 0 else 1.0


def nearest_distances(centers: Float64[np.ndarray, "V 3"]) -> Float64[np.ndarray, " n"]:
    """The distance from each center to the nearest one elsewhere; nothing for a center that has none."""
    from scipy.spatial import cKDTree

    unique = np.unique(centers, axis=0)
    if len(unique) < 2:
        return np.empty(0)
    return np.asarray(cKDTree(unique).query(unique, k=2)[0])[:, 1]


def overlaps(cameras: Cameras, distance: float) -> Float64[np.ndarray, "V V"]:
    """The share of points before view i that view j shows too, from directions up to 75° apart; 0 on the diagonal."""
    count = len(cameras)
    steps = (np.arange(RAYS) + 0.5) / RAYS
    shares = np.zeros((count, count))
    centers = cameras.centers.astype(np.float64)
    for view in range(count):
        columns, rows = np.meshgrid(steps * cameras.widths[view], steps * cameras.heights[view])
        rays = cameras.rays(view, np.stack([columns.ravel(), rows.ravel()], axis=1))
        points = (centers[view] + distance * np.array(DEPTHS)[:, None, None] * rays).reshape(-1, 3)
        pixels, depths = cameras.project(points)
        in_view = cameras.in_image(pixels, depths)
        directions, other_directions = points - centers[view], points - centers[:, None]
        norms = np.linalg.norm(directions, axis=1) * np.linalg.norm(other_directions, axis=2)
        in_view &= np.einsum("pi,vpi->vp", directions, other_directions) > np.cos(MAX_ANGLE) * norms
        shares[view] = in_view.mean(axis=1)
    np.fill_diagonal(shares, 0)
    return shares


def choose_pairs(cameras: Cameras, count: int) -> list[tuple[int, int]]:
    """Pairs of views to match: for each view the `count` others that overlap most with it, each pair once, sorted."""
    shares = overlaps(cameras, typical_distance(cameras))
    both = shares + shares.T
    pairs = set()
    for view in range(len(cameras)):
        order = np.argsort(-both[view], kind="stable")[:count]
        pairs |= {(min(view, int(other)), max(view, int(other))) for other in order if both[view, other] > 0}
    return sorted(pairs)


MAX_EPIPOLAR_ERROR = 2.0
"""Largest distance of a match from the epipolar line, in pixels of the pictures that are matched."""
MIN_MATCHES = 15  # Pairs of views with fewer verified matches are not used
FITTING_SHARE, ENOUGH_MATCHES = 0.1, 100
"""Of this many matches or more, a smaller share lies on the epipolar lines only where poses are wrong: 0.18 to 0.9 of
those of eight choices of views, and 0.00 to 0.11 (once 0.20) with other axes, inverse or exchanged poses."""


SIZE, FEATURES, NEIGHBORS = 1000, 4096, 16
"""Longer side in pixels at which features are detected, features of a photograph, and others it is matched with."""


def triangulate(
    views: Views, *, track: Track = untracked
) -> tuple[Float32[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    """Points that several photographs show, seen from the given poses, and their colors; features on masked pixels are
    not used. Sorted, so that a rerun gives the same arrays.

    Warns:
        SceneWarning: hardly a match lies on the epipolar lines of the poses.
    """
    if views.images is None or len(views) < 2:
        raise InputError(f"triangulate: expected two posed photographs or more, got {len(views)}")
    cameras = views.cameras.resized(SIZE, enlarge=False)
    pairs = choose_pairs(cameras, NEIGHBORS)
    with _matched(views, cameras, pairs, FEATURES, track) as (pycolmap, folder):
        points = []
        if _verify(pycolmap, folder / DATABASE, cameras, pairs):
            model = _posed_model(pycolmap, folder / DATABASE, cameras)
            options = pycolmap.IncrementalPipelineOptions()
            options.random_seed = 0
            options.num_threads = 1
            model = pycolmap.triangulate_points(model, folder / DATABASE, folder / "images", folder, options=options)
            model.extract_colors_for_all_images(folder / "images")
            points = list(model.points3D.values())
    positions = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
    colors = np.array([point.color for point in points], np.uint8).reshape(-1, 3)
    order = np.lexsort(positions.T)
    return positions[order], colors[order]


def _verify(pycolmap: Any, database_path: Path, cameras: Cameras, pairs: Sequence[tuple[int, int]]) -> int:
    """Writes the matches that lie on the epipolar lines of the poses; returns how many pairs have enough of them."""
    verified, total, fitting = 0, 0, 0
    with pycolmap.Database.open(database_path) as database:
        for ids, rows, pair in _matches_in(database, len(cameras), pairs):
            good = on_epipolar_lines(cameras, pair.first, pair.second, pair.first_pixels, pair.second_pixels)
            count = int(good.sum())
            if len(good) >= MIN_MATCHES:
                total, fitting = total + len(good), fitting + count
            if count < MIN_MATCHES:
                continue
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.inlier_matches = rows[good]
            database.write_two_view_geometry(*ids, geometry)
            verified += 1
    if total >= ENOUGH_MATCHES and fitting < FITTING_SHARE * total:
        warnings.warn(
            f"the photographs do not seem to fit their poses: of {total:,} matched features {fitting:,} lie on their "
            "epipolar lines; `gsencoder inspect` looks for the cause",
            SceneWarning,
            stacklevel=4,
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
