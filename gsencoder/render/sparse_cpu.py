"""Products of compressed sparse rows on a CPU, by which B renders and lifts."""

from typing import no_type_check

import numpy as np

from gsencoder.core.process import PIECES, even_cuts, kernel, parallel


@kernel
@no_type_check
def _transpose(crow, cols, weights, where, out_rows, out_weights):
    for row in range(len(crow) - 1):
        for e in range(crow[row], crow[row + 1]):
            at = where[cols[e]]
            where[cols[e]] = at + 1
            out_rows[at] = row
            out_weights[at] = weights[e]


def transpose(
    crow: np.ndarray, cols: np.ndarray, weights: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The columns that occur, and Bᵀ restricted to them as CSR: (columns, crow, row, weight)."""
    uses = np.bincount(cols, minlength=count)
    ends = np.cumsum(uses)
    out_rows, out_weights = np.empty(len(cols), np.int32), np.empty(len(cols), weights.dtype)
    _transpose(crow, cols, weights, ends - uses, out_rows, out_weights)
    columns = np.flatnonzero(uses)
    return columns, np.concatenate(([0], ends[columns])), out_rows, out_weights


@kernel
@no_type_check
def _product(first, last, crow, cols, weights, values, targets, out):
    for row in range(first, last):
        line = out[targets[row]]
        e, end = crow[row], crow[row + 1]
        # Four entries at a time: the line is read and written once for four sources, which is what limits the speed.
        while e + 4 <= end:
            w0, w1, w2, w3 = weights[e], weights[e + 1], weights[e + 2], weights[e + 3]
            s0, s1, s2, s3 = values[cols[e]], values[cols[e + 1]], values[cols[e + 2]], values[cols[e + 3]]
            for d in range(len(line)):
                line[d] = (((line[d] + w0 * s0[d]) + w1 * s1[d]) + w2 * s2[d]) + w3 * s3[d]
            e += 4
        while e < end:
            weight, source = weights[e], values[cols[e]]
            for d in range(len(line)):
                line[d] += weight * source[d]
            e += 1


@kernel
@no_type_check
def _product_of_one_channel(first, last, crow, cols, weights, values, targets, out):
    for row in range(first, last):
        total = out[targets[row], 0]
        for e in range(crow[row], crow[row + 1]):
            total += weights[e] * values[cols[e], 0]
        out[targets[row], 0] = total


def product(
    crow: np.ndarray, cols: np.ndarray, weights: np.ndarray, values: np.ndarray, targets: np.ndarray, out: np.ndarray
) -> None:
    """Adds row i of CSR @ values to out[targets[i]]; targets are distinct, so that threads never meet."""
    cuts = even_cuts(crow)
    run = _product_of_one_channel if values.shape[1] == 1 else _product
    if values.shape[1] * crow[-1] < 1 << 16:
        run(0, len(crow) - 1, crow, cols, weights, values, targets, out)
        return
    parallel(
        lambda piece: run(cuts[piece], cuts[piece + 1], crow, cols, weights, values, targets, out),
        range(PIECES),
    )


@kernel
@no_type_check
def add_codes(crow, cols, weights, codes, out):
    """Adds the weight of each entry to out[column, code of its row]: the transposed product with one_hot(codes), in the
    order of rows, without the transposed matrix. On one thread: so it takes a third of the time of transposing alone.
    """
    for row in range(len(crow) - 1):
        code = codes[row]
        if code >= 0:
            for e in range(crow[row], crow[row + 1]):
                out[cols[e], code] += weights[e]


@kernel
@no_type_check
def _count_between(first, last, crow, cols, depths, least, most, counts):
    for row in range(first, last):
        count = 0
        for e in range(crow[row], crow[row + 1]):
            z = depths[cols[e]]
            count += (z >= least[row]) & (z <= most[row])
        counts[row] = count


@kernel
@no_type_check
def _copy_between(first, last, crow, cols, weights, depths, least, most, starts, out_cols, out_weights):
    for row in range(first, last):
        at = starts[row]
        for e in range(crow[row], crow[row + 1]):
            z = depths[cols[e]]
            if z >= least[row] and z <= most[row]:
                out_cols[at] = cols[e]
                out_weights[at] = weights[e]
                at += 1


def keep_between(
    crow: np.ndarray, cols: np.ndarray, weights: np.ndarray, depths: np.ndarray, least: np.ndarray, most: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """CSR with only the entries whose column's depth lies from least[row] to most[row]: (crow, cols, weights)."""
    cuts = even_cuts(crow)
    starts = np.zeros(len(crow), np.int64)
    parallel(
        lambda piece: _count_between(cuts[piece], cuts[piece + 1], crow, cols, depths, least, most, starts[1:]),
        range(PIECES),
    )
    np.cumsum(starts, out=starts)
    out_cols, out_weights = np.empty(starts[-1], cols.dtype), np.empty(starts[-1], weights.dtype)
    parallel(
        lambda piece: _copy_between(
            cuts[piece], cuts[piece + 1], crow, cols, weights, depths, least, most, starts, out_cols, out_weights
        ),
        range(PIECES),
    )
    return starts, out_cols, out_weights
