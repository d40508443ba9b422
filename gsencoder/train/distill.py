"""Distillation: what a batch of samples costs an encoder (SplatDistill Eq. 5), term by term."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gsencoder.train.losses import Head, LossConfig, contrast_loss, field_loss, render_loss
from gsencoder.train.samples import Batch


class Distillation:
    """The loss L = λ_3D · L_3D + λ_render · L_render, with λ_contrast · L_contrast where asked for, in parts that are
    summed before they are divided.

    A step's loss is Σ total / Σ weight of each term over all its micro-batches on all processes. The weights are known
    before anything is computed, so every micro-batch can divide by the step's own and simply be added.
    """

    def __init__(
        self,
        encoder: nn.Module,
        config: LossConfig,
        codebook: Float[Tensor, "K C"],
        *,
        heads: Sequence[tuple[Head, nn.Module]] = (),
    ) -> None:
        """Args:
        encoder: a `GaussianEncoder`, or one wrapped for several processes.
        config: what is compared.
        codebook: kinds of target, which the codes of a batch are rows of.
        heads: a teacher's adapter heads, each with what decodes standard units for it.
        """
        self.encoder, self.config, self.codebook, self.heads = encoder, config, codebook, heads

    @property
    def lambdas(self) -> dict[str, float]:
        """How much each term counts, of those that do."""
        config = self.config
        terms = {"field": config.field_weight, "render": config.render_weight, "contrast": config.contrast_weight}
        return {name: weight for name, weight in terms.items() if weight}

    def divisors(self, batch: Batch) -> dict[str, float]:
        """The sum of a batch's weights in each term."""
        gaussians = float(batch.loss_weights.double().sum())
        return {
            "field": gaussians,
            "render": float(batch.rows.row_weights.double().sum()),
            "contrast": gaussians,
        }

    def __call__(self, batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms that count, of what the encoder predicts."""
        return self.terms(self.encoder(batch.attributes, batch.opacities, batch.plan), batch)

    def terms(self, predicted: Float[Tensor, "N C"], batch: Batch) -> dict[str, Tensor]:
        """Totals of the terms that count; a batch without rows has a render loss of nothing."""
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
