"""Distillation: the terms of an encoder's loss on a batch (SplatDistill Eq. 5), for one teacher or several."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.models.encoder import GaussianEncoder
from gsencoder.train.batch import Batch, TeacherTargets, join_samples
from gsencoder.train.loop import Trainer, TrainerConfig
from gsencoder.train.losses import AdapterHead, LossConfig, contrast_loss, field_loss, render_loss
from gsencoder.train.samples import SampleDataset, TeacherRecipe

Heads = Sequence[tuple[AdapterHead, nn.Module]]
"""Adapter heads of a teacher, each with a decoder from standard units to its input."""


class Distillation:
    """The loss L = Σ_teachers w · (λ_3D · L_3D + λ_render · L_render + λ_contrast · L_contrast), as totals before
    division.

    In a step each term is Σ total / Σ weight over all micro-batches of all processes. The weights are known before
    anything is computed, so each micro-batch divides its totals by the sum of the step's weights, and gradients are
    simply added. A term of one of several teachers is called TEACHER/TERM, such as "labels/field".
    """

    def __init__(
        self,
        network: nn.Module,
        config: LossConfig,
        teachers: Sequence[TeacherRecipe],
        *,
        heads: Mapping[str, Heads] = {},
        device: torch.device = torch.device("cpu"),
    ) -> None:
        """Args:
        network: a `GaussianEncoder`, possibly compiled or wrapped for several processes.
        config: weights and parameters of the terms.
        teachers: the teachers, in the order of the encoder's output columns.
        heads: adapter heads of teachers, by name.
        device: the device of the losses.
        """
        self.network, self.config = network, config
        self._teachers = list(teachers)
        self._codebooks = [torch.from_numpy(each.class_balance.codebook).to(device) for each in teachers]
        self._heads = {
            name: [(head.to(device), decode.to(device)) for head, decode in of_teacher]
            for name, of_teacher in heads.items()
        }

    @property
    def lambdas(self) -> dict[str, float]:
        """The weights of the terms that are not 0, by name."""
        config = self.config
        terms = {"field": config.field_weight, "render": config.render_weight, "contrast": config.contrast_weight}
        return {
            self._term(teacher, name): weight * teacher.weight
            for teacher in self._teachers
            for name, weight in terms.items()
            if weight * teacher.weight and (teacher.contrast or name != "contrast")
        }

    def _term(self, teacher: TeacherRecipe, name: str) -> str:
        return name if len(self._teachers) == 1 else f"{teacher.name}/{name}"

    @property
    def advice(self) -> str:
        """Settings that leave nothing to compare."""
        return "loss.min_alpha, loss.min_kept and loss.rarity"

    def divisors(self, batch: Batch) -> dict[str, float]:
        """The sum of the weights of a batch's Gaussians or rows, for each term."""
        divisors = {}
        for teacher, targets in zip(self._teachers, batch.teachers, strict=True):
            gaussians = float(targets.loss_weights.double().sum())
            divisors[self._term(teacher, "field")] = gaussians
            divisors[self._term(teacher, "render")] = float(targets.rows.row_weights.double().sum())
            divisors[self._term(teacher, "contrast")] = gaussians
        return divisors

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms whose weight is not 0, for the encoder's predictions."""
        return self.terms(self.network(batch.attributes, batch.opacities, batch.plan), batch)

    def terms(self, predicted: Float[Tensor, "N C"], batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms whose weight is not 0; the terms of a teacher that the batch's scenes lack are 0."""
        widths = [teacher.channels for teacher in self._teachers]
        terms: dict[str, Tensor] = {}
        with torch.autocast(predicted.device.type, enabled=False):
            columns = predicted.split(widths, dim=1)
            for number, (teacher, targets) in enumerate(zip(self._teachers, batch.teachers, strict=True)):
                if teacher.weight:
                    totals = self._teacher_terms(columns[number], targets, number)
                    terms |= {self._term(teacher, name): total for name, total in totals.items()}
        return terms

    def _teacher_terms(
        self, predicted: Float[Tensor, "N C"], targets: TeacherTargets, number: int
    ) -> dict[str, Tensor]:
        """The terms of one teacher; the render loss without rows is 0."""
        config, terms = self.config, dict[str, Tensor]()
        teacher = self._teachers[number]
        if config.field_weight:
            terms["field"] = field_loss(predicted, targets.targets.float(), targets.loss_weights, config)
        if config.render_weight:
            rows, heads = targets.rows, self._heads.get(teacher.name, ())
            b = rows.blend(len(predicted))
            terms["render"] = render_loss(predicted, b, rows.targets, rows.row_weights, config, heads)
        if config.contrast_weight and teacher.contrast:
            codebook = self._codebooks[number]
            terms["contrast"] = contrast_loss(predicted, targets.codes, targets.loss_weights, codebook, config)
        return terms


def encoder_trainer(
    encoder: GaussianEncoder,
    dataset: SampleDataset,
    losses: LossConfig,
    config: TrainerConfig,
    *,
    heads: Mapping[str, Heads] = {},
    device: torch.device = torch.device("cpu"),
    **settings: Any,
) -> Trainer:
    """A trainer that distills the teachers of a dataset into an encoder.

    Args:
        encoder: the encoder, trained in place and moved to `device`.
        dataset: the training samples.
        losses: weights and parameters of the loss terms.
        config: settings of the loop.
        heads: adapter heads of teachers, by name.
        device: device of this process.
        settings: the other arguments of `Trainer`.

    Raises:
        InputError: see `Trainer`.
    """
    return Trainer(
        encoder,
        dataset,
        partial(Distillation, config=losses, teachers=dataset.recipe.teachers, heads=heads, device=device),
        config,
        collate=partial(join_samples, patch=encoder.config.transformer.patch),
        device=device,
        **settings,
    )
