"""Distillation: the terms of an encoder's loss on a batch of samples (SplatDistill Eq. 5)."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.train.losses import AdapterHead, LossConfig, contrast_loss, field_loss, render_loss
from gsencoder.train.samples import Batch


class Distillation:
    """The loss L = λ_3D · L_3D + λ_render · L_render (+ λ_contrast · L_contrast), as totals before division.

    In a step each term is Σ total / Σ weight over all micro-batches of all processes. The weights are known before
    anything is computed, so each micro-batch divides its totals by the sum of the step's weights, and gradients are
    simply added.
    """

    def __init__(
        self,
        encoder: nn.Module,
        config: LossConfig,
        codebook: Float[Tensor, "K C"],
        *,
        heads: Sequence[tuple[AdapterHead, nn.Module]] = (),
    ) -> None:
        """Args:
        encoder: a `GaussianEncoder`, possibly compiled or wrapped for several processes.
        config: weights and parameters of the terms.
        codebook: target classes in standard units, which the codes of a batch index.
        heads: adapter heads of the teacher, each with a decoder from standard units to its input.
        """
        self.encoder, self.config, self.codebook, self.heads = encoder, config, codebook, heads

    @property
    def lambdas(self) -> dict[str, float]:
        """The weights λ of the terms that are not 0, by name."""
        config = self.config
        terms = {"field": config.field_weight, "render": config.render_weight, "contrast": config.contrast_weight}
        return {name: weight for name, weight in terms.items() if weight}

    def divisors(self, batch: Batch) -> dict[str, float]:
        """The sum of the weights of a batch's Gaussians or rows, for each term."""
        gaussians = float(batch.loss_weights.double().sum())
        return {
            "field": gaussians,
            "render": float(batch.rows.row_weights.double().sum()),
            "contrast": gaussians,
        }

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms whose λ is not 0, for the encoder's predictions."""
        return self.terms(self.encoder(batch.attributes, batch.opacities, batch.plan), batch)

    def terms(self, predicted: Float[Tensor, "N C"], batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms whose λ is not 0; the render loss of a batch without rows is 0."""
        config, terms = self.config, {}
        with torch.autocast(predicted.device.type, enabled=False):
            if config.field_weight:
                terms["field"] = field_loss(predicted, batch.targets, batch.loss_weights, config)
            if config.render_weight:
                rows = batch.rows
                b = rows.blend(len(predicted))
                terms["render"] = render_loss(predicted, b, rows.targets, rows.row_weights, config, self.heads)
            if config.contrast_weight:
                terms["contrast"] = contrast_loss(predicted, batch.codes, batch.loss_weights, self.codebook, config)
        return terms
