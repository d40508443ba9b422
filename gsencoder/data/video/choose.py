"""Which frames of a video to take: sharp ones, between which the picture moves evenly."""

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64, UInt8

from gsencoder.core.errors import InputError

SIZE = 640
"""Longer side in pixels of the pictures whose sharpness is measured; motion is measured at half of it."""
BLOCK = 64
"""Side in pixels of the blocks whose motion is measured."""
CONTRAST = 3.0
"""Blocks whose gray levels, of 255, have a smaller standard deviation show nothing that could be seen moving."""
CLEAR = 0.1
"""Height of the peak of a phase correlation, of 1, from which on it is no noise."""
MOVED = 8.0
"""Motion in pixels after which a picture is compared with a newer one."""
EDGE = 0.5
"""What the sharpness of a frame counts midway between two positions, where that of a frame at one counts 1."""


class Course(NamedTuple):
    """What happens in a video.

    Attributes:
        positions: how far the picture has moved since the first frame, in widths of the picture; never falls.
        sharpness: variance of the Laplacian of each frame, comparable between frames that show the same.
    """

    positions: Float[np.ndarray, " F"]
    sharpness: Float[np.ndarray, " F"]


def follow(pictures: Iterable[UInt8[np.ndarray, "H W"]]) -> Course:
    """Measures motion and sharpness of all frames.

    Each frame is compared with the newest one from which the picture had moved by some pixels, so that slow motion
    counts in full, and trembling about one place does not.

    Args:
        pictures: brightness of each frame, at a longer side of about `SIZE` pixels.
    """
    positions: list[float] = []
    sharpness: list[float] = []
    reference: Float[np.ndarray, "h w"] | None = None
    base = 0.0
    for picture in pictures:
        full = picture.astype(np.float32)
        sharpness.append(laplacian_variance(full))
        half = _halved(full)
        # A picture of another size cannot be compared; few videos change theirs.
        if reference is None or reference.shape != half.shape:
            reference = half
            positions.append(positions[-1] if positions else 0.0)
            base = positions[-1]
            continue
        motion = median_motion(reference, half)
        positions.append(max(positions[-1], base + motion / half.shape[1]))
        if motion >= MOVED:
            reference, base = half, positions[-1]
    return Course(np.array(positions, np.float64), np.array(sharpness, np.float64))


def laplacian_variance(picture: Float[np.ndarray, "H W"]) -> float:
    """The usual measure of sharpness: variance of the sum of second differences."""
    middle = picture[1:-1, 1:-1]
    return float((picture[:-2, 1:-1] + picture[2:, 1:-1] + picture[1:-1, :-2] + picture[1:-1, 2:] - 4 * middle).var())


def median_motion(before: Float[np.ndarray, "H W"], after: Float[np.ndarray, "H W"]) -> float:
    """Median length in pixels of the motion of blocks, by phase correlation.

    Blocks without contrast count nowhere; where a picture has no others it stands still. A block with contrast whose
    motion is not clear has moved too far, or became blurred: it counts as half a block, the most that can be measured.
    """
    pairs = np.stack((_blocks(before), _blocks(after)))
    textured = pairs.std(axis=(2, 3)).min(axis=0) >= CONTRAST
    if not textured.any():
        return 0.0
    window = np.hanning(pairs.shape[2])[:, None] * np.hanning(pairs.shape[3])
    pairs = pairs[:, textured]
    spectra = np.fft.rfft2((pairs - pairs.mean(axis=(2, 3), keepdims=True)) * window)
    cross = spectra[1] * spectra[0].conj()
    surface = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-6), s=pairs.shape[2:])
    flat = surface.reshape(len(surface), -1)
    peaks = flat.argmax(axis=1)
    shifts = np.stack(np.unravel_index(peaks, surface.shape[1:]), axis=1).astype(np.float64)
    sides = np.array(surface.shape[1:])
    shifts -= sides * (shifts > sides / 2)
    lengths = np.linalg.norm(shifts, axis=1)
    lengths[flat[np.arange(len(flat)), peaks] < CLEAR] = BLOCK / 2
    return float(np.median(lengths))


def choose_frames(course: Course, *, motion: float, most: int, least: int) -> Int64[np.ndarray, " n"]:
    """Indices of the frames to take, rising: of those nearest to each of evenly spaced positions a sharp one.

    Args:
        course: of the video.
        motion: wanted distance between two frames in widths of the picture.
        most: so many frames at most; they stand farther apart where that is too few.
        least: so many at least, closer together where the picture moves little.

    Raises:
        InputError: the picture hardly moves.
    """
    total = float(course.positions[-1])
    if total < motion:
        raise InputError(
            f"the picture moves by {total:.0%} of its width in {len(course.positions)} frames; a reconstruction needs "
            "a camera that moves through the scene"
        )
    count = min(max(round(total / motion) + 1, least), most, len(course.positions))
    # Nearest positions of all frames; those of one are a slice, because positions never fall.
    step = total / max(1, count - 1)
    nearest = np.floor(course.positions / step + 0.5).astype(np.int64).clip(0, count - 1)
    away = np.abs(course.positions / step - nearest)
    worth = course.sharpness * (1 - (1 - EDGE) * (2 * away) ** 2)
    bounds = np.searchsorted(nearest, np.arange(count + 1))
    slices = [(first, end) for first, end in pairwise(bounds) if first < end]
    return np.array([first + worth[first:end].argmax() for first, end in slices], np.int64)


def _blocks(picture: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "B h w"]:
    """Blocks side by side over the whole picture; a picture that is smaller than a block is one."""
    height, width = (min(BLOCK, side) for side in picture.shape)
    rows, columns = (side // block for side, block in zip(picture.shape, (height, width), strict=True))
    cut = picture[: rows * height, : columns * width].reshape(rows, height, columns, width)
    return cut.swapaxes(1, 2).reshape(-1, height, width)


def _halved(picture: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "h w"]:
    height, width = (side // 2 * 2 for side in picture.shape)
    halves: np.ndarray = picture[:height, :width].reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
    return halves
