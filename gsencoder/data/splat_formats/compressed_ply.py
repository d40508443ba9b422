"""PlayCanvas' compressed .ply: chunks of 256 Gaussians with their bounds, 16 bytes a Gaussian, SH in bytes.

Reference: the PLAYCANVAS splat-transform and SuperSplat tools. Writing is gsply's; reading is here, because gsply's
kernels do not check what a damaged file makes them index, and hold opacities to a logit of ±10.
"""

from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float64, Int64

from gsencoder.core.errors import InputError
from gsencoder.core.process import threads_unchanged
from gsencoder.data.splat_formats.ply import PlyHeader, element_start
from gsencoder.data.splat_formats.raw import RawSplat, logits_from_opacities, quats_from_smallest_three
from gsencoder.types import sh_from_colors

_CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = tuple(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz")
_SCALE_BOUNDS = tuple(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz")
_COLOR_BOUNDS = tuple(f"{end}_{axis}" for end in ("min", "max") for axis in "rgb")


def is_compressed(header: PlyHeader) -> bool:
    """True for a .ply that packs its Gaussians."""
    vertex = header.element("vertex")
    return vertex is not None and vertex.dtype is not None and "packed_position" in (vertex.dtype.names or ())


def read_compressed(path: Path, stream: BinaryIO, header: PlyHeader, size: int) -> RawSplat:
    """Unpacks 11-10-11 bits of position and scale, 2-10-10-10 of rotation, 8-8-8-8 of color, 8 a SH coefficient."""
    chunk, vertex, rest = header.element("chunk"), header.element("vertex"), header.element("sh")
    if header.encoding == "ascii" or chunk is None or vertex is None:
        raise InputError(f"{path}: a packed .ply needs binary data with the elements 'chunk' and 'vertex'")
    starts = {part.name: element_start(path, header, part.name, size) for part in (chunk, vertex, rest) if part}
    assert chunk.dtype is not None
    assert vertex.dtype is not None
    chunk_names, count = chunk.dtype.names or (), vertex.count
    missing = [name for name in _BOUNDS + _SCALE_BOUNDS if name not in chunk_names]
    missing += [name for name in _PACKED if name not in (vertex.dtype.names or ())]
    if missing or any(vertex.dtype[name].kind != "u" or vertex.dtype[name].itemsize != 4 for name in _PACKED):
        raise InputError(f"{path}: the packed .ply lacks {', '.join(missing) or 'uint columns'} in its header")
    if chunk.count * _CHUNK < count:
        raise InputError(
            f"{path}: {chunk.count:,} chunks hold {chunk.count * _CHUNK:,} Gaussians at most, header claims {count:,}"
        )
    coefficients = 0
    if rest is not None:
        assert rest.dtype is not None
        names = rest.dtype.names or ()
        coefficients = len(names) // 3
        if (
            len(names) not in (9, 24, 45)
            or set(names) != {f"f_rest_{i}" for i in range(len(names))}
            or rest.count != count
        ):
            raise InputError(
                f"{path}: element 'sh' has {rest.count:,} rows of {len(names)}; expected {count:,} of 9, 24 or 45"
            )

    stream.seek(starts["chunk"])
    bounds = np.fromfile(stream, chunk.dtype, chunk.count)
    stream.seek(starts["vertex"])
    rows = np.fromfile(stream, vertex.dtype, count)
    if len(bounds) < chunk.count or len(rows) < count:
        raise InputError(f"{path}: ended while it was read")

    def between(names: tuple[str, ...], shares: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        low = np.stack([bounds[name] for name in names[:3]], axis=1).astype(np.float64)
        high = np.stack([bounds[name] for name in names[3:]], axis=1).astype(np.float64)
        which = np.arange(count) // _CHUNK
        return low[which] + shares * (high - low)[which]

    rotation = rows["packed_rotation"].astype(np.uint32)
    thirds = np.stack([rotation >> 20 & 1023, rotation >> 10 & 1023, rotation & 1023], axis=1)
    color = rows["packed_color"].astype(np.uint32)
    rgba = np.stack([color >> 24, color >> 16 & 255, color >> 8 & 255, color & 255], axis=1) / 255
    with np.errstate(over="ignore", invalid="ignore"):
        means = between(_BOUNDS, _shares(rows["packed_position"]))
        log_scales = between(_SCALE_BOUNDS, _shares(rows["packed_scale"])).astype(np.float32)
        # Files before the color bounds were introduced spread colors over 0 to 1.
        rgb = between(_COLOR_BOUNDS, rgba[:, :3]) if "min_r" in chunk_names else rgba[:, :3]
        sh = np.empty((count, coefficients + 1, 3), np.float32)
        sh[:, :1] = sh_from_colors(rgb)
    if rest is not None and rest.dtype is not None:
        stream.seek(starts["sh"])
        packed = np.fromfile(stream, rest.dtype, count)
        for axis in range(3):
            for k in range(coefficients):
                sh[:, k + 1, axis] = (packed[f"f_rest_{axis * coefficients + k}"] + np.float32(0.5)) / 32 - 4
    return RawSplat(
        means=means,
        quats=quats_from_smallest_three(rotation >> 30, (thirds / 1023 - 0.5) * np.sqrt(2)),
        log_scales=log_scales,
        logit_opacities=logits_from_opacities(rgba[:, 3]),
        sh=sh,
        format="PlayCanvas compressed .ply",
    )


def _shares(packed: np.ndarray) -> Float64[np.ndarray, "N 3"]:
    values = packed.astype(np.uint32)
    return np.stack([(values >> 21) / 2047, (values >> 11 & 1023) / 1023, (values & 2047) / 2047], axis=1)


def packed_bytes(raw: RawSplat) -> bytes:
    """The file, with rows in the order given; `morton_order` first makes chunks compact and values precise."""
    from gsply import compress_to_bytes

    rest = raw.sh[:, 1:] if raw.sh.shape[1] > 1 else None
    with threads_unchanged():
        data = compress_to_bytes(
            raw.means.astype(np.float32), raw.log_scales, raw.quats, raw.logit_opacities, raw.sh[:, 0], rest
        )
    return bytes(data)


def morton_order(means: Float64[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Rows along a Z-order curve of 2²¹ cells an axis over the bounding box."""
    low = means.min(axis=0)
    extent = max(float((means.max(axis=0) - low).max()), np.finfo(np.float64).tiny)
    cells = ((means - low) / extent * (2**21 - 1)).astype(np.uint64)
    # Each step doubles the gaps between bits, until two empty bits follow each.
    for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):  # fmt: skip
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    codes = cells[:, 0] | cells[:, 1] << np.uint64(1) | cells[:, 2] << np.uint64(2)
    return np.argsort(codes, kind="stable")
