"""The most memory that a piece of work held beyond what was there before it."""

import ctypes
import gc
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Growth:
    """Filled when the block of `memory_growth` ends.

    Attributes:
        mib: peak resident memory less that at the start, MiB; NaN where the system does not tell.
    """

    def __init__(self) -> None:
        self.mib = math.nan


@contextmanager
def memory_growth() -> Iterator[Growth]:
    """Measures a block, which may run many times in one process.

    Linux keeps each process's peak of resident memory (VmHWM) and lets it be set back to the present value. Freed heap
    memory is given back first, so that the block cannot live on what an earlier one left. Elsewhere the result is NaN.
    """
    growth = Growth()
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    try:
        CLEAR.write_text("5")
        before = _kib("VmRSS")
    except OSError:
        yield growth
        return
    yield growth
    growth.mib = max(_kib("VmHWM") - before, 0) / 1024


def _kib(name: str) -> int:
    for line in STATUS.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1])
    raise OSError(f"{STATUS} has no {name}")
