"""Splats in .ply and .splat files, as raw values: logarithms of scales, logits of opacities, unnormalized quaternions,
defects included. Nothing outside the splat files, `inspect` and `repair` sees these; all others get `Gaussians`.

INRIA's layout, which most trainers write, is that of the code of Kerbl et al., 3D Gaussian Splatting, 2023. PlayCanvas'
compressed .ply (splat-transform, SuperSplat) has chunks of 256 Gaussians with their bounds, 16 bytes a Gaussian, SH in
bytes. Writing it is gsply's; reading is here, because gsply's kernels do not check what a damaged file makes them
index, and hold opacities to a logit of ±10.
"""

import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, Integer, UInt8

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, SceneWarning, readable
from gsencoder.core.files import open_foreign
from gsencoder.core.threads import threads_unchanged
from gsencoder.types import sh_from_colors

LOGIT_LIMIT = 20.0  # Opacities 0 and 1 are written as this logit: 2e-9 away from the true value, and finite
MAX_EXPANSION = 200  # A packed file may unpack to this many times its size …
ALWAYS_ALLOWED = 16 << 20  # … or to this many bytes, whichever is more
SH_COEFFICIENTS = (1, 4, 9, 16)
ENOUGH = 100  # Fewer Gaussians say nothing about how their values were stored
SAMPLE = 4096  # Gaussians whose neighbors and coordinates are looked at
OVERLAP = 3.0
"""Scales are 0.4 to 0.8 times the distance to the nearest neighbor in real splats (median of both), and up to 1.5 where
they were just made."""

COARSE, COARSE_LATTICE = 0.5, 4.0
"""Median scales in a step of float32, or of another lattice, that moves Gaussians visibly. Gaussians on a regular grid
that leave no gaps have about two in a step."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawSplat:
    """One splat as its file stores it; nothing is checked but the structure."""

    means: Float64[np.ndarray, "N 3"]  # centers in the file's own coordinates
    quats: Float32[np.ndarray, "N 4"]  # wxyz, of any length (INRIA files are not normalized)
    # Natural logarithms of the standard deviations; −inf where the file says 0 or less.
    log_scales: Float32[np.ndarray, "N 3"]
    logit_opacities: Float32[np.ndarray, " N"]  # logits; formats that store 0 … 255 give ±20 at the two ends
    sh: Float32[np.ndarray, "N K 3"]  # color coefficients, degree-major, K = 1, 4, 9 or 16
    format: str  # the file format in words
    unused: tuple[str, ...] = ()  # properties and other parts of the file that were not read, in words

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        return math.isqrt(self.sh.shape[1]) - 1

    def select(self, rows: Bool[np.ndarray, " N"] | Integer[np.ndarray, " n"]) -> "RawSplat":
        """The Gaussians of `rows` (indices or a mask), in that order."""
        arrays = ("means", "quats", "log_scales", "logit_opacities", "sh")
        return replace(self, **{name: getattr(self, name)[rows] for name in arrays})


def logits_from_opacities(opacities: Float[np.ndarray, " N"]) -> Float32[np.ndarray, " N"]:
    """ln(p / (1 − p)), held to ±`LOGIT_LIMIT` so that 0 and 1 stay finite."""
    p = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        logits = np.log(p) - np.log1p(-p)
    return np.clip(logits, -LOGIT_LIMIT, LOGIT_LIMIT).astype(np.float32)


def opacities_from_logits(logits: Float32[np.ndarray, " N"]) -> Float32[np.ndarray, " N"]:
    """1 / (1 + e^−x), computed in float64."""
    with np.errstate(over="ignore"):
        return (1 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.float32)


def logs_from_scales(scales: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    """Natural logarithms; −inf for zero and negative scales, NaN for NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(np.maximum(scales.astype(np.float64), 0)).astype(np.float32)


