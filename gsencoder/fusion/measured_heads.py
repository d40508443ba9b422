"""Adapter heads on features (SplatDistill secs. 3.2 and 3.4): measured, applied and stored.

Features and rendered tokens in the space of an adapter head (SplatDistill secs. 3.2 and 3.4).

The backbone's features are distilled and stored; a head is applied to them when its space is asked for. Features in the
coordinates of a basis are decoded first.

Mean and scale of an adapter head's outputs over cells of a teacher's maps, and what a basis costs the head.

Centered cosines remove the mean, and the render loss divides by the scale. Features are stored in the coordinates of a
basis that keeps the energy of the backbone's vectors. What it drops may be small for the backbone and large for a head,
so the outputs for the projected vectors are compared with those for the full ones.
"""

import copy
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

from gsencoder.core.archive import Archive, open_archive, write_archive
from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, about
from gsencoder.fusion.basis import to_coordinates
from gsencoder.fusion.errors import WORST, CellSample
from gsencoder.fusion.folder import check_heads_space, read_heads_space
from gsencoder.teachers.adapter_heads import (
    PARTS,
    TEXT_KINDS,
    Head,
    default_part,
    describe_layers,
    read_layers,
    split_name,
)
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures

CHUNK = 4096
"""Vectors that a head is given at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HeadFit:
    """How well a head's outputs for vectors in a basis agree with those for the full vectors.

    Attributes:
        cells: number of the vectors; mean and scale of the head are theirs, too.
        cosine: mean cosine of the outputs, about their mean.
        worst: the cosine below which the worst 5 % of the vectors are.
    """

    cells: int
    cosine: float
    worst: float

    def describe(self) -> str:
        """The figures in a phrase."""
        return f"cosine {self.cosine:.3f}, worst 5 % below {self.worst:.3f} in {self.cells:,} cells"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredHead:
    """An adapter head with the statistics of its outputs over a data set.

    Attributes:
        head: its layers and its name.
        mean: of the outputs.
        scale: root mean square distance of the outputs from their mean.
        fit: what the basis of the features costs it.
    """

    head: Head
    mean: Float32[np.ndarray, " E"]
    scale: float
    fit: HeadFit

    @property
    def name(self) -> str:
        return self.head.name

    @property
    def channels(self) -> int:
        return len(self.mean)

    def figures(self) -> dict[str, int | float]:
        """For summaries: channels, scale, and what the basis costs."""
        return {
            "channels": self.channels,
            "scale": self.scale,
            "cells": self.fit.cells,
            "cosine": self.fit.cosine,
            "worst": self.fit.worst,
        }


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeadSet:
    """Measured heads of one backbone.

    Attributes:
        space: of the features that the heads take.
        heads: no name twice.
    """

    space: FeatureSpace
    heads: tuple[MeasuredHead, ...] = field(default=())

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(head.name for head in self.heads)


def measure_heads(
    heads: Sequence[Head], sample: CellSample, space: FeatureSpace, basis: FeatureBasis | None
) -> HeadSet:
    """Computes mean and scale of each head's outputs, and what a basis costs it.

    Args:
        heads: of the backbone of `space`.
        sample: cells of the teacher's maps.
        space: of the maps.
        basis: in which features are stored; None = all channels are.

    Raises:
        InputError: no cells, or outputs that are not finite, or all equal.
    """
    vectors = sample.vectors()
    projected = vectors
    if basis is not None:
        projected = (to_coordinates(basis, vectors) @ basis.components + basis.mean).astype(np.float32)
    return HeadSet(space=space, heads=tuple(_measure(head, vectors, projected) for head in heads))


def _measure(head: Head, vectors: Float32[np.ndarray, "n D"], projected: Float32[np.ndarray, "n D"]) -> MeasuredHead:
    full = head_outputs(head, vectors)
    mean = full.mean(axis=0, dtype=np.float64).astype(np.float32)
    scale = float(np.sqrt(np.square(full - mean, dtype=np.float64).sum(axis=1).mean()))
    if not scale > 0:
        raise InputError(f"heads: {head.name} gives the same vector for all {len(vectors):,} cells; check the pictures")
    cosines = np.ones(len(full)) if projected is vectors else _cosines(full, head_outputs(head, projected), mean)
    fit = HeadFit(cells=len(full), cosine=float(cosines.mean()), worst=float(np.quantile(cosines, WORST)))
    return MeasuredHead(head=head, mean=mean, scale=scale, fit=fit)


def head_outputs(head: Head, vectors: Float32[np.ndarray, "n D"]) -> Float32[np.ndarray, "n E"]:
    """The outputs of a head, computed by chunks in float32, on a GPU if there is one.

    Raises:
        InputError: outputs that are not finite.
    """
    device = choose_device("auto")
    body = head.body if device.type == "cpu" else copy.deepcopy(head.body).to(device)
    with torch.inference_mode():
        parts = [body(part.to(device)).cpu() for part in torch.from_numpy(vectors).split(CHUNK)]
        outputs = torch.cat(parts) if parts else torch.zeros(0, head.channels)
    if not torch.isfinite(outputs).all():
        raise InputError(f"heads: outputs of {head.name} are not finite; check the features and the teacher's weights")
    return np.asarray(outputs.numpy())


def _cosines(
    first: Float32[np.ndarray, "n E"], second: Float32[np.ndarray, "n E"], mean: Float32[np.ndarray, " E"]
) -> Float64[np.ndarray, " n"]:
    """Cosines of rows about a mean; 0 where a row is the mean itself."""
    a, b = first - mean, second - mean
    lengths = np.sqrt(np.square(a, dtype=np.float64).sum(axis=1) * np.square(b, dtype=np.float64).sum(axis=1))
    products = (a * b).sum(axis=1, dtype=np.float64)
    return np.asarray(np.divide(products, lengths, where=lengths > 0, out=np.zeros(len(a))))


def head_space(backbone: FeatureSpace, head: MeasuredHead, text_encoder: str = "") -> FeatureSpace:
    """The space of a head's outputs: it names backbone, head and the digest of the weights, which holds for both.

    Args:
        backbone: space of the features that the head takes.
        head: which.
        text_encoder: what turns words into its space; empty if nothing does.
    """
    return replace(
        backbone,
        name=f"{backbone.name}/{head.name}",
        channels=head.channels,
        layer=head.name,
        text_encoder=text_encoder,
    )


def head_features(
    features: GaussianFeatures, head: MeasuredHead, backbone: FeatureSpace, *, text_encoder: str = ""
) -> GaussianFeatures:
    """Applies a head to the vector of every Gaussian that was seen.

    Rows that are equal are computed once: an encoder gives all Gaussians of a voxel one vector. The outputs take
    4 · E bytes a Gaussian.

    Args:
        features: of the backbone, in a basis or not.
        head: which.
        backbone: the space whose features the head takes.
        text_encoder: what turns words into the head's space.

    Returns:
        Features of all E channels with the weights of the given ones; their mean is the head's.

    Raises:
        InputError: features of another backbone, or outputs that are not finite.
    """
    with about(head.name):
        check_heads_space(backbone, features.space)
    seen = np.flatnonzero(features.seen)
    first, inverse = equal_rows(features.stored(seen))
    # Ordered by group, so that the outputs of a few groups at a time are written to all their rows.
    order = np.argsort(inverse, kind="stable")
    rows, group = seen[order], inverse[order]
    values = np.zeros((len(features), head.channels), np.float32)
    for start in range(0, len(first), CHUNK):
        outputs = head_outputs(head.head, features.decode(seen[first[start : start + CHUNK]]))
        begin, end = np.searchsorted(group, (start, start + CHUNK))
        values[rows[begin:end]] = outputs[group[begin:end] - start]
    return GaussianFeatures(
        features=values,
        weights=features.weights,
        mean=head.mean,
        space=head_space(features.space, head, text_encoder),
    )


def equal_rows(
    values: Float32[np.ndarray, "n channels"],
) -> tuple[Int64[np.ndarray, " distinct"], Int64[np.ndarray, " n"]]:
    """Groups rows of equal bits.

    Returns:
        One row number of each group, and for each row the number of its group: `values[first][inverse]` equals
        `values`.
    """
    bits = np.ascontiguousarray(values).view(np.uint32)
    # Rows are compared by a sum with random odd factors modulo 2⁶⁴, which is much faster than by all their columns.
    random = np.random.default_rng(0).integers(0, 1 << 63, bits.shape[1], dtype=np.uint64)
    factors = np.bitwise_or(random, np.uint64(1))
    keys = np.zeros(len(bits), np.uint64)
    for column, factor in enumerate(factors):
        keys += bits[:, column].astype(np.uint64) * factor
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    first, inverse = first.astype(np.int64), inverse.astype(np.int64).reshape(-1)
    for start in range(0, len(bits), CHUNK):
        part = slice(start, start + CHUNK)
        if not np.array_equal(bits[first[inverse[part]]], bits[part]):
            everything = np.arange(len(bits))
            return everything, everything
    return first, inverse


def head_tokens(tokens: Float[Tensor, "V tokens D"], head: MeasuredHead) -> Float[Tensor, "V tokens E"]:
    """Applies a head to rendered tokens of the backbone's space.

    A vision-language model was trained on the head's outputs for one patch, as in SplatDistill's sec. 3.4; heads are
    not linear, so rendering the outputs of the Gaussians' vectors would give others.

    Raises:
        InputError: outputs that are not finite.
    """
    outputs = head_outputs(head.head, tokens.reshape(-1, tokens.shape[-1]).float().numpy())
    return torch.from_numpy(outputs).reshape(*tokens.shape[:-1], head.channels)


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
