"""Scenes, words and features that tests of words to points from a pose stand on."""

from dataclasses import replace

import numpy as np
from feature_fields import plain_features
from jaxtyping import Float64
from memory_samples import make_memory
from rooms import merged
from splats import random_gaussians

from gsencoder.render import blend
from gsencoder.text.table import TextTable, make_text_table
from gsencoder.types import Cameras, FeatureBasis, FeatureSpace, GaussianFeatures, Gaussians, QueryMemory, Scene
from gsencoder.types.features import Scoring

CHANNELS = 40
SPACE = FeatureSpace(name="toy", channels=CHANNELS, text_encoder="toy")
NAMES = tuple(f"word {letter}" for letter in "abcdefghijklmnopqrst")


def words() -> TextTable:
    vectors = np.random.default_rng(5).normal(size=(len(NAMES), CHANNELS))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return make_text_table(NAMES, vectors.astype(np.float32), "toy")


def opaque_ball(n: int = 400) -> Gaussians:
    ball = random_gaussians(n, log_scale=-1.6)
    return replace(ball, opacities=np.sqrt(ball.opacities))


def some_features(n: int, kind: str) -> GaussianFeatures:
    """Random features with a mean, some of them never seen: as vectors, in a basis, or rows of a shared table."""
    rng = np.random.default_rng(1)
    weights = rng.uniform(0.1, 2, n).astype(np.float32)
    weights[::5] = 0
    mean = (3 * rng.normal(size=CHANNELS)).astype(np.float32)
    basis, index, rows, columns = None, None, n, CHANNELS
    if kind == "basis":
        columns = 35
        components = np.linalg.qr(rng.normal(size=(CHANNELS, columns)))[0].T.astype(np.float32)
        basis = FeatureBasis(mean=mean, components=components, energy_kept=0.9, space=SPACE)
    if kind == "table":
        rows = 7
        index = np.where(weights > 0, rng.integers(0, rows, n), -1).astype(np.int32)
    values = rng.normal(size=(rows, columns)).astype(np.float32) + (0 if basis else mean)
    if index is None:
        values[weights == 0] = 0
    return GaussianFeatures(
        features=values.astype(np.float32), weights=weights, mean=mean, space=SPACE, basis=basis, index=index
    )


def scene_of(gaussians: Gaussians, features: GaussianFeatures, origin: tuple[float, float, float] = (0, 0, 0)) -> Scene:
    return Scene(name="toy", gaussians=gaussians, features={"toy": features}, origin=np.array(origin, np.float64))


def ball_scene(kind: str = "basis", origin: tuple[float, float, float] = (0, 0, 0), n: int = 400) -> Scene:
    return scene_of(opaque_ball(n), some_features(n, kind), origin)


def plain_relevancy(
    scene: Scene, cameras: Cameras, text: TextTable, names: tuple[str, ...]
) -> Float64[np.ndarray, "Q P"]:
    """The definition: features of all channels are rendered, then centered cosines; −2 where alpha is below 0.5."""
    features = scene.features["toy"]
    b = blend(scene.gaussians, cameras)
    dense = np.zeros((b.rows, b.gaussians))
    rows = np.repeat(np.arange(b.rows), np.diff(b.crow.numpy()))
    np.add.at(dense, (rows, b.col.numpy()), b.weight.numpy().astype(np.float64))
    dense[:, ~features.seen] = 0
    alpha = dense.sum(axis=1)
    decoded = features.decode().astype(np.float64)
    local = dense @ decoded / np.maximum(alpha, 1e-300)[:, None] - features.mean
    # A feature much shorter than the mean has no direction: `relevancy` adds a thousandth of the mean's length.
    length = np.sqrt(
        (local**2).sum(axis=1, keepdims=True) + 1e-6 * float((features.mean.astype(np.float64) ** 2).sum())
    )
    local /= length
    targets = text.encode(names).astype(np.float64) - text.mean
    targets /= np.linalg.norm(targets, axis=1, keepdims=True)
    return np.where(alpha >= 0.5, targets @ local.T, -2)


def two_kinds(first: Gaussians, second: Gaussians) -> tuple[Gaussians, GaussianFeatures]:
    """Gaussians of two kinds whose features are the words a and b themselves."""
    joined = merged(first, second)
    kinds = np.repeat([0, 1], [len(first), len(second)])
    # The means of features and words are far from both, so that neither is the mean's opposite of the other.
    return joined, plain_features(words().encode(NAMES[:2])[kinds], SPACE, mean=words().mean)


def memory_of(n: int, *, components: int = 9, scoring: Scoring = "centered") -> QueryMemory:
    made = make_memory(scoring, components=components, channels=CHANNELS, gaussians=n)
    return replace(made, bank=replace(made.bank, space=SPACE))
