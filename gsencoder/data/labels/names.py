"""Names in English: articles, plurals, numbers, synonyms and colors."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int64, UInt8

NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
PLURAL_ONLY = ("scissors", "dice", "pants", "glasses", "products", "utensils")
"""Last words of names that are plurals."""
VES = {"knife": "knives", "shelf": "shelves", "bookshelf": "bookshelves", "loaf": "loaves", "leaf": "leaves"}
SAME_THINGS = (
    ("cup", "mug", "pitcher"),
    ("cabinet", "cupboard", "wardrobe", "nightstand", "shelf", "dresser"),
    ("table", "coffee table", "dining table", "desk", "nightstand"),
    ("ball", "softball", "baseball", "tennis ball", "golf ball"),
    ("sofa", "couch"),
    ("chair", "stool", "bench"),
    ("carpet", "rug"),
    ("television", "monitor", "laptop"),
    ("picture frame", "painting", "poster"),
    ("trash can", "basket", "barrel"),
    ("box", "cracker", "pudding", "book"),
    ("cube", "dice", "lego", "box"),
    ("tin can", "can", "soup"),
    ("bottle", "condiment", "detergent", "cleaning products"),
    ("bowl", "plate"),
    ("candle", "vase", "bottle"),
)
"""Names that people use for the same thing, or for things that look alike: where one is there, neither the
number nor the absence of the other is clear."""


def is_plural(name: str) -> bool:
    """Whether a name is a plural, such as scissors."""
    return name.split()[-1] in PLURAL_ONLY


def with_article(name: str) -> str:
    """The name with "a" or "an"; plurals have none."""
    if is_plural(name):
        return name
    return (
        f"{'an' if name[0].lower() in 'aeiou' and not name.lower().startswith(('uni', 'use', 'one')) else 'a'} {name}"
    )


def plural(name: str) -> str:
    """The plural of a name that is a singular."""
    first, last = name.rpartition(" ")[0::2]
    if last in VES:
        last = VES[last]
    elif last.endswith("y") and last[-2:-1] not in "aeiou":
        last = last[:-1] + "ies"
    else:
        last += "es" if last.endswith(("s", "x", "z", "ch", "sh")) else "s"
    return f"{first} {last}".strip()


def alike(a: str, b: str) -> bool:
    """Whether two different names may be used for one thing: by `SAME_THINGS`, or as one has all words of the other."""
    if a == b:
        return False
    (words_a, groups_a), (words_b, groups_b) = _words_and_groups(a), _words_and_groups(b)
    return words_a <= words_b or words_b <= words_a or not groups_a.isdisjoint(groups_b)


@lru_cache(maxsize=4096)
def _words_and_groups(name: str) -> tuple[frozenset[str], frozenset[int]]:
    return frozenset(name.split()), frozenset(row for row, group in enumerate(SAME_THINGS) if name in group)


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
    """The color of a thing in a photograph, of `RANGES`, by the pixels of its mask; None where it is not clear.

    It is clear where, of the pixels that do not touch others than the thing's, at least 60 % have the color, and of no
    other color there are more than 15 %.
    """
    from scipy.ndimage import binary_erosion

    pixels = picture[binary_erosion(mask)]
    if not len(pixels):
        return None
    shares = color_counts(pixels) / len(pixels)
    order = np.argsort(-shares, kind="stable")
    clear = shares[order[0]] >= LEAST_SHARE and shares[order[1]] <= MOST_OTHER
    return RANGES[order[0]].word if clear else None


def color_counts(pixels: UInt8[np.ndarray, "n 3"]) -> Int64[np.ndarray, " C"]:
    """How many pixels lie in each of `RANGES`, which do not overlap."""
    from matplotlib.colors import rgb_to_hsv

    hue, saturation, value = rgb_to_hsv(pixels / 255).T
    hue = 360 * hue
    counts = []
    for each in RANGES:
        low, high = each.hue
        inside = ((hue >= low) & (hue < high)) | (hue + 360 < high)
        for channel, (least, most) in ((saturation, each.saturation), (value, each.value)):
            inside &= (channel >= least) & (channel < most)
        counts.append(int(inside.sum()))
    return np.array(counts, np.int64)
