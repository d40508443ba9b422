"""Boxes as the official scripts of ScanRefer, Scan2Cap and ScanQA write them."""

from gsencoder.data.truth.entries import Corner

_SIGNS = ((1, 1, 1), (1, 0, 1), (0, 0, 1), (0, 1, 1), (1, 1, 0), (1, 0, 0), (0, 0, 0), (0, 1, 0))


def box_corners(lower: Corner, upper: Corner) -> list[list[float]]:
    """The eight corners of an axis-aligned box: around the top, then around the bottom (utils/box_util.py)."""
    return [[(lower, upper)[side][axis] for axis, side in enumerate(sides)] for sides in _SIGNS]
