"""COLMAP models, binary and text: cameras, poses and points.

Each record is checked before it is taken: a file that was cut short is named, and no count asks for memory. Rigs and
frames are not read, since images.bin and images.txt hold the pose of each image in all versions. The layouts are
those of COLMAP's src/colmap/scene/reconstruction_io_binary.cc and reconstruction_io_text.cc.
"""

import io
import math
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.errors import InputError, readable
from gsencoder.core.files import MODEL_BYTES, open_foreign, read_foreign
from gsencoder.data.readers.posed import (
    CameraModel,
    PosedImage,
    PosedImages,
    ReadOptions,
    check_camera,
    inside,
    load_pycolmap,
    rigid_pose,
    warn_left_out,
)

CAMERA_PARAMS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
}  # fmt: skip
"""The number of parameters of the camera models 0 to 10; later ones ask pycolmap."""
QUATERNION_TOLERANCE = 1e-3
"""How far from 1 the length of a quaternion may be; the rest is taken for rounding in the file."""


class _Image(NamedTuple):
    """One image of a model; `pose` is qw qx qy qz tx ty tz of cam_from_world."""

    name: str
    camera: int
    pose: tuple[float, ...]


class _Model(NamedTuple):
    cameras: dict[int, CameraModel]
    images: list[_Image]
    points: Float64[np.ndarray, "P 3"]
    colors: UInt8[np.ndarray, "P 3"]


