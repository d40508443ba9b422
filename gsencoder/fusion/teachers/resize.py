"""How a picture is fitted to a backbone: resized as a whole, without a crop, and normalized."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from PIL import Image


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
    """A picture with sides of whole patches, and the affine from its own pixels to the grid of patches.

    Args:
        image: any size.
        size: about what the longer side becomes, pixels.
        patch: pixels along a patch.
        resample: the filter.
    """
    height, width = image.shape[:2]
    rows, columns = patches_of(height, width, size, patch)
    resized = Image.fromarray(image).resize((columns * patch, rows * patch), resample)
    return np.asarray(resized), np.array([[columns / width, 0, 0], [0, rows / height, 0]])


def normalized(
    image: UInt8[np.ndarray, "H W 3"] | Float32[np.ndarray, "H W 3"],
    scale: float,
    mean: Sequence[float],
    std: Sequence[float],
) -> Float32[np.ndarray, "H W 3"]:
    """(image / scale − mean) / std, channel by channel."""
    return (image.astype(np.float32) / np.float32(scale) - np.array(mean, np.float32)) / np.array(std, np.float32)
