"""What gsplat is asked, and what becomes of its answer; a stand-in answers with the plain twin, in gsplat's shapes."""

import sys
from types import ModuleType

import pytest
import torch
from splats import front_camera, random_gaussians
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.render.rasterize import Raster, RasterConfig, rasterize, rasterize_gsplat


def stand_in(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float,
    eps2d: float,
    packed: bool,
    render_mode: str,
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
