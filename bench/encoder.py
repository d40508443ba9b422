"""What an encoder costs: time and memory by size, against its matrix products alone, and its plan.

    python bench/encoder.py [--model tiny|small|base] [--sizes 10000,100000] [--precision float32|bfloat16]
    python bench/encoder.py --chunked 1000000 [--chunk 250000]

Splats are seeds of a long random floor with things on it, at the spacing that the encoder's grid expects. Every figure
is the best of several runs in this process; ratios are of times taken in turn.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from json_option import add_json_option, write_figures
from torch.utils._python_dispatch import TorchDispatchMode

from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.device import autocast_dtype
from gsencoder.core.process import retain_freed_memory
from gsencoder.infer.encode import EncodeConfig, Encoder
from gsencoder.infer.torch_network import TorchNetwork
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs
from gsencoder.models.output_space import OutputSpace, OutputSpaces
from gsencoder.models.plan import plan_cloud
from gsencoder.models.transformer import (
    _append_zero_row,
    _by_cells,
    _gather_neighborhoods,
    _pairs_by_cell,
    _row_blocks,
)
from gsencoder.types import FeatureSpace, Gaussians

CHANNELS = 64
PRODUCTS = ("mm", "addmm", "bmm", "_scaled_dot_product_flash_attention_for_cpu", "scaled_dot_product_attention")


def surface(count: int, voxel: float = 0.02) -> Gaussians:
    """A floor of one Gaussian a cell, with boxes on it: as many neighbors as scans of rooms have."""
    rng = np.random.default_rng(0)
    side = int(np.sqrt(count / 1.6)) + 1
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    height = np.zeros((side, side))
    for _ in range(max(1, side * side // 900)):
        i, j, w, h = rng.integers(0, side), rng.integers(0, side), rng.integers(4, 16), rng.integers(3, 25)
        height[i : i + w, j : j + w] = h
    points = [np.stack((x, y, height), axis=-1).reshape(-1, 3)]
    for axis in range(2):
        step = np.diff(height, axis=axis, append=0)
        for i, j in np.argwhere(np.abs(step) > 1):
            low, high = sorted((height[i, j], height[i, j] + step[i, j]))
            levels = np.arange(low + 1, high)
            points.append(np.stack((np.full(len(levels), i), np.full(len(levels), j), levels), axis=-1))
    means = np.concatenate(points)[:count]
    means = ((means + rng.uniform(0.2, 0.8, means.shape)) * voxel).astype(np.float32)
    n = len(means)
    quats = rng.normal(size=(n, 4))
    return Gaussians(
        means=means,
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.tile(np.array([0.011, 0.011, 0.0011], np.float32), (n, 1)),
        opacities=np.full(n, 0.95, np.float32),
        sh=rng.normal(size=(n, 1, 3)).astype(np.float32),
    )


def best(run: Callable[[], Any], times: int = 5) -> float:
    """Seconds of the fastest of several runs, after one that is not counted."""
    run()
    found = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        found.append(time.perf_counter() - start)
    return min(found)


def peak_gib() -> float:
    """Most memory that this process has had, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2


class Recorded(TorchDispatchMode):
    """Notes the matrix products of a forward pass, so that they can be done again alone."""

    def __init__(self) -> None:
        super().__init__()
        self.products: list[tuple[Any, tuple[Any, ...], dict[str, Any]]] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = function.overloadpacket.__name__
        if name == "convolve":
            x, neighbors, weight = args
            padded, whole = _append_zero_row(x), weight.flatten(0, 1)
            for rows in _row_blocks(len(x), x.device):
                if _by_cells(x):
                    _, cells, counts = _pairs_by_cell(neighbors[rows], len(x))
                    parts = zip(x[cells].split(counts), weight, strict=True)
                    self.products += [(torch.mm, part, {}) for part in parts]
                else:
                    self.products.append((torch.mm, (_gather_neighborhoods(padded, neighbors[rows]), whole), {}))
        if name in PRODUCTS:

            def copy(value: Any) -> Any:
                return value.detach().clone() if isinstance(value, torch.Tensor) else value

            own = {key: copy(value) for key, value in (kwargs or {}).items()}
            self.products.append((function, tuple(copy(value) for value in args), own))
        return function(*args, **(kwargs or {}))


