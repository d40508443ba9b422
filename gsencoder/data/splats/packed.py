"""Packed splats: Niantic's .spz and PlayCanvas' .sog.

.spz has 8-bit attributes and 24-bit fixed-point positions, in gzip (versions 2, 3) or zstd streams (4): a 32-byte
header in the clear, a table of compressed and unpacked sizes, one zstd frame an attribute. Sections lie in the order
positions, alphas, colors, scales, rotations, SH. By convention y points up and z backwards; numbers are read and
written as they stand, as gsply and open3d do. Reference: nianticlabs/spz.

SOG version 2 is a meta.json with WebP images, in a folder or in a .sog zip; read only. gsply reads it too, but unpacks
zips and images of any size and indexes codebooks without a check. Reference:
https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.
"""

import io
import json
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import read_foreign
from gsencoder.data.splats.ply import (
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
    check_expansion(path, sum(sizes), size)
    sizes = [section for section in sizes if section]
    offset = table + 16 * len(sizes)
    if streams != len(sizes) or table < 32 or offset > size:
        raise InputError(f"{path}: expected {len(sizes)} streams within the file, got {streams} at byte {table:,}")
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
    return _decode(path, b"".join(parts), count, degree, bits, version, flags)


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
            f"{path}: {count:,} Gaussians need {sum(sizes):,} bytes, it unpacks to {len(body):,}: truncated"
        )
    return _decode(path, body, count, degree, bits, version, flags)


def _section_sizes(path: Path, count: int, degree: int, bits: int, *, rotation_bytes: int) -> list[int]:
    if degree > 4 or not 1 <= bits <= 24:
        raise InputError(f"{path}: SH degree {degree} and {bits} fractional bits; expected 0 to 4 and 1 to 24")
    if degree == 4:
        warnings.warn(f"{path}: SH degree 4 was cut to degree 3", SceneWarning, stacklevel=2)
    return [9 * count, count, 3 * count, 3 * count, rotation_bytes * count, 3 * ((degree + 1) ** 2 - 1) * count]


def _decode(path: Path, data: bytes, count: int, degree: int, bits: int, version: int, flags: int) -> RawSplat:
    """Sections to values. Opacity is the byte over 255, log-scale byte/16 − 10, SH (byte − 128)/128."""
    if flags & _EXTENSIONS:
        warnings.warn(f"{path}: extensions of other vendors were left out", SceneWarning, stacklevel=2)
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


MAX_META = 4 << 20
_PALETTE_COLUMNS = 64
_KEYS = ("version", "asset", "count", "means", "scales", "quats", "sh0", "shN")
_QUAT_TAG = 252

Load = Callable[[str, int], bytes]  # A file of the set by its name; longer than the limit is an error


def read_sog_folder(path: Path) -> RawSplat:
    """Reads a folder with meta.json; every file it names must lie in that folder."""

    def load(name: str, limit: int) -> bytes:
        file = path / name
        if not file.is_file() or not file.resolve().is_relative_to(path.resolve()):
            raise InputError(f"{path}: the file {name!r} is missing, or leads out of the folder")
        try:
            return read_foreign(file, limit)
        except OSError as error:
            raise InputError(f"{file}: cannot be read: {error.strerror}") from error

    size = sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    return _read(path, load, size)


def read_sog_zip(path: Path, size: int) -> RawSplat:
    """Reads a .sog bundle without unpacking it to disk; members are bounded before they are inflated."""
    try:
        with zipfile.ZipFile(path) as bundle:
            members = {member.filename: member for member in bundle.infolist()}

            def load(name: str, limit: int) -> bytes:
                member = members.get(name)
                if member is None or member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise InputError(f"{path}: the bundle has no member {name!r} that can be unpacked")
                with bundle.open(member) as stream:
                    data = stream.read(limit + 1)
                if len(data) > limit:
                    raise InputError(f"{path}: member {name!r} unpacks to more than the {limit:,} bytes allowed")
                return data

            return _read(path, load, size)
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, struct.error) as error:
        raise InputError(f"{path}: the .sog bundle is damaged: {str(error)[:120]}") from error


