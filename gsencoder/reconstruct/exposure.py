"""Per-photograph affine colors: a camera that sets exposure and white balance anew for every photograph shows one
surface in several colors, which must not be explained by geometry or by colors that depend on the direction.

The exposure of photographs that were not fitted, from the maps of those that were, without a look at their pixels.

Exposure drifts along a recording, and with what a camera looks at. How far that holds in a scene is measured on the
fitted photographs alone: the map of each is predicted from the others, and what predicts these predicts the rest.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from gsencoder.types import Cameras

RIDGE = 1e-3
"""Pull toward the identity, as a variance of colors in [0, 1]: what a picture does not vary in is not fitted."""
STEP = 0.5
"""Share of the way to the best fit that a map moves at each step of its photograph."""
OPAQUE = 0.5
"""Pixels of a render below this alpha show the background, and tell nothing."""
SAME = 0.03
"""Photographs of which no color channel differs by more from the mean do not count as differing in exposure."""
ROUNDS = 3
"""Number of steps of each photograph after which the maps, now seven eighths of the way to the fits, are judged."""

IDENTITY = torch.eye(3, 4)


class Exposures:
    """An affine map of colors for each fitted photograph, relative to the mean of all.

    The maps are not optimized by gradients, since each photograph is rendered too rarely for that: at each of its steps
    its map moves halfway to the least-squares fit. What all maps have in common, such as the loss of contrast while the
    splat is still blurred, is left to the splat: only the difference of a map from the mean of all is applied.

    Attributes:
        training: row numbers of the fitted photographs.
        maps: of these in their order, [V, 3, 4]: a matrix and an offset.
    """

    def __init__(self, training: Sequence[int], maps: Float[Tensor, "V 3 4"] | None = None) -> None:
        """Args:
        training: row numbers of the fitted photographs.
        maps: of a run that is continued; None = identities.
        """
        self.training = tuple(training)
        self._rows = {view: row for row, view in enumerate(training)}
        self.maps = IDENTITY.repeat(len(training), 1, 1) if maps is None else maps

    def moved(self, view: int, fitted: Float[Tensor, "3 4"]) -> Float[Tensor, "3 4"]:
        """The map of a photograph, a step nearer to the one that fits; nothing changes."""
        return self.maps[self._rows[view]].lerp(fitted, STEP)

    def relative(self, view: int, moved: Float[Tensor, "3 4"]) -> Float[Tensor, "3 4"]:
        """What is applied to a render of a photograph whose map is `moved`."""
        current = self.maps[self._rows[view]]
        return moved - (self.maps.sum(0) + moved - current) / len(self.maps) + IDENTITY

    def set(self, view: int, moved: Float[Tensor, "3 4"]) -> None:
        """Replaces the map of a photograph."""
        self.maps[self._rows[view]] = moved

    def brightness(self) -> Float[Tensor, " V"]:
        """How bright each photograph is, relative to their mean: what its map makes of a middle grey."""
        return self._channels().mean(-1)

    def differ(self) -> bool:
        """Whether photographs differ in exposure or white balance."""
        return float((self._channels() - 1).abs().max()) > SAME

    def _channels(self) -> Float[Tensor, "V 3"]:
        relative = self.maps - self.maps.mean(0) + IDENTITY
        return (0.5 * relative[..., :3].sum(-1) + relative[..., 3]) / 0.5


def fitted_colors(
    render: Float[Tensor, "H W 3"], image: Float[Tensor, "H W 3"], mask: Bool[Tensor, "H W"]
) -> Float[Tensor, "3 4"]:
    """The affine map A·c + b of the render's colors that is nearest to the photograph's, by ridge regression.

    Args:
        render: in [0, 1].
        mask: pixels to compare; without any the map is the identity.

    Returns:
        A in the first three columns and b in the last, on the CPU.
    """
    weights = mask.unsqueeze(-1).to(render.dtype)
    inputs = torch.cat((render, torch.ones_like(render[..., :1])), dim=-1) * weights
    rows, residuals = inputs.flatten(0, 1), ((image - render) * weights).flatten(0, 1)
    count = float(mask.sum().clamp(min=1))
    gram, moments = ((rows.T @ other).double().cpu() / count for other in (rows, residuals))
    change = torch.linalg.solve(gram + RIDGE * torch.eye(4, dtype=torch.float64), moments)
    return IDENTITY + change.T.float()


def apply_colors(colors: Float[Tensor, "H W 3"], affine: Float[Tensor, "3 4"]) -> Float[Tensor, "H W 3"]:
    """A·c + b for each pixel."""
    affine = affine.to(colors)
    return colors @ affine[:, :3].T + affine[:, 3]


def compared_pixels(alpha: Float[Tensor, "H W"], mask: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "H W"]:
    """Pixels whose colors are compared: what the splat covers and the mask leaves."""
    covered = alpha > OPAQUE
    return covered if mask is None else covered & mask.to(covered.device)


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
