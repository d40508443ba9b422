"""Parts of `bench/gpu.py` that blend and rasterize: each is held against the CPU and yields rows of figures."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from fixed_teachers import EXACT, CodedTeacher, make_scene
from gpu_measure import Row, Setting, Skipped, compared, measured
from splats import front_camera, random_gaussians

from gsencoder.fusion.fuse import fuse
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.render.rasterize import RasterConfig, rasterize
from gsencoder.train.losses import LossConfig, contrast_loss, field_loss, render_loss


def blend_parity(setting: Setting) -> Iterator[Row]:
    """B by torch on the device against numba: values, lift, gradients, bits of a second run; and a whole fusion.

    Two orders of summation put an alpha near 1/255, or the transmittance at which a ray ends, on either side of its
    threshold, which moves a ray by 1/255 of a value at most: hence a limit for the largest and one for the mean error.
    """
    count, size = (400, (61, 43)) if setting.small else (200_000, (640, 480))
    splat, camera = random_gaussians(count, log_scale=-2.5 if setting.small else -4.5), front_camera(*size, size[0])
    for rays, patch in ((1, None), (16, 8)):
        config = BlendConfig(rays_per_patch=rays, backend="torch")
        what = f"torch, {'pixels' if patch is None else 'patches'}"
        fast = blend(splat, camera, patch=patch, config=replace(config, backend="cpu"))
        row: Row = {"what": what}
        blend(splat, camera, patch=patch, config=config, device=setting.device)
        with measured(setting, row):
            made = blend(splat, camera, patch=patch, config=config, device=setting.device)
        again = blend(splat, camera, patch=patch, config=config, device=setting.device)
        for name in ("crow", "col", "weight"):
            assert torch.equal(getattr(made, name), getattr(again, name)), f"a second run gives another {name}"
        yield row | {"entries": len(made.col), "entries of numba": len(fast.col)}
        yield from product_rows(made, fast, 5e-3, 1e-4)
    scene = make_scene(150)
    codes = [np.random.default_rng(view).integers(-1, 7, (24, 32)).astype(np.int32) for view in range(5)]
    teacher = CodedTeacher(codes, np.random.default_rng(0).normal(size=(7, 6)).astype(np.float32))
    there = fuse(scene, teacher, replace(EXACT, blend=BlendConfig(backend="torch")), device=setting.device).features
    here = fuse(scene, teacher, EXACT, device="cpu").features
    seen = torch.from_numpy(here.weights > 1e-3)
    yield compared("fused weights", torch.from_numpy(there.weights), torch.from_numpy(here.weights), 1e-4)
    features = [torch.from_numpy(each.features)[seen] for each in (there, here)]
    yield compared("fused features", features[0], features[1], 1e-3)


def product_rows(made: Blend, expected: Blend, most: float, most_mean: float) -> Iterator[Row]:
    """Products of two blends of one view, and the gradients of them."""
    device, generator = made.weight.device, torch.Generator().manual_seed(0)
    values = torch.randn(expected.gaussians, 8, generator=generator)
    maps = torch.randn(expected.rows, 8, generator=generator)
    ours, theirs = (values.clone().to(to).requires_grad_() for to in (device, "cpu"))
    rendered = made.render(ours), expected.render(theirs)
    for each in rendered:
        (each * maps.to(each.device)).sum().backward()
    assert ours.grad is not None
    assert theirs.grad is not None
    yield compared("render", rendered[0], rendered[1], most, most_mean)
    yield compared("lift", made.lift(maps.to(device)), expected.lift(maps), most, most_mean)
    yield compared("gradient of render", ours.grad, theirs.grad, most, most_mean)


def sparse_products(setting: Setting) -> Iterator[Row]:
    """The same matrix multiplied by numba and on the device: sums in another order."""
    made = blend(random_gaussians(400 if setting.small else 50_000), front_camera(160, 120, 130.0))
    moved = Blend(made.crow, made.col, made.weight, made.depths, made.lattice, made.config)
    moved = moved.to(setting.device)
    moved.config = replace(moved.config, backend="torch")
    yield from product_rows(moved, made, 1e-5, 1e-5)
    codes = torch.from_numpy(np.random.default_rng(0).integers(-1, 9, made.rows).astype(np.int32))
    sums = [torch.zeros(made.gaussians, 9, device=device) for device in (setting.device, "cpu")]
    moved.lift_codes_into(codes.to(setting.device), sums[0])
    made.lift_codes_into(codes, sums[1])
    yield compared("lift of codes", sums[0], sums[1], 1e-5)


def losses(setting: Setting) -> Iterator[Row]:
    """Terms of the loss and their gradients in float32 on the device, against float64 on the CPU."""
    view, generator = blend(random_gaussians(300), front_camera(), patch=6), torch.Generator().manual_seed(0)
    predicted, target = (torch.randn(300, 8, generator=generator) for _ in range(2))
    codes, book = torch.randint(0, 5, (300,), generator=generator), torch.randn(5, 8, generator=generator)
    cells, config = torch.randn(view.rows, 8, generator=generator), LossConfig()
    terms: dict[str, Callable[[torch.Tensor, torch.device, torch.dtype], torch.Tensor]] = {
        "field": lambda x, d, t: field_loss(x, target.to(d, t), torch.ones(300, device=d, dtype=t), config),
        "contrast": lambda x, d, t: contrast_loss(
            x, codes.to(d), torch.ones(300, device=d, dtype=t), book.to(d, t), config
        ),
        "render": lambda x, d, t: render_loss(
            x, _typed(view, d, t), cells.to(d, t), torch.ones(view.rows, device=d, dtype=t), config
        ),
    }
    for name, term in terms.items():
        made = []
        for device, dtype in ((setting.device, torch.float32), (torch.device("cpu"), torch.float64)):
            x = predicted.clone().to(device, dtype).requires_grad_()
            value = term(x, device, dtype)
            value.backward()
            made.append((value, x.grad))
        yield compared(name, made[0][0], made[1][0], 1e-4)
        yield compared(f"gradient of {name}", made[0][1], made[1][1], 1e-3)  # type: ignore[arg-type]


def _typed(view: Blend, device: torch.device, dtype: torch.dtype) -> Blend:
    made = Blend(view.crow, view.col, view.weight.to(dtype), view.depths.to(dtype), view.lattice, view.config)
    return made.to(device)


def gsplat_parity(setting: Setting) -> Iterator[Row]:
    """gsplat's rasterizer against numba's, values and gradients; 200 steps of Adam on the colors of a small scene."""
    if not setting.cuda:
        raise Skipped("no CUDA device")
    try:
        import gsplat  # type: ignore[import-not-found] # noqa: F401
    except ImportError as error:
        raise Skipped("package missing: gsplat (pip install 'gsencoder[gpu]')") from error
    splat, camera = random_gaussians(3000, log_scale=-3.0), front_camera(160, 120, 130.0)
    names = ("means", "quats", "scales", "opacities")
    made = []
    for device in (setting.device, torch.device("cpu")):
        inputs = [torch.from_numpy(getattr(splat, name)).to(device).requires_grad_() for name in names]
        inputs.append(torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_())
        view = [torch.from_numpy(each[0]).to(device) for each in (camera.cam_from_world, camera.Ks)]
        raster = rasterize(*inputs, *view, 160, 120, config=RasterConfig())  # type: ignore[arg-type]
        (raster.rgb.square().sum() + raster.alpha.sum()).backward()
        made.append((raster, inputs, view))
    for name in ("rgb", "alpha", "depth"):
        yield compared(name, getattr(made[0][0], name), getattr(made[1][0], name), 1e-2)
    for name, one, other in zip((*names, "colors"), made[0][1], made[1][1], strict=True):
        yield compared(f"gradient of {name}", one.grad, other.grad, 5e-2)
    raster, inputs, view = made[0]
    goal, still = raster.rgb.detach(), [each.detach() for each in inputs[:4]]
    colors = torch.full_like(inputs[4], 0.5).requires_grad_()
    adam, row = torch.optim.Adam([colors], lr=0.02), {"what": "200 steps"}
    errors = []
    with measured(setting, row):
        for _ in range(200):
            adam.zero_grad()
            error = (rasterize(*still, colors, *view, 160, 120, config=RasterConfig()).rgb - goal).square().mean()
            error.backward()
            adam.step()
            errors.append(float(error.detach()))
    assert errors[-1] < errors[0] / 20, f"the error fell from {errors[0]:.2e} to {errors[-1]:.2e} alone"
    yield row | {"first": errors[0], "last": errors[-1]}