def quats_from_smallest_three(
    largest: Integer[np.ndarray, " N"], others: Float[np.ndarray, "N 3"]
) -> Float32[np.ndarray, "N 4"]:
    """Unit quaternions from the index of their largest component, √(1 − Σ others²), and the other three in order."""
    values = others.astype(np.float64)
    is_largest = np.arange(4) == np.asarray(largest)[:, None]
    quats = np.empty((len(values), 4), np.float32)
    quats[is_largest] = np.sqrt(np.maximum(0, 1 - np.square(values).sum(axis=1)))
    quats[~is_largest] = values.reshape(-1)
    return quats


def unusable_rows(raw: RawSplat) -> dict[str, Bool[np.ndarray, " N"]]:
    """Rows that cannot become Gaussians, by the name of the fix that mends them. A row is listed once.

    nonfinite: NaN or Inf in means, quats or sh, NaN in log_scales or logit_opacities.
    quats: norm below 1e-12, so there is no rotation.
    scales: e^log_scale is 0, subnormal or infinite in float32.
    opacities: infinite logits.
    """
    flat = raw.sh.reshape(len(raw), raw.sh.shape[1] * 3)
    with np.errstate(over="ignore", invalid="ignore"):
        # A row's sum is finite unless an entry is not; float64 cannot overflow on sums of float32.
        total = raw.quats.sum(axis=1, dtype=np.float64) + flat.sum(axis=1, dtype=np.float64)
        nonfinite = ~np.isfinite(total) | ~np.isfinite(raw.means.astype(np.float32)).all(axis=1)
        nonfinite |= np.isnan(raw.log_scales).any(axis=1) | np.isnan(raw.logit_opacities)
        norms = np.square(raw.quats.astype(np.float64)).sum(axis=1)
        scales = np.exp(raw.log_scales)
        tiny = np.finfo(np.float32).tiny
        bad_scales = ~((scales >= tiny) & np.isfinite(scales)).all(axis=1)
    defects = {"nonfinite": nonfinite, "quats": norms < 1e-24, "scales": bad_scales}
    defects["opacities"] = np.isinf(raw.logit_opacities)
    reported_rows = nonfinite
    for name in ("quats", "scales", "opacities"):
        defects[name] = defects[name] & ~reported_rows
        reported_rows = reported_rows | defects[name]
    return defects


def linear_columns(raw: RawSplat) -> dict[str, str]:
    """Which of "scales" and "opacities" are stored as they are, where logarithms and logits are expected, and why.

    Scales, if all are 0 or more, and read as logarithms are over `OVERLAP` times the distance between Gaussians, but
    not as lengths. Opacities, if all lie in [0, 1]: as logits they would all be between 0.5 and 0.73.
    """
    columns: dict[str, str] = {}
    if len(raw) < ENOUGH or not np.isfinite(raw.means).all():
        return columns
    if raw.log_scales.min() >= 0 and raw.log_scales.max() < np.inf:
        from scipy.spatial import cKDTree

        rows = even_indices(len(raw), SAMPLE)
        apart = float(np.median(cKDTree(raw.means).query(raw.means[rows], k=2)[0][:, 1]))
        length = float(np.median(raw.log_scales))
        if length < OVERLAP * apart < math.exp(min(length, LOGIT_LIMIT)):
            columns["scales"] = f"all are 0 or more, and e^scale is {math.exp(length) / apart:.3g} times their distance"
    logits = raw.logit_opacities
    if logits.min() >= 0 and 0 < logits.max() <= 1:
        columns["opacities"] = f"all are between {logits.min():.3g} and {logits.max():.3g}"
    return columns


def odd_values(raw: RawSplat) -> list[str]:
    """What is wrong with values that can be read, and what to do: scales or opacities that are not logarithms and
    logits, and coordinates that were rounded to steps as large as Gaussians. Nothing of a good splat."""
    columns = linear_columns(raw)
    odd = [
        f"{name} seem to be stored as they are, not as {'logarithms' if name == 'scales' else 'logits'} ({why}); "
        "gsencoder repair with fix=[activated] converts them"
        for name, why in columns.items()
    ]
    sample = raw.select(even_indices(len(raw), SAMPLE))
    positions, stored = sample.means, sample.log_scales[np.isfinite(sample.log_scales)]
    if len(raw) < ENOUGH or not np.isfinite(positions).all() or not len(stored):
        return odd
    middle = float(np.median(stored))
    scale = middle if "scales" in columns else math.exp(min(middle, LOGIT_LIMIT))
    steps = [_step(positions[:, axis], scale) for axis in range(3)]
    if any(steps):
        axis = int(np.argmax(steps))
        far = np.round(np.median(positions, axis=0), -3) + 0.0
        cause = (
            f"so far from zero float32 has no finer ones: export again with an offset of about {far.tolist()} "
            "subtracted in double precision"
            if far.any()
            else "export again without rounding"
        )
        odd.append(
            f"positions were rounded to steps of {steps[axis]:.3g} along {'xyz'[axis]}, {steps[axis] / scale:.2g} "
            f"times the median scale; {cause} (the digits are not in this file)"
        )
    return odd


