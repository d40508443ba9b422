"""Growth of peak memory in a block of code."""

import ctypes
import gc
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class Growth:
    """The result of `memory_growth`, set when its block ends.

    Attributes:
        mib: peak resident memory minus that at the start, MiB; NaN where the system does not report it.
    """

    def __init__(self) -> None:
        self.mib = math.nan


@contextmanager
def memory_growth() -> Iterator[Growth]:
    """Measures the memory of a block, which may run many times in one process.

    Linux records the peak of resident memory of each process (VmHWM) and can reset it to the present value. Freed heap
    memory is returned to the system first, so that the block cannot reuse what an earlier one freed. On other systems
    the result is NaN.
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
