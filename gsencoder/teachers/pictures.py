"""How pictures are given to networks: resized to whole patches and normalized, through onnxruntime or torch."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from PIL import Image
from torch import Tensor

from gsencoder.core.device import enough_memory, teacher_autocast
from gsencoder.core.errors import InputError
from gsencoder.core.files import read_foreign_text
from gsencoder.core.pretrained import digest_files, open_session
from gsencoder.core.settings import CheckedConfig, option
from gsencoder.teachers.base import MissingInput, settings_of
from gsencoder.types import FeatureMap, FeatureSpace, Views

LARGEST_SIDE = 8192
"""Pixels along a resized picture: beyond this a network's own maps no longer fit into memory."""


def patches_of(height: int, width: int, size: int, patch: int) -> tuple[int, int]:
    """Rows and columns of patches of a picture whose longer side becomes about `size` pixels."""
    ratio = size / max(height, width)
    return max(1, round(height * ratio / patch)), max(1, round(width * ratio / patch))


def fit_to_patches(
    image: UInt8[np.ndarray, "H W 3"],
    size: int,
    patch: int,
    resample: Image.Resampling = Image.Resampling.BICUBIC,
) -> tuple[UInt8[np.ndarray, "h w 3"], Float64[np.ndarray, "2 3"]]:
    """A picture whose longer side is about `size` pixels and whose sides are whole patches, and the affine from its own
    pixels to the grid of patches."""
    height, width = image.shape[:2]
    rows, columns = patches_of(height, width, size, patch)
    resized = Image.fromarray(image).resize((columns * patch, rows * patch), resample)
    return np.asarray(resized), resize_affine((rows, columns), (height, width))


def resize_affine(grid: Sequence[float | int], image: Sequence[int]) -> Float64[np.ndarray, "2 3"]:
    """The affine from pixels of a picture of rows and columns to cells of a grid that covers it."""
    return np.array([[grid[1] / image[1], 0.0, 0.0], [0.0, grid[0] / image[0], 0.0]])


def normalized(
    image: UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"],
    scale: float,
    mean: Sequence[float],
    std: Sequence[float],
) -> Float32[np.ndarray, "H W 3"]:
    """(image / scale − mean) / std, channel by channel."""
    return (image.astype(np.float32) / np.float32(scale) - np.array(mean, np.float32)) / np.array(std, np.float32)


def photograph(views: Views, view: int, subject: str) -> UInt8[np.ndarray, "H W 3"]:
    """The picture of a view, for a teacher that needs one."""
    if views.images is None:
        raise MissingInput(f"{subject}: the scene has no pictures")
    return views.images[view]


class PictureTeacher:
    """A teacher of dense maps that looks at one photograph at a time.

    Attributes:
        advice: what to check where features are not finite.
    """

    table = None
    mean = None
    needs_images = True
    cheap = False
    subject: str
    advice = "the weights"
    space: FeatureSpace

    def cells(
        self, image: UInt8[np.ndarray, "H W 3"]
    ) -> tuple[Float32[np.ndarray, "h w D"], Float64[np.ndarray, "2 3"]]:
        """The features of a picture's cells, and the affine from its pixels to the cells."""
        raise NotImplementedError

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """The features of a photograph's cells; InputError where they are not finite."""
        features, grid_from_image = self.cells(photograph(views, view, self.subject))
        check_finite(features, f"{self.subject}: view {views.names[view]!r}", self.advice)
        return FeatureMap(features=features, grid_from_image=grid_from_image, space=self.space)

    def settings(self) -> dict[str, Any]:
        """All but the views that the maps depend on, as JSON values."""
        return settings_of(self.space)


def check_finite(values: Float32[np.ndarray, "..."], subject: str, advice: str) -> None:
    """Refuses the output of a network that is not finite."""
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        raise InputError(f"{subject}: {bad} of {values.size} values are not finite; check {advice}")


