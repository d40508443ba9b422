"""JSON of values that contain numpy arrays, paths and dataclasses, and atomic JSON files."""

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.errors import SceneWarning
from gsencoder.core.files.atomic import atomic_file


def plain(value: Any, where: str = "", lost: list[str] | None = None) -> Any:
    """Converts `value` to JSON types: numpy values, paths, tuples and dataclasses are converted, non-finite numbers
    null.

    Args:
        value: nested lists, tuples, mappings and dataclasses of such values.
        where: the dotted name of `value`, for `lost`.
        lost: collects the dotted names of the numbers that were not finite.

    Raises:
        TypeError: a value of another type; it is named.
    """

    def inside(name: object, item: Any) -> Any:
        return plain(item, f"{where}.{name}" if where else str(name), lost)

    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        if math.isfinite(value):
            return float(value)
        if lost is not None:
            lost.append(where or "value")
        return None
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.ndarray):
        return plain(value.tolist(), where, lost)
    if isinstance(value, Mapping):
        return {str(name): inside(name, item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [inside(index, item) for index, item in enumerate(value)]
    if is_dataclass(value) and not isinstance(value, type):
        return {item.name: inside(item.name, getattr(value, item.name)) for item in fields(value)}
    raise TypeError(f"{where or 'value'}: {type(value).__name__} cannot be written as JSON")


def json_bytes(value: Any) -> tuple[bytes, list[str]]:
    """`value` as JSON, and the dotted names of the numbers that were not finite."""
    lost: list[str] = []
    text = json.dumps(plain(value, "", lost), indent=2, ensure_ascii=False, allow_nan=False)
    # A lone surrogate stands for a byte of a file name that is not UTF-8; it is escaped.
    return text.encode("utf-8", "backslashreplace") + b"\n", lost


def write_bytes(path: str | Path, data: bytes) -> None:
    """Writes a file atomically; an existing one is replaced.

    Raises:
        InputError: the folder is missing, the disk is full, or the system refuses.
    """
    with atomic_file(path) as stream:
        stream.write(data)


def write_json(path: str | Path, value: Any) -> None:
    """Writes a JSON file atomically; values are converted as by `plain`.

    Numbers that are not finite become null, with one counted `SceneWarning` that names them.

    Raises:
        InputError: as `write_bytes`.
    """
    data, lost = json_bytes(value)
    if lost:
        warnings.warn(
            f"{path}: {len(lost)} numbers are not finite and were written as null: {', '.join(lost[:5])}",
            SceneWarning,
            stacklevel=2,
        )
    write_bytes(path, data)