def _read(path: Path, load: Load, size: int) -> RawSplat:
    text = load("meta.json", MAX_META)
    try:
        meta = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: meta.json is not JSON: {str(error)[:120]}") from error
    if not isinstance(meta, dict) or meta.get("version") != 2:
        version = meta.get("version", 1) if isinstance(meta, dict) else "none"
        raise InputError(f"{path}: meta.json has version {str(version)[:20]}; expected SOG version 2")
    count = meta.get("count")
    if not isinstance(count, int) or isinstance(count, bool) or count < 0:
        raise InputError(f"{path}: meta.json has count {str(count)[:20]!r}; expected a number of Gaussians")
    # Six images of four bytes each for every Gaussian.
    check_expansion(path, 24 * count, size)

    def texels(section: str, index: int, width: int | None = None, rows: int = 0) -> UInt8[np.ndarray, "n 4"]:
        files = _field(path, meta, section, "files")
        name = files[index] if isinstance(files, list) and index < len(files) else None
        if not isinstance(name, str) or not name or Path(name).name != name or "\\" in name or ":" in name:
            raise InputError(f"{path}: meta.json names {str(name)[:60]!r} for {section}; expected a file name")
        count_wanted = rows or count
        # Pixels beyond the count are padding to whole rows; a lossless WebP is no larger than its pixels.
        allowed = 2 * count_wanted + (1 << 16)
        image = _decode_webp(path, name, load(name, 5 * allowed), allowed)
        if image.shape[0] * image.shape[1] < count_wanted or (width is not None and image.shape[1] != width):
            raise InputError(
                f"{path}: {name} has {image.shape[1]}×{image.shape[0]} pixels, too few for {count_wanted:,}"
            )
        return image.reshape(-1, 4)[:count_wanted]

    low, high = _numbers(path, meta, "means", "mins", 3), _numbers(path, meta, "means", "maxs", 3)
    fixed = texels("means", 0)[:, :3] + (texels("means", 1)[:, :3].astype(np.float64) * 256)
    with np.errstate(over="ignore", invalid="ignore"):
        logs = low + (high - low) * (fixed / 65535)
        means = np.sign(logs) * np.expm1(np.abs(logs))
    quats = texels("quats", 0)
    tags = quats[:, 3].astype(np.int64) - _QUAT_TAG
    rotations = quats_from_smallest_three(np.maximum(tags, 0), (quats[:, :3] / 255 * 2 - 1) * np.sqrt(0.5))
    rotations[tags < 0] = 0  # No rotation is stored: a defect to report, not to hide.
    scales = _look_up(path, meta, "scales", texels("scales", 0)[:, :3])
    colors = texels("sh0", 0)
    sh = _look_up(path, meta, "sh0", colors[:, :3])[:, None]
    if meta.get("shN") is not None:
        sh = np.concatenate([sh, _harmonics(path, meta, texels)], axis=1)
    return RawSplat(
        means=means,
        quats=rotations,
        log_scales=scales,
        logit_opacities=logits_from_opacities(colors[:, 3] / 255),
        sh=sh,
        format="SOG version 2",
        unused=tuple(f"key {str(key)[:40]}" for key in meta if key not in _KEYS),
    )


def _harmonics(path: Path, meta: dict[str, Any], texels: Callable[..., np.ndarray]) -> Float32[np.ndarray, "N k 3"]:
    bands, entries = _field(path, meta, "shN", "bands"), _field(path, meta, "shN", "count")
    if type(bands) is not int or type(entries) is not int or not 1 <= bands <= 3 or not 1 <= entries <= 1 << 16:
        raise InputError(f"{path}: shN.bands {str(bands)[:9]}, shN.count {str(entries)[:9]}; expected 1–3, 1–65536")
    k = (bands + 1) ** 2 - 1
    labels = texels("shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
    beyond = int((labels >= entries).sum())
    if beyond:
        raise InputError(
            f"{path}: {beyond:,} Gaussians point beyond the {entries:,} entries of the SH palette; damaged"
        )
    rows = -(-entries // _PALETTE_COLUMNS) * _PALETTE_COLUMNS * k
    palette = _look_up(path, meta, "shN", texels("shN", 0, _PALETTE_COLUMNS * k, rows)[:, :3])
    return palette.reshape(-1, k, 3)[labels]


def _field(path: Path, meta: dict[str, Any], section: str, name: str) -> Any:
    part = meta.get(section)
    if not isinstance(part, dict) or name not in part:
        raise InputError(f"{path}: meta.json lacks {section}.{name}")
    return part[name]


def _numbers(path: Path, meta: dict[str, Any], section: str, name: str, length: int) -> np.ndarray:
    values = _field(path, meta, section, name)
    if not isinstance(values, list) or len(values) > 256 or (length and len(values) != length):
        raise InputError(f"{path}: meta.json: expected {length or 'up to 256'} numbers as {section}.{name}")
    if not all(value is None or type(value) in (int, float) for value in values):
        raise InputError(f"{path}: meta.json has something else than numbers in {section}.{name}")
    try:
        # Some writers leave null where a codebook has an unused entry; a row that uses it shows up as not finite.
        return np.array([np.nan if value is None else float(value) for value in values])
    except OverflowError as error:
        raise InputError(f"{path}: meta.json has a number beyond float64 in {section}.{name}") from error


def _look_up(
    path: Path, meta: dict[str, Any], section: str, codes: UInt8[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    book = _numbers(path, meta, section, "codebook", 0)
    if codes.size and int(codes.max()) >= len(book):
        raise InputError(f"{path}: {section} uses entry {codes.max()} of a codebook with {len(book)}; damaged")
    with np.errstate(over="ignore"):
        return book.astype(np.float32)[codes]


def _decode_webp(path: Path, name: str, data: bytes, allowed: int) -> UInt8[np.ndarray, "h w 4"]:
    """Decodes after the size in the image's own header has been checked."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=("WEBP",)) as image:
            width, height = image.size
    except Exception as error:  # Pillow raises nearly any error on hostile files.
        raise InputError(f"{path}: {name} is not a WebP image: {str(error)[:120]}") from error
    if width * height > allowed:
        raise InputError(f"{path}: {name} claims {width}×{height} pixels, more than the {allowed:,} of the count")
    import imagecodecs

    try:
        decoded = imagecodecs.webp_decode(data, hasalpha=True)
    except (imagecodecs.WebpError, ValueError) as error:
        raise InputError(f"{path}: {name} cannot be decoded: {str(error)[:120]}") from error
    if decoded.shape != (height, width, 4) or decoded.dtype != np.uint8:
        raise InputError(f"{path}: {name} decodes to {decoded.shape}, its header says {height}×{width}")
    return decoded