@dataclass(frozen=True, slots=True, kw_only=True)
class OnnxOptions(CheckedConfig):
    """How pictures are given to an .onnx file, and which of its outputs is read."""

    output: str = option("", "output tensor; empty = the model's first")
    size: int = option(448, "longer side of the resized picture in pixels", ge=1, le=LARGEST_SIDE)
    scale: float = option(255.0, "8-bit values are divided by this, then mean and std apply", ge=1e-6, le=1e6)
    mean: tuple[float, float, float] = option((0.485, 0.456, 0.406), "subtracted per channel", ge=-1e6, le=1e6)
    std: tuple[float, float, float] = option((0.229, 0.224, 0.225), "divided per channel", ge=1e-6, le=1e6)


ONNX_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(uint8)": np.uint8}


class OnnxNetwork:
    """An .onnx file that takes one picture, [1, 3, H, W] or [1, H, W, 3], normalized or of bytes.

    Attributes:
        fixed: rows and columns of the only pictures that it takes; None where it takes others.
        takes_bytes: whether pictures are not normalized.
        channels_first: whether it takes [1, 3, H, W].
    """

    def __init__(self, path: Path, options: OnnxOptions, subject: str) -> None:
        self._session = open_session(path, subject)
        self.name, self.digest, self._options = path.stem, digest_files(path), options
        self.subject = f"{subject}: {path.name}"
        inputs, outputs = self._session.get_inputs(), {each.name: each for each in self._session.get_outputs()}
        self.output = options.output or next(iter(outputs), "")
        if not inputs or self.output not in outputs:
            raise InputError(f"{self.subject} has outputs {list(outputs)}, not {self.output!r}")
        self._input, shape, kind = inputs[0].name, inputs[0].shape, inputs[0].type
        channels = [shape[axis] for axis in (1, 3)] if len(shape) == 4 else []
        if kind not in ONNX_TYPES or not any(size == 3 or not isinstance(size, int) for size in channels):
            raise InputError(
                f"{self.subject} takes {kind}{shape}; expected one picture of float or uint8, [1, 3, H, W] or "
                "[1, H, W, 3]"
            )
        self.channels_first = channels[0] == 3 or channels[1] != 3
        self._type = ONNX_TYPES[kind]
        self.takes_bytes = self._type == np.uint8
        sides = shape[2:4] if self.channels_first else shape[1:3]
        self.fixed = (sides[0], sides[1]) if all(isinstance(side, int) and side > 0 for side in sides) else None
        self.output_shape = outputs[self.output].shape

    def run(self, picture: UInt8[np.ndarray, "h w 3"]) -> Any:
        """The output for a picture of a size that the file takes, with its batch axis."""
        options = self._options
        values: np.ndarray = picture
        if not self.takes_bytes:
            values = normalized(picture, options.scale, options.mean, options.std).astype(self._type)
        if self.channels_first:
            values = values.transpose(2, 0, 1)
        picture_of_one = np.ascontiguousarray(values[None])
        try:
            return self._session.run([self.output], {self._input: picture_of_one})[0]
        except Exception as error:  # onnxruntime raises its own classes, which share only this base
            message = " ".join(str(error).split())[:200]
            raise InputError(
                f"{self.subject} does not run on a picture {list(picture_of_one.shape)}: {message}"
            ) from error


FILES = ("processor_config.json", "preprocessor_config.json")
"""Where it stands: in the section `image_processor` of a processor's file, which transformers prefers, or alone."""
FLOAT_FILTERS = {Image.Resampling.BILINEAR: "bilinear", Image.Resampling.BICUBIC: "bicubic"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Preprocessing:
    """Resize with a filter, times a factor, minus a mean, divided by a standard deviation, for networks of torch.

    Attributes:
        floats: whether values are resized after they were multiplied, and not rounded to 8 bits.
    """

    resample: Image.Resampling = Image.Resampling.BICUBIC
    factor: float = 1 / 255
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)
    floats: bool = False

    def fit(
        self, image: UInt8[np.ndarray, "H W 3"], size: int, patch: int
    ) -> tuple[Float[Tensor, "1 3 h w"], Float64[np.ndarray, "2 3"]]:
        """A picture for the network, with sides of whole patches, the longer about `size` pixels, and the affine from
        its own pixels to patches."""
        if not self.floats:
            resized, affine = fit_to_patches(image, size, patch, self.resample)
            return self.tensor(resized), affine
        height, width = image.shape[:2]
        rows, columns = patches_of(height, width, size, patch)
        values = torch.from_numpy(image.astype(np.float32).transpose(2, 0, 1)[None] * np.float32(self.factor))
        scaled = torch.nn.functional.interpolate(
            values, (rows * patch, columns * patch), mode=FLOAT_FILTERS[self.resample], antialias=True
        )
        pixels = normalized(scaled[0].permute(1, 2, 0).numpy(), 1.0, self.mean, self.std)
        affine = resize_affine((rows, columns), (height, width))
        return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)[None])), affine

    def tensor(self, picture: UInt8[np.ndarray, "h w 3"]) -> Float[Tensor, "1 3 h w"]:
        """A picture that has its size already, normalized."""
        pixels = normalized(picture, 1 / self.factor, self.mean, self.std)
        return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)[None]))

    def describe(self) -> str:
        """For the feature space."""
        numbers = (f"{name} {[round(value, 6) for value in getattr(self, name)]}" for name in ("mean", "std"))
        return f"{self.resample.name.lower()}, × {self.factor:.6g}, {', '.join(numbers)}"


