"""Splat files of all formats: `load_splat` and `save_splat`, and `read_raw` for inspection and repair.

The format is known by the first bytes, and by the suffix where a format has no magic (.splat):

    INRIA .ply           read, write   SH 0–3; any property order, number type and byte order on reading
    compressed .ply      read, write   PlayCanvas; chunks of 256
    .spz                 read, write   reads versions 2, 3, 4; writes 3, 4
    .splat               read          antimatter15, 32 bytes a row, SH 0
    SOG version 2        read          a folder with meta.json, or a .sog zip
"""

import hashlib
import os
import stat
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from gsencoder.core.errors import InputError, SceneWarning
from gsencoder.core.files import atomic_file, open_foreign, warn_if_modified
from gsencoder.data.splats.packed import GZIP_MAGIC, MAGIC, read_sog_folder, read_sog_zip, read_spz, write_spz
from gsencoder.data.splats.ply import (
    RawSplat,
    is_compressed,
    logits_from_opacities,
    logs_from_scales,
    morton_order,
    odd_values,
    opacities_from_logits,
    packed_bytes,
    read_columns,
    read_compressed,
    read_dotsplat,
    read_header,
    read_inria,
    unusable_rows,
    write_inria,
)
from gsencoder.types import Gaussians

__all__ = ["RawSplat", "fingerprint", "gaussians_from_raw", "load_property", "load_splat", "read_raw", "save_splat"]

READABLE = ".ply, .compressed.ply, .spz, .splat, .sog or a SOG folder"
HEADER_BYTES = 1 << 16  # The names of a splat's properties stand in these first bytes of a .ply
WRITABLE = ".ply, .compressed.ply or .spz"
_WHY = {
    "nonfinite": "with NaN or Inf",
    "quats": "with a zero quaternion",
    "scales": "with scales that are 0 or overflow float32",
    "opacities": "with infinite opacity logits",
}


def load_splat(path: str | Path, *, origin: Float64[np.ndarray, "3"] | None = None) -> Gaussians:
    """Reads a splat file of any known format.

    Args:
        path: a file, or a SOG folder. Known by content first, suffix second.
        origin: world coordinates of the scene's origin. It is subtracted in float64 before positions become float32,
            so a .ply with double columns keeps its precision far from zero. What float32 columns rounded away is lost.

    Returns:
        Gaussians relative to `origin`, in the axes and units of the file. Quaternions are normalized; nothing else is
        changed.

    Warns:
        SceneWarning: something was left out, or values look as if they were stored otherwise (see `odd_values`).
    """
    warn_if_modified(path)
    return gaussians_from_raw(read_raw(path), origin=origin, where=str(path))


