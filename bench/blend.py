"""How fast B is made and multiplied, against the plain reference and a dense loop, in one run.

    python bench/blend.py SCENE [--voxel 0.02] [--view 3]

Every figure is the median of several runs; ratios compare runs that alternate.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from json_option import add_json_option, write_figures

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import SeedConfig, seed
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.types import Cameras

RANK = 128
"""The largest rank that fusion takes by default."""


def timed(work: Callable[[], Any], runs: int = 5) -> tuple[float, Any]:
    work()
    seconds, result = [], None
    for _ in range(runs):
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds)), result


def enlarged(cameras: Cameras, factor: int) -> Cameras:
    return cameras.resized_to(cameras.widths * factor, cameras.heights * factor)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--voxel", type=float, default=0.02)
    parser.add_argument("--view", type=int, default=3)
    add_json_option(parser)
    options = parser.parse_args()
    scene = load_scene(options.scene)
    gaussians = seed(scene, SeedConfig(voxel=options.voxel))
    cameras = enlarged(scene.views.cameras, 2)
    size = f"{cameras.widths[options.view]}×{cameras.heights[options.view]}"
    print(f"{len(gaussians):,} Gaussians, view {options.view} at {size}, {torch.get_num_threads()} threads")

    seconds, b = timed(lambda: blend(gaussians, cameras, options.view))
    print(f"blend, pixels:            {seconds:.3f} s, {len(b.col) / b.rows:.1f} entries a row")
    reference = BlendConfig(backend="reference")
    slow, _ = timed(lambda: blend(gaussians, cameras, options.view, config=reference), runs=1)
    print(f"torch reference, pixels:  {slow:.3f} s, ratio {slow / seconds:.1f}")
    figures = {"gaussians": len(gaussians), "seconds": seconds, "entries a row": len(b.col) / b.rows}
    figures |= {"reference / Blend": slow / seconds}
    values = torch.from_numpy(np.random.default_rng(0).normal(size=(len(gaussians), 768)).astype(np.float32))
    coordinates, components = values[:, :RANK].contiguous(), values[:RANK].contiguous()
    for rays in (1, 4, 64, 196):
        config = BlendConfig(rays_per_patch=rays)
        made, p = timed(lambda config=config: blend(gaussians, cameras, options.view, patch=14, config=config))
        product, _ = timed(lambda p=p: p.render(values))
        decoded, _ = timed(lambda p=p: p.render(coordinates) @ components)
        transposing, _ = timed(lambda p=p: Blend.transposed.func(p))  # type: ignore[attr-defined]
        figures |= {
            f"{rays} rays: seconds": made,
            f"{rays} rays: 768 channels / making": product / made,
            f"{rays} rays: basis / making": decoded / made,
        }
        print(
            f"patches of 14, {rays:3d} rays:  {made:.3f} s, {len(p.col) / p.rows:.0f} entries a row; transpose "
            f"{transposing:.4f} s; 768 channels {product:.4f} s = {product / made:.0%} of making it, "
            f"{product / seconds:.0%} of the pixel blend; through a basis of rank {RANK} {decoded:.4f} s = "
            f"{decoded / made:.0%} of making it"
        )
    write_figures(options.json, figures)


if __name__ == "__main__":
    main()
