"""objects.json: labeled objects beside a transforms.json, for evaluation."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsencoder.core.errors import InputError
from gsencoder.data.readers.transforms_json import read_json
from gsencoder.types import SceneObject

MAX_NAME = 1000
"""Largest number of characters of a name, as in a text table."""


def read_objects(path: Path) -> tuple[SceneObject, ...]:
    """Reads a list of {id, name or null, aabb_min, aabb_max, placed, views, max_pixels}; boxes in world coordinates.

    Ids start at 1, since 0 stands for no object in an instance map.

    Raises:
        InputError: not such a list, a repeated id, or a box whose lower corner is not below the upper one.
    """
    rows = read_json(path)
    if not isinstance(rows, list):
        raise InputError(f"{path}: expected a list of objects")
    objects: list[SceneObject] = []
    for index, row in enumerate(rows):
        where = f"{path}: object {index}"
        if not isinstance(row, dict):
            raise InputError(f"{where}: expected an object with id, name, aabb_min and aabb_max")
        name = row.get("name")
        if name is not None and not isinstance(name, str):
            raise InputError(f"{where}: name must be a word or null, got {str(name)[:40]!r}")
        if name is not None and len(name) > MAX_NAME:
            raise InputError(f"{where}: name has {len(name):,} characters, expected at most {MAX_NAME:,}")
        lower, upper = _corner(row, "aabb_min", where), _corner(row, "aabb_max", where)
        if (lower > upper).any():
            raise InputError(f"{where}: aabb_min {lower.tolist()} is not below aabb_max {upper.tolist()}")
        placed = row.get("placed", True)
        if not isinstance(placed, bool):
            raise InputError(f"{where}: placed must be true or false, got {str(placed)[:40]!r}")
        objects.append(
            SceneObject(
                id=_count(row, "id", where, None, minimum=1),
                name=name,
                aabb_min=lower,
                aabb_max=upper,
                placed=placed,
                views=_count(row, "views", where, 0),
                max_pixels=_count(row, "max_pixels", where, 0),
            )
        )
    ids: set[int] = set()
    for item in objects:
        if item.id in ids:
            raise InputError(f"{path}: id {item.id} belongs to several objects")
        ids.add(item.id)
    return tuple(objects)


def _count(row: dict[str, Any], key: str, where: str, default: int | None, minimum: int = 0) -> int:
    value = row.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value < 2**31:
        raise InputError(f"{where}: {key} must be a whole number from {minimum}, got {str(value)[:40]!r}")
    return value


def _corner(row: dict[str, Any], key: str, where: str) -> Float64[np.ndarray, "3"]:
    values = row.get(key)
    good = isinstance(values, list) and len(values) == 3
    good = good and all(isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) < 1e15 for v in values or [])
    if not good or not all(map(math.isfinite, values or [])):
        raise InputError(f"{where}: {key} must be three finite numbers, got {str(values)[:60]}")
    return np.array(values, np.float64)
