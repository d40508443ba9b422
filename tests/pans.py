"""A textured wall before which a camera moves to the side: what tests of videos stand on."""

import numpy as np
from scipy.ndimage import gaussian_filter, shift

HEIGHT, WIDTH = 256, 384


def wallpaper(seed: int = 0) -> np.ndarray:
    """Brightness of a large surface with detail of several sizes."""
    made = np.random.default_rng(seed)
    noise = sum(gaussian_filter(made.normal(size=(600, 1600)), sigma) * sigma for sigma in (1.0, 3.0, 8.0))
    return 128 + 40 * noise / np.abs(noise).std()


WALL = wallpaper().astype(np.float32)


def looking_at(left: float, top: float = 100.0) -> np.ndarray:
    whole = int(left)
    part = shift(WALL[:, whole : whole + WIDTH + 8], (0, -(left - whole)), order=1, mode="nearest")
    return part[int(top) : int(top) + HEIGHT, :WIDTH].clip(0, 255).astype(np.uint8)


def blurred(picture: np.ndarray, pixels: float) -> np.ndarray:
    return gaussian_filter(picture.astype(np.float32), (0, pixels)).astype(np.uint8)
