"""Raw values of splat files: logarithms of scales, logits of opacities, unnormalized quaternions, defects included.

Nothing outside the splat files, `inspect` and `repair` sees these; all others get `Gaussians`.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Integer

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError

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
