"""What a pixel attends to: the components to which its query gives the largest weights (M3, appendix A)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from gsencoder.core.arrays import even_indices
from gsencoder.core.errors import InputError
from gsencoder.memory.attention import render_queries
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.types import Cameras, Gaussians, QueryMemory

MIN_ALPHA = 0.5
"""Opacity, of Gaussians with a query, from which a pixel may be chosen."""
GRID = 64
"""Pixels of the longer side among which one is chosen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PixelAttention:
    """The strongest components of a pixel, strongest first.

    Attributes:
        pixel: column and row of the pixel.
        components: rows of the bank.
        weights: of these in the attention, in which those of all components sum to 1.
    """

    pixel: tuple[int, int]
    components: Int64[np.ndarray, " k"]
    weights: Float32[np.ndarray, " k"]


def strongest_components(
    memory: QueryMemory,
    gaussians: Gaussians,
    cameras: Cameras,
    view: int,
    pixel: tuple[int, int],
    count: int,
    *,
    config: BlendConfig = BlendConfig(),
    blended: Blend | None = None,
) -> PixelAttention:
    """The components that a pixel's rendered query gives the largest weights; of equal ones the first.

    Args:
        memory: of the Gaussians.
        gaussians: the splat.
        cameras: in the same world.
        view: which camera.
        pixel: its column x and row y.
        count: at most so many components.
        config: accuracy of the rendering, where the blend must be made.
        blended: the view's pixel blend, where it has been made already.

    Raises:
        InputError: no such pixel, nothing with a query is seen in it, a count below 1, or a memory of other Gaussians.
    """
    x, y = pixel
    width, height = int(cameras.widths[view]), int(cameras.heights[view])
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(f"pixel ({x}, {y}): expected a column from 0 to {width - 1} and a row from 0 to {height - 1}")
    if count < 1:
        raise InputError(f"count: expected 1 component or more, got {count}")
    # A camera of this pixel alone would see Gaussians at its rim linearized elsewhere.
    b = blend(gaussians, cameras, view, config=config) if blended is None else blended
    queries, alpha = (rows[[y * width + x]] for rows in render_queries(memory, b))
    if not alpha[0] > 0:
        raise InputError(
            f"pixel ({x}, {y}): no Gaussian with a query is seen in this pixel of view {view}; choose a pixel in which "
            "the rendered view shows something"
        )
    weights = memory.attention(queries)[0]
    order = np.argsort(-weights, kind="stable")[:count]
    return PixelAttention(pixel=(x, y), components=order, weights=weights[order])


def salient_pixel(memory: QueryMemory, b: Blend) -> tuple[int, int] | None:
    """The pixel whose attention has the lowest entropy, so that few components are most of it: among evenly spaced
    pixels that are opaque, those of the middle half of the view if any of them is. None where no pixel is opaque.

    Args:
        memory: of the Gaussians of B.
        b: of all pixels of the view.

    Raises:
        InputError: B has other Gaussians.
    """
    height, width = b.shape
    columns, rows = (even_indices(size, max(1, size * GRID // max(height, width))) for size in (width, height))
    x, y = (each.ravel() for each in np.meshgrid(columns, rows))
    queries, alpha = render_queries(memory, b)
    opaque = alpha[y * width + x] >= MIN_ALPHA
    middle = (abs(2 * x + 1 - width) <= width / 2) & (abs(2 * y + 1 - height) <= height / 2)
    chosen = opaque & middle if (opaque & middle).any() else opaque
    if not chosen.any():
        return None
    pixels = (y * width + x)[chosen]
    entropy = attention_entropy(memory.attention(queries[pixels]))
    best = int(pixels[int(entropy.argmin())])
    return best % width, best // width


def attention_entropy(weights: Float32[np.ndarray, "n M"]) -> Float32[np.ndarray, " n"]:
    """−Σ w log w of each row of weights that sum to 1, in nats: 0 for one component, log M for M equal ones."""
    logs = np.log(np.maximum(weights, np.finfo(np.float32).tiny))
    return np.asarray(-(weights * logs).sum(axis=1), np.float32)
