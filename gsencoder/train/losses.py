"""The losses of SplatDistill (sec. 3.3), what they compare, and the table of them.

    L = Σ_teachers w · Σ_terms λ_term · L_term,   L_term = Σ_i w_i · loss_i / Σ_i w_i

A new term is a function of this file, its line in `TERMS`, and the field `NAME_weight` of `LossConfig`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float16, Float32, Int32, Int64
from torch import Tensor, nn
from torch.nn import functional

from gsencoder.core.errors import InputError
from gsencoder.core.settings import check_limits, option
from gsencoder.fusion.measured_heads import HeadSet
from gsencoder.models.output_space import OutputSpace, check_heads_space
from gsencoder.models.plan import Plan
from gsencoder.render import Blend, BlendConfig
from gsencoder.render.blend_cpu import Lattice

EPS = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class LossConfig:
    """Weights and parameters of the loss terms."""

    cosine: float = option(0.9, "α: weight of 1 − cosine in the matching loss", ge=0)
    smooth_l1: float = option(0.1, "β: weight of the smooth L1 distance in the matching loss", ge=0)
    confidence: bool = option(
        True, "weight the cosine of a target near the mean by the target's length; false = Eq. 3 as it is"
    )
    field_weight: float = option(1.0, "λ of the loss on Gaussians (L_3D)", ge=0)
    render_weight: float = option(0.2, "λ of the loss on rendered cells (L_render); 0 = off", ge=0)
    contrast_weight: float = option(0.0, "λ of the cross-entropy among target classes (L_contrast); 0 = off", ge=0)
    contrast_clusters: bool = option(
        False, "L_contrast also among clusters of the targets of dense teachers, which have no names"
    )
    temperature: float = option(0.1, "temperature of the softmax in L_contrast, in squared typical distances", gt=0)
    rarity: float = option(
        0.5,
        "power p of class weights: targets are weighted by n^−p, where their class has n in the sample; 0 = equally",
        ge=0,
        le=4,
    )
    divide_by_alpha: bool = option(
        True, "compare rendered features divided by the cell's opacity; false = as they are composited"
    )
    min_alpha: float = option(0.5, "smallest opacity that a cell must have to enter L_render", gt=0, le=1)
    min_kept: float = option(
        0.95, "smallest share of a cell's weight that must be in the crop for the cell to enter L_render", gt=0, le=1
    )
    teacher_weights: tuple[float, ...] = option(
        (), "weights of the losses of several teachers, in their order; empty = all equal 1", ge=0
    )

    def __post_init__(self) -> None:
        check_limits(self)
        if self.teacher_weights and not sum(self.teacher_weights) > 0:
            raise InputError("teacher_weights: expected one above 0")
        if not (self.cosine + self.smooth_l1 > 0 or self.contrast_weight > 0):
            raise InputError(
                "cosine and smooth_l1: expected one above 0 unless contrast_weight is; there would be no loss"
            )
        if not any(self.lambdas.values()):
            names = ", ".join(f"{name}_weight" for name in TERMS)
            raise InputError(f"{names}: expected one above 0; there would be no loss")

    @property
    def lambdas(self) -> dict[str, float]:
        """The weight of each term of `TERMS`."""
        return {name: getattr(self, f"{name}_weight") for name in TERMS}


class RenderRows(NamedTuple):
    """Rows of B for the render loss, over the Gaussians of a sample or a batch, in compressed form as in
    `gsencoder.render.Blend`, with the teacher's vectors in the cells, in standard units, and the weight of each row."""

    crow: Int64[Tensor, " P_plus_1"]
    col: Int32[Tensor, " nnz"]
    weight: Float[Tensor, " nnz"]
    targets: Float[Tensor, "P C"]
    row_weights: Float[Tensor, " P"]

    def blend(self, gaussians: int) -> Blend:
        """The rows as a `Blend`. They are not the pixels of an image, so its lattice is a single column."""
        lattice = Lattice(height=len(self.crow) - 1, width=1, side=1, x0=0.5, y0=0.5, dx=1.0, dy=1.0)
        depths = self.weight.new_zeros(gaussians)
        return Blend(self.crow, self.col, self.weight, depths, lattice, BlendConfig())


