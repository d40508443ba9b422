"""Bases, output spaces, memory attention, and relevancy."""

from dataclasses import replace

import numpy as np
import torch
from stability import oracles
from stability.extremes import CHANNELS, Case
from stability.of_rendering import blend_of, weights_of
from stability.registry import routine, worst

from gsencoder.fusion.basis import Moments, fit_basis, to_coordinates
from gsencoder.infer.pictures import BlendedFeatures
from gsencoder.infer.relevancy import GaussianProducts, relevancy
from gsencoder.memory.attention import MemoryAttention
from gsencoder.models.output_space import OutputSpace
from gsencoder.types import FeatureSpace, GaussianFeatures, MemoryBank, QueryMemory

Wide = oracles.Wide
SPACE = FeatureSpace(name="s", channels=CHANNELS)
VECTORS = "vectors of length 1e-8 to 1e6"


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
        features=case.vectors,
        weights=np.random.default_rng(0).uniform(0.5, 2, n).astype(np.float32),
        mean=case.vectors.astype(np.float64).mean(axis=0).astype(np.float32),
        space=SPACE,
    )


@routine(
    "basis: moments and eigenvectors",
    "vectors",
    domain=f"{VECTORS}; a mean of up to 1e3 spreads; any rank",
    promise=1e-3,
    measure="energy that the basis of 99 % leaves out, above what it may; and how far its rows are from orthonormal",
    oracle="longdouble residuals of the vectors themselves",
)
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


@routine(
    "basis: coordinates and decoding",
    "vectors",
    domain=f"{VECTORS}; a mean of up to 1e3 spreads; any rank",
    promise=1e-6,
    measure="decoded vector, relative to the length of the longest",
    oracle="longdouble projection on the same basis",
)
def decode_error(case: Case) -> float:
    moments = Moments(CHANNELS)
    moments.add(case.vectors)
    basis = fit_basis(moments.mean, moments.covariance(), SPACE, energy=0.9)
    z = to_coordinates(basis, case.vectors)
    features = replace(features_of(case), features=z, basis=basis, mean=basis.mean)
    axes = basis.components.astype(Wide)
    want = (case.vectors.astype(Wide) - basis.mean) @ axes.T @ axes + basis.mean
    return worst(features.decode(), want, float(lengths(case.vectors).max()))


@routine(
    "output space: standard units and back",
    "vectors",
    domain=f"{VECTORS}; a mean of up to 1e3 spreads",
    promise=1e-6,
    measure="restored vector, relative to the longest vector",
    oracle="the vectors themselves",
)
def output_space_error(case: Case) -> float:
    mean = case.vectors.astype(np.float64).mean(axis=0).astype(np.float32)
    outputs = OutputSpace(space=SPACE, mean=mean, scale=spread_of(case.vectors))
    return worst(outputs.restore(outputs.standardize(case.vectors)), case.vectors, float(lengths(case.vectors).max()))


def bank_of(case: Case) -> MemoryBank:
    m = min(40, len(case.vectors))
    return MemoryBank(
        components=case.vectors[:m],
        sources=np.zeros((m, 3), np.int32),
        grid_from_image=np.tile(np.eye(2, 3), (m, 1, 1)),
        mean=np.zeros(CHANNELS, np.float32),
        threshold=0.9,
        coverage=1.0,
        cosine=0.95,
        space=SPACE,
    )


@routine(
    "memory attention, products",
    "vectors",
    "logits",
    domain="scores from −1e4 to 1e4; components of length 1e-8 to 1e6",
    promise=1e-6,
    measure="feature, relative to the longest component and to 1 + the largest score",
    oracle="longdouble softmax",
)
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


@routine(
    "memory attention, centered cosines",
    "vectors",
    domain="projected queries of length 1e-6 to 1e30; components of length 1e-8 to 1e6; a mean of up to 1e3 spreads",
    promise=1e-4,
    measure="feature, relative to the longest component, at temperature 0.05; in torch and in numpy",
    oracle="longdouble softmax of cosines with the same keys in float32",
)
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
            queries=queries,
            weights=np.ones(50, np.float32),
            projection=projection,
            bank=bank,
            scoring="centered",
            temperature=0.05,
            mean=mean,
        )
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


@routine(
    "relevancy: centered cosines",
    "vectors",
    domain=f"{VECTORS} and words of any length from 1e-20; features shorter than 1e-3 of the mean fade to 0",
    promise=1e-6,
    measure="cosine",
    oracle="longdouble",
)
def relevancy_error(case: Case) -> float:
    features, zero = features_of(case), np.zeros(CHANNELS, np.float32)
    want = wide_cosines(features, features.mean, WORDS).T
    return worst(relevancy(features, WORDS, zero), want, 1)


@routine(
    "relevancy: products in float32",
    "vectors",
    domain=f"{VECTORS}; features shorter than 1e-3 of the mean fade to 0",
    promise=1e-4,
    measure="cosine; that of a feature at the mean is what float32 rounds of the mean, over 1e-3 of it",
    oracle="longdouble",
)
def products_error(case: Case) -> float:
    features = features_of(case)
    directions = WORDS / np.linalg.norm(WORDS.astype(np.float64), axis=1, keepdims=True)
    return worst(GaussianProducts(features).cosines(directions), wide_cosines(features, features.mean, WORDS).T, 1)


@routine(
    "relevancy: contrast with negatives",
    "vectors",
    "logits",
    domain="cosines over temperatures down to 1e-4 (scores from −1e4 to 1e4)",
    promise=1e-6,
    measure="probability, times temperature where that is below 1 / (1 + score)",
    oracle="longdouble pairwise softmax",
)
def contrast_relevancy_error(case: Case) -> float:
    features, zero, temperature = features_of(case), np.zeros(CHANNELS, np.float32), 1 / case.logits
    got = relevancy(features, WORDS[:1], zero, negatives=WORDS[1:], temperature=temperature)
    cosines = wide_cosines(features, features.mean, WORDS)
    margin = (cosines[:, 0] - cosines[:, 1:].max(axis=1)) / Wide(temperature)
    want = 1 / (1 + np.exp(np.clip(-margin, -11000, 11000)))
    return worst(got[0], want, 1 + case.logits)


@routine(
    "relevancy at pixels",
    "splat",
    "camera",
    "vectors",
    domain=f"{VECTORS}; pixels with an opacity above 1e-3",
    promise=1e-4,
    measure="cosine of what is blended; relative to the mean's length over the blended one's where features fade",
    oracle="longdouble compositing and cosine",
)
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
