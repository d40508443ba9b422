"""Masks folded into queries and keys, as on a GPU in half precision, against masks as an argument of attention."""

from functools import cache

import numpy as np
import pytest
import torch
from splats import random_gaussians
from torch.nn import functional

from gsencoder.models.blocks import PatchAttention, attend_folded
from gsencoder.models.encoder import GaussianEncoder, encoder_inputs
from gsencoder.models.weights import load_weights
from gsencoder.types import Gaussians

TOLERANCE = {torch.float64: 1e-12, torch.float32: 2e-6, torch.bfloat16: 2e-2, torch.float16: 2e-3}


@pytest.mark.parametrize("size", [1.0, 300.0], ids=["usual scores", "scores of ten thousands"])
@pytest.mark.parametrize("dtype", TOLERANCE)
def test_a_folded_mask_gives_the_values_and_gradients_of_a_mask(dtype: torch.dtype, size: float) -> None:
    torch.manual_seed(0)
    if dtype == torch.float16:
        size = min(size, 20.0)  # Larger scores are beyond its range, masked or not.
    q, k, v = (torch.randn(5, 2, 9, 16, dtype=torch.float64).mul(scale) for scale in (size, size, 1.0))
    mask = torch.rand(5, 1, 1, 9) < 0.6
    mask[..., 0], mask[3] = True, True
    # In half precision both are asked for what was rounded already.
    inputs = [each.to(dtype).requires_grad_() for each in (q, k, v)]
    exact = [each.detach().double().requires_grad_() for each in inputs]
    folded = attend_folded(*inputs, mask)
    expected = functional.scaled_dot_product_attention(*exact, attn_mask=mask)
    torch.testing.assert_close(folded.double(), expected, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])
    if size > 1:
        return
    toward = torch.randn_like(expected)
    folded.backward(toward.to(dtype))
    expected.backward(toward)
    for one, other in zip(inputs, exact, strict=True):
        assert one.grad is not None
        torch.testing.assert_close(one.grad.double(), other.grad, rtol=5 * TOLERANCE[dtype], atol=5 * TOLERANCE[dtype])


@cache
def splat() -> Gaussians:
    """Gaussians with so many tokens that patches are padded."""
    return random_gaussians(700, log_scale=-4.0)


def outputs_of(encoder: GaussianEncoder, folds: bool | None) -> torch.Tensor:
    attributes, opacities, cloud = encoder_inputs(splat(), encoder.config, 0.1)
    plan = encoder.join([cloud])
    assert any(level.attn_mask is not None for level in plan.levels)
    for module in encoder.modules():
        if isinstance(module, PatchAttention):
            module.folds_mask = folds
    with torch.inference_mode():
        return encoder(attributes, opacities, plan)


@pytest.mark.parametrize("name", ["house", "house_cpu"])
def test_shipped_encoders_give_the_same_with_masks_folded(name: str) -> None:
    encoder = load_weights(name)[0].eval()
    masked, folded = outputs_of(encoder, False), outputs_of(encoder, True)
    assert float(masked.std()) > 0.1
    torch.testing.assert_close(folded, masked, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(outputs_of(encoder, None), masked)
