"""Gaussians that began on a measured surface stay near the place where they stood."""

from dataclasses import dataclass

from jaxtyping import Float32, Int64
from torch import Tensor

from gsencoder.reconstruct.parameters import Parameters

SHORTEST = 1e-30
"""World units; what no float can tell from nothing would make 0 / 0 of a rate that is 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Leash:
    """Where each Gaussian began, and how far it may go from there.

    A step of Adam moves a coordinate by its rate at most, or little more. Pulling back by rate / reach of the way after
    each step therefore leaves it within about one reach, whatever its gradients say; those that disagree from one
    photograph to the next move it less. It is AdamW's decay (Loshchilov & Hutter 2019), towards the seed instead of 0.

    Attributes:
        means: the beginning, world units.
        reach: world units, above 0.
    """

    means: Float32[Tensor, "N 3"]
    reach: Float32[Tensor, " N"]

    def pull(self, means: Float32[Tensor, "N 3"], rows: Int64[Tensor, " n"], rate: float) -> None:
        """Moves rows of `means` back, in place, after a step at a learning rate in world units."""
        share = (rate / self.reach[rows]).clamp(max=1).unsqueeze(1)
        means[rows] = means[rows].lerp(self.means[rows], share)

    def keep(self, rows: Int64[Tensor, " n"]) -> "Leash":
        """That of these rows alone."""
        return Leash(means=self.means[rows], reach=self.reach[rows])


def leash_of(raw: Parameters, length: float) -> Leash:
    """A leash from where the Gaussians are now, `length` times their largest standard deviation long."""
    return Leash(means=raw["means"].clone(), reach=(length * raw["log_scales"].amax(dim=1).exp()).clamp(min=SHORTEST))
