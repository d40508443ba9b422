"""Pictures on disk as lazy sequences of views: files that are decoded on access, undistorted and scaled.

- Distorted pictures are resampled once (undistort.py): color bilinearly, everything else by the nearest pixel.
- A smaller scale averages color over areas; depth and instances take the pixel at the new center. Photographs are
  decoded and undistorted at half, a quarter or an eighth of their size where that is at least twice the view's.
- Photographs that were read last are kept, up to `KEPT_BYTES`: checks, seeds and teachers look at the same ones.
- A file whose width and height are exchanged is turned by the photograph's EXIF orientation; else pixels are as they
  are stored, as COLMAP takes them: poses and intrinsics belong to these. Masks, depth and instance maps of another size
  than the photograph are enlarged or reduced by the nearest pixel.
- Of PNG, JPEG, WebP, TIFF, BMP and PPM (and .npy for depth) the size in the header is checked before anything is
  decoded. Grey becomes RGB by repetition, 16-bit grey keeps its upper 8 bits. An alpha channel composites the color
  over black, which is what a splat rendered without a background gives.
"""

import io
import math
import operator
import threading
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, no_type_check, overload

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.files import check_foreign
from gsencoder.core.threads import kernel
from gsencoder.data.readers.posed import CameraModel, PosedImage, check_camera, pinhole_for, remap_between
from gsencoder.types.orientation import EXCHANGED, INVERSE, turned
from gsencoder.types.scene import Selected, invert_rigid, pixel_centers, unproject_points

if TYPE_CHECKING:
    from PIL.Image import Image


PIXEL_LIMIT = 80_000_000
"""Pictures of more pixels are refused before they are decoded (Pillow's own warning starts a little above this)."""
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")
EXIF_ORIENTATION = 0x0112
DEEP_GREY = ("I;16", "I;16B", "I;16L", "I")  # Pillow's modes of pictures with one channel of more than 8 bits


def check_picture_size(path: Path, width: int, height: int) -> None:
    """Raises InputError where a picture has no pixels, or more than `PIXEL_LIMIT`."""
    if width < 1 or height < 1 or width * height > PIXEL_LIMIT:
        raise InputError(f"{path}: {width}×{height} pixels, expected 1 to {PIXEL_LIMIT:,}; make the picture smaller")


def open_picture(path: Path, data: io.BytesIO | None = None) -> "Image":
    """A picture whose header was read, and whose pixels were not; of `data`, where its content was read already."""
    from PIL import Image

    # Pillow raises nearly any error on hostile files.
    try:
        if data is None:
            check_foreign(path)
        picture = Image.open(path if data is None else data, formats=FORMATS)
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:
        raise InputError(f"{path}: not a readable picture ({_brief(error)}); expected {', '.join(FORMATS)}") from error
    try:
        check_picture_size(path, *picture.size)
        # Pillow turns the pixels of these upright, and poses belong to the stored ones.
        if picture.format == "TIFF" and _orientation(picture) > 1:
            raise InputError(f"{path}: a TIFF file with an EXIF orientation; expected one without, or another format")
    except InputError:
        picture.close()
        raise
    return picture


