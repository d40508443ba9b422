"""Where a training stands: parameters, optimizer and step in one safetensors file that appears whole or not at all.

The schedule, the order of samples and everything random are functions of the seed and the step, so the step is all
that has to be kept of them.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from gsencoder.core.errors import InputError, advised
from gsencoder.core.files.archive import Archive, first_difference, open_archive, write_archive

CHECKPOINT_FILE = "checkpoint.safetensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingState:
    """What a checkpoint says beside its tensors.

    Attributes:
        step: steps that are done.
        seconds: that they took.
        unlogged: losses of the last steps, which the next line of the log stands for too.
        closed: whether what is due after the last step, its line of the log and validation, has been done.
    """

    step: int = 0
    seconds: float = 0.0
    unlogged: tuple[dict[str, float], ...] = ()
    closed: bool = True


def save_checkpoint(
    path: Path,
    model: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    state: TrainingState,
    settings: dict[str, Any],
) -> None:
    """Writes a checkpoint; the one before stays until the new one is whole.

    Args:
        path: the file.
        model: whose parameters are trained.
        optimizer: over parameters of `model`, with state tensors of their shapes, as AdamW has them.
        state: see there.
        settings: what a run must have in common to go on from here, as JSON values.

    Raises:
        InputError: the disk is full.
    """
    arrays = {f"model.{name}": value.detach().cpu().numpy() for name, value in model.state_dict().items()}
    for name, parameter in model.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            arrays[f"optimizer.{key}.{name}"] = value.detach().float().cpu().numpy()
    moved = [name for name, parameter in model.named_parameters() if optimizer.state.get(parameter)]
    header = {**asdict(state), "settings": settings, "moved": moved}
    write_archive(path, arrays, header)


def load_checkpoint(
    path: Path, model: torch.nn.Module, optimizer: torch.optim.Optimizer, settings: dict[str, Any]
) -> TrainingState:
    """Puts model and optimizer where the checkpoint was made.

    Raises:
        InputError: damaged, of another network, or of a run with other settings; the first that differs is named.
    """
    with advised(f"give resume=false to begin anew, or remove {path}"), open_archive(path) as file:
        found = file.value("settings", dict)
        if found != settings:
            raise InputError(
                f"{path}: was made with {first_difference(found, settings)}; give the same settings or another out="
            )
        parameters = {
            name: torch.from_numpy(file.array(f"model.{name}", "float32", tuple(value.shape)))
            for name, value in model.state_dict().items()
        }
        moments: dict[torch.nn.Parameter, dict[str, torch.Tensor]] = {}
        moved = file.value("moved", list)
        for name, parameter in model.named_parameters():
            if name not in moved:
                continue
            shape = tuple(parameter.shape)
            keys = (("step", ()), ("exp_avg", shape), ("exp_avg_sq", shape))
            moments[parameter] = {
                key: torch.from_numpy(file.array(f"optimizer.{key}.{name}", "float32", size).copy())
                for key, size in keys
            }
        state = _state_in(file)
    model.load_state_dict(parameters)
    for parameter, values in moments.items():
        optimizer.state[parameter] = {key: value.to(parameter.device) for key, value in values.items()}
    return state


def _state_in(file: Archive) -> TrainingState:
    step, seconds, unlogged = file.value("step", int), file.value("seconds", float, int), file.value("unlogged", list)
    closed: bool = file.value("closed", bool)
    numbers = all(
        isinstance(row, dict) and all(isinstance(value, (int, float)) for value in row.values()) for row in unlogged
    )
    if step < 1 or not 0 <= seconds < math.inf or not numbers or not (unlogged or closed):
        raise InputError(f"a state that no run was in (step {step}, {len(unlogged)} steps that are not logged)")
    return TrainingState(step=step, seconds=float(seconds), unlogged=tuple(unlogged), closed=closed)