class _Walker:
    """A position in one file's bytes; every step checks that the bytes are there."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"{path.parent}: {path.name} is missing; a COLMAP model has cameras, images and points3D")
        with readable(path):
            self.path, self.data, self.at = path, read_foreign(path, MODEL_BYTES), 0

    def take(self, layout: str, field: str) -> tuple:
        size = struct.calcsize(layout)
        self.skip(size, field)
        return struct.unpack_from(layout, self.data, self.at - size)

    def skip(self, size: int, field: str) -> None:
        if self.at + size > len(self.data):
            self.fail(f"ends at byte {len(self.data)} inside {field}, which needs {self.at + size} bytes")
        self.at += size

    def count(self, smallest: int, field: str) -> int:
        """A record count, which the rest of the file must be able to hold."""
        (count,) = self.take("<Q", f"the number of {field}")
        left = len(self.data) - self.at
        if count * smallest > left:
            self.fail(f"announces {count} {field} (at least {count * smallest} bytes) but {left} bytes follow")
        return int(count)

    def end(self) -> None:
        if self.at != len(self.data):
            self.fail(f"{len(self.data) - self.at} bytes follow the last record")

    def fail(self, fault: str) -> None:
        raise InputError(f"{self.path}: {fault}; the file is cut short or damaged")


def _read_binary(model: Path) -> _Model:
    walker, cameras, images = _Walker(model / "cameras.bin"), dict[int, CameraModel](), list[_Image]()
    for i in range(walker.count(24, "cameras")):
        number, kind, width, height = walker.take("<IiQQ", f"camera {i}")
        name, count = _camera_model(kind, walker)
        params = walker.take(f"<{count}d", f"the parameters of camera {i}")
        cameras[number] = CameraModel(model=name, width=width, height=height, params=params)
    walker.end()
    walker = _Walker(model / "images.bin")
    for i in range(walker.count(73, "images")):
        _, *pose, camera = walker.take("<I7dI", f"image {i}")
        end = walker.data.find(b"\0", walker.at)
        if end < 0:
            walker.fail(f"the name of image {i} has no end")
        try:
            name = walker.data[walker.at : end].decode("utf-8")
        except UnicodeDecodeError:
            walker.fail(f"the name of image {i} is not UTF-8")
        walker.at = end + 1
        walker.skip(24 * walker.count(24, f"observations of image {i}"), f"the observations of image {i}")
        images.append(_Image(name, camera, tuple(pose)))
    walker.end()
    walker, rows = _Walker(model / "points3D.bin"), []
    for i in range(walker.count(51, "points")):
        rows.append(walker.take("<Q3d3Bd", f"point {i}")[1:7])
        walker.skip(8 * walker.count(8, f"observations of point {i}"), f"the track of point {i}")
    walker.end()
    return _Model(cameras, images, *_points(rows))


def _camera_model(number: int, walker: _Walker) -> tuple[str, int]:
    """The name and the number of parameters of a camera model."""
    if 0 <= number < len(CAMERA_PARAMS):
        return list(CAMERA_PARAMS.items())[number]
    pycolmap = load_pycolmap()
    names = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items() if name != "INVALID"}
    if number not in names:
        walker.fail(f"camera model number {number} is unknown to pycolmap {pycolmap.__version__}")
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 1.0, 1, 1)
    return names[number], len(camera.params)


def _points(rows: list[tuple[Any, ...]]) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"]]:
    table = np.array(rows, np.float64).reshape(-1, 6)
    return table[:, :3].copy(), table[:, 3:].astype(np.uint8)


def _read_text(model: Path) -> _Model:
    cameras, images, points = dict[int, CameraModel](), list[_Image](), list[tuple[Any, ...]]()
    for where, words in _rows(model / "cameras.txt"):
        with _expected(where, words, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"):
            number, width, height = int(words[0]), int(words[2]), int(words[3])
            params = tuple(map(float, words[4:]))
            if len(params) != CAMERA_PARAMS.get(words[1], len(params)):
                raise ValueError
        cameras[number] = CameraModel(model=words[1], width=width, height=height, params=params)
    observations = False
    for where, words in _rows(model / "images.txt", blank=True):
        # The line after an image holds X Y POINT3D_ID of its observations; some tools leave empty ones away.
        if observations and (not words or _are_observations(words)):
            observations = False
        elif words:
            with _expected(where, words, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
                int(words[0])
                image = _Image(" ".join(words[9:]) or words[9], int(words[8]), tuple(map(float, words[1:8])))
            images.append(image)
            observations = True
    for where, words in _rows(model / "points3D.txt"):
        with _expected(where, words, "POINT3D_ID X Y Z R G B ERROR TRACK[]"):
            int(words[0])
            x, y, z = map(float, words[1:4])
            red, green, blue, _ = int(words[4]), int(words[5]), int(words[6]), float(words[7])
            if not 0 <= min(red, green, blue) <= max(red, green, blue) <= 255:
                raise ValueError
        points.append((x, y, z, red, green, blue))
    for name, entries in (("cameras", cameras), ("images", images), ("points3D", points)):
        _check_count(model / f"{name}.txt", len(entries))
    return _Model(cameras, images, *_points(points))


def _lines(file: Path) -> Iterator[str]:
    if not file.is_file():
        raise InputError(f"{file.parent}: {file.name} is missing; a COLMAP model has cameras, images and points3D")
    with readable(file), io.TextIOWrapper(open_foreign(file, MODEL_BYTES), encoding="utf-8", errors="replace") as lines:
        yield from lines


def _rows(file: Path, *, blank: bool = False) -> Iterator[tuple[str, list[str]]]:
    """Where each line with values stands, and its words; with `blank`, empty lines too."""
    for number, line in enumerate(_lines(file), 1):
        words = line.split()
        if (words or blank) and not line.startswith("#"):
            yield f"{file}: line {number}", words


@contextmanager
def _expected(where: str, words: list[str], form: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, IndexError):
        raise InputError(f"{where} is not {form}: {' '.join(words)[:80]!r}") from None


def _are_observations(words: list[str]) -> bool:
    """Whether a line may hold X Y POINT3D_ID triples; the first and the last are looked at."""
    try:
        triples = [(float(x), float(y), int(point)) for x, y, point in (words[:3], words[-3:])]
    except ValueError:
        return False
    return len(words) % 3 == 0 and bool(np.isfinite(triples).all())


def _check_count(file: Path, count: int) -> None:
    """Compares with the count in the file's comments: a text file that was cut short has no other sign."""
    for line in _lines(file):
        if not line.startswith("#"):
            return
        announced = re.match(r"# Number of \w+: (\d{1,15})\b", line)
        if announced and int(announced[1]) != count:
            raise InputError(
                f"{file}: announces {announced[1]} entries and holds {count}; the file is cut short or was edited"
            )


