"""Per-photograph affine colors: a camera that sets exposure and white balance anew for every photograph shows one
surface in several colors, which must not be explained by geometry or by colors that depend on the direction."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

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
        image: the photograph.
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