class TeacherTargets(NamedTuple):
    """What one teacher says of the Gaussians and views of a sample or a batch. Targets are in standard units, in
    float16, since samples that are made ahead fill shared memory; the code of a Gaussian is the class of its target, a
    row of the teacher's codebook, and its weight in the loss is 0 without a target."""

    targets: Float16[Tensor, "N C"]
    codes: Int64[Tensor, " N"]
    loss_weights: Float[Tensor, " N"]
    rows: RenderRows


class Batch(NamedTuple):
    """A batch of samples, concatenated along Gaussians, tokens and rows; `names` are scene and views of each sample,
    for messages. In scenes that lack a teacher its targets have no weight."""

    names: tuple[str, ...]
    attributes: Float[Tensor, "N A"]
    opacities: Float[Tensor, " N"]
    plan: Plan
    teachers: tuple[TeacherTargets, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TeacherRecipe:
    """A teacher of a training: the weight of its losses, and whether its targets have classes that a term of the loss
    may compare. The columns of the codebook are the teacher's columns of the encoder's outputs."""

    name: str
    codebook: Float32[np.ndarray, "C channels"]
    weight: float = 1.0
    classes: bool = True

    @property
    def channels(self) -> int:
        """Columns of its targets."""
        return self.codebook.shape[1]


class AdapterHead(nn.Module):
    """A frozen adapter head of a teacher: from decoded features to standard units of another feature space.

    The distilled features must work with these heads as the teacher's features do (SplatDistill sec. 3.3).
    """

    mean: Tensor

    def __init__(self, body: nn.Module, mean: Float[Tensor, " E"], scale: float) -> None:
        """The `body` leads from features [n, D] to vectors [n, E]; for the teacher's features these have the mean
        `mean`, and `scale` is the root mean square distance from it."""
        super().__init__()
        if not 0 < scale < float("inf"):
            raise InputError(f"heads: expected a positive scale, got {scale}")
        self.body = body.requires_grad_(False)
        self.register_buffer("mean", mean)
        self.unit = scale / len(mean) ** 0.5

    def forward(self, features: Float[Tensor, "n D"]) -> Float[Tensor, "n E"]:
        out: Tensor = (self.body(features) - self.mean) / self.unit
        return out


Heads = Sequence[tuple[AdapterHead, nn.Module]]
"""Adapter heads of a teacher, each with a decoder from standard units to its input."""


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
    softmax_k(−|predicted − c_k|² / (2·C·temperature)) for the vectors c_k of the codebook.

    If two classes look alike, L_3D is smallest at a mean of both, which may be nearest to a third class. This term
    moves the prediction towards the likelier of the two, so that it is also the nearest vector of the codebook.
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
    heads: Heads = (),
) -> Float[Tensor, ""]:
    """L_render (Eq. 4) before division: Σ_p w_p · match((B f)_p / alpha_p, t_p) over cells of the teacher's grid.

    alpha_p is the weight of the crop's Gaussians in cell p, so the rendered features are weighted means. Without
    `config.divide_by_alpha` it is 1, and they are the composited features. With heads the loss is summed over their
    outputs; both sides are decoded from the dataset's basis, so what it drops is missing in both.
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


class LossInputs(NamedTuple):
    """What a term is computed from: the columns of one teacher, in standard units."""

    predicted: Float[Tensor, "N C"]
    targets: TeacherTargets
    codebook: Float[Tensor, "K C"]
    heads: Heads
    config: LossConfig


class Term(NamedTuple):
    """A term of the loss: Σ_i w_i · loss_i, its weights w, which are known before anything is computed, and whether it
    compares classes of targets, which dense teachers lack. A statistic of a batch gives Σ_i w_i times its value."""

    total: Callable[[LossInputs], Float[Tensor, ""]]
    weights: Callable[[TeacherTargets], Float[Tensor, " n"]]
    classes: bool = False


TERMS: Mapping[str, Term] = {
    "field": Term(
        lambda at: field_loss(at.predicted, at.targets.targets.float(), at.targets.loss_weights, at.config),
        lambda targets: targets.loss_weights,
    ),
    "render": Term(
        lambda at: render_loss(
            at.predicted,
            at.targets.rows.blend(len(at.predicted)),
            at.targets.rows.targets,
            at.targets.rows.row_weights,
            at.config,
            at.heads,
        ),
        lambda targets: targets.rows.row_weights,
    ),
    "contrast": Term(
        lambda at: contrast_loss(at.predicted, at.targets.codes, at.targets.loss_weights, at.codebook, at.config),
        lambda targets: targets.loss_weights,
        classes=True,
    ),
}
"""The terms by name; the weight of NAME is `LossConfig.NAME_weight`."""


class FeatureDecoder(nn.Module):
    """Decodes outputs of the encoder to vectors of the teacher's space; differentiable."""

    mean: Tensor
    components: Tensor

    def __init__(self, outputs: OutputSpace) -> None:
        super().__init__()
        rows = np.eye(outputs.channels, dtype=np.float32) if outputs.basis is None else outputs.basis.components
        mean = outputs.mean if outputs.centered else np.zeros_like(outputs.mean)
        self.register_buffer("mean", torch.from_numpy(mean.copy()))
        self.register_buffer("components", torch.from_numpy(rows * np.float32(outputs.unit)))

    def forward(self, standard: Float[Tensor, "n channels"]) -> Float[Tensor, "n D"]:
        out: Tensor = standard @ self.components + self.mean
        return out