def is_colmap_model(folder: Path) -> bool:
    """True where the files of a model lie in `folder` itself."""
    return (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()


def read_colmap(
    model: Path,
    images: Path,
    root: Path,
    options: ReadOptions = ReadOptions(),
    *,
    base_names: bool = False,
    masks: Path | None = None,
) -> PosedImages:
    """Reads a model (.bin before .txt where both are there) and finds its photographs.

    Args:
        images: folder that the names of the model are relative to.
        root: the scene folder, which names may not leave unless the options allow it.
        base_names: photographs lie in `images` itself, whatever folders the names of the model begin with.

    Returns:
        The pictures sorted by name, in the model's own world, and its points with their colors. The unit of length and
        up are unknown.
    """
    is_binary = (model / "cameras.bin").is_file()
    content = _read_binary(model) if is_binary else _read_text(model)
    masks = masks if masks is not None and masks.is_dir() else None
    posed: list[PosedImage] = []
    missing: list[str] = []
    checked: set[int] = set()
    for image in sorted(content.images):
        where = f"{model}: image {image.name[:120]!r}"
        name = Path(image.name).name if base_names else image.name
        path = inside(images, name, where, root=root, allow_outside=options.allow_outside)
        if not path.is_file():
            missing.append(image.name)
            continue
        if image.camera not in content.cameras:
            raise InputError(f"{where}: its camera {image.camera} is not in the model")
        camera = content.cameras[image.camera]
        if image.camera not in checked:
            check_camera(camera, f"{model}: camera {image.camera}")
            checked.add(image.camera)
        length = math.hypot(*image.pose[:4])
        if math.isfinite(length) and abs(length - 1) > QUATERNION_TOLERANCE:
            file = "images.bin" if is_binary else "images.txt"
            raise InputError(f"{where}: its quaternion ({file}) has length {length:.4g}, expected 1")
        posed.append(
            PosedImage(
                name=image.name,
                camera=camera,
                cam_from_world=rigid_pose(_matrix(image.pose), where),
                image=path,
                mask=None if masks is None else _find_mask(masks, image.name, where, options),
            )
        )
    total = len(content.images)
    if not posed:
        first = f" (first: {missing[0][:200]!r})" if missing else ""
        raise InputError(f"{model}: no view: of {total} images {len(missing)} are not in {images}{first}")
    warn_left_out(missing, total, str(model), "images of the model", f"not in {images}, they are left out")
    if masks is not None:
        without = [f"{image.name}.png" for image in posed if image.mask is None]
        warn_left_out(without, len(posed), str(masks), "masks", "all pixels of those views are used")
    return PosedImages(source=str(model), images=tuple(posed), points=content.points, colors=content.colors)


def _matrix(pose: tuple[float, ...]) -> Float64[np.ndarray, "4 4"]:
    w, x, y, z, *shift = pose
    matrix = np.eye(4)
    matrix[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    matrix[:3, 3] = shift
    return matrix


def _find_mask(masks: Path, name: str, where: str, options: ReadOptions) -> Path | None:
    """The mask of an image, as COLMAP calls it (the image's name and .png), or with .png in place of the ending."""
    for candidate in (f"{name}.png", str(PurePosixPath(name).with_suffix(".png"))):
        path = inside(masks, candidate, where, root=masks.parent, allow_outside=options.allow_outside)
        if path.is_file():
            return path
    return None
