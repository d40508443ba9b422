"""Samples and batches of the training of an encoder: its inputs, and the targets of each teacher."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Float16, Int64
from torch import Tensor

from gsencoder.core.errors import InputError
from gsencoder.models.plan import CloudPlan, Plan, join_plans
from gsencoder.train.render_rows import RenderRows, empty_rows, join_rows


class TeacherTargets(NamedTuple):
    """What one teacher says of the Gaussians and views of a sample or a batch.

    Attributes:
        targets: targets of the Gaussians, standard units; in float16, since samples that are made
            ahead fill shared memory.
        codes: class of each Gaussian's target, a row of the teacher's codebook; −1 without a target.
        loss_weights: weight of each Gaussian in the loss; 0 without a target.
        rows: rows of the render loss.
    """

    targets: Float16[Tensor, "N C"]
    codes: Int64[Tensor, " N"]
    loss_weights: Float[Tensor, " N"]
    rows: RenderRows


def no_targets(gaussians: int, channels: int) -> TeacherTargets:
    """The targets of a teacher that a scene lacks: nothing that has a weight."""
    return TeacherTargets(
        targets=torch.zeros(gaussians, channels, dtype=torch.float16),
        codes=torch.full((gaussians,), -1),
        loss_weights=torch.zeros(gaussians),
        rows=empty_rows(channels),
    )


class Sample(NamedTuple):
    """One sample, as a data worker returns it; attributes as in `Batch`."""

    name: str
    attributes: Float[Tensor, "N A"]
    opacities: Float[Tensor, " N"]
    plan: CloudPlan
    teachers: tuple[TeacherTargets, ...]


class Batch(NamedTuple):
    """A batch of samples, concatenated along Gaussians, tokens and rows.

    Attributes:
        names: scene and views of each sample, for messages.
        attributes, opacities, plan: inputs of the encoder.
        teachers: targets of each teacher, in the order of the recipe; without weights in scenes that lack the teacher.
    """

    names: tuple[str, ...]
    attributes: Float[Tensor, "N A"]
    opacities: Float[Tensor, " N"]
    plan: Plan
    teachers: tuple[TeacherTargets, ...]

    def to(self, device: torch.device) -> "Batch":
        """The batch with all its tensors on a device."""
        if self.attributes.device == device:
            return self

        def move(value: Tensor) -> Tensor:
            return value.to(device, non_blocking=True)

        return Batch(
            names=self.names,
            attributes=move(self.attributes),
            opacities=move(self.opacities),
            plan=self.plan.to(device),
            teachers=tuple(
                TeacherTargets(
                    targets=move(each.targets),
                    codes=move(each.codes),
                    loss_weights=move(each.loss_weights),
                    rows=RenderRows(*map(move, each.rows)),
                )
                for each in self.teachers
            ),
        )


def join_samples(results: Sequence[Sample | InputError], patch: int) -> Batch | InputError:
    """Joins samples to a batch; if one of them is an error, returns the first error instead.

    Args:
        results: one or more samples or errors.
        patch: largest number of tokens in a patch of the encoder.
    """
    samples = []
    for result in results:
        if isinstance(result, InputError):
            return result
        samples.append(result)
    sizes = [len(sample.attributes) for sample in samples]
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    return Batch(
        names=tuple(sample.name for sample in samples),
        attributes=torch.cat([sample.attributes for sample in samples]),
        opacities=torch.cat([sample.opacities for sample in samples]),
        plan=join_plans([sample.plan for sample in samples], patch),
        teachers=tuple(
            TeacherTargets(
                targets=torch.cat([each.targets for each in of_teacher]),
                codes=torch.cat([each.codes for each in of_teacher]),
                loss_weights=torch.cat([each.loss_weights for each in of_teacher]),
                rows=join_rows([each.rows for each in of_teacher], starts),
            )
            for of_teacher in zip(*(sample.teachers for sample in samples), strict=True)
        ),
    )
