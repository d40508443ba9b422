"""Checkpoints of training: parameters, optimizer state and step in one safetensors file, written atomically.

The learning rate schedule, the order of samples and all random numbers are functions of the seed and the step, so of
these only the step is stored.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from gsencoder.core.archive import Archive, open_archive, write_archive
from gsencoder.core.errors import InputError, advised
from gsencoder.core.settings import first_difference, with_added_options

TRAINING_CHECKPOINT_FILE = "checkpoint.safetensors"


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingState:
    """The state of a training run that is not in tensors.

    Attributes:
        step: number of completed steps.
        seconds: their duration.
        unlogged: losses of the steps since the last row of the log, to be averaged in the next row.
        closed: whether logging and validation after the last step are completed.
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
    """Writes a checkpoint; an existing one is replaced only by a complete new one.

    Args:
        path: the file.
        model: the model in training.
        optimizer: AdamW over parameters of `model`.
        state: step, seconds and losses that are not logged yet.
        settings: the settings that a run must share to resume from here, as JSON values.

    Raises:
        InputError: the disk is full.
    """
    arrays = {f"model.{name}": value.detach().cpu().numpy() for name, value in trained_state(model).items()}
    for name, parameter in model.named_parameters():
        for key, value in optimizer.state.get(parameter, {}).items():
            arrays[f"optimizer.{key}.{name}"] = value.detach().float().cpu().numpy()
    with_moments = [name for name, parameter in model.named_parameters() if optimizer.state.get(parameter)]
    header = {**asdict(state), "settings": settings, "moved": with_moments}
    write_archive(path, arrays, header)


def trained_state(model: torch.nn.Module) -> dict[str, torch.Tensor]:
    """What a training changes of a network: its state, or, where parameters are frozen, the others alone.

    Frozen parameters, and buffers beside them, are those of a model that adapters are trained on; they are read from
    its own files, which are many times larger than the adapters.
    """
    state = model.state_dict()
    trained = {name for name, parameter in model.named_parameters() if parameter.requires_grad}
    if all(parameter.requires_grad for parameter in model.parameters()):
        return state
    return {name: value for name, value in state.items() if name in trained}


def load_checkpoint(
    path: Path, model: torch.nn.Module, optimizer: torch.optim.Optimizer, settings: dict[str, Any]
) -> TrainingState:
    """Restores model and optimizer from a checkpoint.

    Raises:
        InputError: the file is damaged, or is of another network or of a run with other settings; the first setting
            that differs is named.
    """
    with advised(_begin_anew(path)), open_archive(path) as file:
        stored_settings = with_added_options(file.value("settings", dict))
        if stored_settings != settings:
            raise InputError(f"{path}: {_describe_difference(stored_settings, settings)}")
        parameters = {
            name: torch.from_numpy(file.array(f"model.{name}", "float32", tuple(value.shape)))
            for name, value in trained_state(model).items()
        }
        moments: dict[torch.nn.Parameter, dict[str, torch.Tensor]] = {}
        with_moments = file.value("moved", list)
        for name, parameter in model.named_parameters():
            if name not in with_moments:
                continue
            shape = tuple(parameter.shape)
            keys = (("step", ()), ("exp_avg", shape), ("exp_avg_sq", shape))
            moments[parameter] = {
                key: torch.from_numpy(file.array(f"optimizer.{key}.{name}", "float32", size).copy())
                for key, size in keys
            }
        state = _read_state(file)
    # Of a network with frozen parameters these are a part, which is complete, since it was asked for by name.
    model.load_state_dict(parameters, strict=parameters.keys() == model.state_dict().keys())
    for parameter, values in moments.items():
        optimizer.state[parameter] = {key: value.to(parameter.device) for key, value in values.items()}
    return state


def check_same_teachers(path: Path, teachers: Sequence[str]) -> None:
    """Checks that a checkpoint, if there is one, is of a run with these teachers, which is known before anything is
    prepared for them.

    Raises:
        InputError: the file is damaged, or is of a run with other teachers or with these in another order.
    """
    if not path.is_file():
        return
    with advised(_begin_anew(path)), open_archive(path) as file:
        stored, requested = file.value("settings", dict), {"teachers": list(teachers)} if len(teachers) > 1 else {}
        if stored.get("teachers") != requested.get("teachers"):
            raise InputError(f"{path}: {_describe_difference(stored, requested)}")


def _begin_anew(path: Path) -> str:
    return f"give resume=false to begin anew, or remove {path}"


def _describe_difference(stored: dict[str, Any], settings: dict[str, Any]) -> str:
    """The first difference between the settings of a checkpoint and of this run, and what to do about it."""
    # Stated by runs with several teachers alone.
    saved, requested = stored.get("teachers"), settings.get("teachers")
    if saved != requested:
        single = "one teacher"
        saved, requested = (single if each is None else f"teachers={each}" for each in (saved, requested))
        return f"was made with {saved}, and this run asks {requested}; give the same settings or another out="
    if any(stored.get(name) != settings.get(name) for name in ("space", "spaces", "scenes")):
        return "the prepared scenes have changed since; give the former prepared=, or another out="
    before, now = stored.get("samples_per_step"), settings.get("samples_per_step")
    if before != now:
        return (
            f"a step had {before} samples, and this run has {now} (train.batch × train.accumulate × processes); change "
            "train.accumulate= or the number of processes, or give another out="
        )
    return f"was made with {first_difference(stored, settings)}; give the same settings or another out="


def _read_state(file: Archive) -> TrainingState:
    step, seconds, unlogged = file.value("step", int), file.value("seconds", float, int), file.value("unlogged", list)
    closed: bool = file.value("closed", bool)
    all_numeric = all(
        isinstance(row, dict) and all(isinstance(value, (int, float)) for value in row.values()) for row in unlogged
    )
    if step < 1 or not 0 <= seconds < math.inf or not all_numeric or not (unlogged or closed):
        raise InputError(
            f"the state is not one that training writes (step {step}, {len(unlogged)} steps without a row in the log)"
        )
    return TrainingState(step=step, seconds=float(seconds), unlogged=tuple(unlogged), closed=closed)
