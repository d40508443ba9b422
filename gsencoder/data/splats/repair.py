"""Inspection of splat files, and repair of the defects that are named.

Four kinds of rows cannot become Gaussians and stop loading; three more are odd but valid, and are only reported:

    nonfinite    NaN anywhere, Inf (in float32) in means, quats or SH           fix: row dropped
    quats        norm below 1e-12                                            fix: identity rotation
    scales       e^log_scale is 0, subnormal or infinite in float32          fix: 0 raised to 1e-9, infinite dropped
    opacities    infinite logit                                              fix: ±20 (within 2e-9 of 0 or 1)
    huge         a scale above the diagonal of the robust extent (the box    fix: row dropped
                 between the 1st and 99th percentile of each axis)
    duplicates   every stored value equal to an earlier row's                fix: row dropped
    floaters     distance from the median point above 10 times the 90th      fix: row dropped
                 percentile of all distances

Values of all rows may be stored otherwise than a splat's are; `odd_values` says so, and one of these can be mended:

    activated    scales that are no logarithms, opacities that are no logits     fix: converted
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from gsencoder.core.errors import InputError
from gsencoder.data.splats.ply import (
    LOGIT_LIMIT,
    RawSplat,
    linear_columns,
    logits_from_opacities,
    logs_from_scales,
    odd_values,
    opacities_from_logits,
    unusable_rows,
)

BLOCKING = ("nonfinite", "quats", "scales", "opacities")
OF_ROWS = (*BLOCKING, "huge", "duplicates", "floaters")
FIXES = ("activated", *OF_ROWS)
SMALLEST_SCALE = 1e-9
FLOATER_FACTOR = 10.0
_QUANTILES = (0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
_SHOWN = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Defect:
    """One kind of defect: its name in `OF_ROWS`, how many rows have it, the first of them, and if it stops loading."""

    name: str
    count: int
    first_rows: tuple[int, ...]
    stops_loading: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatReport:
    """What `inspect_splat` found. Statistics are over rows whose values are finite; lengths in the file's units."""

    count: int  # Gaussians in the file
    format: str  # the file format in words
    sh_degree: int  # 0 to 3
    # Bounding box of the means; None where no row is finite.
    extent_min: tuple[float, ...] | None
    extent_max: tuple[float, ...] | None
    # The box between the 1st and 99th percentile of each axis.
    robust_min: tuple[float, ...] | None
    robust_max: tuple[float, ...] | None
    median_scale: float | None  # median over all axes of all Gaussians, None where there is none or it is infinite
    opacity_quantiles: dict[str, float]  # opacity by quantile, "0.0" to "1.0"
    defects: tuple[Defect, ...]  # every kind that occurs, in the order of `OF_ROWS`
    unused: tuple[str, ...] = ()  # parts of the file that were not read
    findings: tuple[str, ...] = ()  # of `odd_values`

    @property
    def loadable(self) -> bool:
        """True if `load_splat` takes the file."""
        return self.count > 0 and not any(defect.stops_loading for defect in self.defects)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, `loadable` included."""
        return {**asdict(self), "loadable": self.loadable}


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairChange:
    """What one fix did: `count` rows, and the action in words."""

    fix: str
    count: int
    action: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairReport:
    """What `repair_splat` changed; fixes that found nothing are listed with count 0."""

    rows_before: int
    rows_after: int
    changes: tuple[RepairChange, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def inspect_splat(raw: RawSplat) -> SplatReport:
    """Counts, extent, quantiles and every defect: about a second a million rows at SH 3."""
    unusable = unusable_rows(raw)
    finite = ~unusable["nonfinite"]
    means = raw.means[finite]
    scales = raw.log_scales[finite & np.isfinite(raw.log_scales).all(axis=1)]
    opacities = opacities_from_logits(raw.logit_opacities[finite])
    box: list[tuple[float, ...] | None] = [None] * 4
    if len(means):
        robust = _robust_box(means)
        box = [tuple(map(float, corner)) for corner in (means.min(axis=0), means.max(axis=0), *robust)]
    median_scale = float(np.exp(np.float64(np.median(scales)))) if scales.size else np.inf
    quantiles = np.quantile(opacities, _QUANTILES) if len(opacities) else ()
    defects = []
    for name in OF_ROWS:
        rows = np.flatnonzero(_find(name, raw, unusable))
        if rows.size:
            first = tuple(map(int, rows[:_SHOWN]))
            defects.append(Defect(name=name, count=rows.size, first_rows=first, stops_loading=name in BLOCKING))
    return SplatReport(
        count=len(raw),
        format=raw.format,
        sh_degree=raw.sh_degree,
        extent_min=box[0],
        extent_max=box[1],
        robust_min=box[2],
        robust_max=box[3],
        median_scale=median_scale if np.isfinite(median_scale) else None,
        opacity_quantiles={str(q): float(value) for q, value in zip(_QUANTILES, quantiles, strict=False)},
        defects=tuple(defects),
        unused=raw.unused,
        findings=tuple(odd_values(raw)),
    )


def repair_splat(raw: RawSplat, fixes: Sequence[str]) -> tuple[RawSplat, RepairReport]:
    """Mends what `fixes` names, or everything for "all", in the order of `FIXES`; each sees what the last one left."""
    unknown = [fix for fix in fixes if fix not in (*FIXES, "all")]
    if isinstance(fixes, str) or unknown or not fixes:
        raise InputError(f"fixes={fixes!r}: expected a list of names among {', '.join(FIXES)}, or all")
    before, changes = len(raw), []
    for fix in FIXES:
        if fix in fixes or "all" in fixes:
            raw, parts = _mend(fix, raw)
            changes += parts
    if len(raw) == 0:
        raise InputError(f"repair would drop all {before:,} Gaussians; nothing is left to write")
    return raw, RepairReport(rows_before=before, rows_after=len(raw), changes=tuple(changes))


def _mend(fix: str, raw: RawSplat) -> tuple[RawSplat, list[RepairChange]]:
    if fix == "activated":
        columns = linear_columns(raw)
        if "scales" in columns:
            raw = replace(raw, log_scales=logs_from_scales(raw.log_scales))
        if "opacities" in columns:
            raw = replace(raw, logit_opacities=logits_from_opacities(raw.logit_opacities))
        names = " and ".join(columns) or "scales and opacities"
        return raw, [RepairChange(fix=fix, count=len(raw) if columns else 0, action=f"{names} converted")]
    rows = _find(fix, raw, unusable_rows(raw))
    count = int(rows.sum())
    if fix == "quats":
        quats = np.where(rows[:, None], np.array([1, 0, 0, 0], np.float32), raw.quats)
        return replace(raw, quats=quats), [RepairChange(fix=fix, count=count, action="set to the identity rotation")]
    if fix == "opacities":
        logits = np.where(rows, np.clip(raw.logit_opacities, -LOGIT_LIMIT, LOGIT_LIMIT), raw.logit_opacities)
        return replace(raw, logit_opacities=logits), [
            RepairChange(fix=fix, count=count, action="set to a logit of ±20")
        ]
    if fix == "scales":
        with np.errstate(over="ignore"):
            endless = rows & np.isinf(np.exp(raw.log_scales)).any(axis=1)
        log_scales = np.where(
            rows[:, None], np.maximum(raw.log_scales, np.float32(np.log(SMALLEST_SCALE))), raw.log_scales
        )
        return replace(raw, log_scales=log_scales).select(~endless), [
            RepairChange(fix=fix, count=count - int(endless.sum()), action="scales raised to 1e-9"),
            RepairChange(fix=fix, count=int(endless.sum()), action="dropped, scale infinite"),
        ]
    return (raw.select(~rows) if count else raw), [RepairChange(fix=fix, count=count, action="dropped")]


def _find(name: str, raw: RawSplat, unusable: dict[str, Bool[np.ndarray, " N"]]) -> Bool[np.ndarray, " N"]:
    if name in BLOCKING:
        return unusable[name]
    if name == "duplicates":
        return _duplicates(raw)
    finite = ~unusable["nonfinite"]
    defective = np.zeros(len(raw), bool)
    means = raw.means[finite]
    if not len(means):
        return defective
    if name == "huge":
        diagonal = float(np.linalg.norm(np.diff(_robust_box(means), axis=0)))
        # One point, or coincident ones: there is no scene to be larger than.
        defective[finite] = raw.log_scales[finite].max(axis=1) > (np.log(diagonal) if diagonal else np.inf)
        return defective & ~unusable["scales"]
    distances = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    reach = float(np.quantile(distances, 0.9))
    defective[finite] = distances > (FLOATER_FACTOR * reach if reach > 0 else np.inf)
    return defective


def _robust_box(means: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "2 3"]:
    return np.quantile(means, (0.01, 0.99), axis=0)


def _duplicates(raw: RawSplat) -> Bool[np.ndarray, " N"]:
    """Rows equal to an earlier one, bit for bit."""
    colors = raw.sh.reshape(len(raw), 3 * raw.sh.shape[1])
    arrays = [raw.means, raw.quats, raw.log_scales, raw.logit_opacities[:, None], colors]
    defective = np.zeros(len(raw), bool)
    # Equal rows have equal means: only those few need their other columns compared.
    _, group, counts = np.unique(_row_bytes(arrays[:1]), return_inverse=True, return_counts=True)
    rows = np.flatnonzero(counts[group] > 1)
    _, first = np.unique(_row_bytes([array[rows] for array in arrays]), return_index=True)
    defective[np.delete(rows, first)] = True
    return defective


def _row_bytes(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """The bytes of each row as one value."""
    table = np.concatenate([np.ascontiguousarray(array).view(np.uint32) for array in arrays], axis=1)
    return np.ascontiguousarray(table).view(f"V{4 * table.shape[1]}").reshape(-1)
