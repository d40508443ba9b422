"""The losses of distillation (SplatDistill Eqs. 3–5), as weighted sums, so that a step divides once by global weights.

Losses work in the units of the encoder's outputs (`OutputSpace`): by default standard units about the mean of the
space, since raw CLIP-like vectors are nearly parallel, and the cosine between them hardly distinguishes names.

Eq. 4 of the paper is written with the render of G_fused, which has no parameters. It is computed here with the render
of the predicted features, which can be trained.

The loss of a step: weighted terms, each a sum over the micro-batches of all processes, divided once.

term = Σ total / Σ divisor,     loss = Σ lambda · term
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor, nn
from torch.nn import functional

from gsencoder.core.errors import InputError
from gsencoder.render import Blend
from gsencoder.train.distributed import STOPPED_ELSEWHERE, sum_over_processes

EPS = 1e-12
MAX_RARITY = 4.0
"""Limit of the power of class frequencies: with it a Gaussian of a class of 10⁶ already weighs 1e-24."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LossConfig:
    """Weights and parameters of the loss terms."""

    cosine: float = field(default=0.9, metadata={"help": "α: weight of 1 − cosine in the matching loss"})
    smooth_l1: float = field(default=0.1, metadata={"help": "β: weight of the smooth L1 distance in the matching loss"})
    confidence: bool = field(
        default=True,
        metadata={"help": "weight the cosine of a target near the mean by the target's length; false = Eq. 3 as it is"},
    )
    field_weight: float = field(default=1.0, metadata={"help": "λ of the loss on Gaussians (L_3D)"})
    render_weight: float = field(default=0.2, metadata={"help": "λ of the loss on rendered cells (L_render); 0 = off"})
    contrast_weight: float = field(
        default=0.0, metadata={"help": "λ of the cross-entropy among target classes (L_contrast); 0 = off"}
    )
    contrast_clusters: bool = field(
        default=False,
        metadata={"help": "L_contrast also among clusters of the targets of dense teachers, which have no names"},
    )
    temperature: float = field(
        default=0.1, metadata={"help": "temperature of the softmax in L_contrast, in squared typical distances"}
    )
    rarity: float = field(
        default=0.5,
        metadata={
            "help": "power p of class weights: targets of a class with n Gaussians are weighted by n^−p; 0 = equally"
        },
    )
    divide_by_alpha: bool = field(
        default=True,
        metadata={"help": "compare rendered features divided by the cell's opacity; false = as they are composited"},
    )
    min_alpha: float = field(default=0.5, metadata={"help": "smallest opacity that a cell must have to enter L_render"})
    min_kept: float = field(
        default=0.95,
        metadata={"help": "smallest share of a cell's weight that must be in the crop for the cell to enter L_render"},
    )
    teacher_weights: tuple[float, ...] = field(
        default=(),
        metadata={"help": "weights of the losses of several teachers, in their order; empty = all equal 1"},
    )

    def __post_init__(self) -> None:
        for name in ("cosine", "smooth_l1", "field_weight", "render_weight", "contrast_weight", "rarity"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InputError(f"{name}: expected 0 or more, got {getattr(self, name)}")
        if self.rarity > MAX_RARITY:
            raise InputError(
                f"rarity: expected at most {MAX_RARITY}, got {self.rarity}: only the rarest classes would keep a weight"
            )
        if not 0 < self.temperature < float("inf"):
            raise InputError(f"temperature: expected a positive number, got {self.temperature}")
        for name in ("min_alpha", "min_kept"):
            if not 0 < getattr(self, name) <= 1:
                raise InputError(f"{name}: expected a number in (0, 1], got {getattr(self, name)}")
        if not all(0 <= weight < float("inf") for weight in self.teacher_weights) or (
            self.teacher_weights and not sum(self.teacher_weights) > 0
        ):
            raise InputError(
                f"teacher_weights: expected numbers of 0 or more, not all 0, got {list(self.teacher_weights)}"
            )
        if not (self.cosine + self.smooth_l1 > 0 or self.contrast_weight > 0):
            raise InputError(
                "cosine and smooth_l1: expected one above 0 unless contrast_weight is; there would be no loss"
            )
        if not self.field_weight + self.render_weight + self.contrast_weight > 0:
            raise InputError(
                "field_weight, render_weight and contrast_weight: expected one above 0; there would be no loss"
            )


class AdapterHead(nn.Module):
    """A frozen adapter head of a teacher: from decoded features to standard units of another feature space.

    The distilled features must work with these heads as the teacher's features do (SplatDistill sec. 3.3).
    """

    mean: Tensor

    def __init__(self, body: nn.Module, mean: Float[Tensor, " E"], scale: float) -> None:
        """Args:
        body: network from features [n, D] to vectors [n, E].
        mean: mean of the outputs of `body` for the teacher's features.
        scale: root mean square distance of these outputs from their mean.
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
    """The matching loss of each row (Eq. 3): α·(1 − cos)·c + β·smooth-L1, averaged over channels.

    With `config.confidence` the factor c is min(1, |target| / √C), and else 1, as in the paper. √C is the root mean
    square length of targets in standard units. Near the mean, where "other" lies, the direction of a target is mostly
    noise, so its cosine is weighted by the target's relative length.
    """
    predicted, target = predicted.float(), target.float()
    lengths = torch.sqrt((target * target).sum(dim=1) + EPS)
    cosines = (predicted * target).sum(dim=1) / (lengths * torch.sqrt((predicted * predicted).sum(dim=1) + EPS))
    directions = 1 - cosines
    if config.confidence:
        directions = directions * (lengths / target.shape[1] ** 0.5).clamp(max=1)
    distance = functional.smooth_l1_loss(predicted, target, reduction="none").mean(dim=1)
    return config.cosine * directions + config.smooth_l1 * distance


def field_loss(
    predicted: Float[Tensor, "N C"], target: Float[Tensor, "N C"], weights: Float[Tensor, " N"], config: LossConfig
) -> Float[Tensor, ""]:
    """L_3D (Eq. 3) before division: Σ_i w_i · match_i over Gaussians; those of weight 0 have no target."""
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
    """L_contrast before division: Σ_i w_i · cross-entropy of the class of target i, with the class probabilities
    softmax_k(−|predicted − c_k|² / (2·C·temperature)).

    If two classes look alike, L_3D is smallest at a mean of both, which may be nearest to a third class. This term
    moves the prediction towards the likelier of the two, so that it is also the nearest vector of the codebook.

    Args:
        predicted: predicted features, units of the outputs.
        codes: for each Gaussian, the class of its target, which is a row of the codebook.
        weights: weights in the loss; 0 for Gaussians without a target, whose codes are ignored.
        codebook: vectors c_k of the target classes, standard units.
        config: settings, of which the temperature is used.
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
    heads: Sequence[tuple[AdapterHead, nn.Module]] = (),
) -> Float[Tensor, ""]:
    """L_render (Eq. 4) before division: Σ_p w_p · match((B f)_p / alpha_p, t_p) over cells of the teacher's grid.

    alpha_p is the weight of the crop's Gaussians in cell p, so the rendered features are weighted means. Without
    `config.divide_by_alpha` it is 1, and they are the composited features.

    Args:
        predicted: predicted features f of the Gaussians of the sample, standard units.
        blend: B over these Gaussians, with one row for each cell.
        target: the teacher's vectors t in the cells, standard units.
        weights: weights of the cells in the loss.
        config: settings of the matching loss.
        heads: adapter heads, each with a decoder from standard units to its input; the loss is summed over the outputs
            of the heads. Both sides are decoded from the dataset's basis, so what it drops of the teacher's vectors is
            missing in both. Without heads the features themselves are compared.
    """
    rendered = blend.render(predicted.float())
    if config.divide_by_alpha:
        rendered = rendered / blend.alpha.clamp(min=EPS).unsqueeze(1)
    if not heads:
        losses = match_loss(rendered, target, config)
    else:
        losses = torch.stack(
            [match_loss(head(decode(rendered)), head(decode(target)), config) for head, decode in heads]
        ).sum(dim=0)
    return (losses * weights).sum()


