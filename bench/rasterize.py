"""How fast differentiable rendering is, there and back, against the torch reference, and how exact, in one run.

    python bench/rasterize.py SCENE [--view 3] [--sparse 9]

Forward, backward and forward again alternate; every figure is a median, the reference's a single run. The reference
takes minutes with all Gaussians of a scene, so both are compared on every N-th of them.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from json_option import add_json_option, write_figures
from torch import Tensor

from gsencoder.data.scenes import load_scene
from gsencoder.data.seeding.seed import seed
from gsencoder.reconstruct.optimize import RowAdam, camera_of, parameters_from, rows_in_view
from gsencoder.render.rasterize import Raster, RasterConfig, rasterize
from gsencoder.types import Cameras, Gaussians

CPU, REFERENCE = RasterConfig(backend="cpu"), RasterConfig(backend="reference")


def leaves(gaussians: Gaussians, dtype: torch.dtype, every: int = 1) -> dict[str, Tensor]:
    made = {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "colors": 0.5 + 0.28 * gaussians.sh[:, 0],
    }
    return {name: torch.from_numpy(value[::every].copy()).to(dtype).requires_grad_() for name, value in made.items()}


def draw(inputs: dict[str, Tensor], cameras: Cameras, view: int, config: RasterConfig) -> Raster:
    dtype = inputs["means"].dtype
    pose, K = (torch.from_numpy(part[view]).to(dtype) for part in (cameras.cam_from_world, cameras.Ks))
    return rasterize(
        **inputs,
        cam_from_world=pose,
        K=K,
        width=int(cameras.widths[view]),
        height=int(cameras.heights[view]),
        config=config,
    )


def total(raster: Raster) -> Tensor:
    """A fixed functional of everything that is seen."""
    parts = [raster.rgb, raster.alpha, raster.depth]
    made = torch.Generator().manual_seed(0)
    return torch.stack([(part * torch.randn(part.shape, generator=made).to(part.dtype)).mean() for part in parts]).sum()


def there_and_back(inputs: dict[str, Tensor], drawn: Callable[..., Raster], runs: int) -> tuple[float, float]:
    """Median seconds of forward and of backward."""
    seconds = []
    for _ in range(runs):
        begun = time.perf_counter()
        loss = total(drawn(inputs))
        middle = time.perf_counter()
        torch.autograd.grad(loss, list(inputs.values()))
        seconds.append((middle - begun, time.perf_counter() - middle))
    forward, backward = np.median(seconds, axis=0)
    return float(forward), float(backward)


def adam_seconds(gaussians: Gaussians, cameras: Cameras, view: int) -> tuple[float, float, float]:
    """Median seconds that Adam takes for the rows in view, and for all; the share of rows in view."""
    raw = parameters_from(gaussians, 2)
    pose, _ = camera_of(cameras, view, "cpu")
    size = (int(cameras.widths[view]), int(cameras.heights[view]))
    rows = rows_in_view(raw, pose, torch.from_numpy(cameras.Ks[view]), *size, near=CPU.near, eps2d=CPU.eps2d)
    adam, rates = RowAdam(raw), dict.fromkeys(raw, 0.0)
    medians = []
    for chosen in (rows, torch.arange(len(gaussians))):
        grads = {name: torch.ones_like(value[chosen]) for name, value in raw.items()}
        seconds = []
        for _ in range(9):
            begun = time.perf_counter()
            adam.step(chosen, grads, rates)
            seconds.append(time.perf_counter() - begun)
        medians.append(float(np.median(seconds)))
    return medians[0], medians[1], len(rows) / len(gaussians)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--view", type=int, default=3)
    parser.add_argument("--sparse", type=int, default=9, help="the reference is compared on every N-th Gaussian")
    add_json_option(parser)
    options = parser.parse_args()
    scene = load_scene(options.scene)
    gaussians = scene.gaussians if scene.gaussians is not None else seed(scene)
    cameras, view = scene.views.cameras, options.view
    on_cpu = partial(draw, cameras=cameras, view=view, config=CPU)
    inputs = leaves(gaussians, torch.float32)
    there_and_back(inputs, on_cpu, 1)
    forward, backward = there_and_back(inputs, on_cpu, 9)
    size = f"{cameras.widths[view]}×{cameras.heights[view]}"
    print(f"{len(gaussians):,} Gaussians at {size}, {torch.get_num_threads()} threads")
    print(f"forward {forward:.3f} s, backward {backward:.3f} s, ratio {backward / forward:.2f}")

    exact = torch.autograd.grad(total(on_cpu(wide := leaves(gaussians, torch.float64))), list(wide.values()))
    found = torch.autograd.grad(total(on_cpu(inputs)), list(inputs.values()))
    errors = {}
    for name, value, truth in zip(inputs, found, exact, strict=True):
        seen = truth.reshape(len(truth), -1).norm(dim=1)
        error = (value - truth).reshape(len(truth), -1).norm(dim=1)[seen > 0]
        # A row's gradient is a sum of both signs, so it is judged against no less than a typical one.
        relative = error / seen[seen > 0].clamp(min=float(seen[seen > 0].median()))
        errors[name] = float(relative.median())
        far = relative > 1e-3
        rest = float(error[~far].norm() / seen[seen > 0][~far].norm())
        print(
            f"gradient of {name}: float32 differs from float64 by {float(relative.median()):.0e} in the median row, by "
            f"more than 1e-3 in {int(far.sum())} of {len(far)}, and by {rest:.0e} of the norm of all others"
        )

    in_view, all_rows, share = adam_seconds(gaussians, cameras, view)
    print(f"Adam: {in_view:.4f} s for the {share:.0%} of rows in view, {all_rows:.4f} s for all")

    few = leaves(gaussians, torch.float32, options.sparse)
    plain = partial(draw, cameras=cameras, view=view, config=REFERENCE)
    fast = sum(there_and_back(few, on_cpu, 5))
    slow = there_and_back(few, plain, 1)
    print(
        f"{len(few['means']):,} Gaussians: {fast:.3f} s there and back; torch reference {slow[0]:.1f} + {slow[1]:.1f} "
        f"s, ratio {sum(slow) / fast:.0f}"
    )
    seconds = {"forward": forward, "backward": backward, "backward / forward": backward / forward}
    write_figures(options.json, {**seconds, "reference / rasterizer": sum(slow) / fast, "median error": errors})


if __name__ == "__main__":
    main()
