"""Niantic's .spz: 8-bit attributes and 24-bit fixed-point positions, in gzip (versions 2, 3) or zstd streams (4).

Version 4 is not gzip: a 32-byte header in the clear, a table of compressed and unpacked sizes, one zstd frame an
attribute. Sections lie in the order positions, alphas, colors, scales, rotations, SH in all versions.

The format's convention is that y points up and z backwards. Numbers are read and written as they stand, as gsply and
open3d do; a tool that turns the axes on export has to be turned back by the caller.

Reference: nianticlabs/spz.
"""

import io
import struct
import warnings
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.data.splat_formats.raw import (
    SH_COEFFICIENTS,
    RawSplat,
    check_expansion,
    logits_from_opacities,
    opacities_from_logits,
    quats_from_smallest_three,
)

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
_COLOR_SCALE = 0.15
_QUAT_STEP = np.sqrt(0.5) / 511
_ZSTD_LEVEL = 9
_ANTIALIASED, _EXTENSIONS = 1, 2


def read_spz(path: Path, stream: BinaryIO, size: int) -> RawSplat:
    """Reads versions 2, 3 and 4. A claimed count is checked against the file's size before anything is unpacked."""
    data = stream.read()
    if data.startswith(GZIP_MAGIC):
        return _read_gzip(path, data)
    if len(data) < 32:
        raise InputError(f"{path}: {size} bytes, but the header of an .spz has 32; the file is truncated")
    version, count, degree, bits, flags, streams, table = struct.unpack_from("<IIBBBBI", data, 4)
    if version != 4:
        raise InputError(f"{path}: .spz version {version} without gzip; expected version 4 (or 2, 3 in gzip)")
    sizes = _section_sizes(path, count, degree, bits, rotation_bytes=4)
    if flags & _EXTENSIONS:
        _warn_extensions(path, table - 32)
    check_expansion(path, sum(sizes), size)
    sizes = [section for section in sizes if section]
    offset = table + 16 * len(sizes)
    if streams != len(sizes) or table < 32 or offset > size:
        raise InputError(
            f"{path}: expected {len(sizes)} streams listed within the file, got {streams} at byte {table:,}"
        )
    # As in sog.py: imported where it is used.
    import imagecodecs

    parts = []
    for number, expected_size in enumerate(sizes):
        packed, unpacked = struct.unpack_from("<QQ", data, table + 16 * number)
        if unpacked != expected_size or offset + packed > size:
            raise InputError(
                f"{path}: stream {number} claims {packed:,} bytes that unpack to {unpacked:,}; {count:,} rows need "
                f"{expected_size:,}, and the file has {size - offset:,} left; it is truncated or damaged"
            )
        try:
            part = imagecodecs.zstd_decode(data[offset : offset + packed], out=expected_size)
        except imagecodecs.ZstdError as error:
            raise InputError(f"{path}: stream {number} cannot be unpacked: {error}") from error
        if len(part) != expected_size:
            raise InputError(f"{path}: stream {number} unpacks to {len(part):,} bytes, expected {expected_size:,}")
        parts.append(part)
        offset += packed
    return _decode(b"".join(parts), count, degree, bits, version, flags)


def _read_gzip(path: Path, data: bytes) -> RawSplat:
    unpack = zlib.decompressobj(wbits=31)
    try:
        head = unpack.decompress(data, 16)
        if len(head) < 16 or head[:4] != MAGIC:
            raise InputError(f"{path}: gzip data that does not start with 'NGSP'; expected an .spz file")
        version, count, degree, bits, flags, _ = struct.unpack_from("<IIBBBB", head, 4)
        if version not in (2, 3):
            raise InputError(f"{path}: .spz version {version} in gzip; expected 2 or 3 (version 1 was never released)")
        sizes = _section_sizes(path, count, degree, bits, rotation_bytes=4 if version == 3 else 3)
        check_expansion(path, sum(sizes), len(data))
        body = unpack.decompress(unpack.unconsumed_tail, sum(sizes))
        tail = unpack.decompress(unpack.unconsumed_tail, 1)
    except zlib.error as error:
        raise InputError(f"{path}: the gzip data is damaged: {error}") from error
    if len(body) < sum(sizes) or not (unpack.eof or tail):
        raise InputError(
            f"{path}: {count:,} Gaussians need {sum(sizes):,} bytes, the file unpacks to {len(body):,} and ends early; "
            "it is truncated"
        )
    if flags & _EXTENSIONS:
        _warn_extensions(path, None)
    return _decode(body, count, degree, bits, version, flags)


def _warn_extensions(path: Path, size: int | None) -> None:
    amount = "extensions" if size is None else f"{size:,} bytes of extensions"
    warnings.warn(f"{path}: {amount} of other vendors were left out", SceneWarning, stacklevel=2)


def _section_sizes(path: Path, count: int, degree: int, bits: int, *, rotation_bytes: int) -> list[int]:
    if degree > 4 or not 1 <= bits <= 24:
        raise InputError(f"{path}: SH degree {degree} and {bits} fractional bits; expected 0 to 4 and 1 to 24")
    if degree == 4:
        warnings.warn(f"{path}: SH degree 4 was cut to degree 3", SceneWarning, stacklevel=2)
    return [9 * count, count, 3 * count, 3 * count, rotation_bytes * count, 3 * ((degree + 1) ** 2 - 1) * count]


