"""COLMAP models, binary and text, with or without rigs and frames, read by pycolmap.

Validation of the binary files of a COLMAP model: every record that a count announces must be there.

pycolmap does not look for the end of a file: a cameras.bin that was cut short loads with whatever was in memory, and
a wrong count in points3D.bin asks for all memory before it fails.
So every record is walked first; nothing is decoded here.
The layout is COLMAP's, little-endian: src/colmap/scene/reconstruction_io_binary.cc.
"""

import io
import itertools
import math
import re
import shutil
import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from gsencoder.core.errors import InputError, SceneWarning, readable
from gsencoder.core.files import MODEL_BYTES, check_foreign, open_foreign, read_foreign
from gsencoder.data.readers.posed import PosedImage, PosedImages, inside, rigid_pose, warn_left_out
from gsencoder.data.readers.undistort import CameraModel, check_camera, load_pycolmap

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


def _walk_points(walker: _Walker) -> None:
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
    "points3D.bin": _walk_points,
    "rigs.bin": _rigs,
    "frames.bin": _frames,
}


def check_binary_model(folder: Path) -> None:
    """Walks the records of every .bin file of a model."""
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


QUATERNION_TOLERANCE = 1e-3
"""How far from 1 the length of a quaternion may be; the rest is taken for rounding in the file."""


