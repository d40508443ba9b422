"""Rows of JSON lines with a checksum each, for files that a run reads back when it continues."""

import json
from collections.abc import Mapping
from hashlib import sha256
from typing import Any

SUM = "sum"
"""The key of the checksum, which rows have for nothing else."""


def sealed(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row with its checksum: the first 16 digits of the SHA-256 of its JSON with sorted keys."""
    return {**row, SUM: sha256(json.dumps(row, sort_keys=True).encode()).hexdigest()[:16]}


def unsealed(row: Any) -> dict[str, Any]:
    """A row without its checksum.

    Raises:
        ValueError: it is no object, has no checksum, or is not as it was written.
    """
    if not isinstance(row, dict):
        raise ValueError("the row is no object")
    plain = {name: value for name, value in row.items() if name != SUM}
    if row != sealed(plain):
        raise ValueError("the row is not as it was written")
    return plain
