"""Differentiable rendering: the kernels against their plain twin and finite differences, and both at the extremes."""

import sys
from types import ModuleType
from typing import Any

import pytest
import torch
from splats import front_camera, random_gaussians
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.render import blend
from gsencoder.render.rasterize import Raster, RasterConfig, rasterize, rasterize_gsplat
from gsencoder.types import Gaussians

Inputs = dict[str, Tensor]
CPU, REFERENCE = RasterConfig(backend="cpu"), RasterConfig(backend="reference")


def inputs_of(g: Gaussians, dtype: torch.dtype = torch.float64) -> Inputs:
    torch.manual_seed(0)
    made = {name: torch.from_numpy(getattr(g, name)) for name in ("means", "quats", "scales", "opacities")}
    made["colors"] = torch.rand(len(g), 3)
    return {name: value.to(dtype).requires_grad_() for name, value in made.items()}


def drawn(inputs: Inputs, config: RasterConfig, width: int = 61, height: int = 43) -> Raster:
    camera = front_camera(width, height)
    dtype = inputs["means"].dtype
    pose, K = (torch.from_numpy(part[0]).to(dtype) for part in (camera.cam_from_world, camera.Ks))
    return rasterize(**inputs, cam_from_world=pose, K=K, width=width, height=height, config=config)


def slopes(inputs: Inputs, config: RasterConfig) -> tuple[Raster, list[Tensor]]:
    """A view, and derivatives of a fixed random functional of all that it shows."""
    raster = drawn(inputs, config)
    weights = torch.Generator().manual_seed(1)
    total = torch.zeros((), dtype=inputs["means"].dtype)
    for part in (raster.rgb, raster.alpha, raster.depth):
        total = total + (part * torch.randn(part.shape, generator=weights, dtype=torch.float64).to(part.dtype)).sum()
    return raster, list(torch.autograd.grad(total, list(inputs.values())))


@pytest.mark.parametrize("log_scale", [-6.0, -1.0])
@pytest.mark.slow
def test_kernels_and_plain_twin_agree_in_values_and_gradients(log_scale: float) -> None:
    inputs = inputs_of(random_gaussians(200, log_scale=log_scale))
    fast, fast_slopes = slopes(inputs, CPU)
    plain, plain_slopes = slopes(inputs, REFERENCE)
    for actual, expected in zip([*fast[:3], *fast_slopes], [*plain[:3], *plain_slopes], strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-9 * float(expected.detach().abs().max()))


def test_gradients_in_float32_are_within_a_thousandth_of_those_in_float64() -> None:
    splat = random_gaussians(400)
    _, exact = slopes(inputs_of(splat), CPU)
    _, gradients = slopes(inputs_of(splat, torch.float32), CPU)
    for name, a, b in zip(inputs_of(splat), gradients, exact, strict=True):
        assert float((a.double() - b).norm() / b.norm()) < 1e-3, name


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences() -> None:
    # Soft and apart: no alpha comes near 1/255 or 0.999, no ray stops, no depths change places.
    splat = random_gaussians(4, seed=3, log_scale=0.7)
    inputs = inputs_of(splat)
    inputs["opacities"] = torch.tensor([0.3, 0.5, 0.7, 0.4], dtype=torch.float64, requires_grad=True)

    def draw(*values: Tensor) -> tuple[Tensor, ...]:
        raster = drawn(dict(zip(inputs, values, strict=True)), CPU, width=9, height=7)
        return raster.rgb, raster.alpha, raster.depth

    assert torch.autograd.gradcheck(draw, tuple(inputs.values()), eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)


