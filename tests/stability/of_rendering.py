"""Blend and its products, depths, transmittance, the rasterizer and its gradients, lifting."""

from functools import cache

import numpy as np
import torch
from stability import oracles
from stability.extremes import NEAR, Case
from stability.of_geometry import tensors, view_of
from stability.registry import routine, worst

from gsencoder.fusion.lift import FeatureSums
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.rasterize import RasterConfig, rasterize
from gsencoder.types import FeatureMap, FeatureSpace

_oracles: dict[int, tuple[Case, np.ndarray, np.ndarray]] = {}


def weights_of(case: Case) -> np.ndarray:
    """The oracle's B of a case, which many routines are compared with."""
    if id(case) not in _oracles:
        _oracles[id(case)] = case, *oracles.blend(case.gaussians, case.cameras)
    return _oracles[id(case)][1]


def clear_of(case: Case) -> np.ndarray:
    """The pixels where no threshold of compositing is met within float32's rounding."""
    weights_of(case)
    return _oracles[id(case)][2]


def dense(b: Blend) -> np.ndarray:
    rows = torch.repeat_interleave(torch.arange(b.rows), b.crow.diff())
    made = np.zeros((b.rows, b.gaussians))
    np.add.at(made, (rows.numpy(), b.col.numpy()), b.weight.double().numpy())
    return made


@cache
def _blend_of(key: int, backend: str) -> Blend:
    case = _oracles[key][0]
    return blend(case.gaussians, case.cameras, config=BlendConfig(near=NEAR, backend=backend))  # type: ignore[arg-type]


def blend_of(case: Case, backend: str = "cpu") -> Blend:
    weights_of(case)
    return _blend_of(id(case), backend)


@routine("Blend (numba)", "splat", "camera")
def blend_error(case: Case) -> float:
    return worst(dense(blend_of(case)), weights_of(case), 1)


@routine("Blend (torch, float32)", "splat", "camera")
def reference_error(case: Case) -> float:
    clear = clear_of(case)
    return worst(dense(blend_of(case, "reference"))[clear], weights_of(case)[clear], 1)


@routine("transmittance: 1 − exp Σ log1p(−α)", "splat", "camera")
def alpha_error(case: Case) -> float:
    return worst(blend_of(case).alpha, weights_of(case).sum(axis=1), 1)


@routine("rendered values: B @ values", "splat", "camera", "vectors")
def render_error(case: Case) -> float:
    values = case.vectors if len(case.vectors) == len(case.gaussians) else np.ones((len(case.gaussians), 3), np.float32)
    want = weights_of(case) @ values.astype(oracles.Wide)
    scale = weights_of(case) @ np.abs(values).astype(oracles.Wide)
    return worst(blend_of(case).render(torch.from_numpy(values)), want, np.maximum(scale, 1e-6 * np.abs(values).max()))


@routine("expected and median depth", "splat", "camera")
def depth_error(case: Case) -> float:
    weights, b = weights_of(case), blend_of(case)
    depths = oracles.project(case.gaussians, case.cameras).depths
    alpha = weights.sum(axis=1)
    hit = alpha > 1e-3
    if not hit.any():
        return 0.0 if float(b.depth.abs().max()) == 0 else 1.0
    expected = (weights @ np.where(weights.max(axis=0) > 0, depths, 0))[hit] / alpha[hit]
    error = worst(b.depth.numpy()[hit], expected, expected)
    order = np.argsort(np.where(weights.max(axis=0) > 0, depths, np.inf), kind="stable")
    running = weights[:, order].cumsum(axis=1)
    medians, sorted_depths = b.median_depth.numpy(), depths[order]
    for row in np.flatnonzero(hit):
        low, high = (np.searchsorted(running[row], 0.5 + slack) for slack in (-1e-5, 1e-5))
        if high == len(order):
            error = max(error, 0.0 if medians[row] == 0 or running[row, -1] > 0.5 - 1e-5 else 1.0)
        else:
            least, most = sorted_depths[low], sorted_depths[high]
            error = max(error, float((least - medians[row]) / least), float((medians[row] - most) / most))
    return error