def measure(config: TrainCommandConfig, size: int, precision: str) -> dict[str, float]:
    """The figures of one size."""
    splat = surface(size)
    encoder = GaussianEncoder(config.model, CHANNELS).eval()
    dtype = autocast_dtype(precision, torch.device("cpu"))  # type: ignore[arg-type]
    voxel = config.model.voxel

    def inputs() -> Any:
        return encoder_inputs(splat, config.model, voxel)

    attributes, opacities, cloud = inputs()
    joined = encoder.join([cloud])

    def forward() -> None:
        with torch.inference_mode(), torch.autocast("cpu", dtype, enabled=dtype is not None):
            encoder(attributes, opacities, joined)

    seconds: dict[str, float] = {"gaussians": len(splat), "tokens": len(joined.counts), "before_gib": peak_gib()}
    seconds["forward"] = best(forward)
    seconds["peak_gib"] = peak_gib()
    recorded = Recorded()
    with torch.no_grad(), torch.autocast("cpu", dtype, enabled=dtype is not None), recorded:
        encoder(attributes, opacities, joined)

    def products() -> None:
        with torch.inference_mode():
            for function, args, kwargs in recorded.products:
                function(*args, **kwargs)

    # In turn with what they are held against.
    seconds["products"] = best(products)
    seconds["forward"] = min(seconds["forward"], best(forward))
    means, shape = torch.from_numpy(splat.means), config.model.transformer

    def planned() -> None:
        encoder.join([plan_cloud(means, voxel, levels=shape.levels, orders=shape.orders)])

    seconds["plan"] = best(planned)
    seconds["inputs"] = best(inputs) - seconds["plan"]
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="tiny")
    parser.add_argument("--sizes", default="10000,30000,100000,300000")
    parser.add_argument("--precision", default="float32", choices=["float32", "bfloat16"])
    parser.add_argument("--one", type=int, default=0, help="one size, its figures as JSON")
    parser.add_argument("--patch", type=int, default=0)
    parser.add_argument("--chunked", type=int, default=0)
    parser.add_argument("--chunk", type=int, default=250_000)
    add_json_option(parser)
    chosen = parser.parse_args()
    retain_freed_memory()
    config = compose("train", TrainCommandConfig, ["scene", f"model={chosen.model}"])
    if chosen.patch:
        shape = replace(config.model.transformer, patch=chosen.patch)
        config = replace(config, model=replace(config.model, transformer=shape))
    if chosen.chunked:
        splat = surface(chosen.chunked)
        space = FeatureSpace(name="s", channels=CHANNELS)
        outputs = OutputSpaces(
            by_teacher={"s": OutputSpace(space=space, mean=np.zeros(CHANNELS, np.float32), scale=1.0)}
        )
        start = time.perf_counter()
        encoder = Encoder(TorchNetwork(GaussianEncoder(config.model, CHANNELS), outputs))
        encoder.encode(splat, EncodeConfig(chunk=chosen.chunk, precision=chosen.precision))
        took = time.perf_counter() - start
        print(f"{len(splat):,} Gaussians in chunks of {chosen.chunk:,}: {took:.1f} s, {peak_gib():.2f} GiB at most")
        return
    if chosen.one:
        print(json.dumps(measure(config, chosen.one, chosen.precision)))
        return
    rows = []
    for size in map(int, chosen.sizes.split(",")):
        # A process for each, whose peak of memory is its own.
        done = subprocess.run([sys.executable, *sys.argv, f"--one={size}"], check=True, capture_output=True, text=True)
        row = json.loads(done.stdout)
        rows.append(row)
        print(
            f"{row['gaussians']:>9,} Gaussians {row['tokens']:>9,} tokens: products {row['products']:.3f} s, forward "
            f"{row['forward']:.3f} s ({row['forward'] / row['products']:.2f}×), plan {row['plan']:.3f} s "
            f"({row['plan'] / row['forward']:.1%} of the forward), attributes {row['inputs']:.3f} s, memory "
            f"{row['before_gib']:.2f} GiB before and {row['peak_gib']:.2f} GiB at most",
            flush=True,
        )
    figures = {
        row["gaussians"]: {
            "forward": row["forward"],
            "forward / products": row["forward"] / row["products"],
            "plan / forward": row["plan"] / row["forward"],
            "peak GiB": row["peak_gib"],
        }
        for row in rows
    }
    write_figures(chosen.json, figures)
    if len(rows) > 1:
        tokens = np.array([row["tokens"] for row in rows])
        forward = np.array([row["forward"] for row in rows])
        memory = np.array([row["peak_gib"] - row["before_gib"] for row in rows])
        exponent = np.polyfit(np.log(tokens), np.log(forward), 1)[0]
        print(
            f"forward grows as tokens^{exponent:.2f}, {np.polyfit(tokens, forward, 1)[0] * 1e6:.2f} µs a token; memory "
            f"by {np.polyfit(tokens, memory, 1)[0] * 1024**2:.1f} KiB a token"
        )


if __name__ == "__main__":
    main()
