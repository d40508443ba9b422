"""Anchors: Gaussians that were seeded on a measured surface stay near their seeds."""

from dataclasses import dataclass

from jaxtyping import Float32, Int64
from torch import Tensor

from gsencoder.reconstruct.parameters import Parameters

MIN_REACH = 1e-30
"""Smallest reach in world units: a reach of 0 would divide a learning rate of 0 by 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Anchor:
    """Initial means of Gaussians, and how far each may move from there.

    A step of Adam moves a coordinate by its rate at most, or little more. Pulling back by rate / reach of the way after
    each step therefore leaves it within about one reach, whatever its gradients say; those that disagree from one
    photograph to the next move it less. It is AdamW's decay (Loshchilov & Hutter 2019), towards the seed instead of 0.

    Attributes:
        means: initial centers, world units.
        reach: distance in world units, above 0.
    """

    means: Float32[Tensor, "N 3"]
    reach: Float32[Tensor, " N"]

    def pull(self, means: Float32[Tensor, "N 3"], rows: Int64[Tensor, " n"], rate: float) -> None:
        """Moves rows of `means` back, in place, after a step at a learning rate in world units."""
        share = (rate / self.reach[rows]).clamp(max=1).unsqueeze(1)
        means[rows] = means[rows].lerp(self.means[rows], share)

    def keep(self, rows: Int64[Tensor, " n"]) -> "Anchor":
        """The anchor of some rows."""
        return Anchor(means=self.means[rows], reach=self.reach[rows])


def anchor_at(raw: Parameters, length: float) -> Anchor:
    """An anchor at the present means, with a reach of `length` times each Gaussian's largest standard deviation."""
    return Anchor(means=raw["means"].clone(), reach=(length * raw["log_scales"].amax(dim=1).exp()).clamp(min=MIN_REACH))
