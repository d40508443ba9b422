"""How CPU kernels are compiled and run: numba functions without the GIL, called from a pool of Python threads.

Threads rather than numba's parallel loops: an OpenMP pool aborts a process that was forked after its first use, which
data loaders do. Work is cut into pieces whose results do not depend on how many threads there are, so neither do the
bits.
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
"""Work is cut into so many pieces: enough to balance a dozen cores, few enough to cost nothing on two."""

kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "nsz"})
"""Compiles a function that parallel() may run; reassociation stays off, so sums have one order."""


_here = threading.local()


def _enter() -> None:
    _here.inside = True


def parallel(work: Callable[[int], Any], pieces: Iterable[int]) -> list[Any]:
    """Runs `work` for each piece on as many threads as torch uses; results in order. Work that calls this again does
    its own pieces one after the other: the threads are taken."""
    threads = min(torch.get_num_threads(), os.cpu_count() or 1)
    if threads == 1 or getattr(_here, "inside", False):
        return [work(piece) for piece in pieces]
    with ThreadPoolExecutor(threads, initializer=_enter) as pool:
        return list(pool.map(work, pieces))


def even_cuts(starts: Int64[np.ndarray, " n_plus_1"]) -> Int64[np.ndarray, " pieces_plus_1"]:
    """Cuts a compressed array into pieces of about as many entries each."""
    inner = np.searchsorted(starts, np.linspace(0, starts[-1], PIECES + 1)[1:-1])
    return np.concatenate(([0], inner, [len(starts) - 1]))
