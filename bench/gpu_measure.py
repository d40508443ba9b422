"""What the parts of `bench/gpu.py` share: where they run, rows of figures, errors and costs."""

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

Row = dict[str, Any]


class Skipped(Exception):
    """A part that cannot run here; the message says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """Where and how large.

    Attributes:
        device: of the run.
        small: sizes for a CPU in continuous integration.
        radio: folder of a RADIO release; None = a small one with random weights.
    """

    device: torch.device
    small: bool
    radio: Path | None = None

    @property
    def cuda(self) -> bool:
        return self.device.type == "cuda"


def relative_error(got: torch.Tensor, expected: torch.Tensor) -> float:
    """Largest difference, as a share of the largest expected magnitude."""
    expected = expected.detach().double().cpu()
    return float((got.detach().double().cpu() - expected).abs().max() / expected.abs().max().clamp(min=1e-30))


def mean_error(got: torch.Tensor, expected: torch.Tensor) -> float:
    """Mean difference, as a share of the mean expected magnitude."""
    expected = expected.detach().double().cpu()
    return float((got.detach().double().cpu() - expected).abs().mean() / expected.abs().mean().clamp(min=1e-30))


def compared(name: str, got: torch.Tensor, expected: torch.Tensor, most: float, most_mean: float | None = None) -> Row:
    """A row of a comparison, whose largest error may be `most`, and whose mean error `most_mean` if one is given."""
    row: Row = {"what": name, "error": relative_error(got, expected), "limit": most}
    if most_mean is not None:
        row |= {"mean error": mean_error(got, expected), "limit of the mean": most_mean}
    return row


def broken_limits(rows: list[Row]) -> list[str]:
    """The comparisons whose error is above its limit, or not a number."""
    pairs = (("error", "limit"), ("mean error", "limit of the mean"))
    return [
        f"{row['what']}: {error} {row[error]:.2e} is above {row[limit]:.0e}"
        for row in rows
        for error, limit in pairs
        if error in row and not row[error] <= row[limit]
    ]


@contextmanager
def measured(setting: Setting, row: Row) -> Iterator[None]:
    """Adds seconds and, of a GPU, the peak of memory to a row."""
    if setting.cuda:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
    start = time.perf_counter()
    yield
    if setting.cuda:
        torch.cuda.synchronize()
        row["peak_mib"] = torch.cuda.max_memory_allocated() / 2**20
    else:
        row["process_peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    row["seconds"] = time.perf_counter() - start
