"""Archives changed on purpose: with the checksums of what they now hold, as if they had been written so, or as a disk
would change them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file

from gsencoder.core.archive import RESERVED_KEYS, write_archive


def header_of(path: Path) -> dict[str, Any]:
    """What the writer of an archive put into its header."""
    with safe_open(path, framework="numpy") as file:
        header = json.loads(file.metadata()["gsencoder"])
    return {key: value for key, value in header.items() if key not in RESERVED_KEYS}


def rewrite(
    path: Path, arrays: Mapping[str, np.ndarray] | None = None, header: Mapping[str, Any] | None = None
) -> None:
    """Writes an archive again with other arrays, or another header, and the checksums of these."""
    contents = load_file(path) if arrays is None else arrays
    write_archive(path, contents, header_of(path) if header is None else header)


def flip_bit(path: Path, bit: int) -> None:
    """Turns one bit of a file round."""
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)
