"""An encoder on disk: one safetensors file that says what network it is for and what its outputs mean."""

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from gsencoder.core.errors import InputError
from gsencoder.core.files.archive import open_archive, write_archive
from gsencoder.core.files.model_files import find_file
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.output_space import OutputSpace, read_outputs, write_outputs

WEIGHTS_FILE = "encoder.safetensors"
SHIPPED = Path(__file__).resolve().parent.parent / "weights"
"""Encoders that come with the package, a folder each."""


def find_weights(given: str) -> Path:
    """The weights that a user means: the folder that `train` wrote, a file, or the name of some that come with the
    package; files are also looked for in GSENCODER_MODELS.

    Raises:
        InputError: there are none.
    """
    names = sorted(path.parent.name for path in SHIPPED.glob(f"*/{WEIGHTS_FILE}"))
    try:
        own = Path(given) / WEIGHTS_FILE
        if given and own.is_file():
            return own
        if given in names:
            return SHIPPED / given / WEIGHTS_FILE
        if given and Path(given).is_dir():
            exports = sorted(path.name for path in Path(given).glob("*.onnx"))
            hint = f"; give its {', '.join(exports)} by its full path" if exports else ""
            raise InputError(f"weights: the folder {given} holds no {WEIGHTS_FILE}{hint}")
        return find_file(given, "weights")
    except InputError as error:
        raise InputError(f"{error}; gsencoder comes with {', '.join(names)}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"weights: {given[:200]!r} is not a path ({type(error).__name__})") from error


def save_weights(
    path: Path,
    encoder: GaussianEncoder,
    outputs: OutputSpace,
    made_by: Mapping[str, Any],
    *,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Writes parameters, configuration and output space; what had the name stays until the new file is whole.

    Args:
        path: the file.
        encoder: whose parameters are stored.
        outputs: what its numbers mean.
        made_by: settings and results of the training, as JSON values.
        dtype: float16 halves the file; parameters are a few units at most, and lose 3 digits.

    Raises:
        InputError: parameters that are not finite, or the disk is full.
    """
    arrays, header = write_outputs(outputs)
    for name, value in encoder.state_dict().items():
        with np.errstate(over="ignore"):
            stored = value.detach().cpu().numpy().astype(dtype)
        if not np.isfinite(stored).all():
            wide = f" in {dtype}; take store=float32, or a lower learning rate" if torch.isfinite(value).all() else ""
            raise InputError(f"save_weights: parameter {name} is not finite{wide}")
        arrays[f"encoder.{name}"] = stored
    header |= {"encoder": asdict(encoder.config), "dtype": dtype, "made_by": dict(made_by)}
    write_archive(path, arrays, header)


def load_weights(given: str | Path) -> tuple[GaussianEncoder, OutputSpace, dict[str, Any]]:
    """The encoder, in evaluation mode, its output space, and what made it.

    Args:
        given: a file, a folder of `train`, or a name; see `find_weights`.

    Raises:
        InputError: missing, damaged, of another version, or not the parameters that its configuration needs.
    """
    with open_archive(find_weights(str(given))) as file:
        config = _config(file.value("encoder", dict))
        outputs = read_outputs(file)
        dtype = file.value("dtype", str)
        if dtype not in ("float32", "float16"):
            raise InputError(f"expected parameters of float32 or float16, got {dtype[:20]!r}")
        with torch.device("meta"):
            encoder = GaussianEncoder(config, outputs.channels)
        state = {
            name: torch.from_numpy(file.array(f"encoder.{name}", dtype, tuple(value.shape)).astype(np.float32))
            for name, value in encoder.state_dict().items()
        }
        made_by: dict[str, Any] = file.value("made_by", dict)
    encoder.load_state_dict(state, assign=True)
    return encoder.eval(), outputs, made_by


def _config(values: dict[str, Any]) -> EncoderConfig:
    import dacite

    try:
        return dacite.from_dict(EncoderConfig, values, dacite.Config(strict=True, cast=[tuple]))
    except (dacite.DaciteError, TypeError) as error:
        raise InputError(f"the encoder's configuration is not one of this version: {error}") from error
