"""Training samples: a part of a prepared scene, changed at random, with its plan, its targets and its rows of B.

Everything random about sample k of a run comes from (seed, k), and its size from the step that it belongs to. Nothing
depends on which process makes it or on what was made before, so that a run may be cut off and resumed, or spread over
more machines, and go through the same samples.
"""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int32, Int64
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from gsencoder.core.errors import InputError, about
from gsencoder.models.encoder import EncoderConfig, encoder_inputs
from gsencoder.models.grid.plan import CloudPlan, Plan, join_plans
from gsencoder.train.augment import AugmentConfig, augment
from gsencoder.train.class_balance import Rarity, nearest_codes
from gsencoder.train.crops import SamplingConfig, choose_part, crop_size, thin_out
from gsencoder.train.losses import LossConfig
from gsencoder.train.prepared_scene import PreparedScene
from gsencoder.train.render_rows import Rows, join_rows, no_rows, restrict, rows_of

OPEN_SCENES = 256
"""Scenes that a process keeps open, the latest used."""


class Sample(NamedTuple):
    """One part of one scene, as a worker hands it over; see `Batch`."""

    name: str
    attributes: Float[Tensor, "N A"]
    opacities: Float[Tensor, " N"]
    plan: CloudPlan
    targets: Float[Tensor, "N C"]
    codes: Int64[Tensor, " N"]
    loss_weights: Float[Tensor, " N"]
    rows: Rows


