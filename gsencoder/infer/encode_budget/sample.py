"""What a setting of encoding changes and costs, measured on parts of a scene.

The network sees what lies around a Gaussian up to where its chunk ends. How much its features turn depends on how near
that is. A part of the scene that is encoded whole and in two halves tells by how much at every distance from the cut,
and the boxes of the chunks how many Gaussians of the scene are how far from theirs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from gsencoder.core.process import Precision
from gsencoder.fusion.errors import row_cosines
from gsencoder.infer.encode.chunks import Chunk, EncodeConfig, cut, scene_regions
from gsencoder.infer.load_encoder import Encoder
from gsencoder.types import GaussianFeatures, Gaussians

PARTS = 2
LEAST_ROWS, MOST_ROWS, SHARE = 256, 4096, 64
"""A part holds one of so many Gaussians of the scene, within these bounds. Larger parts did not predict better."""
ROUNDING_ROWS = 512
"""Gaussians on which precisions are compared: parts of a scene differ in it by less than a tenth."""
BINS = 8
"""Number of distances at which the error of cutting is stated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """A part of the scene that was encoded whole, and in halves where the scene is cut.

    Attributes:
        rows: its number of Gaussians.
        seconds: of encoding it whole, by precision; empty if they do not matter.
        distances: from which on an error of `cutting` is made, ascending, metres; empty where the scene is not cut.
        cutting: error where the scene is cut so far away; never rises.
    """

    rows: int
    seconds: Mapping[Precision, float]
    distances: Float64[np.ndarray, " b"]
    cutting: Float64[np.ndarray, " b"]

    def cutting_error(self, seen: Float[np.ndarray, " n"]) -> float:
        """Mean error over Gaussians around which the network sees so far, in metres; infinite = to the end."""
        if not len(self.cutting):
            return 0.0
        number = np.maximum(np.searchsorted(self.distances, seen, side="right") - 1, 0)
        return float(np.where(np.isfinite(seen), self.cutting[number], 0).mean())


def measure_rounding(
    gaussians: Gaussians,
    encoder: Encoder,
    config: EncodeConfig,
    precisions: Sequence[Precision],
    *,
    metres_per_unit: float,
    seed: int,
) -> dict[Precision, float]:
    """The error of each precision, on a small part of the scene.

    Args:
        gaussians: the splat.
        encoder: whose teachers count as the worst of them.
        config: whose device is used.
        precisions: the exact one first, whose error is 0 by definition.
        metres_per_unit: see `Encoder.encode`.
        seed: of the part.
    """
    if len(precisions) < 2:
        return dict.fromkeys(precisions, 0.0)
    part = gaussians.select(_box_around(gaussians, _centers(gaussians, seed)[0], ROUNDING_ROWS))
    exact, *others = (
        encoder.encode_spaces(part, replace(config, chunk=0, precision=precision), metres_per_unit=metres_per_unit)
        for precision in precisions
    )
    errors = (0.0, *(float(_errors(each, exact).mean()) for each in others))
    return dict(zip(precisions, errors, strict=True))


def measure_parts(
    gaussians: Gaussians,
    encoder: Encoder,
    config: EncodeConfig,
    precisions: Sequence[Precision],
    *,
    is_cut: bool,
    metres_per_unit: float,
    seed: int,
    clock: Callable[[], float] | None,
) -> list[Part]:
    """Encodes parts of a scene whole, and in halves where the scene is cut into chunks.

    Args:
        gaussians: the splat.
        encoder: whose teachers count as the worst of them.
        config: whose device and precision are used.
        precisions: whose seconds are measured; the cheapest one last.
        is_cut: whether a region of the scene has several chunks.
        metres_per_unit: see `Encoder.encode`.
        seed: of the parts.
        clock: seconds; None if they do not matter.
    """
    if not is_cut and clock is None:
        return []
    count = max(min(len(gaussians) // SHARE, MOST_ROWS), LEAST_ROWS)
    # What a cut changes is the same in each precision, and the last one is the cheapest.
    uncut, parts = replace(config, chunk=0, precision=precisions[-1]), []
    for center in _centers(gaussians, seed):
        part = gaussians.select(_box_around(gaussians, center, count))
        seconds: dict[Precision, float] = {}
        for precision in precisions if clock is not None else ():
            assert clock is not None
            begun = clock()
            encoder.encode_spaces(part, replace(uncut, precision=precision), metres_per_unit=metres_per_unit)
            seconds[precision] = clock() - begun
        distances, cutting = np.zeros(0), np.zeros(0)
        if is_cut:
            exact = encoder.encode_spaces(part, uncut, metres_per_unit=metres_per_unit)
            halves = replace(uncut, chunk=max(len(part) * 2 // 3, 1), halo=0.0)
            halved = encoder.encode_spaces(part, halves, metres_per_unit=metres_per_unit)
            regions = scene_regions(part.means, encoder.voxel / metres_per_unit)
            seen = seen_around(part.means, cut(part.means, halves.chunk, 0.0, regions)) * metres_per_unit
            distances, cutting = _never_rising(seen, _errors(halved, exact))
        parts.append(Part(rows=len(part), seconds=seconds, distances=distances, cutting=cutting))
    return parts


def _centers(gaussians: Gaussians, seed: int) -> list[int]:
    """Gaussians around which parts lie."""
    chosen = np.random.default_rng(seed).choice(len(gaussians), min(PARTS, len(gaussians)), replace=False)
    return [int(center) for center in chosen]


def seen_around(means: Float32[np.ndarray, "N 3"], chunks: Sequence[Chunk]) -> Float64[np.ndarray, " N"]:
    """How far the network sees around each Gaussian of a scene in chunks, world units; infinite where nothing is
    cut."""
    seen = np.empty(len(means))
    for chunk in chunks:
        seen[chunk.core_rows] = chunk.seen_around(means)
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
        1
        - row_cosines(
            *((encoded.decode().astype(np.float64) - encoded.mean) for encoded in (features[name], exact[name]))
        )
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
