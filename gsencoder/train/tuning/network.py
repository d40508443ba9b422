"""The network that is tuned, and its loss: the mean negative logarithm of the probabilities of the answers' tokens."""

import inspect
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from gsencoder.train.tuning.samples import IGNORED, TuningBatch
from gsencoder.train.tuning.towers import TokenHook, TowerLayout

TERM = "answer"


class TunedVlm(nn.Module):
    """A vision-language model under adapters, with rendered features in the place of its tower's output or without.

    Attributes:
        adapted: the `peft.PeftModel`.
        projection: from the channels of the features to those of the tower; None where they are the same, or where no
            features are given.
    """

    def __init__(
        self, adapted: Any, layout: TowerLayout | None = None, channels: int | None = None, *, seed: int = 0
    ) -> None:
        """Args:
        adapted: a `peft.PeftModel`.
        layout: of the tower's output; None where the model looks at pictures.
        channels: of the features that are projected; None = they are given as they are.
        seed: of the projection.
        """
        super().__init__()
        self.adapted = adapted
        self.projection: nn.Linear | None = None
        model = adapted.get_base_model()
        self._hook = None if layout is None else TokenHook(model.get_encoder("image"), layout)
        if layout is not None and channels is not None:
            torch.manual_seed(seed)
            self.projection = nn.Linear(channels, layout.channels)
        self._keeps = "logits_to_keep" in inspect.signature(model.forward).parameters

    def forward(
        self,
        inputs: dict[str, Tensor],
        tokens: Float[Tensor, "n P D"] | None = None,
        keep: Int64[Tensor, " K"] | None = None,
    ) -> Float[Tensor, "B K vocabulary"]:
        """Logits.

        Args:
            inputs: of the model, as its processor gives them.
            tokens: rendered features of the pictures, in their order.
            keep: positions whose logits are wanted, in each row; None = all.
        """
        options = {} if keep is None or not self._keeps else {"logits_to_keep": keep}
        if self._hook is not None and tokens is not None:
            self._hook.tokens = tokens if self.projection is None else self.projection(tokens)
        try:
            logits: Tensor = self.adapted(**inputs, use_cache=False, **options).logits
        finally:
            if self._hook is not None:
                self._hook.tokens = None
        return logits if keep is None or self._keeps else logits[:, keep]


class AnswerObjective:
    """The loss of answers: Σ −log p(token | all before it) over the answers' tokens, divided by their number in a step,
    so that a long answer counts for more than a short one, and padding for nothing."""

    advice = "the answers"
    lambdas = {TERM: 1.0}  # noqa: RUF012 - a constant of the protocol

    def __init__(self, network: nn.Module) -> None:
        self.network = network

    def divisors(self, batch: TuningBatch) -> dict[str, float]:
        """The number of the answers' tokens."""
        return {TERM: float((batch.labels[:, 1:] != IGNORED).sum())}

    def __call__(self, batch: TuningBatch) -> dict[str, Tensor]:
        """The sum over the answers' tokens."""
        # The logits of a position are of the token after it. Only those that are needed are computed, since a
        # vocabulary is large and prompts are long.
        next_labels = batch.labels[:, 1:]
        keep = (next_labels != IGNORED).any(dim=0).nonzero()[:, 0]
        logits = self.network(batch.inputs, batch.tokens, keep)
        with torch.autocast(logits.device.type, enabled=False):
            loss = nn.functional.cross_entropy(
                logits.float().flatten(0, 1), next_labels[:, keep].flatten(), ignore_index=IGNORED, reduction="sum"
            )
        return {TERM: loss}
