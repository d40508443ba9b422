"""Adapter heads on disk, with the mean and the scale of their outputs and the space of the features that they take."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsencoder.core.archive import Archive, open_archive, write_archive
from gsencoder.core.errors import InputError
from gsencoder.fusion.heads.layers import describe_layers, read_layers
from gsencoder.fusion.heads.measure import HeadFit, HeadSet, MeasuredHead
from gsencoder.fusion.heads.names import PARTS, TEXT_KINDS, default_part, split_name
from gsencoder.fusion.heads.radio import Head
from gsencoder.fusion.store.heads_file import read_heads_space


def save_heads(path: Path, heads: HeadSet) -> None:
    """Writes adapter heads to a file.

    Raises:
        InputError: a layer of a type that a file cannot hold, or the disk is full.
    """
    arrays: dict[str, np.ndarray] = {}
    entries = [_describe(head, arrays) for head in heads.heads]
    space = {name: getattr(heads.space, name) for name in heads.space.__dataclass_fields__}
    write_archive(path, arrays, {"space": space, "heads": entries})


def _describe(measured: MeasuredHead, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The header's entry of a head, whose arrays are added to `arrays`."""
    head, fit = measured.head, measured.fit
    arrays[f"{head.name}.mean"] = measured.mean
    return {
        "name": head.name,
        "text": head.text,
        "model": head.model,
        "layers": describe_layers(head.body, head.name, arrays),
        "scale": float(measured.scale),
        "cells": fit.cells,
        "cosine": fit.cosine,
        "worst": fit.worst,
    }


def load_heads(path: Path) -> HeadSet:
    """Loads the adapter heads of a file.

    Raises:
        InputError: the file is missing or damaged, or holds no heads.
    """
    with open_archive(path) as file:
        space = read_heads_space(file)
        heads = tuple(_read(file, entry, space.channels) for entry in file.value("heads", list))
        if len({head.name for head in heads}) < len(heads):
            raise InputError("expected heads of different names")
    return HeadSet(space=space, heads=heads)


def _read(file: Archive, entry: Any, channels: int) -> MeasuredHead:
    kinds = {"name": str, "text": str, "model": str, "layers": list, "scale": float, "cells": int}
    kinds |= {"cosine": float, "worst": float}
    good = isinstance(entry, dict) and all(type(entry.get(key)) is kind for key, kind in kinds.items())
    if not good or not entry["layers"] or not 0 < entry["scale"] < float("inf"):
        raise InputError(f"expected heads with {', '.join(kinds)}, got {str(entry)[:80]}")
    name = entry["name"]
    if name.rpartition(".")[2] not in PARTS or entry["text"] not in ("", *TEXT_KINDS):
        raise InputError(f"expected a head called NAME.summary or NAME.features, got {str(entry)[:80]}")
    body, width = read_layers(file, entry["layers"], name, channels)
    return MeasuredHead(
        head=Head(
            name=name, body=body.requires_grad_(False).eval(), text=str(entry["text"]), model=str(entry["model"])
        ),
        mean=file.array(f"{name}.mean", "float32", (width,)),
        scale=entry["scale"],
        fit=HeadFit(cells=entry["cells"], cosine=entry["cosine"], worst=entry["worst"]),
    )


def find_head(heads: HeadSet, name: str, option: str = "head") -> MeasuredHead:
    """The head that a name stands for: NAME.summary, NAME.features, or NAME for the one that is meant most often.

    Args:
        heads: to choose from.
        name: of the head.
        option: of the command, for the error.

    Raises:
        InputError: it is not among them.
    """
    by_name, full = {head.name: head for head in heads.heads}, _full_name(heads, name)
    if full not in by_name:
        meant = f" ({full})" if full and full != name else ""
        raise InputError(
            f"{option}={name}{meant}: not among the heads at hand: {', '.join(by_name) or 'none'}; name one of these, "
            "or fuse or train again with that head (teacher.heads=, heads=)"
        )
    return by_name[full]


def has_head(heads: HeadSet, name: str) -> bool:
    """Whether the head that a name stands for is among them."""
    return _full_name(heads, name) in heads.names


def _full_name(heads: HeadSet, name: str) -> str:
    """NAME.summary or NAME.features, whichever a name stands for; empty if no head of that adapter is there."""
    kinds = {head.name.rpartition(".")[0]: head.head.text for head in heads.heads}
    adapter, part = split_name(name, kinds)
    return f"{adapter}.{part or default_part(kinds[adapter])}" if adapter in kinds else ""


def choose_heads(heads: HeadSet, names: Sequence[str], option: str = "heads") -> HeadSet:
    """The heads of some names, in their order, each once.

    Raises:
        InputError: one is not there.
    """
    chosen = {(head := find_head(heads, name, option)).name: head for name in names}
    return replace(heads, heads=tuple(chosen.values()))


def heads_digest(heads: HeadSet) -> str:
    """A fingerprint of layers, means and scales, and of the space; 16 hexadecimal digits."""
    arrays: dict[str, np.ndarray] = {}
    entries = [_describe(head, arrays) for head in heads.heads]
    digest = hashlib.sha256(repr((heads.space, entries)).encode())
    for name in sorted(arrays):
        digest.update(name.encode() + np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()[:16]