NO_WEIGHT = 1e-12
"""Divisor of a term that nothing in a step has a weight for."""


@runtime_checkable
class TrainingBatch(Protocol):
    """A batch of samples.

    Attributes:
        names: of the samples, for messages.
    """

    @property
    def names(self) -> Sequence[str]: ...

    def to(self, device: torch.device) -> "TrainingBatch": ...


@runtime_checkable
class Objective(Protocol):
    """The loss of a network as weighted terms. In a step each term is Σ total / Σ divisor, summed over all
    micro-batches of all processes.

    Attributes:
        network: the network to call, possibly compiled or wrapped for several processes.
        lambdas: the weights of the terms that are not 0, by name.
        advice: for the error where no term has a divisor above 0: what the user should check.
    """

    network: nn.Module

    @property
    def lambdas(self) -> dict[str, float]: ...

    @property
    def advice(self) -> str: ...

    def divisors(self, batch: Any) -> dict[str, float]:
        """The sum of the weights of a batch's rows, for each term."""
        ...

    def __call__(self, batch: Any) -> dict[str, Tensor]:
        """The totals of the terms whose weight is not 0."""
        ...


def sum_divisors(
    objective: Objective, items: Sequence[TrainingBatch | InputError], device: torch.device
) -> tuple[list[TrainingBatch], dict[str, float]]:
    """Separates the batches of a step from errors, and sums the divisors of its loss terms over all processes.

    Args:
        objective: gives the divisors of a batch.
        items: micro-batches of this process, or the errors of their samples.

    Returns:
        The batches, and for each term its divisor, at least `NO_WEIGHT`.
    """
    batches = [item for item in items if not isinstance(item, InputError)]
    lambdas = objective.lambdas
    batch_divisors = [objective.divisors(batch) for batch in batches]
    sums = [sum(divisors[name] for divisors in batch_divisors) for name in lambdas]
    failed = len(items) - len(batches)
    totals = sum_over_processes(torch.tensor([*sums, failed], dtype=torch.float64, device=device)).tolist()
    for item in items:
        if isinstance(item, InputError):
            raise item
    if totals[-1]:
        raise InputError(STOPPED_ELSEWHERE)
    if not any(totals[:-1]):
        names = "; ".join(name for batch in batches for name in batch.names)
        raise InputError(
            f"training: there is nothing to compare in {names}: no Gaussian has a target with a weight, and no "
            f"cell of the teacher passes the thresholds; check {objective.advice}, and these scenes"
        )
    return batches, {name: max(total, NO_WEIGHT) for name, total in zip(lambdas, totals, strict=False)}


