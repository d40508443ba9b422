"""The losses, in closed form and at their ends."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from splats import dense, front_camera, random_gaussians

from gsencoder.core.errors import InputError
from gsencoder.render import blend
from gsencoder.train.losses import AdapterHead, LossConfig, contrast_loss, field_loss, match_loss, render_loss

CONFIG = LossConfig()


def typical(count: int, channels: int = 8, seed: int = 0) -> torch.Tensor:
    """Targets of typical length: √channels."""
    vectors = torch.randn(count, channels, generator=torch.Generator().manual_seed(seed))
    return vectors / vectors.norm(dim=1, keepdim=True) * channels**0.5


def equation_three(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """L_match(x, y) of each row as SplatDistill prints it: α(1 − cos(x, y)) + β · smooth L1, averaged over channels."""
    cosines = (x * y).sum(axis=1) / (np.linalg.norm(x, axis=1) * np.linalg.norm(y, axis=1))
    difference = np.abs(x - y)
    smooth = np.where(difference < 1, 0.5 * difference**2, difference - 0.5)
    return np.asarray(0.9 * (1 - cosines) + 0.1 * smooth.mean(axis=1))


@pytest.mark.parametrize("size", [0.01, 1.0, 30.0])
def test_without_confidence_the_matching_loss_is_equation_three_for_targets_of_any_length(size: float) -> None:
    config = replace(CONFIG, confidence=False)
    target = torch.randn(7, 8, generator=torch.Generator().manual_seed(1)) * size
    predicted = torch.randn(7, 8, generator=torch.Generator().manual_seed(2), requires_grad=True)
    loss = match_loss(predicted, target, config)
    x, y = predicted.detach().double().numpy(), target.double().numpy()
    np.testing.assert_allclose(loss.detach().numpy(), equation_three(x, y), rtol=1e-5)
    (gradient,) = torch.autograd.grad(loss.sum(), [predicted])
    step = 1e-6
    for row, channel in np.ndindex(x.shape):
        moved = np.zeros_like(x)
        moved[row, channel] = step
        slope = (equation_three(x + moved, y) - equation_three(x - moved, y)).sum() / (2 * step)
        assert gradient[row, channel].item() == pytest.approx(slope, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 1.0, 3.0])
def test_near_the_mean_the_direction_counts_in_proportion_and_beyond_it_not_more(share: float) -> None:
    target, predicted = typical(4) * share, torch.randn(4, 8)
    config = replace(CONFIG, cosine=1.0, smooth_l1=0.0)
    cosines = torch.nn.functional.cosine_similarity(predicted, typical(4), dim=1)
    torch.testing.assert_close(match_loss(predicted, target, config), (1 - cosines) * min(1, share), atol=1e-5, rtol=0)


def test_gaussians_that_were_never_seen_neither_cost_nor_learn() -> None:
    predicted = torch.randn(5, 8, requires_grad=True)
    target = typical(5)
    weights = torch.tensor([1.0, 0.0, 2.0, 0.0, 1.0])
    loss = field_loss(predicted, target, weights, CONFIG)
    expected = (match_loss(predicted, target, CONFIG) * weights).sum()
    torch.testing.assert_close(loss, expected)
    (gradient,) = torch.autograd.grad(loss, [predicted])
    assert (gradient[[1, 3]] == 0).all()
    spoiled = target.clone()
    spoiled[1] = float("nan")
    assert torch.isfinite(field_loss(predicted, spoiled, weights, CONFIG))


@pytest.mark.parametrize("divided", [True, False])
def test_the_render_loss_compares_composited_features_divided_by_alpha_or_as_they_are(divided: bool) -> None:
    b = blend(random_gaussians(60), front_camera(), patch=8)
    predicted = torch.randn(60, 8, requires_grad=True)
    weights, target = (b.alpha > 0.3).float(), typical(b.rows)
    rendered = torch.from_numpy(dense(b)).float() @ predicted
    rendered = rendered / b.alpha.clamp(min=1e-12)[:, None] if divided else rendered
    expected = (match_loss(rendered, target, CONFIG) * weights).sum()
    loss = render_loss(predicted, b, target, weights, replace(CONFIG, divide_by_alpha=divided))
    torch.testing.assert_close(loss, expected, rtol=1e-4, atol=1e-4)
    ours = torch.autograd.grad(loss, [predicted])[0]
    plain = torch.autograd.grad(expected, [predicted])[0]
    torch.testing.assert_close(ours, plain, rtol=1e-3, atol=1e-5)


def test_heads_are_compared_in_their_own_spaces_and_do_not_learn() -> None:
    b = blend(random_gaussians(60), front_camera(), patch=8)
    body = torch.nn.Linear(12, 5)
    decode = torch.nn.Linear(8, 12)
    head = AdapterHead(body, torch.zeros(5), 1.0)
    predicted = torch.randn(60, 8, requires_grad=True)
    weights = (b.alpha > 0.3).float()
    loss = render_loss(predicted, b, typical(b.rows), weights, CONFIG, [(head, decode), (head, decode)])
    once = render_loss(predicted, b, typical(b.rows), weights, CONFIG, [(head, decode)])
    torch.testing.assert_close(loss, 2 * once)
    assert body.weight.requires_grad is False
    assert torch.autograd.grad(loss, [predicted])[0].abs().sum() > 0


def test_the_contrast_is_a_cross_entropy_over_squared_distances_to_the_kinds() -> None:
    # Kinds of different lengths: of equal ones the length takes no part.
    codebook = typical(5) * torch.tensor([[0.2], [0.5], [1.0], [1.5], [2.0]])
    predicted, codes = torch.randn(7, 8), torch.tensor([0, 1, 2, 3, 4, 4, 0])
    weights = torch.tensor([1.0, 2.0, 0.5, 1.0, 3.0, 1.0, 1.0])
    loss = contrast_loss(predicted, codes, weights, codebook, CONFIG)
    logits = -(torch.cdist(predicted.double(), codebook.double()) ** 2) / (2 * 8 * CONFIG.temperature)
    expected = (torch.nn.functional.cross_entropy(logits, codes, reduction="none") * weights).sum()
    torch.testing.assert_close(loss.double(), expected, atol=1e-4, rtol=1e-5)


def test_where_kinds_look_alike_the_contrast_ends_nearer_to_the_likelier_one_by_the_logarithm_of_the_odds() -> None:
    codebook, codes = typical(3).double(), torch.tensor([0] * 6 + [1] * 4)
    guess = torch.zeros(1, 8, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([guess], max_iter=300, line_search_fn="strong_wolfe", tolerance_change=1e-12)

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        loss = contrast_loss(guess.expand(10, 8), codes, torch.ones(10, dtype=torch.float64), codebook, CONFIG)
        loss.backward()
        return loss

    optimizer.step(closure)
    squares = (guess.detach() - codebook).square().sum(dim=1)
    gap = (squares[1] - squares[0]) / (2 * 8 * CONFIG.temperature)
    torch.testing.assert_close(gap, torch.tensor(6 / 4).log().double(), atol=1e-4, rtol=0)
    assert squares[2] > squares[1]


def test_unseen_gaussians_have_no_kind_and_no_part_in_the_contrast() -> None:
    predicted = torch.randn(4, 8, requires_grad=True)
    weights, codes = torch.tensor([1.0, 0.0, 1.0, 0.0]), torch.tensor([1, -1, 0, -1])
    contrast_loss(predicted, codes, weights, typical(3), CONFIG).backward()
    assert (predicted.grad[codes < 0] == 0).all()
    assert (predicted.grad[codes >= 0] != 0).any(dim=1).all()


def test_a_loss_of_no_term_and_a_temperature_of_zero_are_refused() -> None:
    with pytest.raises(InputError, match="_weight: expected one above 0"):
        LossConfig(field_weight=0.0, render_weight=0.0)
    with pytest.raises(InputError, match="cosine and smooth_l1"):
        LossConfig(cosine=0.0, smooth_l1=0.0)
    for cosine, smooth, contrast in ((0.0, 1e-3, 0.0), (1e-3, 0.0, 0.0), (0.0, 0.0, 1.0)):
        LossConfig(cosine=cosine, smooth_l1=smooth, contrast_weight=contrast)
    LossConfig(field_weight=0.0, render_weight=0.0, contrast_weight=1.0)
    with pytest.raises(InputError, match="temperature"):
        LossConfig(temperature=0.0)


def test_a_head_gives_standard_units_of_its_own_space() -> None:
    """Less the mean, and by the root mean square distance from it over √channels."""
    vectors = torch.randn(500, 6, generator=torch.Generator().manual_seed(0)).double() * 3 + 7
    mean = vectors.mean(dim=0)
    scale = float((vectors - mean).square().sum(dim=1).mean().sqrt())
    outputs = AdapterHead(torch.nn.Identity(), mean.float(), scale)(vectors.float())
    torch.testing.assert_close(outputs.double(), (vectors - mean) / scale * 6**0.5, rtol=1e-4, atol=1e-5)
    assert abs(outputs.square().mean() - 1) < 1e-4
    for wrong in (0.0, -0.5, float("inf"), float("nan")):
        with pytest.raises(InputError, match="heads: expected a positive scale"):
            AdapterHead(torch.nn.Identity(), mean.float(), wrong)
