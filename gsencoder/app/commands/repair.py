"""`gsencoder repair SPLAT out=FILE fix=…`: repairs defects of a splat file and reports the changes."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

from gsencoder.app.runs.output_folder import refuse_existing
from gsencoder.app.runs.progress import console
from gsencoder.app.runs.summary import Summary
from gsencoder.app.settings.config import CommonConfig
from gsencoder.core.errors import InputError
from gsencoder.core.files.json_values import write_json
from gsencoder.data.splat_formats.repair import repair_splat
from gsencoder.data.splats import READABLE, WRITABLE, RawSplat, gaussians_from_raw, read_raw, save_splat

Fix = Literal["nonfinite", "quats", "scales", "opacities", "huge", "duplicates", "floaters", "all"]


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairConfig(CommonConfig):
    """Settings of `repair`."""

    paths: tuple[str, ...] = field(
        default=(), metadata={"help": f"one splat file: {READABLE}", "metavar": "SPLAT", "required": True}
    )
    out: Path | None = field(
        default=None,
        metadata={
            "help": f"the file to write: {WRITABLE}; FILE.summary.json beside it holds the changes",
            "metavar": "FILE",
            "required": True,
        },
    )
    fix: tuple[Fix, ...] = field(
        default=("nonfinite", "quats", "scales", "opacities"),
        metadata={"help": "defects to repair: the four that prevent loading, and huge, duplicates, floaters, or all"},
    )

    def __post_init__(self) -> None:
        if len(self.paths) > 1:
            raise InputError(f"paths: expected one splat file, got {len(self.paths)}")
        if not self.fix:
            raise InputError("fix: expected the name of a defect, got none (gsencoder inspect lists them)")


def run(config: RepairConfig, summary: Summary) -> None:
    """Reads, repairs and writes a splat, and prints each change with its count."""
    assert config.out is not None
    refuse_existing(config.out, config.overwrite)
    with summary.step("read"):
        raw = read_raw(config.paths[0])
    with summary.step("repair"):
        repaired, report = repair_splat(raw, config.fix)
        origin = float64_origin(repaired)
        gaussians = gaussians_from_raw(
            repaired, origin=origin, where=f"{config.paths[0]} after fix={','.join(config.fix)}"
        )
    with summary.step("write"):
        save_splat(config.out, gaussians, origin=origin)
    summary.results.update(report.to_dict(), path=str(config.out))
    write_json(f"{config.out}.summary.json", summary.to_dict())
    screen = console(config.quiet)
    for change in report.changes:
        screen.print(f"{change.fix}: {change.count:,} rows {change.action}")
    screen.print(f"{config.out}: {report.rows_after:,} of {report.rows_before:,} Gaussians")


def float64_origin(raw: RawSplat) -> Float64[np.ndarray, "3"] | None:
    """Integer coordinates near the middle of the splat if its positions need float64; None if float32 holds them."""
    if np.array_equal(raw.means, raw.means.astype(np.float32)):
        return None
    return np.floor(np.median(raw.means, axis=0))