def _step(values: Float64[np.ndarray, " n"], scale: float) -> float:
    """The step of coordinates that is coarse for a scale; 0 where there is none."""
    step = float(np.spacing(np.float32(np.median(np.abs(values)))))
    if step > COARSE * scale and (values == values.astype(np.float32)).all():
        return step
    levels = np.unique(values)
    if not 4 <= len(levels) <= len(values) / 4:
        return 0.0
    gaps = np.diff(levels)
    multiples = gaps / gaps.min()
    regular = np.abs(multiples - np.round(multiples)).max() < 0.01
    return float(gaps.min()) if regular and gaps.min() > COARSE_LATTICE * scale else 0.0


def check_expansion(path: Path, unpacked: int, size: int) -> None:
    """Refuses a file that claims to unpack to far more than any real one does."""
    allowed = max(MAX_EXPANSION * size, ALWAYS_ALLOWED)
    if unpacked > allowed:
        raise InputError(
            f"{path}: claims to unpack to {unpacked:,} bytes from {size:,}; damaged or made to exhaust memory"
        )


MAX_HEADER = 1 << 18
_BLOCK = 1 << 12  # Rows a block: small enough that its columns are read from cache.
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "double": "f8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_REQUIRED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
             "rot_0", "rot_1", "rot_2", "rot_3")  # fmt: skip

FILTER = "filter_3D"
"""The property with the width of mip-splatting's smoothing filter, which its files leave to be applied."""
_COLORS, _NORMALS = ("red", "green", "blue"), ("nx", "ny", "nz")


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyElement:
    """One element of a header; `dtype` is None where a list property leaves the row size open."""

    name: str
    count: int
    dtype: np.dtype | None
    first_bad: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyHeader:
    """What a .ply says about itself. `start` is the offset of the data in bytes."""

    encoding: str
    elements: tuple[PlyElement, ...]
    start: int

    def element(self, name: str) -> PlyElement | None:
        """The element called `name`, or None."""
        return next((element for element in self.elements if element.name == name), None)


def read_header(path: Path, stream: BinaryIO) -> PlyHeader:
    """Parses the header at the start of `stream`; every way to be wrong is an InputError that names the line."""
    head = stream.read(MAX_HEADER)
    end = re.search(rb"\nend_header[ \t]*\r?\n", head)
    if end is None:
        raise InputError(f"{path}: no 'end_header' line in the first {len(head):,} bytes; truncated or damaged")
    lines = head[: end.start()].decode("ascii", errors="replace").splitlines()
    encoding, order = "", "<"
    elements: list[tuple[str, int, list[tuple[str, str]], str]] = []
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        match words:
            case [] | ["comment", *_] | ["obj_info", *_]:
                continue
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian", _] if not encoding:
                encoding = words[1]
                order = ">" if encoding == "binary_big_endian" else "<"
            case ["element", name, digits] if digits.isascii() and digits.isdigit() and len(digits) < 20:
                elements.append((name, int(digits), [], ""))
            case ["property", "list", _, _, name] if elements:
                elements[-1] = (*elements[-1][:3], name)
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name, order + _TYPES[kind]))
            case _:
                raise InputError(f"{path}: line {number} of the .ply header cannot be read: {line[:80]!r}")
    if not encoding:
        raise InputError(f"{path}: the .ply header has no usable 'format' line")
    names = [name for name, *_ in elements]
    if len(set(names)) != len(names):
        raise InputError(f"{path}: the .ply header repeats an element: {', '.join(names)[:120]}")
    parsed = []
    for name, count, fields, list_name in elements:
        if len({field for field, _ in fields}) != len(fields):
            raise InputError(f"{path}: the .ply header repeats a property of element {name!r}")
        dtype = None if list_name else np.dtype(fields)
        parsed.append(PlyElement(name=name, count=count, dtype=dtype, first_bad=list_name))
    return PlyHeader(encoding=encoding, elements=tuple(parsed), start=end.end())


