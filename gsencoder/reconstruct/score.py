"""Scores of a splat on held-out photographs: over all pixels, and over the ones that a fitted photograph shows, in the
exposures that the fitted ones let expect."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64, UInt8
from torch import Tensor

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError, error_hint
from gsencoder.core.logs import Log
from gsencoder.data.photographs import Photographs
from gsencoder.data.seeding.stereo import confirms, sample_depth, world_points
from gsencoder.reconstruct.optimize import SAME, Exposures, Optimizer
from gsencoder.render.images import IDENTITY, inner, psnr, ssim
from gsencoder.types import Cameras
from gsencoder.types.orientation import turned

SAME_DEPTH = 0.02
"""Relative difference of measured depths up to which two photographs show the same surface."""


CLEARLY = 0.8
"""A source replaces the one before (mean, order, cameras) where its error is below this share of that one's; what is
less than a fifth better may be so by chance."""
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
    maps: Float[Tensor, "Q 3 4"]
    errors: Mapping[str, float]


def predict_exposures(exposures: Exposures | None, cameras: Cameras, queries: Sequence[int]) -> ExposurePrediction:
    """Predicts the maps of photographs that were not fitted, from the maps of the fitted ones, without a look at their
    pixels. How far exposure drifts along the recording, or with what a camera looks at, is measured on the fitted
    photographs alone: the map of each is predicted from the others, and what predicts these predicts the rest.

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


def map_error(differences: Float[Tensor, "V 3 4"]) -> float:
    """Root mean square, over maps and over all colors, of what the difference of two maps makes of a color."""
    squares = torch.einsum("vij,jk,vik->v", differences, COLOR_MOMENTS.to(differences), differences) / 3
    return float(squares.mean().sqrt())


def _mixed(weights: Float64[np.ndarray, "Q V"], maps: Float[Tensor, "V 3 4"]) -> Float[Tensor, "Q 3 4"]:
    return torch.einsum("qv,vij->qij", torch.from_numpy(weights).to(maps), maps)


class Score(NamedTuple):
    """Means over views.

    Attributes:
        psnr: in dB, of the pixels that masks leave, in the exposures that are predicted.
        matched_psnr: in dB, as psnr, after the colors of each render were fitted to its photograph by an affine map.
        seen_psnr: in dB, of those of them that some fitted photograph shows too; None where no sensor tells.
        seen: share of the pixels that are such.
        floating: mean opacity where held-out photographs show that nothing is there; None where none shows that.
    """

    psnr: float
    ssim: float
    matched_psnr: float
    seen_psnr: float | None = None
    seen_ssim: float | None = None
    seen: float | None = None
    floating: float | None = None


def covisible_pixels(
    photographs: Photographs, views: Sequence[int], training: Sequence[int]
) -> dict[int, Bool[Tensor, "H W"]]:
    """For each view the pixels whose surface some other photograph shows; nothing else can be known about the rest.

    Measured depth carries a pixel into the other photographs; it is seen where one measured the same depth there, and
    not where one looks past it, before it, or where a depth is unknown.

    Args:
        photographs: of all views; views without measured depth are left out of the result.
        training: the photographs that a splat is fitted to.
    """
    known, points, visible = {}, {}, {}
    for view in views:
        photo = photographs.at_scale(view)
        if photo.depth is not None:
            known[view] = photo.depth > 0
            points[view] = world_points(photo.depth, photo, _pose(photographs, view))[known[view]]
            visible[view] = torch.zeros_like(known[view])
    # One fitted photograph after the other, so that not all of them are held at once.
    for other in training if points else ():
        photo = photographs.at_scale(other)
        for view, positions in points.items():
            if photo.depth is not None:
                z, measured = sample_depth(positions, photo.depth, photo, _pose(photographs, other))
                visible[view][known[view]] |= confirms(z, measured, SAME_DEPTH)
    return visible


def _pose(photographs: Photographs, view: int) -> Float[Tensor, "4 4"]:
    return torch.from_numpy(photographs.cameras.cam_from_world[view].copy())


@torch.no_grad()
def score(optimizer: Optimizer, views: Sequence[int], seen: Mapping[int, Bool[Tensor, "H W"]] = {}) -> Score:
    """Mean scores of a splat on some views.

    Args:
        seen: what `covisible_pixels` found; a view of which nothing is seen, or its edges alone, in which no window of
            SSIM has its middle, counts in the whole pictures alone.
    """
    complete, covisible, shares, floating = [], [], [], []
    predicted = predict_exposures(optimizer.exposures, optimizer.photographs.cameras, views)
    for view, colors in zip(views, predicted.maps, strict=True):
        photo = optimizer.photographs.at_scale(view)
        picture, matched = optimizer.pictures(view, photo, colors)
        scores = (psnr(picture, photo.image, photo.mask), float(ssim(picture, photo.image, photo.mask)))
        complete.append((*scores, psnr(matched, photo.image, photo.mask)))
        if photo.empty is not None and photo.empty.any():
            floating.append(float(optimizer.opacity(view, photo)[photo.empty].mean()))
        if view in seen:
            mask = seen[view] if photo.mask is None else seen[view] & photo.mask
            shares.append(float(mask.float().mean()))
            if inner(mask).any():
                covisible.append((psnr(picture, photo.image, mask), float(ssim(picture, photo.image, mask))))
    overall, ssims, matched_psnr = (float(mean) for mean in np.mean(complete, axis=0))
    empty = float(np.mean(floating)) if floating else None
    means = Score(psnr=overall, ssim=ssims, matched_psnr=matched_psnr, floating=empty)
    if not covisible:
        return means
    seen_psnr, seen_ssim = (float(mean) for mean in np.mean(covisible, axis=0))
    return means._replace(seen_psnr=seen_psnr, seen_ssim=seen_ssim, seen=float(np.mean(shares)))