def is_colmap_model(folder: Path) -> bool:
    """True where the files of a model lie in `folder` itself."""
    return (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()


def read_colmap(
    model: Path,
    images: Path,
    root: Path,
    *,
    allow_outside: bool = False,
    base_names: bool = False,
    masks: Path | None = None,
) -> PosedImages:
    """Reads a model and finds its photographs.

    Args:
        model: folder of cameras, images and points3D (.bin before .txt where both are there), rigs and frames.
        images: folder that the names of the model are relative to.
        root: the scene folder, which names may not leave.
        base_names: photographs lie in `images` itself, whatever folders the names of the model begin with.

    Returns:
        The registered pictures sorted by name, in the model's own world, and its points with their colors. The unit
        of length and up are unknown.
    """
    reconstruction = _load(model)
    masks = masks if masks is not None and masks.is_dir() else None
    posed: list[PosedImage] = []
    missing: list[str] = []
    unregistered = 0
    cameras: dict[int, CameraModel] = {}
    for image in sorted(reconstruction.images.values(), key=lambda image: image.name):
        where = f"{model}: image {image.name[:120]!r}"
        if not image.has_pose:
            unregistered += 1
            continue
        name = Path(image.name).name if base_names else image.name
        path = inside(images, name, where, root=root, allow_outside=allow_outside)
        if not path.is_file():
            missing.append(image.name)
            continue
        if image.camera_id not in cameras:
            if image.camera_id not in reconstruction.cameras:
                raise InputError(f"{where}: its camera {image.camera_id} is not in the model")
            colmap_camera = reconstruction.cameras[image.camera_id]
            camera = CameraModel(
                model=colmap_camera.model.name,
                width=int(colmap_camera.width),
                height=int(colmap_camera.height),
                params=tuple(float(value) for value in colmap_camera.params),
            )
            check_camera(camera, f"{model}: camera {image.camera_id}")
            cameras[image.camera_id] = camera
        cam_from_world = image.cam_from_world()
        length = math.hypot(*map(float, cam_from_world.rotation.quat))
        # pycolmap takes a quaternion of zeros for no rotation.
        if not abs(length - 1) <= QUATERNION_TOLERANCE:
            raise InputError(
                f"{where}: its quaternion ({_pose_file(model)}) has length {length:.4g}, expected 1; export the model "
                "again, or remove the image"
            )
        pose = np.eye(4)
        pose[:3] = cam_from_world.matrix()
        posed.append(
            PosedImage(
                name=image.name,
                camera=cameras[image.camera_id],
                cam_from_world=rigid_pose(pose, where),
                image=path,
                mask=None if masks is None else _find_mask(masks, image.name, where, allow_outside=allow_outside),
            )
        )
    total = len(reconstruction.images)
    if not posed:
        first = f" (first: {missing[0][:200]!r})" if missing else ""
        raise InputError(
            f"{model}: no view: of {total} images {unregistered} have no pose "
            f"and {len(missing)} are not in {images}{first}"
        )
    warn_left_out(missing, total, str(model), "images of the model", f"not in {images}, they are left out")
    if unregistered:
        warnings.warn(
            f"{model}: {unregistered} of {total} images have no pose and are left out", SceneWarning, stacklevel=2
        )
    if masks is not None:
        without = [f"{image.name}.png" for image in posed if image.mask is None]
        warn_left_out(without, len(posed), str(masks), "masks", "all pixels of those views are used")
    points, colors = _points(reconstruction)
    return PosedImages(source=str(model), images=tuple(posed), points=points, colors=colors)


def _find_mask(masks: Path, name: str, where: str, *, allow_outside: bool) -> Path | None:
    """The mask of an image, as COLMAP calls it (the image's name and .png), or with .png in place of the ending."""
    for candidate in (f"{name}.png", str(PurePosixPath(name).with_suffix(".png"))):
        path = inside(masks, candidate, where, root=masks.parent, allow_outside=allow_outside)
        if path.is_file():
            return path
    return None


def _pose_file(model: Path) -> str:
    """The file that holds the poses: that of the frames where there is one (since COLMAP 3.12)."""
    suffix = "bin" if (model / "cameras.bin").is_file() else "txt"
    return f"frames.{suffix}" if (model / f"frames.{suffix}").is_file() else f"images.{suffix}"


def _image_lines(file: Path) -> tuple[list[str], bool, bool]:
    """The lines of an images.txt, two for each image, whether the file itself has them, and whether any has points."""
    lines: list[str] = []
    lost, with_points, complete = 0, 0, True
    with io.TextIOWrapper(open_foreign(file), encoding="utf-8", errors="replace") as stream:
        for number, line in enumerate(stream, 1):
            words = line.split()
            comment = not words or words[0].startswith("#")
            if len(lines) % 2:
                if comment or _are_points(words):
                    lines.append("" if comment else line.strip())
                    with_points += not comment
                    continue
                lost, complete = lost or number, False
                lines.append("")
            elif comment:
                continue
            _check_image_line(words, f"{file}: line {number}")
            lines.append(line.strip())
    if lost and with_points:
        raise InputError(
            f"{file}: line {lost} holds no points of the image above it; expected two lines an image, of which the "
            "second may be empty (X Y POINT3D_ID …)"
        )
    if len(lines) % 2:
        lines, complete = [*lines, ""], False
    return lines, complete, with_points > 0


def _are_points(words: list[str]) -> bool:
    """Whether a line may hold X Y POINT3D_ID triples; the first and the last are looked at."""
    try:
        return len(words) % 3 == 0 and all(
            np.isfinite([float(x), float(y), int(point)]).all() for x, y, point in (words[:3], words[-3:])
        )
    except ValueError:
        return False


def _check_image_line(words: list[str], where: str) -> None:
    with _expected(where, words, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"):
        [int(words[0]), int(words[8])]
        name, pose = words[9], [float(word) for word in words[1:8]]
    if not np.isfinite(pose).all():
        raise InputError(f"{where}: image {name[:120]!r}: the pose has values that are not finite")


def _load(model: Path) -> Any:
    pycolmap = load_pycolmap()
    binary = (model / "cameras.bin").is_file()
    for path in sorted(model.glob("*.bin" if binary else "*.txt")):
        with readable(path):
            check_foreign(path, MODEL_BYTES)
    if binary:
        check_binary_model(model)
    else:
        for name in ("cameras.txt", "images.txt", "points3D.txt"):
            if not (model / name).is_file():
                raise InputError(f"{model}: {name} is missing; a COLMAP model has cameras, images and points3D")
    reconstruction = pycolmap.Reconstruction()
    try:
        if binary:
            reconstruction.read_binary(str(model))
        else:
            _read_text(reconstruction, model)
        # Names are decoded when they are asked for, so a name that is not UTF-8 shows only here.
        [image.name for image in reconstruction.images.values()]
    except InputError:
        raise
    except Exception as error:
        if not binary:
            _check_lines(model)
        message = " ".join(str(error).split())[:200]
        raise InputError(f"{model}: pycolmap cannot read this model ({type(error).__name__}: {message})") from error
    if not binary:
        _check_text_counts(model, reconstruction)
    return reconstruction


def _read_text(reconstruction: Any, model: Path) -> None:
    """Reads a text model, also one whose images.txt has one line an image, or no points for the tracks of points3D.txt
    to name (tracks are not used)."""
    lines, complete, with_points = _image_lines(model / "images.txt")
    points = [] if with_points else [words[:8] for _, words in _rows(model / "points3D.txt")]
    if complete and not points:
        reconstruction.read_text(str(model))
        return
    with TemporaryDirectory(prefix="gsencoder_model_") as folder:
        for file in model.glob("[cprf]*.txt"):
            shutil.copy(file, folder)
        Path(folder, "images.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        if points:
            Path(folder, "points3D.txt").write_text("\n".join(map(" ".join, points)) + "\n", encoding="utf-8")
        reconstruction.read_text(folder)


def _check_lines(model: Path) -> None:
    """Raises InputError with the line of a text model that pycolmap cannot read, or that names what is not there."""
    pycolmap = load_pycolmap()
    counts = {pycolmap.CameraModelId(number).name: count for number, count in enumerate(CAMERA_PARAMS)}
    cameras, points = set[int](), dict[int, int]()
    for where, words in _rows(model / "cameras.txt"):
        with _expected(where, words, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"):
            cameras.add(int(words[0]))
            if len([int(words[2]), int(words[3]), *map(float, words[4:])]) != 2 + counts[words[1]]:
                raise ValueError
    lines = _image_lines(model / "images.txt")[0]
    for image, seen in zip(lines[::2], lines[1::2], strict=True):
        words = image.split()
        points[int(words[0])] = len(seen.split()) // 3
        if int(words[8]) not in cameras:
            where = next(where for where, row in _rows(model / "images.txt") if row == words)
            raise InputError(f"{where} says that {words[9]!r} has camera {words[8]}, which cameras.txt lacks")
    for where, words in _rows(model / "points3D.txt"):
        with _expected(where, words, "POINT3D_ID X Y Z R G B ERROR TRACK[]"):
            [int(words[0]), words[7], *map(float, words[1:8])]
            track = list(map(int, words[8:]))
            seen_by = list(zip(track[::2], track[1::2], strict=True))
        for number, point in seen_by:
            if point >= points.get(number, 0):
                raise InputError(f"{where} names point {point} of image {number}, which images.txt lacks")


def _rows(file: Path) -> Iterator[tuple[str, list[str]]]:
    """Where each line with values stands, and its words."""
    with io.TextIOWrapper(open_foreign(file), encoding="utf-8", errors="replace") as stream:
        for number, line in enumerate(stream, 1):
            if (words := line.split()) and not words[0].startswith("#"):
                yield f"{file}: line {number}", words


@contextmanager
def _expected(where: str, words: list[str], form: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, IndexError, KeyError):
        raise InputError(f"{where} is not {form}: {' '.join(words)[:80]!r}") from None


def _check_text_counts(model: Path, reconstruction: Any) -> None:
    """Compares what was read with the counts in the files' comments: a text file cut short has no other sign."""
    entries = {"cameras": reconstruction.cameras, "images": reconstruction.images, "points3D": reconstruction.points3D}
    for name, values in entries.items():
        with io.TextIOWrapper(open_foreign(model / f"{name}.txt"), encoding="utf-8", errors="replace") as lines:
            for line in itertools.takewhile(lambda line: line.startswith("#"), lines):
                promised = re.match(r"# Number of \w+: (\d{1,15})\b", line)
                if promised and int(promised[1]) != len(values):
                    raise InputError(
                        f"{model / name}.txt: promises {promised[1]} entries and holds {len(values)}; "
                        "the file is cut short or was edited (correct or remove its comment)"
                    )


def _points(reconstruction: Any) -> tuple[np.ndarray, np.ndarray]:
    sfm_points = list(reconstruction.points3D.values())
    points = np.array([point.xyz for point in sfm_points], np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in sfm_points], np.uint8).reshape(-1, 3)
    return points, colors