def element_start(path: Path, header: PlyHeader, name: str, size: int) -> int:
    """Offset in bytes of a binary element, checked against the size of the file before anything is allocated."""
    offset = header.start
    for element in header.elements:
        if element.dtype is None:
            raise InputError(
                f"{path}: {element.name!r} has the list property {element.first_bad!r}; expected a splat, not a mesh"
            )
        end = offset + element.count * element.dtype.itemsize
        if element.name == name:
            if end > size:
                raise InputError(
                    f"{path}: the header claims {element.count:,} rows of {name!r}, {end:,} bytes in all, but has "
                    f"{size:,} ({end - size:,} missing); it is truncated or its header is wrong"
                )
            return offset
        offset = end
    raise InputError(f"{path}: the .ply has no element {name!r}; expected a Gaussian splat")


def read_inria(path: Path, stream: BinaryIO, header: PlyHeader, size: int) -> RawSplat:
    """Gaussians from the element `vertex`: any order of properties, any number type; `filter_3D` is applied, with a
    warning, and others are ignored and listed."""
    vertex = header.element("vertex")
    if vertex is None or vertex.dtype is None:
        raise InputError(f"{path}: the .ply has no element 'vertex' of plain numbers; expected a Gaussian splat")
    names = vertex.dtype.names or ()
    missing = [name for name in _REQUIRED if name not in names]
    if missing == ["scale_2"]:
        raise InputError(f"{path}: has scale_0 and scale_1 only, a 2D splat (surfels); expected three scales")
    if missing:
        raise InputError(f"{path}: the .ply lacks {', '.join(missing)}; expected a Gaussian splat")
    colors = {name for name in names if re.fullmatch(r"f_rest_\d+", name)}
    rest = len(colors)
    if rest not in (0, 9, 24, 45, 72) or any(f"f_rest_{i}" not in names for i in range(rest)):
        raise InputError(f"{path}: has {rest} f_rest properties; expected 0, 9, 24 or 45 (SH 0 to 3)")
    per_channel = rest // 3
    coefficients = min(per_channel + 1, SH_COEFFICIENTS[-1])
    if coefficients < per_channel + 1:
        warnings.warn(f"{path}: SH degree 4 was cut to degree 3", SceneWarning, stacklevel=2)
    count, blocks = vertex.count, _blocks(path, stream, header, vertex, size)
    means = np.empty((count, 3), np.float64)
    quats, scales = np.empty((count, 4), np.float32), np.empty((count, 3), np.float32)
    opacities, sh = np.empty(count, np.float32), np.empty((count, coefficients, 3), np.float32)
    widths = np.zeros(count, np.float64)
    columns = _columns(means, quats, scales, opacities, sh, per_channel)
    if FILTER in names:
        columns[FILTER] = widths
    with np.errstate(over="ignore", invalid="ignore"):
        for part, block in blocks:
            for name, column in columns.items():
                column[part] = block[name]
    if FILTER in names:
        if wrong := int((~((widths >= 0) & (widths < np.inf))).sum()):
            raise InputError(f"{path}: {FILTER} of {wrong:,} rows is no width; expected 0 or more in each row")
        scales, opacities = _filtered(scales, opacities, widths)
        warnings.warn(
            f"{path}: {FILTER} of mip-splatting is applied, which widens Gaussians and makes them fainter",
            SceneWarning,
            stacklevel=2,
        )
    used = {*columns, *colors, *_NORMALS}
    others = [f"element {element.name}" for element in header.elements if element is not vertex and element.count]
    return RawSplat(
        means=means,
        quats=quats,
        log_scales=scales,
        logit_opacities=opacities,
        sh=sh,
        format=f"INRIA .ply, {header.encoding}{f', {FILTER} applied' if FILTER in names else ''}",
        unused=(*(f"property {name}" for name in names if name not in used), *others),
    )