def finite_terms(
    step: int,
    batches: Sequence[TrainingBatch],
    names: Sequence[str],
    micro_terms: Float64[Tensor, "micro terms"],
    norm: float,
    *,
    processes: int,
) -> dict[str, float]:
    """The loss terms of a step over all processes, by name.

    Args:
        step: number of the step, for messages.
        batches: micro-batches of this process.
        names: of the terms.
        micro_terms: what each micro-batch adds to each term.
        norm: norm of the gradient, which is summed over all processes.
        processes: their number.
    """
    bad_loss = bad_gradient = ""
    for batch, row in zip(batches, micro_terms.tolist(), strict=True):
        for name, value in zip(names, row, strict=True):
            if not math.isfinite(value):
                bad_loss = bad_loss or f"the {name} loss of {'; '.join(batch.names)}"
    if not bad_loss and not math.isfinite(norm):
        # Gradients are already summed over processes, so samples of any of them may be the cause.
        samples = "; ".join(name for batch in batches for name in batch.names)
        bad_gradient = f"the gradient of {samples}{' or of samples of other processes' if processes > 1 else ''}"
    flags = micro_terms.new_tensor([float(bool(bad_loss)), float(bool(bad_gradient))])
    *totals, bad_losses, bad_gradients = sum_over_processes(torch.cat((micro_terms.sum(dim=0), flags))).tolist()
    if bad_losses or bad_gradients:
        # A loss identifies the samples that cause it; the gradient is named only if all losses are finite.
        where = bad_loss or ("a loss of another process" if bad_losses else bad_gradient)
        raise InputError(
            f"training: {where} is not finite at step {step}; parameters were not changed. Use a lower "
            "learning_rate, or check these scenes (`gsencoder inspect`)"
        )
    return dict(zip(names, totals, strict=True))