def raster(case: Case, dtype: torch.dtype, backend: str) -> tuple[list[torch.Tensor], torch.Tensor]:
    """Inputs with gradients, and [H, W, 5] pictures."""
    inputs = tensors(case.gaussians, dtype)
    colors = torch.from_numpy(np.random.default_rng(0).uniform(size=(len(case.gaussians), 3))).to(dtype)
    inputs = [each.requires_grad_() for each in (*inputs, colors)]
    config = RasterConfig(near=NEAR, backend=backend)  # type: ignore[arg-type]
    out = rasterize(*inputs, *view_of(case.cameras, dtype), config=config)
    return inputs, torch.cat((out.rgb, out.alpha[..., None], out.depth[..., None]), dim=2)


@routine("rasterizer, forward (numba, float32)", "splat", "camera")
def raster_error(case: Case) -> float:
    inputs, out = raster(case, torch.float32, "cpu")
    weights = weights_of(case)
    depths = oracles.project(case.gaussians, case.cameras).depths
    seen = np.where(weights.max(axis=0) > 0, depths, 0)
    values = np.concatenate([inputs[4].detach().numpy(), np.ones((len(seen), 1)), seen[:, None]], axis=1)
    want = weights @ values.astype(oracles.Wide)
    scale = np.array([1, 1, 1, 1, max(float(seen.max()), 1e-9)])
    clear = clear_of(case)
    return worst(out.detach().flatten(0, 1).numpy()[clear], want[clear], scale)


@routine("rasterizer, backward (numba, float32)", "splat", "camera", limits={"scale": (-8.0, 7.0)})
def gradient_error(case: Case) -> float:
    gradients = []
    for dtype, backend in ((torch.float32, "cpu"), (torch.float64, "reference")):
        inputs, out = raster(case, dtype, backend)
        wave = torch.sin(torch.arange(out.numel() // 5 * 4, dtype=torch.float64)).to(dtype).view(*out.shape[:2], 4)
        wave = wave * torch.from_numpy(clear_of(case)).view(*out.shape[:2], 1)
        (out[..., :4] * wave).sum().backward()
        gradients.append([each.grad if each.grad is not None else torch.zeros_like(each) for each in inputs])
    errors, turn = [], float((gradients[1][2] * torch.from_numpy(case.gaussians.scales)).abs().max())
    for number, (got, want) in enumerate(zip(*gradients, strict=True)):
        largest = max(float(want.abs().max()), turn if number == 1 else 0.0)
        if largest > 1e-30:
            errors.append(worst(got.double(), want.numpy(), largest))
        elif not bool(torch.isfinite(got).all()):
            errors.append(np.inf)
    return max(errors, default=0.0)


@routine("lift: Σ Bᵀ @ maps / Σ Bᵀ @ 1", "splat", "camera", "vectors")
def lift_error(case: Case) -> float:
    weights, b = weights_of(case), blend_of(case)
    rng = np.random.default_rng(0)
    cells = case.vectors[rng.integers(0, len(case.vectors), b.rows)]
    height, width = b.shape
    space = FeatureSpace(name="s", channels=cells.shape[1])
    grid = np.eye(2, 3)
    feature_map = FeatureMap(features=cells.reshape(height, width, -1), grid_from_image=grid, space=space)
    sums = FeatureSums(b.gaussians, space, None, None)
    for _ in range(3):
        sums.add(b, feature_map, None)
    features, got_weights = sums.finish()
    total = weights.sum(axis=0)
    rows = total > 1e-6
    want = (weights.T @ cells.astype(oracles.Wide))[rows] / total[rows, None]
    scale = np.linalg.norm(cells.astype(oracles.Wide), axis=1).max()
    return max(
        worst(features[rows], want, float(scale)),
        worst(got_weights[rows], 3 * total[rows], total[rows]) if rows.any() else 0.0,
        0.0 if np.isfinite(features).all() else np.inf,
    )
