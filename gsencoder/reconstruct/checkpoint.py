"""Checkpoints of a reconstruction: parameters, moments and step in one file, written atomically."""

import math
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError, advised
from gsencoder.core.settings import first_difference
from gsencoder.reconstruct.optimize import Anchor
from gsencoder.reconstruct.parameters import RowAdam, shapes_of

CHECKPOINT_FILE = "reconstruction.safetensors"
IMAGE_SCALE = "image_scale"
"""The setting that says by which factor a budget made the photographs smaller."""
PLANNED_DEGREE = "sh_degree_planned"
"""The fact that says up to which degree colors depend on the direction."""
ANCHOR_SHAPES: dict[str, tuple[int | str, ...]] = {"means": ("N", 3), "reach": ("N",)}


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """A reconstruction between two steps. The first is of step 0: seeds are sought once.

    Attributes:
        adam: parameters and moments.
        anchor: what holds positions near their seeds, if anything does.
        exposures: an affine map of colors for each fitted photograph, if they are fitted; None at step 0, and
            where photographs do not differ in exposure.
        step: steps that are done.
        seconds: that they took.
        facts: how it began, as JSON values: number and source of the seeds, what was added to points, and what is
            planned.
    """

    adam: RowAdam
    anchor: Anchor | None
    exposures: Float[Tensor, "V 3 4"] | None = None
    step: int
    seconds: float
    facts: Mapping[str, Any]


def save_state(path: Path, state: State, settings: Mapping[str, Any]) -> None:
    """Writes the state; the one before stays until the new one is whole.

    Args:
        path: the file.
        state: to keep.
        settings: what a run must have in common to go on from here, as JSON values.

    Raises:
        InputError: the disk is full.
    """
    arrays = {
        f"{kind}.{name}": value.detach().cpu().numpy()
        for kind, table in state.adam.tables().items()
        for name, value in table.items()
    }
    if state.anchor is not None:
        arrays |= {f"leash.{name}": getattr(state.anchor, name).cpu().numpy() for name in ANCHOR_SHAPES}
    if state.exposures is not None:
        arrays["exposure.maps"] = state.exposures.numpy()
    header = {
        "step": state.step,
        "adam_steps": state.adam.steps,
        "seconds": state.seconds,
        "facts": dict(state.facts),
        "settings": dict(settings),
    }
    write_archive(path, arrays, header)


def image_scale_of(path: Path) -> float | None:
    """The factor by which an unfinished run makes photographs smaller; None where there is no such run, or its
    checkpoint does not say so or is damaged, which `load_state` says.

    Args:
        path: the file.
    """
    if not os.path.lexists(path):
        return None
    with suppress(InputError), open_archive(path) as file:
        scale = file.value("settings", dict).get(IMAGE_SCALE)
        return scale if isinstance(scale, float) and 0 < scale <= 1 else None
    return None


def load_state(
    path: Path, settings: Mapping[str, Any], *, steps: int, sh_degree: int, device: torch.device | str = "cpu"
) -> State:
    """The state that a run has left.

    Args:
        path: the file.
        settings: of this run.
        steps: that this run takes at most.
        sh_degree: of its colors, unless `facts` have another one under `PLANNED_DEGREE`.
        device: where it computes.

    Raises:
        InputError: damaged, or of a run with other settings; the first that differs is named.
    """
    with advised(f"give resume=false to begin anew, or remove {path}"), open_archive(path) as file:
        earlier = file.value("settings", dict)
        if earlier != settings:
            raise InputError(f"{path}: was made with {first_difference(earlier, settings)}")
        step, adam_steps = file.value("step", int), file.value("adam_steps", int)
        seconds, facts = float(file.value("seconds", float, int)), file.value("facts", dict)
        if not (0 <= adam_steps <= step <= steps and 0 <= seconds < math.inf):
            raise InputError(f"a state that no run was in (step {step} of {steps})")
        degree = facts.get(PLANNED_DEGREE, sh_degree)
        if degree not in range(sh_degree + 1):
            raise InputError(f"colors of a degree that no run has ({degree!r})")
        tables = {
            kind: {
                name: torch.from_numpy(file.array(f"{kind}.{name}", "float32", ("N", *shape)).copy()).to(device)
                for name, shape in shapes_of(degree).items()
            }
            for kind in RowAdam.KINDS
        }
        anchor = None
        if "leash.means" in file:
            arrays = {name: file.array(f"leash.{name}", "float32", shape) for name, shape in ANCHOR_SHAPES.items()}
            anchor = Anchor(**{name: torch.from_numpy(value.copy()).to(device) for name, value in arrays.items()})
        exposures = None
        if "exposure.maps" in file:
            exposures = torch.from_numpy(file.array("exposure.maps", "float32", ("V", 3, 4)).copy())
    adam = RowAdam.restored(tables, adam_steps)
    return State(adam=adam, anchor=anchor, exposures=exposures, step=step, seconds=seconds, facts=facts)
