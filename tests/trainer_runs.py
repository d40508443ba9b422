"""Trainings of a small encoder, and what their folders hold."""

from pathlib import Path

import numpy as np
from safetensors.numpy import load_file
from training_scenes import LOSSES, SHORT, samples, small_encoder

from gsencoder.core.archive import open_archive
from gsencoder.core.logs import LOG_FILE, read_log
from gsencoder.train.loop import TRAINING_CHECKPOINT_FILE, Trainer, TrainerConfig
from gsencoder.train.prepare import PreparedDataset
from gsencoder.train.run import encoder_trainer

Prepared = tuple[PreparedDataset, list[str]]


def trainer(dataset: Prepared, folder: Path, config: TrainerConfig = SHORT, **changes: object) -> Trainer:
    folder.mkdir(exist_ok=True)
    return encoder_trainer(
        small_encoder(), samples(*dataset), LOSSES, config, folder=folder, settings={"run": 1}, **changes
    )


def losses(folder: Path, column: str = "loss") -> list[float]:
    return [float(row[column]) for row in read_log(folder / LOG_FILE)]


def rows(folder: Path) -> list[dict[str, str]]:
    """The log without what the clock says."""
    return [{name: value for name, value in row.items() if name != "seconds"} for row in read_log(folder / LOG_FILE)]


def weights_in(folder: Path) -> dict[str, np.ndarray]:
    """Parameters of the checkpoint."""
    arrays = load_file(folder / TRAINING_CHECKPOINT_FILE)
    return {name: value for name, value in arrays.items() if name.startswith("model.")}


def steps_in(folder: Path) -> int:
    with open_archive(folder / TRAINING_CHECKPOINT_FILE) as file:
        return file.value("step", int)


def assert_same_weights(one: Path, other: Path) -> None:
    first, second = weights_in(one), weights_in(other)
    assert first.keys() == second.keys()
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name])