MAX_COMPARISONS = 4
"""Held-out photographs of which the result holds a render."""
MATCHED_GAIN = 0.5
"""Smallest gain in dB by fitting the exposure of held-out photographs that is worth a word."""
PREDICTED: dict[str, str] = {
    "mean": "those of held-out photographs cannot be predicted from them, and are taken to be the mean",
    "order": "those of held-out photographs are interpolated between the photographs before and after",
    "cameras": "those of held-out photographs are taken from the nearest cameras",
}
"""By source of an `ExposurePrediction`."""
LogRow = dict[str, int | float]
"""One line of the log: step, seconds, gaussians, and the fields of a Score."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparison:
    """A held-out photograph and the render of the same view.

    Attributes:
        render: of the reconstructed splat, in the exposure that is predicted; where photographs differ in exposure and
            nothing predicts it, in the colors that fit the photograph best.
    """

    name: str
    photograph: UInt8[np.ndarray, "H W 3"]
    render: UInt8[np.ndarray, "H W 3"]


def describe_exposure(darkest: float, brightest: float, source: str) -> str | None:
    """How the photographs differ in brightness, relative to their mean, and what predicts that of others; None where
    they hardly differ."""
    if 1 - darkest <= SAME and brightest - 1 <= SAME:
        return None
    return (
        f"the exposure of photographs differs: {darkest:.2f} to {brightest:.2f} times the mean brightness; a map of "
        f"colors was fitted to each (optimize.exposure=false fits them as they are); {PREDICTED[source]}"
    )


def compare(optimizer: Optimizer, held_out: Sequence[int], *, matched: bool) -> tuple[Comparison, ...]:
    """Evenly spaced held-out photographs with renders of their views, whose exposure is matched if so wanted."""
    chosen = [held_out[index] for index in even_indices(len(held_out), MAX_COMPARISONS)]
    predicted = predict_exposures(optimizer.exposures, optimizer.photographs.cameras, chosen)

    def pixels(image: torch.Tensor) -> UInt8[np.ndarray, "H W 3"]:
        return (image * 255 + 0.5).to(torch.uint8).numpy()

    comparisons = []
    for view, colors in zip(chosen, predicted.maps, strict=True):
        photo, orientation = optimizer.photographs.at_scale(view), optimizer.photographs.orientations[view]
        pictures = optimizer.pictures(view, photo, colors)
        comparisons.append(
            Comparison(
                name=optimizer.photographs.names[view],
                photograph=turned(pixels(photo.image), orientation),
                render=turned(pixels(pictures.matched if matched else pictures.expected), orientation),
            )
        )
    return tuple(comparisons)


def describe(row: LogRow) -> str:
    """The scores of a row in words."""
    overall = f"{row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}"
    if row["matched_psnr"] - row["psnr"] > MATCHED_GAIN:
        overall = f"{row['matched_psnr']:.2f} dB with exposures matched, {overall} without"
    if "floating" in row:
        overall += f", opacity {row['floating']:.3f} in empty space"
    if "seen_psnr" not in row:
        return overall
    return (
        f"{row['seen_psnr']:.2f} dB where a fitted photograph shows the surface ({row['seen']:.0%}), {overall} in all"
    )


START_AGAIN = "give resume=false to start again"
Report = Callable[[str], None]
"""Receives one line of text for people."""


class Validation:
    """Scores of held-out photographs: rows of the log, and lines for people.

    Attributes:
        rows: oldest first, those of the runs that this one continues among them.
    """

    def __init__(self, optimizer: Optimizer, held_out: Sequence[int], work: Path, report: Report) -> None:
        with error_hint(START_AGAIN):
            self._log = Log(work, done=optimizer.step, events=False, begun=bool(held_out and optimizer.step))
            try:
                self.rows: list[LogRow] = [
                    {name: float(cell) for name, cell in row.items()} for row in self._log.before
                ]
            except ValueError as error:
                raise InputError(f"{self._log.path}: damaged: {error}") from error
        self._optimizer, self._held_out, self._report = optimizer, held_out, report
        self._seen = covisible_pixels(optimizer.photographs, held_out, optimizer.training)

    def __call__(self, seconds: float) -> None:
        """Validates the splat as it is; `seconds` have gone since the first step."""
        one = self._optimizer
        # A continued run may begin at a step whose validation was cut off, or whose row is in the log already.
        if not self._held_out or (self.rows and self.rows[-1]["step"] == one.step):
            return
        scores = score(one, self._held_out, self._seen)._asdict().items()
        row: LogRow = {"seconds": seconds, "gaussians": len(one.parameters["means"])}
        row |= {name: value for name, value in scores if value is not None}
        size = f"{row['gaussians']:,} Gaussians"
        line = f"step {one.step} of {one.config.steps}: {describe(row)}, {size}, {row['seconds']:.0f} s"
        self._log.add(one.step, row)
        self.rows.append({"step": one.step, **row})
        self._report(line)
