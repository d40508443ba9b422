"""What the choices that were made for CPUs are worth: each ratio is of two ways, taken in turn in one run.

    python bench/cpu.py [--gaussians 15000] [--rounds 12]

heap: training steps of ever new sizes in a process that keeps what it frees, and in one that does not; and a forward
pass of 200,000 Gaussians in float32. rounding: steps with plans whose sizes are rounded up, and not, in bfloat16.
attention: forward and backward of attention in bfloat16 and in float32. order: the 3³ convolution with tokens in Morton
order, and shuffled.
"""

import argparse
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from encoder import CHANNELS, surface
from json_option import add_json_option, write_figures
from torch.nn import functional

from gsencoder.app.commands.train import TrainCommandConfig
from gsencoder.app.compose import compose
from gsencoder.core.process import retain_freed_memory
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs
from gsencoder.models.grid import morton_codes
from gsencoder.models.neighbors import NeighborConv, neighbor_table
from gsencoder.models.plan import grid_coords, join_plans
from gsencoder.train.losses import LossConfig, match_loss


def steps(gaussians: int, rounds: int, *, round_up: bool) -> float:
    """Median seconds of training steps of sizes that never occur twice."""
    config = compose("train", TrainCommandConfig, ["scene"])
    encoder = GaussianEncoder(config.model, CHANNELS).train()
    whole, found = surface(2 * gaussians), []
    for turn in range(rounds):
        splat = whole.select(np.arange(gaussians + 37 * turn))
        attributes, opacities, cloud = encoder_inputs(splat, config.model, config.model.voxel)
        plan = join_plans([cloud], config.model.transformer.patch, round_up=round_up)
        start = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16):
            out = encoder(attributes, opacities, plan)
        match_loss(out, torch.ones_like(out), LossConfig()).mean().backward()
        found.append(time.perf_counter() - start)
        encoder.zero_grad()
    return float(np.median(found[2:]))


def forward(gaussians: int, rounds: int) -> float:
    """Fastest of some forward passes in float32."""
    config = compose("train", TrainCommandConfig, ["scene"])
    encoder = GaussianEncoder(config.model, CHANNELS).eval()
    attributes, opacities, cloud = encoder_inputs(surface(gaussians), config.model, config.model.voxel)
    plan, found = encoder.join([cloud]), []
    with torch.inference_mode():
        for _ in range(rounds):
            start = time.perf_counter()
            encoder(attributes, opacities, plan)
            found.append(time.perf_counter() - start)
    return min(found[1:])


def in_turn(first: Callable[[], object], second: Callable[[], object], rounds: int) -> float:
    """How many times as long the first takes as the second: the median over turns."""
    ratios = []
    for _ in range(rounds):
        spent = []
        for run in (first, second):
            start = time.perf_counter()
            run()
            spent.append(time.perf_counter() - start)
        ratios.append(spent[0] / spent[1])
    return float(np.median(ratios[1:]))


def attention(dtype: torch.dtype) -> Callable[[], None]:
    """Forward and backward of attention in 120 patches of 128, two heads of 32."""
    q, k, v = (torch.randn(120, 2, 128, 32, dtype=dtype, requires_grad=True) for _ in range(3))
    return lambda: functional.scaled_dot_product_attention(q, k, v).sum().backward()


def convolution(gaussians: int, *, shuffled: bool) -> Callable[[], torch.Tensor]:
    """The 3³ convolution of 64 channels over the tokens of a surface."""
    cells = torch.unique(grid_coords(torch.from_numpy(surface(gaussians).means), 0.02), dim=0)
    order = torch.randperm(len(cells)) if shuffled else torch.argsort(morton_codes(cells))
    cells = cells[order]
    layer, x, table = NeighborConv(64, 64), torch.randn(len(cells), 64), neighbor_table(cells)

    def run() -> torch.Tensor:
        with torch.inference_mode():
            return layer(x, table)

    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=15_000)
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--only", default="", help="heap, forward or rounding, -on or -off: its seconds")
    add_json_option(parser)
    chosen = parser.parse_args()
    if chosen.only:
        if chosen.only not in ("heap-off", "forward-off"):
            retain_freed_memory()
        if chosen.only.startswith("forward"):
            print(forward(200_000, 5))
            return
        print(steps(chosen.gaussians, chosen.rounds, round_up=chosen.only != "rounding-off"))
        return
    own = [sys.executable, __file__, f"--gaussians={chosen.gaussians}", f"--rounds={chosen.rounds}"]
    told = {"heap": "a step without the heap", "forward": "a forward without it", "rounding": "a step without rounding"}
    figures = {}
    for choice, text in told.items():
        ratios = []
        for _ in range(3):
            off, on = (
                float(subprocess.run([*own, f"--only={choice}-{way}"], check=True, capture_output=True).stdout)
                for way in ("off", "on")
            )
            ratios.append(off / on)
        figures[choice] = np.median(ratios)
        print(f"{choice}: {text} takes {np.median(ratios):.2f} times as long", flush=True)
    retain_freed_memory()
    ratio = in_turn(attention(torch.bfloat16), attention(torch.float32), chosen.rounds)
    figures["attention"] = ratio
    print(f"attention: forward and backward in bfloat16 take {ratio:.2f} times as long as in float32")
    for size in (chosen.gaussians, 20 * chosen.gaussians):
        ratio = in_turn(convolution(size, shuffled=True), convolution(size, shuffled=False), chosen.rounds)
        print(f"order: the convolution over {size:,} shuffled tokens {ratio:.2f} times as long as in Morton order")
        figures[f"order, {size}"] = ratio
    write_figures(chosen.json, figures)


if __name__ == "__main__":
    main()
