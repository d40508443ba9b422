"""Validation of the binary files of a COLMAP model: every record that a count announces must be there.

pycolmap does not look for the end of a file: a cameras.bin that was cut short loads with whatever was in memory, and
a wrong count in points3D.bin asks for all memory before it fails.
So every record is walked first; nothing is decoded here.
The layout is COLMAP's, little-endian: src/colmap/scene/reconstruction_io_binary.cc.
"""

import struct
from collections.abc import Callable
from pathlib import Path

from gsencoder.core.errors import InputError
from gsencoder.core.files import MODEL_BYTES, read_foreign
from gsencoder.data.readers.undistort import load_pycolmap

CAMERA_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12)
"""How many parameters the camera models 0 (SIMPLE_PINHOLE) to 10 (THIN_PRISM_FISHEYE) have; later ones ask pycolmap."""
_SENSOR = struct.calcsize("<iI")


class _Walker:
    """A position in one file's bytes; every step checks that the bytes are there."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, read_foreign(path, MODEL_BYTES), 0

    def take(self, layout: struct.Struct, field: str) -> tuple[int, ...]:
        self.skip(layout.size, field)
        return layout.unpack_from(self.data, self.at - layout.size)

    def skip(self, size: int, field: str) -> None:
        if self.at + size > len(self.data):
            raise InputError(
                f"{self.path}: ends at byte {len(self.data)} inside {field}, which needs {self.at + size} bytes; "
                "the file is cut short or damaged"
            )
        self.at += size

    def count(self, smallest: int, field: str) -> int:
        """A record count, which the rest of the file must be able to hold."""
        (count,) = self.take(_U64, f"the number of {field}")
        if count * smallest > len(self.data) - self.at:
            raise InputError(
                f"{self.path}: announces {count} {field} (at least {count * smallest} bytes) but "
                f"{len(self.data) - self.at} bytes follow; the file is cut short or damaged"
            )
        return count

    def fail(self, fault: str) -> None:
        raise InputError(f"{self.path}: {fault}; the file is damaged")


_U64, _U32 = struct.Struct("<Q"), struct.Struct("<I")
_CAMERA = struct.Struct("<IiQQ")
_FLAG = struct.Struct("<B")


def _params_of(model: int, walker: _Walker) -> int:
    if 0 <= model < len(CAMERA_PARAMS):
        return CAMERA_PARAMS[model]
    pycolmap = load_pycolmap()
    names = {int(value): name for name, value in pycolmap.CameraModelId.__members__.items()}
    if model < 0 or model not in names or names[model] == "INVALID":
        walker.fail(f"camera model number {model} is unknown to pycolmap {pycolmap.__version__}")
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(model), 1.0, 1, 1)
    return len(camera.params)


def _cameras(walker: _Walker) -> None:
    for i in range(walker.count(_CAMERA.size, "cameras")):
        _, model, _, _ = walker.take(_CAMERA, f"camera {i}")
        walker.skip(8 * _params_of(model, walker), f"the parameters of camera {i}")


def _images(walker: _Walker) -> None:
    for i in range(walker.count(73, "images")):
        walker.skip(64, f"image {i}")
        end = walker.data.find(b"\0", walker.at)
        if end < 0:
            walker.fail(f"the name of image {i} has no end")
        try:
            walker.data[walker.at : end].decode("utf-8")
        except UnicodeDecodeError:
            walker.fail(f"the name of image {i} is not UTF-8")
        walker.at = end + 1
        walker.skip(24 * walker.count(24, f"observations of image {i}"), f"the observations of image {i}")


def _points(walker: _Walker) -> None:
    for i in range(walker.count(51, "points")):
        walker.skip(43, f"point {i}")
        walker.skip(8 * walker.count(8, f"observations of point {i}"), f"the track of point {i}")


def _rigs(walker: _Walker) -> None:
    for i in range(walker.count(8, "rigs")):
        walker.skip(4, f"rig {i}")
        (sensors,) = walker.take(_U32, f"rig {i}")
        if not sensors:
            continue
        walker.skip(_SENSOR, f"rig {i}")
        for _ in range(sensors - 1):
            walker.skip(_SENSOR, f"the sensors of rig {i}")
            if walker.take(_FLAG, f"the sensors of rig {i}")[0]:
                walker.skip(56, f"the sensors of rig {i}")


def _frames(walker: _Walker) -> None:
    for i in range(walker.count(68, "frames")):
        walker.skip(64, f"frame {i}")
        (images,) = walker.take(_U32, f"frame {i}")
        walker.skip(16 * images, f"the images of frame {i}")


_FILES: dict[str, Callable[[_Walker], None]] = {
    "cameras.bin": _cameras,
    "images.bin": _images,
    "points3D.bin": _points,
    "rigs.bin": _rigs,
    "frames.bin": _frames,
}


def check_binary_model(folder: Path) -> None:
    """Walks the records of every .bin file of a model.

    Raises:
        InputError: a file is missing, ends inside a record, announces more records than it holds, or has extra bytes.
    """
    for name, walk in _FILES.items():
        path = folder / name
        if not path.is_file():
            if name in ("rigs.bin", "frames.bin"):  # Written since COLMAP 3.12.
                continue
            raise InputError(f"{folder}: {name} is missing; a binary COLMAP model has cameras, images and points3D")
        try:
            walker = _Walker(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error})") from error
        walk(walker)
        if walker.at != len(walker.data):
            walker.fail(f"{len(walker.data) - walker.at} bytes follow the last record")
