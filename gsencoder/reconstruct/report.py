"""What a reconstruction tells people: its plan, its scores, and held-out photographs beside renders."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8

from gsencoder.core.arrays import even_indices
from gsencoder.reconstruct.exposure import SAME
from gsencoder.reconstruct.exposure_prediction import predict_exposures
from gsencoder.reconstruct.optimize import Optimizer
from gsencoder.types.orientation import turned

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
        name: of the view.
        photograph: as decoded.
        render: of the reconstructed splat, in the exposure that is predicted; where photographs differ in exposure and
            nothing predicts it, in the colors that fit the photograph best.
    """

    name: str
    photograph: UInt8[np.ndarray, "H W 3"]
    render: UInt8[np.ndarray, "H W 3"]


def describe_plan(optimizer: Optimizer, usual: int, seconds: float, option: str, most: int) -> str:
    """What is about to happen, and how long it should take.

    Args:
        optimizer: before its first step, or where it goes on.
        usual: number of steps by default.
        seconds: expected.
        option: that changes this number; with budget.error more follow until it is reached.
        most: number of steps that may be done for it.
    """
    widths, heights = optimizer.photographs.cameras.widths, optimizer.photographs.cameras.heights
    steps = optimizer.config.steps
    number = f"{steps - optimizer.step:,} more of {steps:,} steps" if optimizer.step else f"{steps:,} steps"
    if option == "budget.error":
        number += f", and up to {most:,} until {option} is reached"
    elif steps != usual:
        number += f" instead of {usual:,} ({option})"
    expected = f"{seconds / 60:.1f} minutes" if seconds >= 90 else f"{seconds:.0f} s"
    return (
        f"{len(optimizer.training)} photographs of {int(np.median(widths))}×{int(np.median(heights))}, "
        f"{len(optimizer.parameters['means']):,} Gaussians, {number}: about {expected}"
    )


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
    """Evenly spaced held-out photographs beside renders of their views, whose exposure is matched if so wanted."""
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
