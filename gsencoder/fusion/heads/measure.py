"""Mean and scale of an adapter head's outputs over cells of a teacher's maps, and what a basis costs the head.

Centered cosines remove the mean, and the render loss divides by the scale. Features are stored in the coordinates of a
basis that keeps the energy of the backbone's vectors. What it drops may be small for the backbone and large for a head,
so the outputs for the projected vectors are compared with those for the full ones.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float32, Float64

from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError
from gsencoder.fusion.basis import to_coordinates
from gsencoder.fusion.basis_fit import WORST
from gsencoder.fusion.cell_sample import CellSample
from gsencoder.fusion.heads.radio import Head
from gsencoder.types import FeatureBasis, FeatureSpace

CHUNK = 4096
"""Vectors that a head is given at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadFit:
    """How well a head's outputs for vectors in a basis agree with those for the full vectors.

    Attributes:
        cells: number of the vectors; mean and scale of the head are theirs, too.
        cosine: mean cosine of the outputs, about their mean.
        worst: the cosine below which the worst 5 % of the vectors are.
    """

    cells: int
    cosine: float
    worst: float

    def describe(self) -> str:
        """The figures in a phrase."""
        return f"cosine {self.cosine:.3f}, worst 5 % below {self.worst:.3f} in {self.cells:,} cells"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredHead:
    """An adapter head with the statistics of its outputs over a data set.

    Attributes:
        head: its layers and its name.
        mean: of the outputs.
        scale: root mean square distance of the outputs from their mean.
        fit: what the basis of the features costs it.
    """

    head: Head
    mean: Float32[np.ndarray, " E"]
    scale: float
    fit: HeadFit

    @property
    def name(self) -> str:
        return self.head.name

    @property
    def channels(self) -> int:
        return len(self.mean)

    def figures(self) -> dict[str, int | float]:
        """For summaries: channels, scale, and what the basis costs."""
        return {
            "channels": self.channels,
            "scale": self.scale,
            "cells": self.fit.cells,
            "cosine": self.fit.cosine,
            "worst": self.fit.worst,
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeadSet:
    """Measured heads of one backbone.

    Attributes:
        space: of the features that the heads take.
        heads: no name twice.
    """

    space: FeatureSpace
    heads: tuple[MeasuredHead, ...] = field(default=())

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(head.name for head in self.heads)


def measure_heads(
    heads: Sequence[Head], sample: CellSample, space: FeatureSpace, basis: FeatureBasis | None
) -> HeadSet:
    """Computes mean and scale of each head's outputs, and what a basis costs it.

    Args:
        heads: of the backbone of `space`.
        sample: cells of the teacher's maps.
        space: of the maps.
        basis: in which features are stored; None = all channels are.

    Raises:
        InputError: no cells, or outputs that are not finite, or all equal.
    """
    vectors = sample.vectors()
    projected = vectors
    if basis is not None:
        projected = (to_coordinates(basis, vectors) @ basis.components + basis.mean).astype(np.float32)
    return HeadSet(space=space, heads=tuple(_measure(head, vectors, projected) for head in heads))


def _measure(head: Head, vectors: Float32[np.ndarray, "n D"], projected: Float32[np.ndarray, "n D"]) -> MeasuredHead:
    full = head_outputs(head, vectors)
    mean = full.mean(axis=0, dtype=np.float64).astype(np.float32)
    scale = float(np.sqrt(np.square(full - mean, dtype=np.float64).sum(axis=1).mean()))
    if not scale > 0:
        raise InputError(f"heads: {head.name} gives the same vector for all {len(vectors):,} cells; check the pictures")
    cosines = np.ones(len(full)) if projected is vectors else _cosines(full, head_outputs(head, projected), mean)
    fit = HeadFit(cells=len(full), cosine=float(cosines.mean()), worst=float(np.quantile(cosines, WORST)))
    return MeasuredHead(head=head, mean=mean, scale=scale, fit=fit)


def head_outputs(head: Head, vectors: Float32[np.ndarray, "n D"]) -> Float32[np.ndarray, "n E"]:
    """The outputs of a head, computed by chunks in float32, on a GPU if there is one.

    Raises:
        InputError: outputs that are not finite.
    """
    device = choose_device("auto")
    body = head.body if device.type == "cpu" else copy.deepcopy(head.body).to(device)
    with torch.inference_mode():
        parts = [body(part.to(device)).cpu() for part in torch.from_numpy(vectors).split(CHUNK)]
        outputs = torch.cat(parts) if parts else torch.zeros(0, head.channels)
    if not torch.isfinite(outputs).all():
        raise InputError(f"heads: outputs of {head.name} are not finite; check the features and the teacher's weights")
    return np.asarray(outputs.numpy())


def _cosines(
    first: Float32[np.ndarray, "n E"], second: Float32[np.ndarray, "n E"], mean: Float32[np.ndarray, " E"]
) -> Float64[np.ndarray, " n"]:
    """Cosines of rows about a mean; 0 where a row is the mean itself."""
    a, b = first - mean, second - mean
    lengths = np.sqrt(np.square(a, dtype=np.float64).sum(axis=1) * np.square(b, dtype=np.float64).sum(axis=1))
    products = (a * b).sum(axis=1, dtype=np.float64)
    return np.asarray(np.divide(products, lengths, where=lengths > 0, out=np.zeros(len(a))))
