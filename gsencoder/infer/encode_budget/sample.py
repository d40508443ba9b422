"""What a setting of encoding changes and costs, measured on parts of a scene.

The network sees what lies around a Gaussian up to where its chunk ends. How much its features turn depends on how near
that is. A part of the scene that is encoded whole and in two halves tells by how much at every distance from the cut,
and the boxes of the chunks how many Gaussians of the scene are how far from theirs.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float64, Int64

from gsencoder.core.runtime.device_names import Precision
from gsencoder.fusion.feature_error import row_cosines
from gsencoder.infer.encode.chunks import Chunk, EncodeConfig, cut
from gsencoder.infer.load_encoder import Encoder
from gsencoder.types import GaussianFeatures, Gaussians

PARTS = 2
LEAST_ROWS, MOST_ROWS, SHARE = 256, 4096, 16
"""A part holds one of so many Gaussians of the scene, within these bounds. Larger parts did not predict better."""
WARM_ROWS = 256
BINS = 8
"""Distances that are told apart."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured:
    """One part of the scene.

    Attributes:
        rows: its number of Gaussians.
        seconds: of encoding it whole, by precision.
        rounding: error of each precision.
        distances: from which on an error of `cutting` is made, ascending, metres.
        cutting: error where the scene is cut so far away; never rises.
    """

    rows: int
    seconds: Mapping[Precision, float]
    rounding: Mapping[Precision, float]
    distances: Float64[np.ndarray, " b"]
    cutting: Float64[np.ndarray, " b"]

    def error(self, precision: Precision, seen: Float[np.ndarray, " n"]) -> float:
        """Mean error over Gaussians around which the network sees so far, in metres."""
        error = self.rounding[precision]
        if len(self.cutting):
            number = np.maximum(np.searchsorted(self.distances, seen, side="right") - 1, 0)
            error += float(np.where(np.isfinite(seen), self.cutting[number], 0).mean())
        return min(error, 1.0)


def measure_parts(
    gaussians: Gaussians,
    encoder: Encoder,
    config: EncodeConfig,
    precisions: Sequence[Precision],
    *,
    is_cut: bool,
    metres_per_unit: float,
    seed: int,
    timed: bool = True,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Measured]:
    """Encodes parts of a scene in each precision, and in halves where the scene is cut into chunks.

    Args:
        gaussians: the splat.
        encoder: whose teachers count as the worst of them.
        config: whose device is used.
        precisions: the exact one first.
        is_cut: whether the scene has several chunks.
        metres_per_unit: see `Encoder.encode`.
        seed: of the parts.
        timed: whether seconds matter.
        clock: seconds.
    """
    rng = np.random.default_rng(seed)
    for precision in precisions if timed else ():
        # The first pass of a process loads kernels, which no later one pays for.
        first = gaussians.select(np.arange(min(WARM_ROWS, len(gaussians))))
        encoder.encode_spaces(first, replace(config, chunk=0, precision=precision), metres_per_unit=metres_per_unit)
    count = max(min(len(gaussians) // SHARE, MOST_ROWS), LEAST_ROWS)
    parts = []
    for center in rng.choice(len(gaussians), min(PARTS, len(gaussians)), replace=False):
        part = gaussians.select(_box_around(gaussians, int(center), count))
        whole = replace(config, chunk=0)
        seconds, features = {}, {}
        for precision in precisions:
            begun = clock()
            one = replace(whole, precision=precision)
            features[precision] = encoder.encode_spaces(part, one, metres_per_unit=metres_per_unit)
            seconds[precision] = clock() - begun
        exact = features[precisions[0]]
        rounding = {name: float(_errors(each, exact).mean()) for name, each in features.items()}
        distances, cutting = np.zeros(0), np.zeros(0)
        if is_cut:
            halves = replace(whole, chunk=max(len(part) * 2 // 3, 1), halo=0.0, precision=precisions[0])
            halved = encoder.encode_spaces(part, halves, metres_per_unit=metres_per_unit)
            seen = seen_around(part, cut(part.means, halves.chunk, 0.0)) * metres_per_unit
            distances, cutting = _never_rising(seen, _errors(halved, exact))
        parts.append(Measured(rows=len(part), seconds=seconds, rounding=rounding, distances=distances, cutting=cutting))
    return parts


def seen_around(gaussians: Gaussians, chunks: Sequence[Chunk]) -> Float64[np.ndarray, " N"]:
    """How far the network sees around each Gaussian, world units; infinite where nothing is cut."""
    seen = np.empty(len(gaussians))
    for chunk in chunks:
        seen[chunk.core_rows] = chunk.seen_around(gaussians.means)
    return seen


def _box_around(gaussians: Gaussians, center: int, count: int) -> Int64[np.ndarray, " n"]:
    """The Gaussians of the cube around one that holds so many."""
    if count >= len(gaussians):
        return np.arange(len(gaussians))
    far = np.abs(gaussians.means - gaussians.means[center]).max(axis=1)
    return np.sort(np.argpartition(far, count - 1)[:count])


def _errors(features: dict[str, GaussianFeatures], exact: dict[str, GaussianFeatures]) -> Float64[np.ndarray, " n"]:
    """1 − centered cosine of each Gaussian, of the teacher that is off the most."""
    each = [
        1 - row_cosines(*((one.decode().astype(np.float64) - one.mean) for one in (features[name], exact[name])))
        for name in exact
    ]
    return np.asarray(max(each, key=lambda values: float(values.mean())))


def _never_rising(
    seen: Float64[np.ndarray, " n"], errors: Float64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, " b"], Float64[np.ndarray, " b"]]:
    """Distances, and the mean error from each of them to the next, where a larger one further on counts before it."""
    order = np.argsort(seen, kind="stable")
    groups = [group for group in np.array_split(order, BINS) if len(group)]
    means = np.array([errors[group].mean() for group in groups])
    return np.array([seen[group[0]] for group in groups]), np.maximum.accumulate(means[::-1])[::-1]