def gaussians_from_raw(
    raw: RawSplat, *, origin: Float64[np.ndarray, "3"] | None = None, where: str = "splat"
) -> Gaussians:
    """Activates raw values: scale = e^log_scale, opacity = 1/(1 + e^−logit), quaternion over its norm."""
    if len(raw) == 0:
        raise InputError(f"{where}: holds no Gaussians; expected at least one")
    bad = {name: int(rows.sum()) for name, rows in unusable_rows(raw).items()}
    if any(bad.values()):
        counts = ", ".join(f"{count:,} {_WHY[name]}" for name, count in bad.items() if count)
        raise InputError(f"{where}: of {len(raw):,} rows {counts}; mend with 'gsencoder repair'")
    shift = _checked_origin(origin)
    means64 = raw.means - shift if shift.any() else raw.means
    means = means64.astype(np.float32)
    scales = np.exp(raw.log_scales)
    if not np.isfinite(means).all():
        raise InputError(f"{where}: positions minus the origin overflow float32; check origin={shift.tolist()}")
    lost = float(np.abs(means64 - means).max())
    if lost > 0 and lost > 0.1 * float(np.median(scales)):
        warnings.warn(
            f"{where}: positions lose up to {lost:.2g} in float32, over a tenth of the median scale; give an origin",
            SceneWarning,
            stacklevel=3,
        )
    for fault in odd_values(raw):
        warnings.warn(f"{where}: {fault}", SceneWarning, stacklevel=3)
    quats = raw.quats.astype(np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return Gaussians(
        means=means,
        quats=quats.astype(np.float32),
        scales=scales,
        opacities=opacities_from_logits(raw.logit_opacities),
        sh=raw.sh,
    )


def is_ply_of_splat(path: Path) -> bool:
    """Whether a file is a .ply with Gaussians, by the names of its properties; boxes and meshes are not."""
    if not (path.name.lower().endswith(".ply") and path.is_file()):
        return False
    with open_foreign(path) as stream:
        header = stream.read(HEADER_BYTES)
    return b" opacity" in header or b" packed_position" in header


# Damaged numbers reach the caller as they are: no warning about a signalling NaN that is cast on the way.
@np.errstate(invalid="ignore", over="ignore")
def read_raw(path: str | Path) -> RawSplat:
    """Reads a splat file without judging its values: only what breaks the format is an error.

    Counts are checked against the size of the file before memory is taken, and unpacking is bounded.
    """
    path = Path(path)
    try:
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            if not (path / "meta.json").is_file():
                inner = sorted(each.name for each in path.iterdir() if is_ply_of_splat(each))
                hint = f"; give its {', '.join(inner)}" if inner else ""
                raise InputError(f"{path}: is a folder without meta.json; expected a splat file or a SOG folder{hint}")
            return read_sog_folder(path)
        if path.name == "meta.json":
            return read_sog_folder(path.parent)
        return _read_file(path, status.st_size)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{path}: cannot be read: {reason}") from error


def _read_file(path: Path, size: int) -> RawSplat:
    suffix = path.suffix.lower()
    with open_foreign(path) as stream:
        start = stream.read(4)
        stream.seek(0)
        if size == 0:
            raise InputError(f"{path}: the file is empty; expected {READABLE}")
        if start[:3] == b"ply" and start[3:] in (b"\n", b"\r"):
            header = read_header(path, stream)
            reader = read_compressed if is_compressed(header) else read_inria
            return reader(path, stream, header, size)
        if start == MAGIC or start[:2] == GZIP_MAGIC:
            return read_spz(path, stream, size)
        if start == b"PK\x03\x04":
            return read_sog_zip(path, size)
        if suffix == ".splat":
            return read_dotsplat(path, stream, size)
    raise InputError(f"{path}: starts with {start!r}, which no known splat format does; expected {READABLE}")


def load_property(path: str | Path, name: str) -> Float64[np.ndarray, " N"]:
    """One value for each Gaussian that a .ply holds besides those of a splat (see `further` of `save_splat`)."""
    return read_columns(Path(path), [name])[0][name]


def check_splat_name(path: Path) -> None:
    """Checks that `save_splat` knows a format by the name of a file."""
    if not path.name.lower().endswith((".ply", ".spz")):
        raise InputError(f"{path}: cannot write {path.suffix or 'a name without suffix'}; expected {WRITABLE}")


def save_splat(
    path: str | Path,
    gaussians: Gaussians,
    *,
    origin: Float64[np.ndarray, "3"] | None = None,
    spz_version: int = 4,
    keep_order: bool = False,
    further: Mapping[str, Float32[np.ndarray, " N"]] | None = None,
) -> None:
    """Writes a splat; the suffix selects the format, and the file is written atomically.

    Args:
        path: .ply (INRIA), .compressed.ply or .spz, in any case of letters.
        origin: added to the positions in float64. A .ply then has double x y z; .compressed.ply and .spz cannot
            hold coordinates far from zero and are refused or warn.
        spz_version: 4 (zstd), or 3 (gzip) for older readers.
        keep_order: whether row i of a .compressed.ply is Gaussian i; otherwise rows follow a Z-order curve, which makes
            its chunks precise. The other formats always keep the order.
        further: additional properties of a .ply, one value for each Gaussian, by name.

    Precision of a round trip:
        .ply: means exact, quaternions 1e-6, scales 1e-5 relative, opacities 1e-6 (0 and 1 become logits of ±20).
        .compressed.ply: means and log-scales half of a 1023rd of their range in a chunk, opacities ±1/510, colors
            half of a 255th of their range in a chunk, other SH ±1/64 in ±4, quaternion components 7e-4 (the left-out
            one 2e-3).
        .spz: see `gsencoder.data.splats.packed.write_spz`.
    """
    path = Path(path)
    check_splat_name(path)
    name = path.name.lower()
    if spz_version not in (3, 4):
        raise InputError(f"spz_version={spz_version}: expected 3 or 4")
    if len(gaussians) == 0:
        raise InputError(f"{path}: there are no Gaussians to write")
    columns = further or {}
    if columns and name.endswith((".spz", ".compressed.ply")):
        raise InputError(f"{path}: only a plain .ply holds further properties ({', '.join(columns)[:60]})")
    if any(len(values) != len(gaussians) for values in columns.values()):
        raise InputError(f"{path}: expected further properties of {len(gaussians)} values, one a Gaussian")
    shift = _checked_origin(origin)
    raw = RawSplat(
        means=gaussians.means + shift,
        quats=gaussians.quats,
        log_scales=logs_from_scales(gaussians.scales),
        logit_opacities=logits_from_opacities(gaussians.opacities),
        sh=gaussians.sh,
        format="memory",
    )
    with atomic_file(path) as stream:
        if name.endswith(".spz"):
            write_spz(path, stream, raw, version=spz_version)
        elif name.endswith(".compressed.ply"):
            _check_packable(path, raw)
            ordered = raw if keep_order else raw.select(morton_order(raw.means))
            stream.write(packed_bytes(ordered))
        else:
            write_inria(stream, raw, double_means=bool(shift.any()), further=columns)


def _check_packable(path: Path, raw: RawSplat) -> None:
    lost = float(np.abs(raw.means - raw.means.astype(np.float32)).max())
    if lost > 0.1 * float(np.exp(np.median(raw.log_scales))):
        raise InputError(f"{path}: positions this far from zero lose {lost:.2g} in a .compressed.ply; save as .ply")
    clipped = int((np.abs(raw.sh[:, 1:]) > 4 + 1 / 64).sum() + (np.abs(raw.log_scales) > 20).sum())
    if clipped:
        warnings.warn(f"{path}: {clipped:,} values were clipped to the range of the format", SceneWarning, stacklevel=3)


FINGERPRINT_DIGITS = 64


def fingerprint(gaussians: Gaussians) -> str:
    """sha256 over names, shapes and bytes of all arrays: equal only for the same rows in the same order."""
    digest = hashlib.sha256()
    for name in ("means", "quats", "scales", "opacities", "sh"):
        array = np.ascontiguousarray(getattr(gaussians, name), dtype="<f4")
        digest.update(f"{name}{array.shape}".encode())
        digest.update(array.data)
    return digest.hexdigest()


def _checked_origin(origin: Float64[np.ndarray, "3"] | None) -> Float64[np.ndarray, "3"]:
    shift = np.zeros(3) if origin is None else np.asarray(origin, np.float64)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise InputError(f"origin: expected three finite numbers, got {shift.tolist()}")
    return shift
