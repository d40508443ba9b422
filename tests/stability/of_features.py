"""Bases, output spaces, memory attention, relevancy, the losses of distillation, and what features are kept in."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from stability import oracles
from stability.extremes import CHANNELS, Case
from stability.of_rendering import blend_of, weights_of
from stability.registry import routine, worst

from gsencoder.core.arrays import round_columns
from gsencoder.fusion.basis import Moments, fit_basis
from gsencoder.fusion.checkpoint import read_map, write_map
from gsencoder.fusion.folder import load_features, save_features
from gsencoder.fusion.quantize import compact
from gsencoder.infer.pictures import BlendedFeatures
from gsencoder.infer.relevancy import GaussianProducts, relevancy
from gsencoder.memory.attention import MemoryAttention
from gsencoder.models.output_space import OutputSpace
from gsencoder.train.losses import LossConfig, contrast_loss, match_loss, render_loss
from gsencoder.types import FeatureMap, FeatureSpace, GaussianFeatures, MemoryBank, QueryMemory, Scene

Wide = oracles.Wide
SPACE = FeatureSpace(name="s", channels=CHANNELS)


def spread_of(vectors: np.ndarray) -> float:
    """Root mean square length of vectors, less their mean; of equal ones their own length."""
    wide = vectors.astype(Wide)
    spread = float(np.sqrt((np.square(wide - wide.mean(axis=0))).sum(axis=1).mean()))
    return spread or float(np.linalg.norm(wide[0]))


def lengths(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(vectors.astype(Wide)).sum(axis=-1, keepdims=True))


def features_of(case: Case) -> GaussianFeatures:
    n = len(case.vectors)
    return GaussianFeatures(
        features=case.vectors, weights=np.random.default_rng(0).uniform(0.5, 2, n).astype(np.float32),
        mean=case.vectors.astype(np.float64).mean(axis=0).astype(np.float32), space=SPACE,
    )  # fmt: skip


@routine("basis: moments and eigenvectors", "vectors")
def basis_error(case: Case) -> float:
    moments = Moments(CHANNELS)
    for part in np.array_split(case.vectors, 3):
        moments.add(part)
    basis = fit_basis(moments.mean, moments.covariance(), SPACE, energy=0.99)
    local = case.vectors.astype(Wide) - case.vectors.astype(Wide).mean(axis=0)
    axes = basis.components.astype(Wide)
    left = np.square(local - local @ axes.T @ axes).sum()
    total = np.square(local).sum()
    noise = np.square(np.abs(case.vectors.astype(Wide)).max() * np.finfo(np.float32).eps) * local.size
    lost = max(0.0, float((left - noise) / max(total, noise)) - 0.01) if total > 0 else 0.0
    square = np.abs(axes @ axes.T - np.eye(len(axes))).max()
    return max(lost, float(square))


@routine("basis: coordinates and decoding", "vectors")
def decode_error(case: Case) -> float:
    moments = Moments(CHANNELS)
    moments.add(case.vectors)
    basis = fit_basis(moments.mean, moments.covariance(), SPACE, energy=0.9)
    z = basis.coordinates(case.vectors)
    features = replace(features_of(case), features=z, basis=basis, mean=basis.mean)
    axes = basis.components.astype(Wide)
    want = (case.vectors.astype(Wide) - basis.mean) @ axes.T @ axes + basis.mean
    return worst(features.decode(), want, float(lengths(case.vectors).max()))


@routine("output space: standard units and back", "vectors")
def output_space_error(case: Case) -> float:
    mean = case.vectors.astype(np.float64).mean(axis=0).astype(np.float32)
    outputs = OutputSpace(space=SPACE, mean=mean, scale=spread_of(case.vectors))
    return worst(outputs.restore(outputs.standardize(case.vectors)), case.vectors, float(lengths(case.vectors).max()))


def bank_of(case: Case) -> MemoryBank:
    m = min(40, len(case.vectors))
    return MemoryBank(
        components=case.vectors[:m], sources=np.zeros((m, 3), np.int32),
        grid_from_image=np.tile(np.eye(2, 3), (m, 1, 1)), mean=np.zeros(CHANNELS, np.float32), threshold=0.9,
        coverage=1.0, cosine=0.95, space=SPACE,
    )  # fmt: skip


@routine("memory attention, products", "vectors", "logits")
def attention_error(case: Case) -> float:
    bank = bank_of(case)
    projection = np.random.default_rng(0).normal(size=(6, CHANNELS)).astype(np.float32)
    queries = np.random.default_rng(1).normal(size=(50, 6))
    peak = np.abs(queries @ projection @ bank.components.astype(np.float64).T).max()
    queries = (queries * case.logits / peak).astype(np.float32)
    zero = np.zeros(CHANNELS, np.float32)
    network = MemoryAttention(bank, torch.from_numpy(projection), mean=zero, scoring="dot", temperature=1.0)
    with torch.no_grad():
        got = network(torch.from_numpy(queries))
    scores = queries.astype(Wide) @ projection.astype(Wide) @ bank.components.astype(Wide).T
    want = oracles.softmax_mean(scores, bank.components)
    return worst(got, want, float(lengths(bank.components).max()) * (1 + case.logits))


@routine("memory attention, centered cosines", "vectors")
def cosine_attention_error(case: Case) -> float:
    bank, errors = bank_of(case), []
    mean = bank.components.astype(np.float64).mean(axis=0).astype(np.float32)
    projection = np.random.default_rng(0).normal(size=(6, CHANNELS)).astype(np.float32)
    for length in (1e-4, 1.0, 1e30):
        queries = (np.random.default_rng(1).normal(size=(50, 6)) * length).astype(np.float32)
        network = MemoryAttention(bank, torch.from_numpy(projection), mean=mean, scoring="centered", temperature=0.05)
        with torch.no_grad():
            got = network(torch.from_numpy(queries))
        memory = QueryMemory(
            queries=queries, weights=np.ones(50, np.float32), projection=projection, bank=bank,
            scoring="centered", temperature=0.05, mean=mean,
        )  # fmt: skip
        # What float32 rounds of components close to their mean is part of the case.
        keys = (bank.components - mean).astype(Wide)
        keys = keys / np.where(lengths(keys) > 0, lengths(keys), 1)
        led = queries.astype(Wide) @ projection.astype(Wide)
        scores = led / lengths(led) @ keys.T / Wide("0.05")
        want = oracles.softmax_mean(scores, bank.components)
        scale = float(lengths(bank.components).max())
        errors += [worst(got, want, scale), worst(memory.attend(queries), want, scale)]
    return max(errors)


WORDS = np.random.default_rng(9).normal(size=(5, CHANNELS)).astype(np.float32)


def wide_cosines(features: GaussianFeatures, removed: np.ndarray, words: np.ndarray) -> np.ndarray:
    """Cosines [N, Q] about a mean, fading for features below 1e-3 of it."""
    local = features.features.astype(Wide) - removed
    floor = Wide("1e-6") * (removed.astype(Wide) ** 2).sum()
    long_ = np.sqrt(np.square(local).sum(axis=1, keepdims=True) + floor)
    return local / np.where(long_ > 0, long_, 1) @ (words.astype(Wide) / lengths(words)).T


@routine("relevancy: centered cosines", "vectors")
def relevancy_error(case: Case) -> float:
    features, zero = features_of(case), np.zeros(CHANNELS, np.float32)
    want = wide_cosines(features, features.mean, WORDS).T
    return worst(relevancy(features, WORDS, zero), want, 1)


@routine("relevancy: products in float32", "vectors")
def products_error(case: Case) -> float:
    features = features_of(case)
    directions = WORDS / np.linalg.norm(WORDS.astype(np.float64), axis=1, keepdims=True)
    return worst(GaussianProducts(features).cosines(directions), wide_cosines(features, features.mean, WORDS).T, 1)


@routine("relevancy: contrast with negatives", "vectors", "logits")
def contrast_relevancy_error(case: Case) -> float:
    features, zero, temperature = features_of(case), np.zeros(CHANNELS, np.float32), 1 / case.logits
    got = relevancy(features, WORDS[:1], zero, negatives=WORDS[1:], temperature=temperature)
    cosines = wide_cosines(features, features.mean, WORDS)
    margin = (cosines[:, 0] - cosines[:, 1:].max(axis=1)) / Wide(temperature)
    want = 1 / (1 + np.exp(np.clip(-margin, -11000, 11000)))
    return worst(got[0], want, 1 + case.logits)


@routine("relevancy at pixels", "splat", "camera", "vectors")
def pixel_error(case: Case) -> float:
    weights, n = weights_of(case), len(case.gaussians)
    features = features_of(replace(case, vectors=np.resize(case.vectors, (n, CHANNELS))))
    directions = WORDS / np.linalg.norm(WORDS.astype(np.float64), axis=1, keepdims=True)
    got = BlendedFeatures(GaussianProducts(features), blend_of(case)).cosines(directions)
    local = features.features.astype(Wide) - features.mean
    alpha = weights.sum(axis=1)
    rows = alpha > 1e-3
    blended = (weights @ local)[rows]
    floor = Wide("1e-6") * (features.mean.astype(Wide) ** 2).sum() * alpha[rows, None] ** 2
    squares = np.square(blended).sum(axis=1, keepdims=True) + floor
    want = blended / np.sqrt(np.where(squares > 0, squares, 1)) @ directions.astype(Wide).T
    # Vectors that cancel one another in a pixel leave a direction of rounding.
    parts = weights[rows] @ np.abs(local).max(axis=1, keepdims=True) + np.abs(features.mean).max() * alpha[rows, None]
    return worst(got[:, rows], want.T, np.maximum(parts / np.sqrt(np.where(squares > 0, squares, np.inf)), 1).T)


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
        want = wide_match(predicted, target, config)
        errors += [worst(got.detach(), want, 1 + want), 0.0 if bool(leaf.grad.isfinite().all()) else 1.0]
    return max(errors)


@routine("loss: cross-entropy among classes", "vectors")
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
    if not bool(leaf.grad.isfinite().all()):
        return 1.0
    rendered = (weights @ vectors.astype(Wide))[rows] / alpha[rows, None]
    want = wide_match(rendered, target[rows], config).mean() if rows.any() else Wide(0)
    return float(np.abs(got.item() - want) / (1 + want + Wide("1e-3") * lengths(vectors).max()))


@routine(
    "package: codes of few bits",
    "vectors",
    limits={"n": (2, 60)},
    exempt={"one Gaussian": "one vector is the mean, and is refused", "equal vectors": "all are the mean, and refused"},
)
def package_error(case: Case) -> float:
    features = features_of(case)
    back = compact(features, error=0.05).features().decode().astype(Wide) - features.mean
    local = features.features.astype(Wide) - features.mean
    product = lengths(local) * lengths(back)
    cosines = (local * back).sum(axis=1, keepdims=True) / np.where(product > 0, product, 1)
    return float(1 - cosines[product > 0].mean())


@routine("features as float16 files", "vectors")
def folder_error(case: Case) -> float:
    features = features_of(case)
    with tempfile.TemporaryDirectory() as folder:
        gaussians = case.gaussians.select(np.zeros(len(case.vectors), np.int64))
        save_features(Path(folder) / "f", Scene(name="s", gaussians=gaussians), features, {"teacher": "t"})
        (back,) = load_features(Path(folder) / "f").features.values()
        return worst(back.features.copy(), features.features, np.abs(features.features).max(axis=0))


@routine("maps as float16 files", "vectors")
def map_error(case: Case) -> float:
    vectors = case.vectors[None]
    with tempfile.TemporaryDirectory() as folder:
        made = FeatureMap(features=vectors, grid_from_image=np.eye(2, 3), space=SPACE)
        write_map(Path(folder) / "m", made)
        back = read_map(Path(folder) / "m", SPACE)
        return worst(back.features, vectors, np.abs(vectors).max(axis=(0, 1)))


@routine("matrices in int8", "vectors")
def int8_error(case: Case) -> float:
    integers, scale = round_columns(case.vectors)
    back = integers.astype(Wide) * scale
    return worst(back.astype(np.float64), case.vectors, np.abs(case.vectors).max(axis=0))
