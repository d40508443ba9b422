"""The `palette` teacher: photographs as shares of eleven color names. Works offline on anything that has a picture."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32, UInt8

from gsencoder.core.errors import InputError
from gsencoder.fusion.teachers import MissingInput
from gsencoder.types import FeatureMap, FeatureSpace, Views

# The eleven basic color terms of English (Berlin & Kay 1969) and typical sRGB values, several where a name is wide.
_PROTOTYPES: dict[str, tuple[tuple[int, int, int], ...]] = {
    "black": ((12, 12, 12), (35, 35, 38)),
    "grey": ((80, 80, 80), (128, 128, 128), (170, 170, 172)),
    "white": ((230, 230, 230), (255, 255, 255)),
    "red": ((200, 20, 30), (150, 15, 25), (230, 60, 60)),
    "orange": ((245, 130, 30), (220, 100, 20)),
    "yellow": ((245, 220, 40), (220, 190, 30), (250, 240, 120)),
    "green": ((40, 160, 60), (20, 90, 40), (140, 200, 90)),
    "blue": ((30, 80, 200), (20, 40, 110), (110, 170, 230)),
    "purple": ((120, 50, 160), (80, 30, 100), (170, 120, 210)),
    "pink": ((250, 150, 180), (230, 90, 150)),
    "brown": ((120, 75, 40), (85, 50, 30), (160, 110, 70)),
}

COLOR_NAMES = tuple(_PROTOTYPES)


@dataclass(frozen=True, slots=True, kw_only=True)
class PaletteConfig:
    """Settings of the palette teacher."""

    name: Literal["palette"] = "palette"
    cell: int = field(default=2, metadata={"help": "pixels along the side of a cell, averaged before naming"})
    softness: float = field(default=12.0, metadata={"help": "L*a*b* distance over which one name gives way to another"})

    def __post_init__(self) -> None:
        if self.cell < 1:
            raise InputError(f"cell: expected at least 1 pixel, got {self.cell}")
        if not 1e-3 <= self.softness <= 1e6:
            raise InputError(f"softness: expected a distance from 0.001 to 1e6, got {self.softness}")


def lab_from_rgb(rgb: UInt8[np.ndarray, "*n 3"]) -> Float32[np.ndarray, "*n 3"]:
    """CIE L*a*b* (D65) of 8-bit sRGB; distances in it roughly match what people see (L* from 0 to 100)."""
    c = np.arange(256, dtype=np.float64) / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)[rgb]
    to_xyz = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]]
    )
    xyz = linear @ to_xyz.T / to_xyz.sum(axis=1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    lab = np.stack((116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])), axis=-1)
    return lab.astype(np.float32)


class PaletteTeacher:
    """Soft assignment of each cell's mean color to color names, softmax(−distance² / 2·softness²) in L*a*b*.

    Its text side is one channel a word, so `query=red` is the first unit vector that a reader would expect.
    """

    table = None
    mean = None
    needs_images = True
    cheap = True

    def __init__(self, config: PaletteConfig = PaletteConfig()) -> None:
        """Prepares the prototypes of each name."""
        self.cell, self.softness = cell, softness = config.cell, config.softness
        self.space = FeatureSpace(
            name="palette-11",
            channels=len(COLOR_NAMES),
            teacher="palette",
            preprocessing=f"mean of {cell}×{cell} pixels, softness {softness:g} in L*a*b*",
            text_encoder="palette-11",
        )
        lab = [lab_from_rgb(np.array(colors, np.uint8)) for colors in _PROTOTYPES.values()]
        self._centers = np.concatenate(lab)
        self._owner = np.repeat(np.arange(len(lab)), [len(part) for part in lab])

    def feature_map(self, views: Views, view: int) -> FeatureMap:
        """Color-name shares on a grid of cells; pixels over the last whole cell are left out.

        Raises:
            MissingInput: the scene has no pictures.
            InputError: one of them is smaller than a cell.
        """
        if views.images is None:
            raise MissingInput("teacher palette: the scene has no pictures")
        image, cell = views.images[view], self.cell
        h, w = image.shape[0] // cell, image.shape[1] // cell
        if h == 0 or w == 0:
            raise InputError(f"teacher palette: view {views.names[view]} is smaller than a cell of {cell} pixels")
        blocks = image[: h * cell, : w * cell].reshape(h, cell, w, cell, 3)
        mean = blocks.mean(axis=(1, 3), dtype=np.float32).round().astype(np.uint8)
        return FeatureMap(
            features=self.name_shares(mean.reshape(-1, 3)).reshape(h, w, -1),
            grid_from_image=np.array([[1 / cell, 0, 0], [0, 1 / cell, 0]]),
            space=self.space,
        )

    def name_shares(self, rgb: UInt8[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 11"]:
        """Share of each color name, summing to 1."""
        # Channel by channel: an array of pixels × prototypes × channels would not fit into the cache.
        lightness, a, b = np.ascontiguousarray(lab_from_rgb(rgb).T)
        nearest = np.full((len(COLOR_NAMES), len(rgb)), np.inf, np.float32)
        for center, owner in zip(self._centers, self._owner, strict=True):
            distance = (lightness - center[0]) ** 2 + (a - center[1]) ** 2 + (b - center[2]) ** 2
            np.minimum(nearest[owner], distance, out=nearest[owner])
        score = -np.ascontiguousarray(nearest.T) / (2 * self.softness**2)
        score = np.exp(score - score.max(axis=1, keepdims=True))
        return (score / score.sum(axis=1, keepdims=True)).astype(np.float32)

    def settings(self) -> dict[str, Any]:
        return {"name": "palette", "cell": self.cell, "softness": self.softness}
