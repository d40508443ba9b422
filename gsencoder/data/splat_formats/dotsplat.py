"""The 32-byte rows of .splat files (antimatter15/splat): 3 float positions, 3 float scales, RGBA bytes, wxyz bytes."""

from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsencoder.core.errors import InputError
from gsencoder.data.splat_formats.raw import RawSplat, logits_from_opacities, logs_from_scales
from gsencoder.types import sh_from_colors

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def read_dotsplat(path: Path, stream: BinaryIO, size: int) -> RawSplat:
    """Colors are SH degree 0; scales are stored as standard deviations; quaternion bytes are 128 + 128·q."""
    if size % _ROW.itemsize:
        raise InputError(
            f"{path}: {size:,} bytes is not a whole number of {_ROW.itemsize}-byte rows; the .splat is truncated"
        )
    rows = np.fromfile(stream, _ROW)
    rgba = rows["rgba"].astype(np.float64) / 255
    return RawSplat(
        means=rows["means"].astype(np.float64),
        quats=((rows["quats"].astype(np.float32) - 128) / 128),
        log_scales=logs_from_scales(rows["scales"]),
        logit_opacities=logits_from_opacities(rgba[:, 3]),
        sh=sh_from_colors(rgba[:, :3]).astype(np.float32),
        format=".splat",
    )
