"""How pictures are given to a vision tower: by its own preprocessor_config.json, whole and without a crop."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from gsencoder.core.errors import InputError
from gsencoder.core.files import read_foreign_text
from gsencoder.fusion.teachers.resize import fit_to_patches, normalized, patches_of

FILES = ("processor_config.json", "preprocessor_config.json")
"""Where it is stated: in the section `image_processor` of a processor's file, which transformers prefers, or alone."""
FLOAT_FILTERS = {Image.Resampling.BILINEAR: "bilinear", Image.Resampling.BICUBIC: "bicubic"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Preprocessing:
    """Resize with a filter, times a factor, minus a mean, divided by a standard deviation.

    Attributes:
        resample: filter of the resize.
        factor: 8-bit values are multiplied by this.
        mean: subtracted, one a channel.
        std: divided by, one a channel.
        floats: whether values are resized after they were multiplied, and not rounded to 8 bits.
    """

    resample: Image.Resampling
    factor: float
    mean: tuple[float, ...]
    std: tuple[float, ...]
    floats: bool = False

    def fit(
        self, image: UInt8[np.ndarray, "H W 3"], size: int, patch: int
    ) -> tuple[Float32[np.ndarray, "1 3 h w"], Float64[np.ndarray, "2 3"]]:
        """What the network takes, with sides of whole patches, and the affine from pixels of the picture to patches.

        Args:
            image: any size.
            size: about what the longer side becomes, pixels.
            patch: pixels along a patch.
        """
        if self.floats:
            return self._fit_floats(image, size, patch)
        resized, affine = fit_to_patches(image, size, patch, self.resample)
        return normalized(resized, 1 / self.factor, self.mean, self.std).transpose(2, 0, 1)[None], affine

    def _fit_floats(
        self, image: UInt8[np.ndarray, "H W 3"], size: int, patch: int
    ) -> tuple[Float32[np.ndarray, "1 3 h w"], Float64[np.ndarray, "2 3"]]:
        import torch

        height, width = image.shape[:2]
        rows, columns = patches_of(height, width, size, patch)
        values = torch.from_numpy(image.astype(np.float32).transpose(2, 0, 1)[None] * np.float32(self.factor))
        resized = torch.nn.functional.interpolate(
            values, (rows * patch, columns * patch), mode=FLOAT_FILTERS[self.resample], antialias=True
        )
        pixels = normalized(resized[0].permute(1, 2, 0).numpy(), 1.0, self.mean, self.std)
        return pixels.transpose(2, 0, 1)[None], np.array([[columns / width, 0, 0], [0, rows / height, 0]])

    def describe(self) -> str:
        """For the feature space."""
        numbers = (f"{name} {[round(value, 6) for value in getattr(self, name)]}" for name in ("mean", "std"))
        return f"{self.resample.name.lower()}, × {self.factor:.6g}, {', '.join(numbers)}"


def read_preprocessing(folder: Path, subject: str, *, floats: bool = False) -> Preprocessing:
    """The preprocessing that a folder states.

    Its sizes and crops are not used: a map is of the whole picture. Mean, standard deviation and filter must be stated,
    since features of pictures that were normalized otherwise look plausible, and are wrong.

    Args:
        folder: of the model.
        subject: who reads it, for messages.
        floats: see `Preprocessing`.

    Raises:
        InputError: no file, or one that does not state it.
    """
    path, stated = _stated(folder, subject)
    where = f"{subject}: {path}"
    missing = [name for name in ("resample", "image_mean", "image_std") if name not in stated]
    if missing:
        raise InputError(f"{where} does not state {', '.join(missing)}; take the file that belongs to the model")
    if type(stated["resample"]) is not int or not 0 <= stated["resample"] <= 5:
        raise InputError(f"{where}: resample: expected a number from 0 to 5, got {stated['resample']!r}")
    resample = Image.Resampling(stated["resample"])
    if floats and resample not in FLOAT_FILTERS:
        raise InputError(f"{where}: resample: expected 2 (bilinear) or 3 (bicubic), got {int(resample)}")
    normalizes = stated.get("do_normalize", True)
    factor = stated.get("rescale_factor", 1 / 255) if stated.get("do_rescale", True) else 1.0
    if not _is_number(factor) or factor <= 0:
        raise InputError(f"{where}: rescale_factor: expected a number above 0, got {factor!r}")
    return Preprocessing(
        resample=resample,
        factor=float(factor),
        mean=_three(stated["image_mean"], f"{where}: image_mean") if normalizes else (0.0, 0.0, 0.0),
        std=_three(stated["image_std"], f"{where}: image_std", positive=True) if normalizes else (1.0, 1.0, 1.0),
        floats=floats,
    )


def _stated(folder: Path, subject: str) -> tuple[Path, dict[str, Any]]:
    for path in (folder / name for name in FILES):
        try:
            stated = json.loads(read_foreign_text(path))
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise InputError(f"{subject}: {path}: cannot be read: {error}") from error
        section = stated.get("image_processor") if isinstance(stated, dict) and path.name == FILES[0] else stated
        if isinstance(section, dict):
            return path, section
    raise InputError(
        f"{subject}: {folder} has no preprocessor_config.json, which says how its pictures are resized and normalized; "
        "take the file that belongs to the model"
    )


def _three(value: Any, where: str, *, positive: bool = False) -> tuple[float, ...]:
    numbers = value if isinstance(value, list) else []
    if len(numbers) != 3 or not all(_is_number(number) and (number > 0 or not positive) for number in numbers):
        expected = "three numbers above 0" if positive else "three numbers"
        raise InputError(f"{where}: expected {expected}, one a channel, got {str(value)[:60]}")
    return tuple(float(number) for number in numbers)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))
