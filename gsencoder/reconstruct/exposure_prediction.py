"""The exposure of photographs that were not fitted, from the maps of those that were, without a look at their pixels.

Exposure drifts along a recording, and with what a camera looks at. How far that holds in a scene is measured on the
fitted photographs alone: the map of each is predicted from the others, and what predicts these predicts the rest.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64

from gsencoder.reconstruct.exposure import IDENTITY, Exposures
from gsencoder.types import Cameras

CLEARLY = 0.8
"""A source replaces the one before (mean, order, cameras) where its error is smaller than so many times that one's;
what is less than a fifth better may be so by chance."""
NEAREST = 2
"""Cameras whose maps predict that of one between them."""

COLOR_MOMENTS = torch.full((4, 4), 0.25)
"""Mean of c·cᵀ over all colors c = (red, green, blue, 1) of [0, 1]³."""
COLOR_MOMENTS[[0, 1, 2], [0, 1, 2]] = 1 / 3
COLOR_MOMENTS[3, :3] = COLOR_MOMENTS[:3, 3] = 0.5
COLOR_MOMENTS[3, 3] = 1.0


class ExposurePrediction(NamedTuple):
    """Maps of photographs that were not fitted.

    Attributes:
        source: what they are predicted from: "mean" of all fitted photographs, their neighbors in the "order" of the
            recording, or the nearest "cameras".
        maps: to be applied to renders, [Q, 3, 4].
        errors: of each source, where it predicts the maps of the fitted photographs from one another: root mean square
            over photographs and colors.
    """

    source: str
    maps: Float[torch.Tensor, "Q 3 4"]
    errors: Mapping[str, float]


def predict_exposures(exposures: Exposures | None, cameras: Cameras, queries: Sequence[int]) -> ExposurePrediction:
    """Predicts the maps of photographs that were not fitted.

    Args:
        exposures: maps of the fitted photographs; None = all are taken as they are.
        cameras: of all views, in the order of the recording.
        queries: row numbers of views that were not fitted.
    """
    if exposures is None or len(exposures.training) < 2:
        return ExposurePrediction("mean", IDENTITY.repeat(len(queries), 1, 1), {})
    relative = exposures.maps - exposures.maps.mean(0)
    fitted, query_rows = np.array(exposures.training), np.array(queries, np.int64)
    centers = cameras.centers
    tables = {
        "mean": (mean_weights(fitted, fitted), mean_weights(query_rows, fitted)),
        "order": (order_weights(fitted, fitted), order_weights(query_rows, fitted)),
        "cameras": (camera_weights(fitted, fitted, centers), camera_weights(query_rows, fitted, centers)),
    }
    errors = {source: map_error(_mixed(left_out, relative) - relative) for source, (left_out, _) in tables.items()}
    source = "mean"
    for other in ("order", "cameras"):
        if errors[other] < CLEARLY * errors[source]:
            source = other
    return ExposurePrediction(source, _mixed(tables[source][1], relative) + IDENTITY, errors)


def mean_weights(queries: Int64[np.ndarray, " Q"], fitted: Int64[np.ndarray, " V"]) -> Float64[np.ndarray, "Q V"]:
    """The mean of all other photographs."""
    others = (queries[:, None] != fitted).astype(np.float64)
    return others / others.sum(axis=1, keepdims=True)


def order_weights(queries: Int64[np.ndarray, " Q"], fitted: Int64[np.ndarray, " V"]) -> Float64[np.ndarray, "Q V"]:
    """Linear interpolation between the fitted photographs before and after; the nearest one at either end.

    Args:
        queries: positions in the recording; one that was fitted is interpolated as if it had not been.
        fitted: positions of the fitted photographs, rising.
    """
    before = np.searchsorted(fitted, queries, side="left") - 1
    after = np.searchsorted(fitted, queries, side="right")
    before, after = np.where(before < 0, after, before), np.where(after == len(fitted), before, after)
    span = fitted[after] - fitted[before]
    share = (queries - fitted[before]) / np.where(span, span, 1)
    weights, rows = np.zeros((len(queries), len(fitted))), np.arange(len(queries))
    weights[rows, after] = np.where(span, share, 1)
    weights[rows, before] += np.where(span, 1 - share, 0)
    return weights


def camera_weights(
    queries: Int64[np.ndarray, " Q"], fitted: Int64[np.ndarray, " V"], centers: Float[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "Q V"]:
    """The mean of the photographs whose cameras stand nearest, a camera itself left out."""
    distances = np.linalg.norm(centers[queries][:, None] - centers[fitted], axis=2)
    distances[queries[:, None] == fitted] = np.inf
    nearest = min(NEAREST, len(fitted) - 1)
    rows = np.argsort(distances, axis=1, kind="stable")[:, :nearest]
    weights = np.zeros(distances.shape)
    np.put_along_axis(weights, rows, 1 / nearest, axis=1)
    return weights


def map_error(differences: Float[torch.Tensor, "V 3 4"]) -> float:
    """Root mean square, over maps and over all colors, of what the difference of two maps makes of a color."""
    squares = torch.einsum("vij,jk,vik->v", differences, COLOR_MOMENTS.to(differences), differences) / 3
    return float(squares.mean().sqrt())


def _mixed(weights: Float64[np.ndarray, "Q V"], maps: Float[torch.Tensor, "V 3 4"]) -> Float[torch.Tensor, "Q 3 4"]:
    return torch.einsum("qv,vij->qij", torch.from_numpy(weights).to(maps), maps)