def _columns(
    means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, logits: np.ndarray, sh: np.ndarray, per_channel: int
) -> dict[str, np.ndarray]:
    """The properties of INRIA's layout, in its order, as views of arrays; f_rest has `per_channel` values a color."""
    return {
        **{name: means[:, axis] for axis, name in enumerate("xyz")},
        **{f"f_dc_{axis}": sh[:, 0, axis] for axis in range(3)},
        **{f"f_rest_{axis * per_channel + k - 1}": sh[:, k, axis] for axis in range(3) for k in range(1, sh.shape[1])},
        "opacity": logits,
        **{f"scale_{axis}": log_scales[:, axis] for axis in range(3)},
        **{f"rot_{axis}": quats[:, axis] for axis in range(4)},
    }


def _blocks(
    path: Path, stream: BinaryIO, header: PlyHeader, vertex: PlyElement, size: int
) -> Iterator[tuple[slice, np.ndarray]]:
    """The rows of an element, some at a time, and where they stand; their number is checked by the call itself."""
    assert vertex.dtype is not None
    if header.encoding == "ascii":
        return iter([(slice(0, vertex.count), _ascii_rows(path, stream, header, vertex, size))])
    stream.seek(element_start(path, header, vertex.name, size))

    def read() -> Iterator[tuple[slice, np.ndarray]]:
        for start in range(0, vertex.count, _BLOCK):
            part = slice(start, min(start + _BLOCK, vertex.count))
            block = np.fromfile(stream, vertex.dtype, part.stop - start)
            if len(block) < part.stop - start:
                raise InputError(f"{path}: ended while it was read, at row {start + len(block):,} of {vertex.count:,}")
            yield part, block

    return read()


def _filtered(
    log_scales: Float32[np.ndarray, "N 3"], logits: Float32[np.ndarray, " N"], widths: Float64[np.ndarray, " N"]
) -> tuple[Float32[np.ndarray, "N 3"], Float32[np.ndarray, " N"]]:
    """Gaussians convolved with isotropic ones of these widths: scale √(s² + f²), opacity times √(Π s² / Π (s² + f²))
    (Yu et al., Mip-Splatting, 2024)."""
    logs = log_scales.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        wider = np.logaddexp(2 * logs, 2 * np.log(widths)[:, None]) / 2
        opacities = opacities_from_logits(logits) * np.exp((logs - wider).sum(axis=1))
    return wider.astype(np.float32), logits_from_opacities(opacities)


def read_columns(
    path: Path, names: Sequence[str], optional: Sequence[str] = ()
) -> tuple[dict[str, Float64[np.ndarray, " N"]], np.dtype]:
    """Properties of the element `vertex`, those of `optional` if all are there, and the type of its rows."""
    with readable(path), open_foreign(path) as stream:
        if stream.read(4)[:3] != b"ply":
            raise InputError(f"{path}: not a .ply file")
        size = stream.seek(0, 2)
        stream.seek(0)
        header = read_header(path, stream)
        vertex = header.element("vertex")
        known = () if vertex is None or vertex.dtype is None else vertex.dtype.names or ()
        if vertex is None or vertex.dtype is None or not set(names) <= set(known):
            raise InputError(f"{path}: the .ply has no property {next(n for n in names if n not in known)!r}")
        blocks, chosen = _blocks(path, stream, header, vertex, size), [*names, *optional]
        columns = {
            name: np.empty(vertex.count, np.float64) for name in (chosen if set(optional) <= set(known) else names)
        }
        for part, block in blocks:
            for name, column in columns.items():
                column[part] = block[name]
    return columns, vertex.dtype


