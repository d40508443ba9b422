"""Memory of a CPU process that runs networks: large blocks are kept and used again.

glibc gives every block above 32 MB back to the system when it is freed, and threads other than the first get heaps that
cannot grow beyond 64 MB. Each layer's activations are then new pages, which the system must clear: that costs more than
the arithmetic (`bench/cpu.py`).
"""

import ctypes
import os

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8
_KEPT = (1 << 31) - 1


def keep_heap() -> bool:
    """Lets this process keep what it frees, from now on; whether the system's C library knows how (glibc does).

    The process then holds as much memory as it once needed. Meant for commands, which own their process; to be called
    before the first network runs, since oneDNN looks once how many compiled products it may keep (1,024 unless told:
    too few for the sizes that occur in a training).
    """
    os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "16384")
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    settings = ((_M_MMAP_THRESHOLD, 1 << 30), (_M_TRIM_THRESHOLD, _KEPT), (_M_ARENA_MAX, 1))
    accepted = [mallopt(name, value) for name, value in settings]
    return accepted == [1, 1, 1]
