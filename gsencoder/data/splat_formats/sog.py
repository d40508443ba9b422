"""PlayCanvas' SOG version 2: a meta.json with WebP images, in a folder or in a .sog zip.

Reference: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. Read only. gsply reads it too,
but unpacks zips and images of any size and indexes codebooks without a check.
"""

import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from gsencoder.core.errors import InputError
from gsencoder.core.files import read_foreign
from gsencoder.data.splat_formats.raw import RawSplat, check_expansion, logits_from_opacities, quats_from_smallest_three

MAX_META = 4 << 20
_PALETTE_COLUMNS = 64
_KEYS = ("version", "asset", "count", "means", "scales", "quats", "sh0", "shN")
_QUAT_TAG = 252

Load = Callable[[str, int], bytes]
"""A file of the set by its name; longer than the limit is an error."""


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
                if member is None:
                    raise InputError(f"{path}: the bundle has no member {name!r}")
                if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & 1:
                    raise InputError(f"{path}: member {name!r} is encrypted or packed in an unknown way")
                with bundle.open(member) as stream:
                    data = stream.read(limit + 1)
                if len(data) > limit:
                    raise InputError(f"{path}: member {name!r} unpacks to more than the {limit:,} bytes allowed")
                return data

            return _read(path, load, size)
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        OSError,
        NotImplementedError,
        RuntimeError,
        struct.error,
    ) as error:
        raise InputError(f"{path}: the .sog bundle is damaged: {str(error)[:120]}") from error


def _read(path: Path, load: Load, size: int) -> RawSplat:
    text = load("meta.json", MAX_META)
    try:
        meta = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: meta.json is not JSON: {str(error)[:120]}") from error
    if not isinstance(meta, dict) or meta.get("version") != 2:
        version = meta.get("version", 1) if isinstance(meta, dict) else "none"
        raise InputError(
            f"{path}: meta.json has version {str(version)[:20]}; expected SOG version 2 (splat-transform converts)"
        )
    count = meta.get("count")
    if not isinstance(count, int) or isinstance(count, bool) or count < 0:
        raise InputError(f"{path}: meta.json has count {str(count)[:20]!r}; expected a number of Gaussians")
    # Six images of four bytes each for every Gaussian.
    check_expansion(path, 24 * count, size)

    def texels(section: str, index: int, width: int | None = None, rows: int = 0) -> UInt8[np.ndarray, "n 4"]:
        files = _field(path, meta, section, "files")
        name = files[index] if isinstance(files, list) and index < len(files) else None
        if not isinstance(name, str) or not name or Path(name).name != name or "\\" in name or ":" in name:
            raise InputError(
                f"{path}: meta.json names {str(name)[:60]!r} for {section}; expected a file name without a folder"
            )
        count_wanted = rows or count
        # Pixels beyond the count are padding to whole rows; a lossless WebP is no larger than its pixels.
        allowed = 2 * count_wanted + (1 << 16)
        image = _decode_webp(path, name, load(name, 5 * allowed), allowed)
        if image.shape[0] * image.shape[1] < count_wanted or (width is not None and image.shape[1] != width):
            raise InputError(
                f"{path}: {name} has {image.shape[1]}×{image.shape[0]} pixels, too few for {count_wanted:,} entries"
            )
        return image.reshape(-1, 4)[:count_wanted]

    low, high = _numbers(path, meta, "means", "mins", 3), _numbers(path, meta, "means", "maxs", 3)
    fixed = texels("means", 0)[:, :3] + (texels("means", 1)[:, :3].astype(np.float64) * 256)
    with np.errstate(over="ignore", invalid="ignore"):
        logs = low + (high - low) * (fixed / 65535)
        means = np.sign(logs) * np.expm1(np.abs(logs))
    quats = texels("quats", 0)
    tags = quats[:, 3].astype(np.int64) - _QUAT_TAG
    rotations = quats_from_smallest_three(tags, (quats[:, :3] / 255 * 2 - 1) * np.sqrt(0.5))
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
        raise InputError(
            f"{path}: meta.json has shN.bands {str(bands)[:9]}, shN.count {str(entries)[:9]}; expected 1–3, 1–65536"
        )
    k = (bands + 1) ** 2 - 1
    labels = texels("shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
    beyond = int((labels >= entries).sum())
    if beyond:
        raise InputError(
            f"{path}: {beyond:,} Gaussians point beyond the {entries:,} entries of the SH palette; it is damaged"
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
        raise InputError(
            f"{path}: meta.json has an unusable list {section}.{name}; expected {length or 'up to 256'} numbers"
        )
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
        raise InputError(
            f"{path}: {section} uses entry {codes.max()} of a codebook with {len(book)}; the file is damaged"
        )
    with np.errstate(over="ignore"):
        return book.astype(np.float32)[codes]


def _decode_webp(path: Path, name: str, data: bytes, allowed: int) -> UInt8[np.ndarray, "h w 4"]:
    """Decodes after the size in the image's own header has been checked."""
    kind = data[12:16] if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30 else b""
    if kind == b"VP8L":
        fields = int.from_bytes(data[21:25], "little")
        width, height = (fields & 0x3FFF) + 1, (fields >> 14 & 0x3FFF) + 1
    elif kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    else:
        raise InputError(f"{path}: {name} is not a lossless WebP image")
    if width * height > allowed:
        raise InputError(
            f"{path}: {name} claims {width}×{height} pixels, more than the {allowed:,} that the count allows"
        )
    # Few scenes need it, and it is slow to import.
    import imagecodecs

    try:
        image = imagecodecs.webp_decode(data, hasalpha=True)
    except (imagecodecs.WebpError, ValueError) as error:
        raise InputError(f"{path}: {name} cannot be decoded: {str(error)[:120]}") from error
    if image.shape != (height, width, 4) or image.dtype != np.uint8:
        raise InputError(f"{path}: {name} decodes to {image.shape}, its header says {height}×{width}")
    return image
