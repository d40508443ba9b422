"""Encoder weights on disk: one safetensors file with parameters, configuration of the network and output spaces."""

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from gsencoder.core.archive import open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.core.files import open_foreign
from gsencoder.core.pretrained import find_file
from gsencoder.data.scenes import kind_of_path
from gsencoder.models.encoder import EncoderConfig, GaussianEncoder
from gsencoder.models.output_space import OutputSpaces, output_spaces_parts, read_output_spaces

WEIGHTS_FILE = "encoder.safetensors"
SHIPPED_WEIGHTS = Path(__file__).resolve().parent.parent / "weights"
"""Folder of the encoders that come with the package, one folder each."""
DEFAULT_WEIGHTS = "house_cpu"
"""The one of them that is taken where none is named."""
SHIPPED = "shipped:"
"""What a name of them begins with that cannot be taken for a path."""


def find_weights(source: str, option: str = "weights") -> Path:
    """Finds the file of weights: in a folder that `train` wrote, at a path, or by the name of an encoder that comes
    with the package. Relative paths are also looked up in GSENCODER_MODELS.

    Args:
        source: the path or name; `shipped:NAME` is never a path, and "" is DEFAULT_WEIGHTS.
        option: that gives it, for errors.
    """
    names = sorted(path.parent.name for path in SHIPPED_WEIGHTS.glob(f"*/{WEIGHTS_FILE}"))
    name = (source or SHIPPED + DEFAULT_WEIGHTS).removeprefix(SHIPPED)
    try:
        if name in names and (name != source or not os.path.lexists(source)):
            return SHIPPED_WEIGHTS / name / WEIGHTS_FILE
        if name in names:
            raise InputError(
                f"{option}: {source} is the name of an encoder that comes with gsencoder, and there is "
                f"{Path(source).absolute()}, too; give {SHIPPED}{source} or ./{source}"
            )
        in_folder = Path(source) / WEIGHTS_FILE
        if in_folder.is_file():
            return in_folder
        if Path(source).is_dir():
            exports = sorted(path.name for path in Path(source).glob("*.onnx"))
            hint = f"; give its {', '.join(exports)} by its full path" if exports else ""
            raise InputError(
                f"{option}: {source} is {kind_of_path(source)}, and holds no {WEIGHTS_FILE}; expected a folder that "
                f"`gsencoder train` wrote{hint}"
            )
        file = find_file(source, option)
        if file.suffix != Path(WEIGHTS_FILE).suffix and not _begins_as_archive(file):
            raise InputError(
                f"{option}: {source} is {kind_of_path(file)}; expected {WEIGHTS_FILE} or its folder, which "
                "`gsencoder train` writes"
            )
        return file
    except InputError as error:
        raise InputError(f"{error}; encoders that come with gsencoder: {', '.join(names)}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{option}: {source[:200]!r} is not a path ({type(error).__name__})") from error


def _begins_as_archive(path: Path) -> bool:
    """Whether a file begins as safetensors do, whatever it is called."""
    with open_foreign(path) as stream:
        return stream.read(9)[8:] == b"{"


def save_weights(
    path: Path,
    encoder: GaussianEncoder,
    outputs: OutputSpaces,
    made_by: Mapping[str, Any],
    *,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Writes parameters, configuration and output spaces; an existing file is replaced only by a complete new one.

    Args:
        encoder: the encoder to save.
        outputs: its output spaces.
        made_by: settings and results of the training, as JSON values.
        dtype: type of the stored parameters. float16 halves the file and keeps 3 decimal digits of the parameters,
            which are small numbers.
    """
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
    """Loads an encoder.

    Args:
        source: a file, a folder that `train` wrote, or the name of an encoder that comes with the package; see
            `find_weights`.
        option: that gives it, for errors.

    Returns:
        The encoder in evaluation mode, its output spaces, and settings and results of its training.
    """
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
