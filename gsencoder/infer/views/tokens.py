"""Rendered features in the layout of a vision tower's output: what a VLM can take in place of its own.

SplatDistill sec. 3.4 feeds maps that were rendered from the features of the tower's kind to VILA; M3 decodes such maps
at any pose.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.render import Blend, BlendConfig, blend
from gsencoder.types import Cameras, FeatureMap, FeatureSpace, GaussianFeatures, Gaussians

Fit = Literal["stretch", "crop"]
MOST_CELLS = 1 << 16


def tower_grid(width: int, height: int, grid: tuple[int, int], fit: Fit = "stretch") -> Float64[np.ndarray, "2 3"]:
    """From pixels of a picture to cells of a tower's grid, by the tower's own preprocessing.

    Args:
        width: of the picture, pixels.
        height: of the picture, pixels.
        grid: rows and columns of patches.
        fit: stretch = the whole picture is resized to the tower's, whatever its shape; crop = it is resized until it
            covers the tower's, and the middle is cut out. Square pictures need neither, nor the padding of towers that
            make a square by it.

    Raises:
        InputError: a grid without cells.
    """
    lines, columns = grid
    if not (lines >= 1 and columns >= 1 and lines * columns <= MOST_CELLS):
        raise InputError(f"grid: expected rows and columns of 1 or more, at most {MOST_CELLS:,} cells, got {grid}")
    scale = np.array([columns / width, lines / height])
    if fit == "crop":
        scale[:] = scale.max()
    offset = (np.array([columns, lines]) - scale * (width, height)) / 2
    return np.array([[scale[0], 0, offset[0]], [0, scale[1], offset[1]]])


def token_blends(
    gaussians: Gaussians,
    cameras: Cameras,
    grid: tuple[int, int],
    *,
    fit: Fit = "stretch",
    config: BlendConfig = BlendConfig(),
) -> tuple[Blend, ...]:
    """The blending weights of each view, pooled to a tower's grid: keep them to render several features.

    Args:
        gaussians: the splat.
        cameras: in the same world.
        grid: rows and columns of the tower's patches.
        fit: see `tower_grid`.
        config: accuracy knobs.

    Raises:
        InputError: a grid without cells.
    """
    # A blend takes its grid from a map.
    space, cells = FeatureSpace(name="grid", channels=1), np.zeros((*grid, 1), np.float32)
    sizes = list(zip(cameras.widths.tolist(), cameras.heights.tolist(), strict=True))
    return tuple(
        blend(
            gaussians,
            cameras,
            view,
            like=FeatureMap(grid_from_image=tower_grid(*size, grid, fit), space=space, features=cells),
            config=config,
        )
        for view, size in enumerate(sizes)
    )


def feature_tokens(blends: Sequence[Blend], features: GaussianFeatures) -> Float[Tensor, "V tokens D"]:
    """Rendered features of views as a vision tower would give them: patches in lines from the top left, D channels.

    A token is mean + Σᵢ B[p, i] (fᵢ − mean): where rays meet nothing, or Gaussians that no teacher saw, the mean of the
    space stands.

    In a model of transformers these replace what the vision tower gives to the model's connector, by a forward hook on
    the tower. Where that is depends on the model: `last_hidden_state` for Idefics3 and SmolVLM, `hidden_states[-2]` for
    LLaVA, so that features must be of that layer; towers that begin with a summary token need theirs put first, and
    those that merge patches before they give them (Qwen2-VL) need tokens on the merged grid.

    Args:
        blends: of `token_blends`, one for each view, all on one grid.
        features: of the same Gaussians.

    Returns:
        float32.

    Raises:
        InputError: blends of another splat or of several grids, or no blends.
    """
    if not blends or len({each.shape for each in blends}) > 1:
        raise InputError(f"tokens: expected blends on one grid, got {sorted({each.shape for each in blends})}")
    if any(each.gaussians != len(features) for each in blends):
        raise InputError(f"tokens: features of {len(features):,} Gaussians, blends of {blends[0].gaussians:,}")
    values = torch.from_numpy(features.stored())
    if features.basis is None:
        values = values - torch.from_numpy(features.mean)
    values = values * torch.from_numpy(features.seen)[:, None]
    tokens = torch.stack([each.render(values) for each in blends])
    if features.basis is not None:
        tokens = tokens @ torch.from_numpy(features.basis.components)
    return tokens + torch.from_numpy(features.mean)
