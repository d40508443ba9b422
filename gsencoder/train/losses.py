"""The losses of distillation (SplatDistill Eqs. 3–5): unreduced, so that a step divides once, by global counts.

All of them work in standard units (`OutputSpace`), about the space's mean: raw CLIP-like vectors are nearly parallel,
and a cosine between them hardly tells names apart.

Eq. 4 of the paper prints the render of G_fused, which has no parameters; what trains is the render of the predicted
features, and that is what stands here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from gsencoder.core.errors import InputError
from gsencoder.render import Blend

EPS = 1e-12
MOST_RARITY = 4.0
"""Kinds of a million Gaussians then still count 1e-24 times as much as one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossConfig:
    """What is compared, and how much it counts."""

    cosine: float = field(default=0.9, metadata={"help": "α: weight of 1 − cosine in the matching loss"})
    smooth_l1: float = field(default=0.1, metadata={"help": "β: weight of the smooth L1 distance in it"})
    field_weight: float = field(default=1.0, metadata={"help": "λ of the loss on Gaussians"})
    render_weight: float = field(default=0.2, metadata={"help": "λ of the loss on rendered cells; 0 = not rendered"})
    contrast_weight: float = field(
        default=0.0, metadata={"help": "λ of telling a target's kind from the dataset's others; 0 = not asked"}
    )
    temperature: float = field(
        default=0.1, metadata={"help": "of the contrast: how much nearer its own kind must be, in typical distances²"}
    )
    rarity: float = field(
        default=0.5, metadata={"help": "targets of a kind with n Gaussians in the dataset count n^−this; 0 = all alike"}
    )
    min_alpha: float = field(default=0.5, metadata={"help": "cells less opaque than this are not compared"})
    min_kept: float = field(
        default=0.95, metadata={"help": "cells that lose more of their weight to the selection are not compared"}
    )

    def __post_init__(self) -> None:
        for name in ("cosine", "smooth_l1", "field_weight", "render_weight", "contrast_weight", "rarity"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        if self.rarity > MOST_RARITY:
            raise InputError(
                f"rarity: expected at most {MOST_RARITY}, got {self.rarity}: all but the rarest would be 0"
            )
        if not 0 < self.temperature < float("inf"):
            raise InputError(f"temperature: expected a positive number, got {self.temperature}")
        for name in ("min_alpha", "min_kept"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError(f"{name}: expected a share in (0, 1], got {getattr(self, name)}")
        if not (self.cosine + self.smooth_l1 > 0 or self.contrast_weight > 0):
            raise InputError("cosine and smooth_l1: expected one above 0, there is no loss left")
        if not self.field_weight + self.render_weight + self.contrast_weight > 0:
            raise InputError(
                "field_weight, render_weight and contrast_weight: expected one above 0, there is no loss left"
            )


class Head(nn.Module):
    """A teacher's adapter head, frozen: from decoded features to another space, in standard units of that space.

    The network's features must serve these heads as the teacher's own do (SplatDistill sec. 3.3).
    """

    mean: Tensor

    def __init__(self, body: nn.Module, mean: Float[Tensor, " E"], scale: float) -> None:
        """Args:
        body: features [n, D] to vectors [n, E].
        mean: of the head's outputs over the dataset.
        scale: their root mean square distance from it.
        """
        super().__init__()
        if not 0 < scale < float("inf"):
            raise InputError(f"heads: expected a positive scale, got {scale}")
        self.body = body.requires_grad_(False)
        self.register_buffer("mean", mean)
        self.unit = scale / len(mean) ** 0.5

    def forward(self, features: Float[Tensor, "n D"]) -> Float[Tensor, "n E"]:
        out: Tensor = (self.body(features) - self.mean) / self.unit
        return out


def match_loss(
    predicted: Float[Tensor, "n C"], target: Float[Tensor, "n C"], config: LossConfig
) -> Float[Tensor, " n"]:
    """α·(1 − cos)·min(1, |target| / √C) + β·smooth-L1, averaged over channels (Eq. 3), for each row.

    √C is the length of a typical target in standard units. Near the mean a target's direction is noise (it is where
    "other" lies), so the cosine counts in proportion there.
    """
    predicted, target = predicted.float(), target.float()
    lengths = torch.sqrt((target * target).sum(dim=1) + EPS)
    cosines = (predicted * target).sum(dim=1) / (lengths * torch.sqrt((predicted * predicted).sum(dim=1) + EPS))
    sure = (lengths / target.shape[1] ** 0.5).clamp(max=1)
    distance = functional.smooth_l1_loss(predicted, target, reduction="none").mean(dim=1)
    return config.cosine * (1 - cosines) * sure + config.smooth_l1 * distance


def field_loss(
    predicted: Float[Tensor, "N C"], target: Float[Tensor, "N C"], weights: Float[Tensor, " N"], config: LossConfig
) -> Float[Tensor, ""]:
    """L_3D (Eq. 3) before its division: Σ_i w_i · match_i over Gaussians; those of weight 0 were never seen and have no
    target."""
    rows = torch.nonzero(weights).squeeze(1)
    losses = match_loss(predicted.index_select(0, rows), target.index_select(0, rows), config)
    return (losses * weights.index_select(0, rows)).sum()


def contrast_loss(
    predicted: Float[Tensor, "N C"],
    codes: Int64[Tensor, " N"],
    weights: Float[Tensor, " N"],
    codebook: Float[Tensor, "K C"],
    config: LossConfig,
) -> Float[Tensor, ""]:
    """Σ_i w_i · cross-entropy of a target's kind among all kinds, softmax_k(−|predicted − c_k|² / (2·C·temperature)).

    Where two kinds look alike, what fits both best under L_3D is their mean, which may be nearest to a third. This term
    makes the likelier one win, by as much as the features are told apart by later: their nearest vector.

    Args:
        predicted: standard units.
        codes: for each Gaussian the row of the codebook that its target is nearest to.
        weights: in the loss; 0 where a Gaussian has no target, and whatever its code is is not looked at.
        codebook: kinds of target, standard units.
        config: for the temperature.
    """
    rows = torch.nonzero(weights).squeeze(1)
    half = 0.5 * (codebook * codebook).sum(dim=1)
    logits = (predicted.index_select(0, rows) @ codebook.T - half) / (codebook.shape[1] * config.temperature)
    losses = functional.cross_entropy(logits, codes.index_select(0, rows), reduction="none")
    return (losses * weights.index_select(0, rows)).sum()


def render_loss(
    predicted: Float[Tensor, "N C"],
    blend: Blend,
    target: Float[Tensor, "P C"],
    weights: Float[Tensor, " P"],
    config: LossConfig,
    heads: Sequence[tuple[Head, nn.Module]] = (),
) -> Float[Tensor, ""]:
    """L_render (Eq. 4) before its division: Σ_p w_p · match((B f)_p / alpha_p, t_p) over cells of the teacher's grid.

    The division by alpha is by what of each cell the selection covers.

    Args:
        predicted: on the Gaussians of the sample.
        blend: B over these Gaussians, rows of the cells that are compared.
        target: the teacher's vectors there.
        weights: of the rows.
        config: weights of the terms.
        heads: each with what decodes standard units to the teacher's space; the loss is summed over heads. Without
            heads features are compared as they are.
    """
    alpha = blend.alpha.clamp(min=EPS).unsqueeze(1)
    rendered = blend.render(predicted.float()) / alpha
    if not heads:
        losses = match_loss(rendered, target, config)
    else:
        losses = torch.stack(
            [match_loss(head(decode(rendered)), head(decode(target)), config) for head, decode in heads]
        ).sum(dim=0)
    return (losses * weights).sum()
