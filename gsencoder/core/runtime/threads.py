"""CPU kernels: numba functions without the GIL, called from a pool of Python threads.

numba's parallel loops are not used, since an OpenMP pool aborts a process that was forked after its first use, as data
loaders do. Work is cut into a fixed number of pieces, so that results do not depend on the number of threads.
"""

import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from jaxtyping import Int64
from numba import njit

PIECES = 32
"""Number of pieces that work is cut into: enough to balance a dozen cores, few enough to cost nothing on two."""

kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
"""Compiles a function for `parallel`; reassociation is off, so that sums have one order."""


_here = threading.local()


def _mark_worker() -> None:
    _here.inside = True


def parallel(work: Callable[[int], Any], pieces: Iterable[int]) -> list[Any]:
    """Runs `work` for each piece on as many threads as torch uses, and returns the results in order. A nested call runs
    its pieces one after the other, since all threads are busy."""
    threads = min(torch.get_num_threads(), os.cpu_count() or 1)
    if threads == 1 or getattr(_here, "inside", False):
        return [work(piece) for piece in pieces]
    with ThreadPoolExecutor(threads, initializer=_mark_worker) as pool:
        return list(pool.map(work, pieces))


def even_cuts(starts: Int64[np.ndarray, " n_plus_1"]) -> Int64[np.ndarray, " pieces_plus_1"]:
    """Cuts the rows of a compressed array into pieces with about equally many entries."""
    inner = np.searchsorted(starts, np.linspace(0, starts[-1], PIECES + 1)[1:-1])
    return np.concatenate(([0], inner, [len(starts) - 1]))
