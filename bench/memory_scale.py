"""Memories at the sizes of large scenes: a word over a million Gaussians of an index, and attention over a hundred
thousand components.

    python bench/memory_scale.py [--gaussians 1000000] [--components 100000]

The features are random. The index has 2,500 rows in a basis of rank 128, as the plush has; beside it the same features
as rows of their own. The attention, of 3,000 queries of 16 channels, runs forward and backward; its memory is that
which the process took beyond the bank, and all scores at once would take 3,000 × components × 4 bytes several times.
"""

import argparse
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from json_option import add_json_option, write_figures

from gsencoder.infer.relevancy import relevancy
from gsencoder.memory.attention import MemoryAttention
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures, MemoryBank

ROWS, RANK, CHANNELS = 2500, 128, 384
QUERIES, QUERY_CHANNELS = 3000, 16
SPACE = FeatureSpace(name="random", channels=CHANNELS)


def milliseconds(answer: Callable[[], object], repeats: int) -> float:
    """The median over some calls, after one that is not counted."""
    answer()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        answer()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds)


def words_over_gaussians(count: int) -> dict[str, float]:
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.standard_normal((CHANNELS, RANK)))[0].T
    basis = FeatureBasis(
        components=np.ascontiguousarray(axes, np.float32),
        mean=np.zeros(CHANNELS, np.float32),
        energy_kept=1.0,
        space=SPACE,
    )
    indexed = GaussianFeatures(
        features=rng.standard_normal((ROWS, RANK), np.float32),
        weights=np.ones(count, np.float32),
        mean=rng.standard_normal(CHANNELS, np.float32) / 10,
        space=SPACE,
        basis=basis,
        index=rng.integers(0, ROWS, count).astype(np.int32),
    )
    dense = replace(indexed, features=indexed.stored(), index=None)
    word, mean = rng.standard_normal((1, CHANNELS), np.float32), np.zeros(CHANNELS, np.float32)
    quick = milliseconds(lambda: relevancy(indexed, word, mean), 20)
    slow = milliseconds(lambda: relevancy(dense, word, mean), 3)
    print(
        f"a word over {count:,} Gaussians: index {quick:.1f} ms, rows of their own {slow:.0f} ms ({slow / quick:.0f} ×)"
    )
    return {"index, ms": quick, "rows / index": slow / quick}


def attention_over_components(count: int) -> dict[str, float]:
    rng = np.random.default_rng(0)
    bank = MemoryBank(
        components=rng.standard_normal((count, CHANNELS), np.float32),
        sources=np.zeros((count, 3), np.int32),
        grid_from_image=np.tile(np.eye(2, 3), (count, 1, 1)),
        mean=np.zeros(CHANNELS, np.float32),
        threshold=0.9,
        coverage=1.0,
        cosine=1.0,
        space=SPACE,
    )
    torch.manual_seed(0)
    projection = torch.randn(QUERY_CHANNELS, CHANNELS)
    attention = MemoryAttention(bank, projection, mean=bank.mean, scoring="centered", temperature=0.05)
    queries = torch.randn(QUERIES, QUERY_CHANNELS, requires_grad=True)
    before, start = resident_megabytes(), time.perf_counter()
    attention(queries).square().mean().backward()
    seconds, memory = time.perf_counter() - start, peak_megabytes() - before
    print(
        f"{QUERIES:,} queries over {count:,} components of {CHANNELS} channels, forward and backward: "
        f"{seconds:.1f} s, {memory:.0f} MB"
    )
    return {"attention, s": seconds, "attention, MB": memory}


def resident_megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def peak_megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--components", type=int, default=100_000)
    add_json_option(parser)
    arguments = parser.parse_args()
    figures = attention_over_components(arguments.components)
    write_figures(arguments.json, figures | words_over_gaussians(arguments.gaussians))


if __name__ == "__main__":
    main()
