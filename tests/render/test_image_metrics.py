"""PSNR and SSIM against their definitions, written out pixel by pixel."""

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from gsencoder.core.errors import InputError
from gsencoder.render.images import psnr, ssim, ssim_map


def pictures(height: int = 37, width: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    made = torch.Generator().manual_seed(0)
    first = torch.rand(height, width, 3, generator=made, dtype=torch.float64)
    return first, (first + 0.2 * torch.rand(height, width, 3, generator=made, dtype=torch.float64)).clamp(0, 1)


def ssim_by_scipy(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Wang et al. 2004, equation 13, with scipy's filters."""
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    taps /= taps.sum()

    def blur(a: np.ndarray) -> np.ndarray:
        return correlate1d(correlate1d(a, taps, axis=0), taps, axis=1)[5:-5, 5:-5]

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 1e-4, 9e-4
    return (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))


@pytest.mark.parametrize("size", [(11, 11), (37, 50), (74, 42), (12, 200)])
def test_ssim_is_that_of_the_definition(size: tuple[int, int]) -> None:
    x, y = pictures(*size)
    expected = np.stack([ssim_by_scipy(x[..., c].numpy(), y[..., c].numpy()) for c in range(3)], axis=-1)
    np.testing.assert_allclose(ssim_map(x, y).numpy(), expected, rtol=1e-9, atol=1e-12)


def test_ssim_has_the_gradient_of_finite_differences() -> None:
    x, y = pictures(12, 13)
    assert torch.autograd.gradcheck(lambda a: ssim(a, y), (x.requires_grad_(),), fast_mode=True)


def test_a_picture_is_like_itself_and_unlike_its_negative() -> None:
    x, _ = pictures()
    assert float(ssim(x, x)) == pytest.approx(1)
    assert float(ssim(x, 1 - x)) < 0


def test_ssim_with_a_mask_counts_the_windows_whose_middle_is_in_it() -> None:
    x, y = pictures()
    mask = torch.zeros(x.shape[:2], dtype=torch.bool)
    mask[20, 30] = mask[2, 2] = True  # The second is too near the border for a window.
    assert float(ssim(x, y, mask)) == pytest.approx(float(ssim_map(x, y)[15, 25].mean()))


def test_pictures_smaller_than_a_window_are_refused() -> None:
    with pytest.raises(InputError, match="at least 11 pixels"):
        ssim(*pictures(10, 40))


def test_psnr_of_a_known_error() -> None:
    x = torch.full((4, 5, 3), 0.5)
    assert psnr(x + 0.1, x) == pytest.approx(20, abs=1e-4)
    assert psnr(x, x) == 120
    mask = torch.zeros(4, 5, dtype=torch.bool)
    mask[0] = True
    y = x.clone()
    y[1:] = 0
    y[0] += 0.01
    assert psnr(y, x, mask) == pytest.approx(40, abs=1e-3)
