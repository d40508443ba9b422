"""Memories on disk: queries, projection and bank of one teacher, beside the scene that they belong to."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.archive import Archive, write_archive
from gsencoder.core.arrays import rise_within
from gsencoder.core.errors import InputError
from gsencoder.data.scene_arrays import (
    bank_parts,
    check_splat,
    read_bank,
    read_space,
    scaled_halves,
    space_parts,
)
from gsencoder.data.splats.files import fingerprint
from gsencoder.types import Gaussians, QueryMemory

MEMORY_FILE = "memory.safetensors"


def write_memory(path: Path, memory: QueryMemory, gaussians: Gaussians, more: Mapping[str, Any] = {}) -> None:
    """Writes a memory: queries of seen Gaussians and components as float16, each channel divided by its largest
    magnitude.

    Args:
        path: the file.
        memory: to write.
        gaussians: that the queries belong to.
        more: further entries of the header, as JSON values.

    Raises:
        InputError: another number of Gaussians, or the disk is full.
    """
    if len(memory) != len(gaussians):
        raise InputError(f"{path}: {len(memory):,} queries need as many Gaussians, got {len(gaussians):,}")
    rows, bank = np.flatnonzero(memory.weights > 0), memory.bank
    arrays, header = space_parts(memory.space, memory.mean, memory.basis)
    queries, query_scale = scaled_halves(memory.queries[rows])
    components, component_scale = scaled_halves(bank.components)
    arrays |= {
        "rows": rows.astype(np.int32),
        "queries": queries,
        "query_scale": query_scale,
        "weights": memory.weights[rows],
        "projection": memory.projection,
        "bank": components,
        "bank_scale": component_scale,
    }
    of_bank, figures = bank_parts(bank)
    header |= {
        "fingerprint": fingerprint(gaussians),
        "scoring": memory.scoring,
        "temperature": memory.temperature,
        **figures,
    }
    write_archive(path, arrays | of_bank, header | dict(more))


def read_memory(file: Archive, gaussians: Gaussians) -> QueryMemory:
    """Reads a memory.

    Raises:
        InputError: damaged, or of another splat.
    """
    check_splat(file, gaussians, "make the memory of this splat again")
    space, mean, basis = read_space(file)
    rows, count = file.array("rows", "int32", ("n",)), len(gaussians)
    if not rise_within(rows, count):
        raise InputError(f"expected row numbers that rise from 0 to at most {count - 1}")
    seen = file.array("weights", "float32", (len(rows),))
    if (seen <= 0).any():
        raise InputError("expected weights above 0")
    projection = file.array("projection", "float32", ("s", space.channels))
    scale = file.array("query_scale", "float32", (len(projection),))
    queries, weights = np.zeros((count, len(projection)), np.float32), np.zeros(count, np.float32)
    queries[rows] = file.array("queries", "float16", (len(rows), len(projection))).astype(np.float32) * scale
    weights[rows] = seen
    components = file.array("bank", "float16", ("M", space.channels)).astype(np.float32)
    bank = read_bank(file, components * file.array("bank_scale", "float32", (space.channels,)), space)
    scoring = file.value("scoring", str)
    if scoring not in ("centered", "cosine", "dot"):
        raise InputError(f"expected scoring centered, cosine or dot in the header, got {scoring[:40]!r}")
    return QueryMemory(
        queries=queries,
        weights=weights,
        projection=projection,
        bank=bank,
        scoring=scoring,
        temperature=file.value("temperature", float, int),
        mean=mean,
        basis=basis,
    )
