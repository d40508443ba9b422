"""Where a reconstruction stands: parameters, moments and step in one file that appears whole or not at all."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from gsencoder.data.archive import first_difference, open_archive, write_archive
from gsencoder.errors import InputError, advised
from gsencoder.reconstruct.optimize import Optimizer

CHECKPOINT_FILE = "reconstruction.safetensors"
_KINDS = ("parameters", "averages", "squares")


def save_state(path: Path, optimizer: Optimizer, seconds: float, settings: Mapping[str, Any]) -> None:
    """Writes the state; the one before stays until the new one is whole.

    Args:
        path: the file.
        optimizer: whose state it is.
        seconds: that its steps took.
        settings: what a run must have in common to go on from here, as JSON values.

    Raises:
        InputError: the disk is full.
    """
    arrays = {
        f"{kind}.{name}": value.detach().cpu().numpy()
        for kind in _KINDS
        for name, value in getattr(optimizer.adam, kind).items()
    }
    header = {
        "step": optimizer.step,
        "adam_steps": optimizer.adam.steps,
        "seconds": seconds,
        "settings": dict(settings),
    }
    write_archive(path, arrays, header)


def load_state(path: Path, optimizer: Optimizer, settings: Mapping[str, Any]) -> float:
    """Puts the optimiser where the state was saved; the seconds that its steps took.

    Raises:
        InputError: damaged, or of a run with other settings; the first that differs is named.
    """
    with advised(f"give resume=false to begin anew, or remove {path}"), open_archive(path) as file:
        found = file.value("settings", dict)
        if found != settings:
            raise InputError(f"{path}: was made with {first_difference(found, settings)}")
        step, adam_steps = file.value("step", int), file.value("adam_steps", int)
        seconds = float(file.value("seconds", float, int))
        if not (0 <= adam_steps <= step <= optimizer.config.steps and 0 <= seconds < math.inf):
            raise InputError(f"a state that no run was in (step {step} of {optimizer.config.steps})")
        tables = {
            kind: {
                name: torch.from_numpy(file.array(f"{kind}.{name}", "float32", ("N", *value.shape[1:])).copy())
                for name, value in optimizer.raw.items()
            }
            for kind in _KINDS
        }
    for kind, table in tables.items():
        setattr(optimizer.adam, kind, {name: value.to(optimizer.device) for name, value in table.items()})
    optimizer.adam.steps, optimizer.step = adam_steps, step
    return seconds
