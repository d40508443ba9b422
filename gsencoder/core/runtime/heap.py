"""Heap settings of a CPU process that runs networks: freed blocks are reused instead of returned to the system.

glibc returns every block above 32 MB to the system when it is freed, and threads other than the first get heaps that
cannot grow beyond 64 MB. Each layer's activations are then new pages, which the system must clear: that costs more than
the arithmetic (`bench/cpu.py`).
"""

import ctypes
import os

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_NEVER_TRIM = (1 << 31) - 1


def retain_freed_memory() -> bool:
    """Makes this process reuse freed memory from now on; False if the C library does not support it (glibc does).

    The process then never shrinks below its peak. Meant for commands, which have a process of their own. To be called
    before the first network runs, since oneDNN reads the capacity of its cache of compiled products once; the default
    of 1,024 is too small for the sizes that occur in a training.
    """
    os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "16384")
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    settings = ((_M_MMAP_THRESHOLD, 1 << 30), (_M_TRIM_THRESHOLD, _NEVER_TRIM), (_M_ARENA_MAX, 1))
    accepted = [mallopt(name, value) for name, value in settings]
    return accepted == [1, 1, 1]
