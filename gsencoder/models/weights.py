"""Encoder weights on disk: one safetensors file with parameters, configuration of the network and output spaces."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.output_space import OutputSpaces, find_weights, output_spaces_parts, read_output_spaces


def save_weights(
    path: Path,
    encoder: GaussianEncoder,
    outputs: OutputSpaces,
    made_by: Mapping[str, Any],
    *,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Writes parameters as `dtype`, configuration and output spaces, with settings and results of the training as JSON
    values."""
    arrays, header = output_spaces_parts(outputs)
    for name, value in encoder.state_dict().items():
        with np.errstate(over="ignore"):
            stored = value.detach().cpu().numpy().astype(dtype)
        if not np.isfinite(stored).all():
            remedy = f" in {dtype}; use store=float32 or a lower learning rate" if torch.isfinite(value).all() else ""
            raise InputError(f"save_weights: parameter {name} is not finite{remedy}")
        arrays[f"encoder.{name}"] = stored
    header |= {"encoder": asdict(encoder.config), "dtype": dtype, "made_by": dict(made_by)}
    write_archive(path, arrays, header)


def load_weights(source: str | Path, option: str = "weights") -> tuple[GaussianEncoder, OutputSpaces, dict[str, Any]]:
    """Loads an encoder in evaluation mode, its output spaces, and settings and results of its training; see
    `find_weights` for the arguments."""
    with open_archive(find_weights(str(source), option)) as file:
        config = _read_config(file.value("encoder", dict))
        outputs = read_output_spaces(file)
        dtype = file.value("dtype", str)
        if dtype not in ("float32", "float16"):
            raise InputError(f"expected parameters of float32 or float16, got {dtype[:20]!r}")
        with torch.device("meta"):
            encoder = GaussianEncoder(config, outputs.widths)
        state = {
            name: torch.from_numpy(file.array(f"encoder.{name}", dtype, tuple(value.shape)).astype(np.float32))
            for name, value in encoder.state_dict().items()
        }
        made_by: dict[str, Any] = file.value("made_by", dict)
    encoder.load_state_dict(state, assign=True)
    return encoder.eval(), outputs, made_by


def _read_config(values: dict[str, Any]) -> EncoderConfig:
    import dacite

    try:
        return dacite.from_dict(EncoderConfig, values, dacite.Config(strict=True, cast=[tuple]))
    except (dacite.DaciteError, TypeError) as error:
        raise InputError(f"the encoder's configuration does not fit this version of gsencoder: {error}") from error