def render_heads(heads: HeadSet, outputs: OutputSpace) -> list[tuple[AdapterHead, nn.Module]]:
    """Heads as the render loss takes them, each with a decoder from standard units to its input."""
    check_heads_space(heads.space, outputs.space)
    decode = FeatureDecoder(outputs)
    return [(AdapterHead(each.head.body, torch.from_numpy(each.mean), each.scale), decode) for each in heads.heads]


class Distillation:
    """The loss L = Σ_teachers w · Σ_terms λ_term · L_term over the terms of `TERMS`, as totals before division.

    In a step each term is Σ total / Σ weight over all micro-batches of all processes. The weights are known before
    anything is computed, so each micro-batch divides its totals by the sum of the step's weights, and gradients are
    simply added. A term of one of several teachers is called TEACHER/TERM, such as "labels/field".
    """

    advice = "loss.min_alpha, loss.min_kept and loss.rarity"

    def __init__(
        self,
        network: nn.Module,
        config: LossConfig,
        teachers: Sequence[TeacherRecipe],
        *,
        heads: Mapping[str, Heads] = {},
        device: torch.device = torch.device("cpu"),
    ) -> None:
        """The `network` is a `GaussianEncoder`, possibly wrapped for several processes; teachers are in the order of
        its output columns, and adapter heads by teacher."""
        self.network, self.config = network, config
        self._widths = [teacher.channels for teacher in teachers]
        self._codebooks = [torch.from_numpy(each.codebook).to(device) for each in teachers]
        self._heads = [
            [(head.to(device), decode.to(device)) for head, decode in heads.get(each.name, ())] for each in teachers
        ]
        self._terms = [
            (name if len(teachers) == 1 else f"{teacher.name}/{name}", weight * teacher.weight, number, TERMS[name])
            for number, teacher in enumerate(teachers)
            for name, weight in config.lambdas.items()
            if weight * teacher.weight and (teacher.classes or not TERMS[name].classes)
        ]

    @property
    def lambdas(self) -> dict[str, float]:
        """The weights of the terms that are not 0, by name."""
        return {name: weight for name, weight, _, _ in self._terms}

    def divisors(self, batch: Batch) -> dict[str, float]:
        """The sum of the weights of a batch's Gaussians or rows, for each term."""
        return {
            name: float(term.weights(batch.teachers[number]).double().sum()) for name, _, number, term in self._terms
        }

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms whose weight is not 0, for the encoder's predictions."""
        return self.terms(self.network(batch.attributes, batch.opacities, batch.plan), batch)

    def terms(self, predicted: Float[Tensor, "N C"], batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms whose weight is not 0; the terms of a teacher that the batch's scenes lack are 0."""
        with torch.autocast(predicted.device.type, enabled=False):
            columns = predicted.split(self._widths, dim=1)
            inputs = [
                LossInputs(*each, self.config)
                for each in zip(columns, batch.teachers, self._codebooks, self._heads, strict=True)
            ]
            return {name: term.total(inputs[number]) for name, _, number, term in self._terms}
