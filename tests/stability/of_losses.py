"""The losses of distillation."""

import numpy as np
import torch
from stability import oracles
from stability.extremes import CHANNELS, Case
from stability.of_features import VECTORS, lengths
from stability.of_rendering import blend_of, weights_of
from stability.registry import routine, worst

from gsencoder.train.losses import LossConfig, contrast_loss, match_loss, render_loss

Wide = oracles.Wide


def predicted_of(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Predictions and targets: the vectors, and what lies between them and their neighbors."""
    return case.vectors, (0.8 * case.vectors + 0.2 * np.roll(case.vectors, 1, axis=0)).astype(np.float32)


def wide_match(predicted: np.ndarray, target: np.ndarray, config: LossConfig) -> np.ndarray:
    """Eq. 3 of the paper with the factor of `confidence`, without anything against division by zero."""
    p, t = predicted.astype(Wide), target.astype(Wide)
    long_t, long_p = lengths(t)[:, 0], lengths(p)[:, 0]
    product = long_t * long_p
    cosines = np.where(product > 0, (p * t).sum(axis=1) / np.where(product > 0, product, 1), 0)
    confidence = np.minimum(long_t / Wide(t.shape[1]) ** Wide("0.5"), 1) if config.confidence else 1
    away = np.abs(p - t)
    smooth = np.where(away < 1, away * away / 2, away - Wide("0.5")).mean(axis=1)
    return config.cosine * (1 - cosines) * confidence + config.smooth_l1 * smooth


@routine(
    "loss: 1 − cosine and smooth L1",
    "vectors",
    domain="vectors of length 1e-3 to 1e6 in standard units; shorter ones fade to having no direction",
    promise=1e-5,
    measure="loss, relative to 1 + itself; 1 where a gradient is not finite",
    oracle="longdouble, from the equation",
    limits={"norm": (-2.0, 6.0)},
    exempt={"norm 1e-8": "below the shortest length that has a direction: the loss tends to that of a zero vector"},
)
def match_error(case: Case) -> float:
    predicted, target = predicted_of(case)
    errors = []
    for config in (LossConfig(), LossConfig(confidence=False)):
        leaf = torch.from_numpy(predicted).requires_grad_()
        got = match_loss(leaf, torch.from_numpy(target), config)
        got.sum().backward()
        assert leaf.grad is not None
        want = wide_match(predicted, target, config)
        errors += [worst(got.detach(), want, 1 + want), 0.0 if bool(leaf.grad.isfinite().all()) else 1.0]
    return max(errors)


@routine(
    "loss: cross-entropy among classes",
    "vectors",
    domain=f"{VECTORS}, in standard units",
    promise=1e-6,
    measure="loss of a row, relative to 1 + the largest logit",
    oracle="longdouble log-sum-exp of the distances",
)
def contrast_error(case: Case) -> float:
    config = LossConfig(contrast_weight=1.0)
    codebook = case.vectors[: min(8, len(case.vectors))]
    codes = torch.arange(len(case.vectors)) % len(codebook)
    wide, centers = case.vectors.astype(Wide), codebook.astype(Wide)
    logits = (wide @ centers.T - np.square(centers).sum(1) / 2) / (CHANNELS * Wide(config.temperature))
    top = logits.max(axis=1)
    want = top + np.log(np.exp(logits - top[:, None]).sum(axis=1)) - logits[np.arange(len(wide)), codes.numpy()]
    errors = [0.0]
    for row in range(0, len(wide), 7):
        weights = torch.zeros(len(wide))
        weights[row] = 1
        got = contrast_loss(torch.from_numpy(case.vectors), codes, weights, torch.from_numpy(codebook), config)
        errors.append(worst(got, want[row], 1 + np.abs(logits).max()))
    return max(errors)


@routine(
    "loss of rendered cells",
    "splat",
    "camera",
    "vectors",
    domain="features of length 1e-3 to 1e6 in standard units; cells of any opacity above 0",
    promise=1e-4,
    measure="mean loss, relative to 1 + itself + 1e-3 of the longest feature; 1 where a gradient is not finite",
    oracle="longdouble compositing and the equation",
    limits={"norm": (-2.0, 6.0)},
    exempt={"norm 1e-8": "below the shortest length that has a direction, as of the loss it sums"},
)
def render_loss_error(case: Case) -> float:
    weights, b, config = weights_of(case), blend_of(case), LossConfig()
    vectors = np.resize(case.vectors, (len(case.gaussians), CHANNELS))
    alpha = weights.sum(axis=1)
    rows = alpha > 1e-3
    target = np.resize(vectors, (len(alpha), CHANNELS))
    leaf = torch.from_numpy(vectors.copy()).requires_grad_()
    counted = rows.astype(np.float32) / max(rows.sum(), 1)
    got = render_loss(leaf, b, torch.from_numpy(target), torch.from_numpy(counted), config)
    got.backward()
    assert leaf.grad is not None
    if not bool(leaf.grad.isfinite().all()):
        return 1.0
    rendered = (weights @ vectors.astype(Wide))[rows] / alpha[rows, None]
    want = wide_match(rendered, target[rows], config).mean() if rows.any() else Wide(0)
    return float(np.abs(got.item() - want) / (1 + want + Wide("1e-3") * lengths(vectors).max()))