class Batch(NamedTuple):
    """Samples side by side: Gaussians, tokens and rows follow one another, and plans and rows count on.

    Attributes:
        names: scene and views of each sample, for messages.
        attributes, opacities, plan: what the encoder takes.
        targets: standard units.
        codes: of each target the nearest row of the codebook; −1 where there is no target.
        loss_weights: of each Gaussian; 0 where it has no target.
        rows: of the render loss.
    """

    names: tuple[str, ...]
    attributes: Float[Tensor, "N A"]
    opacities: Float[Tensor, " N"]
    plan: Plan
    targets: Float[Tensor, "N C"]
    codes: Int64[Tensor, " N"]
    loss_weights: Float[Tensor, " N"]
    rows: Rows

    def to(self, device: torch.device) -> "Batch":
        """The same on a device."""
        if self.attributes.device == device:
            return self

        def move(value: Tensor) -> Tensor:
            return value.to(device, non_blocking=True)

        return Batch(
            names=self.names,
            attributes=move(self.attributes),
            opacities=move(self.opacities),
            plan=self.plan.to(device),
            targets=move(self.targets),
            codes=move(self.codes),
            loss_weights=move(self.loss_weights),
            rows=Rows(*map(move, self.rows)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SampleRecipe:
    """All that turns a scene into samples.

    Attributes:
        encoder: which attributes, which grid.
        sampling: which part of the scene.
        augmentation: what is changed; None leaves the scene as it is.
        losses: which rows are compared.
        rarity: how often targets of each kind occur.
        seed: of everything random.
        step_samples: samples of one step, over all processes; they are of one size, so that no process waits for
            another.
    """

    encoder: EncoderConfig
    sampling: SamplingConfig
    augmentation: AugmentConfig | None
    losses: LossConfig
    rarity: Rarity
    seed: int
    step_samples: int = 1


class SampleDataset(Dataset[Sample]):
    """Sample k of a run, for any k: each pass over the scenes is in an order of its own."""

    def __init__(self, scenes: Sequence[PreparedScene], recipe: SampleRecipe) -> None:
        """Raises:
        InputError: no scenes.
        """
        if not scenes:
            raise InputError("training: no scenes to train on")
        self.scenes, self.recipe = list(scenes), recipe
        self._codes: OrderedDict[int, np.ndarray] = OrderedDict()

    def __getitem__(self, number: int) -> Sample | InputError:  # type: ignore[override]
        """Sample `number`, or why there is none: from another process an error would come as a heap of text."""
        try:
            return self.make(number)
        except InputError as error:
            return error

    def make(self, number: int) -> Sample:
        """Sample `number`.

        Raises:
            InputError: a scene that cannot be read, or whose views see nothing.
        """
        epoch, place = divmod(number, len(self.scenes))
        order = np.random.default_rng([self.recipe.seed, 0, epoch]).permutation(len(self.scenes))
        rng = np.random.default_rng([self.recipe.seed, 1, number])
        step = np.random.default_rng([self.recipe.seed, 2, number // self.recipe.step_samples])
        size = crop_size(self.recipe.sampling, step)
        which = int(order[place])
        scene = self.scenes[which]
        with about(f"scene {scene.name}"):
            return make_sample(scene, self._codes_of(which), self.recipe, size, rng)

    def _codes_of(self, which: int) -> Int32[np.ndarray, " N"]:
        """Kinds of a scene's targets. Only so many scenes are kept open: each holds a file descriptor."""
        if which not in self._codes:
            self._codes[which] = target_codes(self.scenes[which], self.recipe.rarity)
        self._codes.move_to_end(which)
        if len(self._codes) > OPEN_SCENES:
            oldest, _ = self._codes.popitem(last=False)
            self.scenes[oldest].close()
        return self._codes[which]


class StepSampler(Sampler[list[int]]):
    """The numbers of the samples of each micro-batch of this process, step by step.

    Step s of a run takes samples s·n to (s + 1)·n − 1, n being batch · accumulate · processes; micro-batch m of process
    r takes `batch` of them in a row.
    """

    def __init__(self, first: int, last: int, *, batch: int, accumulate: int, rank: int, world: int) -> None:
        """Args:
        first: step to begin with.
        last: step to end before.
        batch: samples of a micro-batch.
        accumulate: micro-batches of a process in a step.
        rank: number of this process.
        world: number of processes.
        """
        self.steps = range(first, last)
        self.batch, self.accumulate, self.rank, self.world = batch, accumulate, rank, world

    def __len__(self) -> int:
        return len(self.steps) * self.accumulate

    def __iter__(self) -> Iterator[list[int]]:
        for step in self.steps:
            for micro in range(self.accumulate):
                start = ((step * self.accumulate + micro) * self.world + self.rank) * self.batch
                yield list(range(start, start + self.batch))


def target_codes(scene: PreparedScene, rarity: Rarity) -> Int32[np.ndarray, " N"]:
    """For each Gaussian the row of the codebook that its target is nearest to; −1 where it has none."""
    codes = np.full(len(scene), -1, np.int32)
    seen = np.flatnonzero(scene.weights)
    codes[seen] = nearest_codes(rarity.codebook, scene.targets(seen))
    return codes


def make_sample(
    scene: PreparedScene,
    codes: Int32[np.ndarray, " N"],
    recipe: SampleRecipe,
    size: int,
    rng: np.random.Generator,
) -> Sample:
    """Cuts a part out of a scene and makes it ready for the encoder.

    Args:
        scene: to cut from.
        codes: of its Gaussians (`target_codes`).
        recipe: how.
        size: most Gaussians; 0 = all that the views see.
        rng: everything random comes from it.

    Raises:
        InputError: the chosen views see none of the scene's Gaussians.
    """
    # Code −1 is the last row of these tables, which gives the unseen 0. All kinds are equally often the center.
    chances = np.append(recipe.rarity.each(1.0), np.float32(0))[codes]
    weights = np.append(recipe.rarity.each(recipe.losses.rarity), np.float32(0))[codes]
    views, selected = choose_part(scene.means, scene.cameras, chances, recipe.sampling, size, rng)
    change = recipe.augmentation
    kept = thin_out(selected, change.drop, rng) if change is not None else selected
    voxel = recipe.encoder.voxel / (scene.metres_per_unit or 1.0)
    gaussians = scene.gaussians(kept)
    if change is not None:
        gaussians = augment(gaussians, rng, change, voxel=voxel, up=scene.up)
    attributes, opacities, plan = encoder_inputs(gaussians, recipe.encoder, voxel)
    shape = recipe.losses
    rows = [no_rows(scene.channels)]
    for view in views if shape.render_weight else ():
        rows.append(rows_of(restrict(scene.view(view), len(scene), selected, kept, shape), recipe.rarity, shape.rarity))
    return Sample(
        name=f"{scene.name} ({', '.join(scene.view_names[view] for view in views)})",
        attributes=attributes,
        opacities=opacities,
        plan=plan,
        targets=torch.from_numpy(scene.targets(kept)),
        codes=torch.from_numpy(codes[kept].astype(np.int64)),
        loss_weights=torch.from_numpy(weights[kept]),
        rows=join_rows(rows, [0] * len(rows)),
    )


def join_samples(parts: Sequence[Sample | InputError], patch: int) -> Batch | InputError:
    """Puts samples side by side; if one could not be made, that is what comes back.

    Args:
        parts: at least one.
        patch: of the encoder's attention.
    """
    samples = []
    for part in parts:
        if isinstance(part, InputError):
            return part
        samples.append(part)
    sizes = [len(sample.attributes) for sample in samples]
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    return Batch(
        names=tuple(sample.name for sample in samples),
        attributes=torch.cat([sample.attributes for sample in samples]),
        opacities=torch.cat([sample.opacities for sample in samples]),
        plan=join_plans([sample.plan for sample in samples], patch),
        targets=torch.cat([sample.targets for sample in samples]),
        codes=torch.cat([sample.codes for sample in samples]),
        loss_weights=torch.cat([sample.loss_weights for sample in samples]),
        rows=join_rows([sample.rows for sample in samples], starts),
    )