def test_a_picture_is_what_the_blend_of_the_same_view_renders() -> None:
    splat = random_gaussians(300)
    inputs = inputs_of(splat, torch.float32)
    raster = drawn(inputs, CPU)
    b = blend(splat, front_camera())
    torch.testing.assert_close(raster.rgb.reshape(-1, 3), b.render(inputs["colors"]), atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(raster.alpha.reshape(-1), b.alpha, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(raster.depth.reshape(-1), b.render(b.depths), atol=1e-4, rtol=1e-4)


def test_a_rerun_gives_the_same_bits_whatever_the_number_of_threads() -> None:
    inputs = inputs_of(random_gaussians(300), torch.float32)
    before = torch.get_num_threads()
    runs = []
    try:
        for threads in (1, 2, 2):
            torch.set_num_threads(threads)
            raster, gradients = slopes(inputs, CPU)
            runs.append([*raster[:3], *gradients])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for run in runs[1:] for a, b in zip(runs[0], run, strict=True))


EXTREMES: dict[str, tuple[str, Any]] = {
    "behind": ("means", [0.0, 0.0, -1.0]),
    "on the camera": ("means", 0.0),
    "coincident": ("means", [0.0, 0.0, 2.0]),
    "far away": ("means", [0.0, 0.0, 1e6]),
    "needles": ("scales", [1e-6, 1e-6, 1.0]),
    "discs": ("scales", [1.0, 1.0, 1e-6]),
    "huge": ("scales", 1e4),
    "tiny": ("scales", 1e-9),
    "opaque": ("opacities", 1.0),
    "clear": ("opacities", 0.0),
    "zero quats": ("quats", 0.0),
}


@pytest.mark.parametrize("case", EXTREMES)
def test_pictures_and_gradients_stay_finite_at_the_extremes(case: str) -> None:
    changed, values = EXTREMES[case]
    inputs = {name: value.detach().clone() for name, value in inputs_of(random_gaussians(50), torch.float32).items()}
    inputs[changed][:] = torch.tensor(values)
    raster, gradients = slopes({name: value.requires_grad_() for name, value in inputs.items()}, CPU)
    assert all(bool(torch.isfinite(part).all()) for part in (*raster, *gradients))


def test_radii_are_zero_where_nothing_reaches_the_picture() -> None:
    inputs = {name: value.detach() for name, value in inputs_of(random_gaussians(20)).items()}
    inputs["means"][5, 2] = -1
    inputs["means"][6, 0] = 1e5
    radii = drawn(inputs, CPU).radii
    assert radii[5] == radii[6] == 0
    assert float(radii.max()) > 1


def test_a_backend_for_another_device_is_refused() -> None:
    with pytest.raises(InputError, match="gsplat cannot render tensors on cpu"):
        drawn(inputs_of(random_gaussians(2)), RasterConfig(backend="gsplat"))


def stand_in(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height, *, near_plane, eps2d, packed, render_mode
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    assert (viewmats.shape, Ks.shape, packed, render_mode) == ((1, 4, 4), (1, 3, 3), False, "RGB+D")
    config = RasterConfig(near=near_plane, eps2d=eps2d, backend="reference")
    raster = rasterize(means, quats, scales, opacities, colors, viewmats[0], Ks[0], width, height, config=config)
    rendered = torch.cat((raster.rgb, raster.depth.unsqueeze(-1)), dim=-1)
    radii = raster.radii.ceil().int()
    info = {"radii": torch.stack((radii, radii // 2), dim=-1)[None], "means2d": raster.means2d[None]}
    return rendered[None], raster.alpha[None, ..., None], info


def both(config: RasterConfig) -> tuple[Raster, Raster]:
    """A view through gsplat's stand-in, and the plain one."""
    g, camera = random_gaussians(80), front_camera()
    torch.manual_seed(0)
    inputs = [*map(torch.from_numpy, (g.means, g.quats, g.scales, g.opacities)), torch.rand(len(g), 3)]
    view = (torch.from_numpy(camera.cam_from_world[0]), torch.from_numpy(camera.Ks[0]), 61, 43)
    return rasterize_gsplat(*inputs, *view, config), rasterize(*inputs, *view, config=config)


@pytest.fixture
def gsplat(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("gsplat")
    module.rasterization = stand_in  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat", module)


@pytest.mark.usefixtures("gsplat")
@pytest.mark.parametrize("eps2d", [0.1, 0.3])
def test_the_knobs_reach_gsplat_and_its_answer_is_a_view(eps2d: float) -> None:
    rendered, expected = both(RasterConfig(eps2d=eps2d, near=0.3))
    for name in ("rgb", "alpha", "depth", "means2d"):
        torch.testing.assert_close(getattr(rendered, name), getattr(expected, name), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(rendered.radii, expected.radii.ceil())


@pytest.mark.usefixtures("gsplat")
def test_a_transmittance_that_gsplat_does_not_take_is_refused() -> None:
    with pytest.raises(InputError, match="gsplat ends rays at 0.0001 and takes no other value, got 0.001"):
        both(RasterConfig(stop_transmittance=1e-3))


def test_without_gsplat_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(InputError, match=r"pip install 'gsencoder\[gpu\]'"):
        both(RasterConfig())
