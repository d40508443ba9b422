"""The color word of a thing, from its pixels in photographs, where nearly all of them agree on one."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8


class ColorRange(NamedTuple):
    """Pixels that people call by one word: bounds of hue (degrees), saturation and value, the lower ones included."""

    word: str
    hue: tuple[float, float]
    saturation: tuple[float, float]
    value: tuple[float, float]


RANGES = (
    ColorRange("black", (0, 360), (0, 1.01), (0, 0.17)),
    ColorRange("white", (0, 360), (0, 0.12), (0.8, 1.01)),
    ColorRange("red", (350, 370), (0.65, 1.01), (0.35, 1.01)),
    ColorRange("brown", (12, 38), (0.35, 0.75), (0.2, 0.52)),
    ColorRange("orange", (14, 36), (0.75, 1.01), (0.6, 1.01)),
    ColorRange("yellow", (43, 68), (0.45, 1.01), (0.5, 1.01)),
    ColorRange("green", (85, 165), (0.3, 1.01), (0.2, 1.01)),
    ColorRange("blue", (200, 250), (0.35, 1.01), (0.2, 1.01)),
    ColorRange("purple", (264, 295), (0.3, 1.01), (0.2, 1.01)),
    ColorRange("pink", (310, 350), (0.2, 0.6), (0.65, 1.01)),
)
"""The ranges of different words are apart: what lies between them is called differently by different people. Gray is
no word here, since white in the shade has the same pixels."""
LEAST_SHARE = 0.6
"""A thing has a color if it has this share of its pixels …"""
MOST_OTHER = 0.15
"""… and no other color has more than this share."""


def color_word(picture: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"]) -> str | None:
    """The color of a thing in a photograph, of `RANGES`; None where it is not clear.

    It is clear where, of the pixels that do not touch others than the thing's, at least 60 % have the color, and of no
    other color there are more than 15 %.

    Args:
        picture: sRGB.
        mask: the pixels of the thing.
    """
    pixels = picture[inner_pixels(mask)]
    if not len(pixels):
        return None
    shares = color_counts(pixels) / len(pixels)
    order = np.argsort(-shares, kind="stable")
    clear = shares[order[0]] >= LEAST_SHARE and shares[order[1]] <= MOST_OTHER
    return RANGES[order[0]].word if clear else None


def color_counts(pixels: UInt8[np.ndarray, "n 3"]) -> Int64[np.ndarray, " C"]:
    """How many pixels lie in each of `RANGES`, which do not overlap."""
    hue, saturation, value = hsv(pixels)
    counts = []
    for each in RANGES:
        low, high = each.hue
        inside = ((hue >= low) & (hue < high)) | (hue + 360 < high)
        for channel, (least, most) in ((saturation, each.saturation), (value, each.value)):
            inside &= (channel >= least) & (channel < most)
        counts.append(int(inside.sum()))
    return np.array(counts, np.int64)


def hsv(
    pixels: UInt8[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Hue in degrees from 0 to below 360 (0 for grays), saturation and value in [0, 1]."""
    rgb = pixels.astype(np.float64) / 255
    value, least = rgb.max(axis=1), rgb.min(axis=1)
    chroma = value - least
    safe = np.where(chroma > 0, chroma, 1)
    r, g, b = rgb.T
    hue = np.select([value == r, value == g], [(g - b) / safe % 6, (b - r) / safe + 2], (r - g) / safe + 4)
    return np.where(chroma > 0, 60 * hue, 0.0), chroma / np.where(value > 0, value, 1), value


def inner_pixels(mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The pixels of a mask whose four neighbors are in it: at its border, colors of two things are mixed."""
    padded = np.pad(mask, 1)
    return np.asarray(
        mask & padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:],
    )
