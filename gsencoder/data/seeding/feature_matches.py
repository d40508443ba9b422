"""Features of photographs and their matches: SIFT by pycolmap, in a database of its own."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.core.process import Track, untracked
from gsencoder.data.readers.undistort import load_pycolmap
from gsencoder.types import Cameras, Views
from gsencoder.types.checks import invert_rigid


def picture_name(view: int) -> str:
    """The name of a view in the database."""
    return f"{view:06d}.png"


def detect_features(
    pycolmap: Any,
    database_path: Path,
    pictures: Path,
    views: Views,
    cameras: Cameras,
    features: int,
    track: Track,
) -> None:
    """Writes the pictures at the size of `cameras`, and their features into a new database."""
    from PIL import Image

    masks = pictures.with_name("masks")
    assert views.images is not None
    for view in track(range(len(views)), "reading photographs"):
        size = int(cameras.widths[view]), int(cameras.heights[view])
        Image.fromarray(views.images[view]).resize(size, Image.Resampling.BOX).save(
            pictures / picture_name(view), compress_level=1
        )
        if views.masks is not None:
            masks.mkdir(exist_ok=True)
            mask = Image.fromarray(views.masks[view].astype(np.uint8) * 255).resize(size, Image.Resampling.NEAREST)
            mask.save(masks / f"{picture_name(view)}.png", compress_level=1)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = max(int(cameras.widths.max()), int(cameras.heights.max()))
    extraction.use_gpu = False
    extraction.sift.max_num_features = features
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "PINHOLE"
    if views.masks is not None:
        reader.mask_path = masks
    pycolmap.extract_features(
        database_path,
        pictures,
        image_names=[picture_name(view) for view in range(len(views))],
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )


def match_pairs(pycolmap: Any, database_path: Path, list_path: Path, pairs: Sequence[tuple[int, int]]) -> None:
    """Writes the nearest features of pairs of views into the database, without any check of their geometry."""
    lines = [f"{picture_name(first)} {picture_name(second)}\n" for first, second in pairs]
    list_path.write_text("".join(lines), encoding="utf-8")
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.skip_geometric_verification = True
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = list_path
    pycolmap.match_image_pairs(
        database_path, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu
    )


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
    """How far pairs of pixels are from showing one point: the larger of the distances in pixels of each from the
    epipolar line of the other; 0 where there is no such line, as for views from one place."""
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
    """Pixels of two views that look alike.

    Attributes:
        first: row of a view.
        second: row of another.
        first_pixels: (u, v) in the first.
        second_pixels: the same features in the second.
    """

    first: int
    second: int
    first_pixels: Float64[np.ndarray, "M 2"]
    second_pixels: Float64[np.ndarray, "M 2"]


def match_photographs(
    views: Views, cameras: Cameras, pairs: Sequence[tuple[int, int]], *, features: int, track: Track = untracked
) -> list[PairMatches]:
    """Matched features of pairs of photographs, unverified; pairs without any are left out.

    Args:
        views: with photographs.
        cameras: of the same views, at the size in which features are detected.
        pairs: rows of two views each.
        features: largest number of features of a photograph.
        track: progress.

    Raises:
        InputError: pycolmap is missing or refuses the photographs.
    """
    pycolmap = load_pycolmap()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL
    matched = []
    with TemporaryDirectory(prefix="gsencoder_match_") as name:
        folder = Path(name)
        database_path, pictures = folder / "database.db", folder / "images"
        pictures.mkdir()
        try:
            detect_features(pycolmap, database_path, pictures, views, cameras, features, track)
            match_pairs(pycolmap, database_path, folder / "pairs.txt", pairs)
        except (RuntimeError, ValueError) as error:
            message = " ".join(str(error).split())[:160]
            raise InputError(f"pycolmap cannot match these photographs: {message}") from error
        with pycolmap.Database.open(database_path) as database:
            ids = image_ids(database, len(views))
            keypoints = [database.read_keypoints(number)[:, :2].astype(np.float64) for number in ids]
            for first, second in pairs:
                if database.exists_matches(ids[first], ids[second]):
                    rows = database.read_matches(ids[first], ids[second])
                    matched.append(
                        PairMatches(
                            first=first,
                            second=second,
                            first_pixels=keypoints[first][rows[:, 0]],
                            second_pixels=keypoints[second][rows[:, 1]],
                        )
                    )
    return matched