def read_preprocessing(folder: Path, subject: str, *, floats: bool = False) -> Preprocessing:
    """The preprocessing that the folder of a model states.

    Its sizes and crops are not used: a map is of the whole picture. Mean, standard deviation and filter must be given,
    since features of pictures that were normalized otherwise look plausible, and are wrong.
    """
    path, settings = _find_settings(folder, subject)
    try:
        resample = Image.Resampling(settings["resample"])
        mean, std = ([float(value) for value in settings[name]] for name in ("image_mean", "image_std"))
        factor = float(settings.get("rescale_factor", 1 / 255)) if settings.get("do_rescale", True) else 1.0
        if len(mean) != 3 or len(std) != 3 or not np.isfinite([*mean, *std, factor]).all() or min(*std, factor) <= 0:
            raise ValueError("numbers out of range")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{subject}: {path}: expected a filter of Pillow as resample, three numbers as image_mean, three above 0 "
            f"as image_std, and a rescale_factor above 0 ({error}); take the file that belongs to the model"
        ) from error
    if floats and resample not in FLOAT_FILTERS:
        raise InputError(f"{subject}: {path}: resample: expected 2 (bilinear) or 3 (bicubic), got {int(resample)}")
    if not settings.get("do_normalize", True):
        mean, std = [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
    return Preprocessing(resample=resample, factor=factor, mean=tuple(mean), std=tuple(std), floats=floats)


def _find_settings(folder: Path, subject: str) -> tuple[Path, dict[str, Any]]:
    """The file that states the preprocessing, and what it states."""
    for path in (folder / name for name in FILES):
        try:
            content = json.loads(read_foreign_text(path))
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise InputError(f"{subject}: {path}: cannot be read: {error}") from error
        section = content.get("image_processor") if isinstance(content, dict) and path.name == FILES[0] else content
        if isinstance(section, dict):
            return path, section
    raise InputError(
        f"{subject}: {folder} has no preprocessor_config.json, which says how its pictures are resized and normalized; "
        "take the file that belongs to the model"
    )


class TorchTeacher(PictureTeacher):
    """A network of torch on whole pictures, which are resized to multiples of its `patch`, without a crop."""

    preprocessing: Preprocessing
    size: int
    device: str
    network: Any

    def map_of(self, pixels: Float[Tensor, "1 3 H W"]) -> Float[Tensor, "h w D"]:
        """The vectors of the patches of a normalized picture."""
        out: Tensor = self.network(pixels)
        return out

    def cells(
        self, image: UInt8[np.ndarray, "H W 3"]
    ) -> tuple[Float32[np.ndarray, "h w D"], Float64[np.ndarray, "2 3"]]:
        """The network's vectors of the patches of a picture."""
        pixels, grid_from_image = self.preprocessing.fit(image, self.size, self.network.patch)
        with torch.inference_mode(), teacher_autocast(self.device), enough_memory(self.subject, "teacher.size="):
            cells = self.map_of(pixels.to(self.device))
        return np.ascontiguousarray(cells.cpu().numpy()), grid_from_image