def read_points(path: Path) -> tuple[Float64[np.ndarray, "P 3"], UInt8[np.ndarray, "P 3"] | None]:
    """Positions of a point cloud, and its colors if it has any; others than integers are taken for shares of 1."""
    columns, row = read_columns(path, "xyz", _COLORS)
    points = np.stack([columns[name] for name in "xyz"], axis=1)
    if "red" not in columns:
        return points, None
    colors = np.stack([columns[name] for name in _COLORS], axis=1) * (1 if row["red"].kind in "iu" else 255)
    return points, colors.round().clip(0, 255).astype(np.uint8)


def _ascii_rows(path: Path, stream: BinaryIO, header: PlyHeader, vertex: PlyElement, size: int) -> np.ndarray:
    assert vertex.dtype is not None
    names = vertex.dtype.names or ()
    skipped = 0
    for element in header.elements:
        if element is vertex:
            break
        skipped += element.count
    # A row has at least one digit and one separator a value.
    if skipped + vertex.count * len(names) * 2 > size - header.start + 1:
        raise InputError(
            f"{path}: the header claims {vertex.count:,} rows, more than {size:,} bytes hold; truncated or wrong"
        )
    stream.seek(header.start)
    lines = islice(stream, skipped, skipped + vertex.count)
    if vertex.count == 0:
        return np.empty(0, vertex.dtype)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # "input contained no data" becomes the count's error below.
            table = np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2, encoding="latin-1")
    except ValueError as error:
        raise InputError(f"{path}: a row of the ascii .ply cannot be read: {str(error)[:120]}") from error
    if table.shape != (vertex.count, len(names)):
        actual = f"{table.shape[0]:,} rows of {table.shape[1]} numbers"
        raise InputError(f"{path}: expected {vertex.count:,} rows of {len(names)} numbers, got {actual}: truncated")
    # Columns get names again; numbers stay float64, so that text with many digits keeps them.
    return table.view(np.dtype([(name, np.float64) for name in names])).reshape(-1)


def inria_row_bytes(sh_degree: int, *, double_means: bool) -> int:
    """Bytes of a row that `write_inria` writes without further properties."""
    positions, normals, others = 3, 3, 1 + 3 + 4
    return 4 * (positions * (1 + double_means) + normals + 3 * (sh_degree + 1) ** 2 + others)


def write_inria(
    stream: BinaryIO, raw: RawSplat, *, double_means: bool, further: Mapping[str, Float32[np.ndarray, " N"]]
) -> None:
    """Writes binary little-endian rows x y z nx ny nz f_dc f_rest opacity scale rot; normals are 0.

    `double_means` writes x y z as doubles, for scenes far from zero; everything else is float. `further` properties
    follow.
    """
    columns = _columns(
        raw.means, raw.quats, raw.log_scales, raw.logit_opacities, raw.sh, per_channel=raw.sh.shape[1] - 1
    )
    columns |= further
    names = ["x", "y", "z", *_NORMALS, *list(columns)[3:]]
    dtype = np.dtype([(name, "<f8" if double_means and name in "xyz" else "<f4") for name in names])
    words = {"<f8": "double", "<f4": "float"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(raw)}"]
    lines += [f"property {words[dtype[name].str]} {name}" for name in names]
    stream.write(("\n".join([*lines, "end_header"]) + "\n").encode("ascii"))
    for start in range(0, len(raw), _BLOCK):
        part = slice(start, start + _BLOCK)
        block = np.zeros(len(raw.means[part]), dtype)
        for name, column in columns.items():
            block[name] = column[part]
        stream.write(block.tobytes())


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
        raise InputError(f"{path}: {chunk.count:,} chunks of {_CHUNK} are too few for {count:,} Gaussians")
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
            raise InputError(f"{path}: 'sh' has {rest.count:,} rows of {len(names)}; expected {count:,} of 9, 24 or 45")
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


_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def read_dotsplat(path: Path, stream: BinaryIO, size: int) -> RawSplat:
    """Colors are SH degree 0; scales are stored as standard deviations; quaternion bytes are 128 + 128·q."""
    if size % _ROW.itemsize:
        raise InputError(f"{path}: {size:,} bytes is not a whole number of {_ROW.itemsize}-byte rows; truncated")
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
