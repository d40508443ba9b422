"""Where models and tables are found: at the path that was given, or by bare name in the folder of models."""

import os
from pathlib import Path

from gsencoder.errors import InputError

MODELS_VARIABLE = "GSENCODER_MODELS"


def find_file(name: str, option: str) -> Path:
    """The file at `name`, else the file of that name in the folder that GSENCODER_MODELS names.

    Args:
        name: a path, or a bare file name.
        option: what the user would set, for the error.

    Raises:
        InputError: neither exists.
    """
    folder = os.environ.get(MODELS_VARIABLE, "")
    tried = [Path(name)]
    if folder and not tried[0].is_absolute():
        tried.append(Path(folder) / name)
    for path in tried:
        if path.is_file():
            return path
    hint = "" if folder else f", and {MODELS_VARIABLE} is not set (a folder to look for models in)"
    raise InputError(f"{option}: no file at {' or '.join(map(str, tried))}{hint}")