def _decode(data: bytes, count: int, degree: int, bits: int, version: int, flags: int) -> RawSplat:
    """Sections to values. Opacity is the byte over 255, log-scale byte/16 − 10, SH (byte − 128)/128."""
    coefficients = (degree + 1) ** 2 - 1
    kept_coefficients = min(coefficients + 1, SH_COEFFICIENTS[-1])
    flat = np.frombuffer(data, np.uint8)
    offset = 0

    def take(columns: int) -> UInt8[np.ndarray, "N columns"]:
        nonlocal offset
        part = flat[offset : offset + columns * count].reshape(count, columns)
        offset += columns * count
        return part

    fixed = take(9).reshape(count, 3, 3).astype(np.int32)
    fixed = fixed[..., 0] | fixed[..., 1] << 8 | fixed[..., 2] << 16
    fixed -= (fixed >> 23) << 24
    alphas, colors, scales = take(1), take(3), take(3)
    rotations = take(4 if version >= 3 else 3)
    sh = np.empty((count, kept_coefficients, 3), np.float32)
    sh[:, 0] = (colors / np.float32(255) - np.float32(0.5)) / np.float32(_COLOR_SCALE)
    if coefficients:
        rest = take(3 * coefficients).reshape(count, coefficients, 3)
        sh[:, 1:] = rest[:, : kept_coefficients - 1]
        sh[:, 1:] -= 128
        sh[:, 1:] /= 128
    if version >= 3:
        packed = rotations.copy().view("<u4")[:, 0]
        three = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
        values = (three & 511) * np.where(three >> 9, -_QUAT_STEP, _QUAT_STEP)
        xyzw = quats_from_smallest_three(packed >> 30, values)
    else:
        xyzw = quats_from_smallest_three(np.full(count, 3), rotations / 127.5 - 1)
    return RawSplat(
        means=fixed * 2.0**-bits,
        quats=np.roll(xyzw, 1, axis=1),
        log_scales=scales / np.float32(16) - np.float32(10),
        logit_opacities=logits_from_opacities(alphas[:, 0] / 255),
        sh=sh,
        format=f".spz version {version}",
        unused=("flag antialiased",) if flags & _ANTIALIASED else (),
    )


def write_spz(path: Path, stream: BinaryIO | io.BytesIO, raw: RawSplat, *, version: int) -> None:
    """Writes version 3 (gzip) or 4 (zstd).

    Precision: positions ±2⁻ᵇ/2 with b = 12 fractional bits, more where all coordinates are small (a step is at most
    2⁻¹⁶ of the largest), fewer, with a warning, where they exceed 2047; log-scales ±1/32 in [−10, 5.94]; opacities
    ±1/510; quaternion components ±7e-4 (the left-out one 2e-3); f_dc ±0.0131 in ±3.33; other SH ±1/256 in [−1, 0.992].
    """
    largest = float(np.abs(raw.means).max(initial=0))
    # A step is at most 2⁻¹⁶ of the largest coordinate (aim), and that coordinate fits 24 signed bits (limit).
    aim = 17 - np.ceil(np.log2(largest)) if largest > 0 else 12
    limit = np.floor(np.log2((2**23 - 1) / largest)) if largest > 0 else 12
    bits = int(min(max(12, min(aim, 24)), limit))
    if bits < 1:
        raise InputError(f"{path}: a coordinate of {largest:g} is beyond what .spz can hold (4e6); save as .ply")
    if bits < 12:
        step = 2.0**-bits
        warnings.warn(
            f"{path}: coordinates up to {largest:g} leave steps of {step:g} in .spz", SceneWarning, stacklevel=3
        )
    fixed = np.rint(raw.means * 2.0**bits).astype(np.int32)
    positions = np.stack([fixed, fixed >> 8, fixed >> 16], axis=-1).astype(np.uint8)
    clipped = 0

    def bytes_of(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
        nonlocal clipped
        clipped += int(((values < -0.51) | (values > 255.51)).sum())
        return np.rint(values).clip(0, 255).astype(np.uint8)

    sections = [
        positions,
        bytes_of(opacities_from_logits(raw.logit_opacities) * 255.0),
        bytes_of(raw.sh[:, 0] * (_COLOR_SCALE * 255) + 127.5),
        bytes_of((raw.log_scales + 10.0) * 16),
        _pack_quats(raw.quats.astype(np.float64)),
        bytes_of(raw.sh[:, 1:] * np.float32(128) + np.float32(128)),
    ]
    if clipped:
        warnings.warn(f"{path}: {clipped:,} values were clipped to the range of .spz", SceneWarning, stacklevel=3)
    parts = [section.tobytes() for section in sections if section.size]
    if version == 3:
        header = struct.pack("<4sIIBBBB", MAGIC, 3, len(raw), raw.sh_degree, bits, 0, 0)
        pack = zlib.compressobj(6, zlib.DEFLATED, 31)
        for part in [header, *parts]:
            stream.write(pack.compress(part))
        stream.write(pack.flush())
        return
    import imagecodecs

    frames = [imagecodecs.zstd_encode(part, level=_ZSTD_LEVEL) for part in parts]
    stream.write(struct.pack("<4sIIBBBBI12x", MAGIC, 4, len(raw), raw.sh_degree, bits, 0, len(parts), 32))
    stream.write(b"".join(struct.pack("<QQ", len(f), len(p)) for f, p in zip(frames, parts, strict=True)))
    stream.write(b"".join(frames))


def _pack_quats(quats: Float64[np.ndarray, "N 4"]) -> UInt8[np.ndarray, "N 4"]:
    """Two bits for the largest of xyzw, then sign and nine bits of magnitude for each of the others, in order."""
    xyzw = np.roll(quats, -1, axis=1)
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(axis=1)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], axis=1) < 0, -1, 1)
    magnitude = np.rint(np.abs(xyzw) / _QUAT_STEP).clip(0, 511).astype(np.uint32)
    codes = magnitude | (xyzw < 0).astype(np.uint32) << 9
    packed = largest.astype(np.uint32)
    for axis in range(4):
        packed = np.where(largest == axis, packed, packed << 10 | codes[:, axis])
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)