def _brief(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"


def _decode(path: Path, picture: "Image") -> "Image":
    try:
        picture.load()
    except Exception as error:
        raise InputError(f"{path}: cannot be decoded ({_brief(error)}); the file is cut short or damaged") from error
    return picture


def _orientation(picture: "Image") -> int:
    """The EXIF orientation from the header; 1 where there is none that can be read."""
    from PIL import Image

    try:
        # Of PNG files Pillow's own method would decode all pixels, in case EXIF data follow them.
        value = Image.Image.getexif(picture).get(EXIF_ORIENTATION)
    except Exception:
        return 1
    return int(value) if isinstance(value, int) and 1 <= value <= 8 else 1


def check_picture(path: Path) -> None:
    """Decodes a picture to its end."""
    with open_picture(path) as picture:
        _decode(path, picture)


def load_npy(path: Path, *, header_only: bool = False) -> np.ndarray:
    """The array of a .npy file; its header is checked before its values are read.

    Args:
        header_only: whether to leave the values unread, for the shape and the type. Those of a file that is cut off
            afterwards must not be touched: the system would end the process.
    """
    try:
        check_foreign(path)
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:
        raise InputError(f"{path}: not a readable .npy array ({_brief(error)})") from error
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        raise InputError(f"{path}: expected a .npy array of numbers [H, W]")
    shape = values.shape[:2] if values.shape[2:] == (1,) else values.shape
    if len(shape) != 2:
        raise InputError(f"{path}: expected an array [H, W], got {list(shape)}")
    check_picture_size(path, shape[1], shape[0])
    if header_only:
        return values.reshape(shape)
    try:
        return np.load(path, allow_pickle=False).reshape(shape)
    except Exception as error:
        raise InputError(f"{path}: not a readable .npy array ({_brief(error)})") from error


def picture_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header alone."""
    return picture_info(path)[0]


def picture_info(path: Path) -> tuple[tuple[int, int], bool, int]:
    """((width, height), whether there is transparency, EXIF orientation) from the header alone."""
    if path.suffix.lower() == ".npy":
        height, width = load_npy(path, header_only=True).shape
        return (width, height), False, 1
    with open_picture(path) as picture:
        try:
            return picture.size, bool(picture.has_transparency_data), _orientation(picture)
        except Exception as error:
            raise InputError(f"{path}: not a readable picture ({_brief(error)})") from error


def read_rgba(path: Path, *, reduction: int = 1) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"] | None]:
    """Color (composited over black) and alpha, None where the file has none.

    Args:
        reduction: 1, 2, 4 or 8: JPEG is decoded this many times smaller, and files of other formats are not.
    """
    with open_picture(path) as file:
        if file.format == "JPEG" and reduction > 1:
            file.draft("RGB", (file.width // reduction, file.height // reduction))
        picture = _decode(path, file)
        try:
            if picture.mode.startswith("I"):
                wide = np.asarray(picture).astype(np.int64)
                if wide.min() < 0 or wide.max() > 65_535:
                    raise InputError(f"{path}: grey values beyond 16 bits; expected an 8- or 16-bit photograph")
                return np.repeat((wide >> 8).astype(np.uint8)[..., None], 3, axis=2), None
            if picture.mode == "F":
                raise InputError(f"{path}: a floating-point picture; expected an 8- or 16-bit photograph")
            if not picture.has_transparency_data:
                return np.array(picture.convert("RGB")), None
            rgba = np.asarray(picture.convert("RGBA"))
        except InputError:
            raise
        except Exception as error:
            raise InputError(f"{path}: cannot be turned into RGB ({_brief(error)})") from error
    alpha = rgba[..., 3]
    color = (rgba[..., :3].astype(np.uint16) * alpha[..., None] + 127) // 255
    return color.astype(np.uint8), alpha.copy()


def read_small(path: Path, side: int) -> UInt8[np.ndarray, "h w 3"]:
    """About side × side pixels or more of a picture: JPEG is decoded smaller, of others every n-th pixel is taken."""
    with open_picture(path) as file:
        if file.format == "JPEG":
            file.draft("RGB", (side, side))
            picture = np.asarray(_decode(path, file).convert("RGB"))
        else:
            picture = read_rgba(path)[0]
    step = max(1, min(picture.shape[:2]) // side)
    return picture[::step, ::step]


def read_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Where a mask file is not 0. One that was saved as RGB is white and black like any other; alpha says nothing."""
    with open_picture(path) as file:
        picture = _decode(path, file)
        values, bands = np.asarray(picture), picture.getbands()
    if values.ndim == 2:
        return np.asarray(values != 0)
    return np.asarray(values[..., : len(bands) - ("A" in bands)].any(axis=2))


def read_integers(path: Path, subject: str, *, wide: bool = False, data: io.BytesIO | None = None) -> np.ndarray:
    """A single-channel integer PNG [H, W], int32, of `data` where its content was read already; `wide` asks for more
    than 8 bits, as depth in millimetres has."""
    with open_picture(path, data) as file:
        if file.format == "JPEG":
            raise InputError(f"{path}: {subject} was saved as JPEG, which changes values; expected PNG")
        allowed = DEEP_GREY + (() if wide else ("L", "P", "1"))
        if file.mode not in allowed:
            kind = "16-bit" if wide else "8- or 16-bit"
            raise InputError(f"{path}: {subject} must be a {kind} picture with one channel, got mode {file.mode}")
        values = np.asarray(_decode(path, file)).astype(np.int32)
    if values.size and values.min() < 0:
        raise InputError(f"{path}: {subject} has negative values")
    return values


Array = TypeVar("Array", bound=np.ndarray)
KEPT_BYTES = 64 << 20  # Of all photographs that are kept; scenes with more decode them each time they are looked at
_kept: dict[Any, UInt8[np.ndarray, "_ _ 3"]] = {}
_kept_lock = threading.Lock()


@dataclass(frozen=True, slots=True, kw_only=True)
class PixelGrid:
    """How the pixels of a view's file become the pixels of the view."""

    source: CameraModel  # the camera that the file's pixels belong to
    pinhole: CameraModel  # the camera without distortion, at full size
    width: int  # of the view, after scaling
    height: int  # of the view, after scaling
    # EXIF orientation by which a file is turned whose width and height are those of `source` exchanged; 1 = no such
    # file is read.
    turn: int = 1

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:
        """Intrinsics of the view."""
        return self.pinhole.matrix(self.width, self.height)

    @property
    def reduction(self) -> int:
        """How many times smaller a photograph is decoded: 1, 2, 4 or 8."""
        source = self.source
        most = min(source.width // (2 * self.width), source.height // (2 * self.height))
        # Pixels that are cut off are the last ones of the file; turned they would be the first.
        sides = 0 if self.turn == 1 else math.gcd(source.width, source.height)
        return max(each for each in (1, 2, 4, 8) if each <= max(1, most) and sides % each == 0)

    def is_exchanged(self, width: int, height: int) -> bool:
        """Whether a file of this size is to be turned."""
        source = self.source
        return self.turn in EXCHANGED and (width > height) != (source.width > source.height) and width != height

    def fits(self, width: int, height: int) -> bool:
        """Whether a file of this size has the shape of the photograph, to the nearest pixel."""
        if self.is_exchanged(width, height):
            width, height = height, width
        source = self.source
        return abs(width * source.height - height * source.width) < min(source.width, source.height)


def pixel_grids(
    images: Sequence[PosedImage], pinholes: Mapping[CameraModel, CameraModel], image_scale: float, source: str
) -> tuple[list[PixelGrid], list[PixelGrid], list[Path | None], list[int]]:
    """Of each view the grids of its photograph and of its depth, the photograph where it has transparency, and the EXIF
    orientation of its stored pixels. The sizes in the headers of all files are checked.

    Args:
        pinholes: the camera without distortion of each camera of the views.
        source: begins errors.
    """
    grids, depth_grids = [], []
    transparent: list[Path | None] = []
    orientations: list[int] = []
    for image in images:
        pinhole = pinholes[image.camera]
        width, height = (max(1, round(side * image_scale)) for side in (pinhole.width, pinhole.height))
        size, is_transparent, orientation = picture_info(image.image)
        # A photograph that is stored sideways, with the camera of the upright picture, is turned on load. With the
        # camera of its stored pixels it is not, and a mask whose sides are exchanged belongs to the upright picture.
        camera_size = image.camera.width, image.camera.height
        exchanged = orientation in EXCHANGED and size[::-1] == camera_size != size
        turn = orientation if exchanged else INVERSE[orientation]
        grid = PixelGrid(source=image.camera, pinhole=pinhole, width=width, height=height, turn=turn)
        depth_grid = replace(grid, source=image.depth_camera or image.camera)
        where = f"{source}: view {image.name[:120]!r}"
        if image.depth is not None and image.depth == image.image:
            raise InputError(f"{where}: {image.image} is listed as photograph and as depth image; list the photograph")
        if (size[::-1] if grid.is_exchanged(*size) else size) != camera_size:
            width, height = camera_size
            raise InputError(f"{where}: {image.image} has {size[0]}×{size[1]} pixels but its camera {width}×{height}")
        for file, expected in ((image.depth, depth_grid), (image.mask, grid), (image.instance, grid)):
            if file is not None and not expected.fits(*(actual := picture_size(file))):
                raise InputError(
                    f"{where}: {file} has {actual[0]}×{actual[1]} pixels but {image.image} has {size[0]}×{size[1]}"
                )
        grids.append(grid)
        depth_grids.append(depth_grid)
        transparent.append(image.image if is_transparent else None)
        orientations.append(1 if exchanged else orientation)
    return grids, depth_grids, transparent, orientations


FEW_CAMERAS = 8


def have_empty_pixels(grids: Sequence[PixelGrid]) -> bool:
    """Whether some pixel of a pinhole camera is outside the distorted picture; taken for granted of many cameras."""
    cameras = {(grid.pinhole, grid.source, grid.reduction) for grid in grids if not grid.source.is_pinhole}
    if len(cameras) > FEW_CAMERAS:
        return True
    maps = [remap_between(*camera) for camera in cameras]
    return any(remap is not None and not remap.valid.all() for remap in maps)


class PictureFiles(Sequence[Array]):
    """Files of V views, read on access; nothing is kept in memory."""

    def __init__(self, paths: Sequence[Path | None], grids: Sequence[PixelGrid]) -> None:
        self._paths, self.grids = tuple(paths), tuple(grids)

    def __len__(self) -> int:
        return len(self._paths)

    @overload
    def __getitem__(self, index: int) -> Array: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Array]: ...
    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return Selected(self, list(range(len(self)))[index])
        view = operator.index(index)
        if not -len(self) <= view < len(self):
            raise IndexError(f"view {view} of {len(self)}")
        return self._load(view % len(self))

    @abstractmethod
    def _load(self, view: int) -> Array: ...

    def check_size(self, view: int, shape: tuple[int, ...]) -> None:
        """Raises InputError where the pixels of a file are not of the size [H, W] that its header had at first."""
        source = self.grids[view].source
        if shape != (source.height, source.width):
            raise InputError(
                f"{self._paths[view]}: {shape[1]}×{shape[0]} pixels, expected {source.width}×{source.height}"
            )

    def _turned(self, view: int, pixels: np.ndarray) -> np.ndarray:
        """Pixels of a file turned as those of `source`, where width and height are exchanged."""
        grid = self.grids[view]
        return turned(pixels, grid.turn) if grid.is_exchanged(pixels.shape[1], pixels.shape[0]) else pixels

    def _of_source(self, view: int, values: np.ndarray) -> np.ndarray:
        """Values of a file turned and scaled by the nearest pixel to the pixels of `source`."""
        values, grid = self._turned(view, values), self.grids[view]
        if grid.fits(values.shape[1], values.shape[0]):
            values = resized_nearest(values, grid.source.width, grid.source.height)
        self.check_size(view, values.shape)
        return values

    def _nearest(self, view: int, values: np.ndarray) -> np.ndarray:
        grid = self.grids[view]
        values = self._of_source(view, values)
        remap = remap_between(grid.pinhole, grid.source)
        if remap is not None:
            values = remap.nearest(values)
        return resized_nearest(values, grid.width, grid.height)


def resized_nearest(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """[h, w] at another size: the value at the center of each new pixel."""
    if values.shape == (height, width):
        return values
    rows = ((np.arange(height) + 0.5) * (values.shape[0] / height)).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * (values.shape[1] / width)).astype(np.int64)
    return values[rows][:, columns]


class ImageFiles(PictureFiles[UInt8[np.ndarray, "H W 3"]]):
    """Photographs as uint8 [H, W, 3] RGB, undistorted and scaled."""

    def _load(self, view: int) -> UInt8[np.ndarray, "H W 3"]:
        path, grid = self._paths[view], self.grids[view]
        assert path is not None
        state = path.stat() if path.exists() else None
        key = (path, grid, state and (state.st_mtime_ns, state.st_size))
        with _kept_lock:
            color = _kept.pop(key, None)
        if color is None:
            color = self._decoded(view, path)
        if color.nbytes <= KEPT_BYTES:
            with _kept_lock:
                _kept[key] = color
                while sum(each.nbytes for each in _kept.values()) > KEPT_BYTES:
                    _kept.pop(next(iter(_kept)))
        return color.copy()

    def _decoded(self, view: int, path: Path) -> UInt8[np.ndarray, "H W 3"]:
        from PIL import Image

        grid = self.grids[view]
        reduction = grid.reduction
        size, color = picture_size(path), read_rgba(path, reduction=reduction)[0]
        if color.shape[:2] == size[::-1] and reduction > 1:
            color = np.array(Image.fromarray(color).reduce(reduction))
        if grid.is_exchanged(*size):
            color, size = turned(color, grid.turn), size[::-1]
        self.check_size(view, size[::-1])
        remap = remap_between(grid.pinhole, grid.source, reduction)
        if remap is not None:
            color = remap.bilinear(color)
        if color.shape[:2] != (grid.height, grid.width):
            # Of two to four pixels for one a box would take some whole and some not at all.
            method = Image.Resampling.BOX if reduction == 1 else Image.Resampling.HAMMING
            whole = (0, 0, size[0] / reduction, size[1] / reduction)
            color = np.array(Image.fromarray(color).resize((grid.width, grid.height), method, box=whole))
        return color


PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")


def frame_key(stem: str) -> tuple[bool, int, str]:
    """Orders names of frames: numbers by value, then other names."""
    return (not stem.isdecimal(), int(stem) if stem.isdecimal() else 0, stem)


def files_by_stem(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """The files of a folder by their stems, in the order of `frame_key`; hidden files are left out."""
    if not folder.is_dir():
        return {}
    files = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    stems: dict[str, Path] = {}
    for path in sorted(files, key=lambda path: (frame_key(path.stem), path.name)):
        if path.stem in stems:
            raise InputError(f"{folder}: frame {path.stem} is there twice ({stems[path.stem].name}, {path.name})")
        stems[path.stem] = path
    return stems


def pinhole_of(
    fx: float, fy: float, cx: float, cy: float, picture: Path, where: str, *, size: tuple[int, int] | None = None
) -> CameraModel:
    """A camera without distortion at the size of a picture, or at another that is given."""
    width, height = size or picture_size(picture)
    camera = CameraModel(model="PINHOLE", width=width, height=height, params=(fx, fy, cx, cy))
    check_camera(camera, where)
    if not (0.25 * width < cx < 0.75 * width and 0.25 * height < cy < 0.75 * height):
        raise InputError(
            f"{where}: principal point {cx:g}, {cy:g} does not belong to pictures of {width}×{height} ({picture.name})"
        )
    return camera


def ray_lengths(K: Float64[np.ndarray, "3 3"], width: int, height: int) -> Float64[np.ndarray, "height width"]:
    """The distance from the camera of a point of depth z = 1, for each pixel."""
    rays = unproject_points(pixel_centers(width, height), np.ones((height, width)), K)
    return np.asarray(np.linalg.norm(rays, axis=2))


class DepthFiles(PictureFiles[Float32[np.ndarray, "H W"]]):
    """Sensor depth as float32 [H, W], z in world units, 0 = none; a view without a file is all zero.

    PNG holds integers and .npy any number type; both are multiplied by the view's scale. In .npy, NaN and infinity
    also mean none. Depth of a sensor that stands elsewhere is carried over (`register_depth`).
    """

    def __init__(self, images: Sequence[PosedImage], grids: Sequence[PixelGrid]) -> None:
        super().__init__([image.depth for image in images], grids)
        self._images = tuple(images)

    def _load(self, view: int) -> Float32[np.ndarray, "H W"]:
        path, grid = self._paths[view], self.grids[view]
        if path is None:
            return np.zeros((grid.height, grid.width), np.float32)
        if path.suffix.lower() == ".npy":
            array = load_npy(path)
            with np.errstate(over="ignore"):
                values = np.where(np.isfinite(array), array, 0).astype(np.float64)
            if values.size and values.min() < 0:
                raise InputError(f"{path}: depth has negative values")
        else:
            values = read_integers(path, "depth", wide=True).astype(np.float64)
        image = self._images[view]
        if image.no_depth is not None:
            values[values == image.no_depth] = 0
        if image.depth_from_color is None:
            depth = self._nearest(view, values) * image.depth_scale
            if image.depth_measure == "ray":
                depth /= ray_lengths(grid.K, grid.width, grid.height)
        else:
            depth = self._registered(view, values * image.depth_scale, image)
        if depth.size and depth.max() > np.finfo(np.float32).max:
            raise InputError(f"{path}: depth of {depth.max():g} world units; check the depth scale")
        return depth.astype(np.float32)

    def _registered(self, view: int, depth: np.ndarray, image: PosedImage) -> Float32[np.ndarray, "H W"]:
        """The depth of a sensor that stands elsewhere, as the photograph's camera sees it."""
        grid = self.grids[view]
        depth = self._of_source(view, depth)
        pinhole = pinhole_for(grid.source, str(self._paths[view]))
        remap = remap_between(pinhole, grid.source)
        if remap is not None:
            depth = remap.nearest(depth)
        K = pinhole.matrix(pinhole.width, pinhole.height)
        if image.depth_measure == "ray":
            depth = depth / ray_lengths(K, pinhole.width, pinhole.height)
        assert image.depth_from_color is not None
        return register_depth(
            depth.astype(np.float32),
            K,
            invert_rigid(image.depth_from_color),
            grid.K,
            grid.width,
            grid.height,
        )


MARGIN = 1.1
"""The square that a depth pixel covers is this much wider than the distance to its neighbor's, so that slanted surfaces
have no holes."""


def register_depth(
    depth: Float32[np.ndarray, "h w"],
    depth_K: Float64[np.ndarray, "3 3"],
    color_from_depth: Float64[np.ndarray, "4 4"],
    color_K: Float64[np.ndarray, "3 3"],
    width: int,
    height: int,
) -> Float32[np.ndarray, "height width"]:
    """Depth z in the color camera at its pixels, 0 = none: also where a surface hides from the depth sensor.

    Each depth pixel becomes a square that faces the color camera, as large as the pixel at its depth. Of several in a
    pixel the nearest counts. `color_K` is that of the result's size.
    """
    result = np.full((height, width), np.inf, np.float32)
    matrices = (np.ascontiguousarray(matrix, np.float64) for matrix in (depth_K, color_from_depth, color_K))
    _register(np.ascontiguousarray(depth, np.float32), *matrices, result)
    result[np.isinf(result)] = 0
    return result


@kernel
@no_type_check
def _register(depth, depth_K, color_from_depth, color_K, result):
    height, width = result.shape
    fx, fy, cx, cy = color_K[0, 0], color_K[1, 1], color_K[0, 2], color_K[1, 2]
    half_x, half_y = 0.5 * MARGIN * fx / depth_K[0, 0], 0.5 * MARGIN * fy / depth_K[1, 1]
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if not z > 0:
                continue
            x = (column + 0.5 - depth_K[0, 2]) / depth_K[0, 0] * z
            y = (row + 0.5 - depth_K[1, 2]) / depth_K[1, 1] * z
            m = color_from_depth
            far = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            if not far > 0:
                continue
            u = fx * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / far + cx
            v = fy * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / far + cy
            wide, high = half_x * z / far, half_y * z / far
            if not (u + wide > 0 and v + high > 0 and u - wide < width and v - high < height):
                continue
            left, right = max(0, int(np.ceil(u - wide - 0.5))), min(width - 1, int(np.floor(u + wide - 0.5)))
            top, bottom = max(0, int(np.ceil(v - high - 0.5))), min(height - 1, int(np.floor(v + high - 0.5)))
            for r in range(top, bottom + 1):
                for c in range(left, right + 1):
                    if far < result[r, c]:
                        result[r, c] = far
