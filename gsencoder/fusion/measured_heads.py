"""Adapter heads on features (SplatDistill secs. 3.2 and 3.4): measured, applied and stored.

The backbone's features are distilled and stored; a head is applied to them when its space is asked for. Centered
cosines remove the mean of its outputs, and the render loss divides by their scale; both are measured over cells of the
teacher's maps. Features are stored in the coordinates of a basis, and what that drops may be small for the backbone and
large for a head, so the outputs for the projected vectors are compared with those for the full ones.
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
from torch import Tensor, nn

from gsencoder.core.archive import Archive, open_archive, write_archive
from gsencoder.core.device import choose_device
from gsencoder.core.errors import InputError, error_prefix
from gsencoder.fusion.basis import WORST
from gsencoder.models.output_space import check_heads_space, read_heads_space
from gsencoder.teachers.base import PARTS, TEXT_KINDS, Head, Residual, default_part, split_name
from gsencoder.types import FeatureBasis, FeatureSpace, GaussianFeatures

CHUNK = 4096
"""Vectors that a head is given at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredHead:
    """An adapter head with the statistics of its outputs over a data set, and what the basis of the features costs it.

    Attributes:
        scale: root mean square distance of the outputs from their mean.
        cells: number of the vectors that were measured.
        cosine: mean cosine, about the mean, of its outputs for vectors in the basis with those for the full vectors.
        worst: the cosine below which the worst 5 % of the vectors are.
    """

    head: Head
    mean: Float32[np.ndarray, " E"]
    scale: float
    cells: int
    cosine: float
    worst: float

    @property
    def name(self) -> str:
        return self.head.name

    @property
    def channels(self) -> int:
        return len(self.mean)

    def figures(self) -> dict[str, int | float]:
        return {"channels": self.channels, **{name: getattr(self, name) for name in FIGURES}}

    def describe(self) -> str:
        return (
            f"head {self.head.describe()}: {self.channels} channels; behind the basis its outputs keep cosine "
            f"{self.cosine:.3f}, worst 5 % below {self.worst:.3f} in {self.cells:,} cells"
        )


FIGURES = {"scale": float, "cells": int, "cosine": float, "worst": float}
"""What is measured of a head, apart from the mean of its outputs."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeadSet:
    """Measured heads, of different names, of the backbone whose features have this space."""

    space: FeatureSpace
    heads: tuple[MeasuredHead, ...] = field(default=())

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(head.name for head in self.heads)


def measure_heads(
    heads: Sequence[Head], vectors: Float32[np.ndarray, "n D"], space: FeatureSpace, basis: FeatureBasis | None
) -> HeadSet:
    """Computes mean and scale of each head's outputs for vectors of the teacher's maps, and what a basis costs it."""
    measured = []
    for head in heads:
        full = head_outputs(head, vectors)
        mean = full.mean(axis=0, dtype=np.float64).astype(np.float32)
        scale = float(np.sqrt(np.square(full - mean, dtype=np.float64).sum(axis=1).mean()))
        if not scale > 0:
            raise InputError(
                f"heads: {head.name} gives the same vector for all {len(vectors):,} cells; check the pictures"
            )
        cosines = np.ones(len(full))
        if basis is not None:
            projected = (basis.coordinates(vectors) @ basis.components + basis.mean).astype(np.float32)
            cosines = _cosines(full, head_outputs(head, projected), mean)
        cosine, worst = float(cosines.mean()), float(np.quantile(cosines, WORST))
        measured.append(MeasuredHead(head=head, mean=mean, scale=scale, cells=len(full), cosine=cosine, worst=worst))
    return HeadSet(space=space, heads=tuple(measured))


def head_outputs(head: Head, vectors: Float32[np.ndarray, "n D"]) -> Float32[np.ndarray, "n E"]:
    """The outputs of a head, computed by chunks in float32, on a GPU if there is one; InputError if not finite."""
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
    """The space of a head's outputs: it names backbone, head and the digest of the weights, which holds for both."""
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

    Rows that are equal are computed once: an encoder gives all Gaussians of a voxel one vector. The outputs have all E
    channels and the weights of the given features; their mean is the head's.

    Args:
        features: of the space `backbone`, which the head takes, in a basis or not.
        text_encoder: what turns words into the head's space.
    """
    with error_prefix(head.name):
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
    """Groups rows of equal bits: one row number of each group, and for each row the number of its group.

    `values[first][inverse]` equals `values`.
    """
    rows = np.ascontiguousarray(values)
    bits = rows.view(np.dtype((np.void, rows.shape[1] * rows.itemsize))).reshape(-1)
    _, first, inverse = np.unique(bits, return_index=True, return_inverse=True)
    return first.astype(np.int64), inverse.astype(np.int64).reshape(-1)


def head_tokens(tokens: Float[Tensor, "V tokens D"], head: MeasuredHead) -> Float[Tensor, "V tokens E"]:
    """Applies a head to rendered tokens of the backbone's space.

    A vision-language model was trained on the head's outputs for one patch, as in SplatDistill's sec. 3.4; heads are
    not linear, so rendering the outputs of the Gaussians' vectors would give others.
    """
    outputs = head_outputs(head.head, tokens.reshape(-1, tokens.shape[-1]).float().numpy())
    return torch.from_numpy(outputs).reshape(*tokens.shape[:-1], head.channels)


LAYER_TYPES: dict[str, tuple[type[nn.Module], tuple[str, ...]]] = {
    "linear": (nn.Linear, ("weight", "bias")),
    "layernorm": (nn.LayerNorm, ("weight", "bias")),
    "gelu": (nn.GELU, ()),
    "relu": (nn.ReLU, ()),
}
"""The layer types that a head may have, with the names of their parameters."""


def describe_layers(layers: nn.Sequential, name: str, arrays: dict[str, np.ndarray]) -> list[Any]:
    """The names of the layers' types, residual blocks as nested lists; parameters are added to `arrays` as
    NAME.NUMBER.PARAMETER."""
    layer_types: list[Any] = []
    for number, layer in enumerate(layers):
        key = f"{name}.{number}"
        if isinstance(layer, Residual):
            layer_types.append(describe_layers(layer, key, arrays))
            continue
        layer_type = next(layer_type for layer_type, (cls, _) in LAYER_TYPES.items() if type(layer) is cls)
        layer_types.append(layer_type)
        for parameter in LAYER_TYPES[layer_type][1]:
            arrays[f"{key}.{parameter}"] = getattr(layer, parameter).detach().float().numpy()
    return layer_types


def read_layers(file: Archive, layer_types: Sequence[Any], name: str, width: int) -> tuple[nn.Sequential, int]:
    """Layers that `describe_layers` described, whose input has `width` channels, and the channels of their outputs."""
    layers: list[nn.Module] = []
    for number, layer_type in enumerate(layer_types):
        key = f"{name}.{number}"
        if isinstance(layer_type, list):
            inner, out = read_layers(file, layer_type, key, width)
            if out != width:
                raise InputError(f"{key}: expected a residual block with {width} output channels, got {out}")
            layers.append(Residual(*inner))
        elif layer_type == "linear":
            weight = file.array(f"{key}.weight", "float32", (key, width))
            linear = nn.Linear(width, len(weight))
            width = len(weight)
            bias = file.array(f"{key}.bias", "float32", (width,))
            linear.weight.data, linear.bias.data = torch.from_numpy(weight.copy()), torch.from_numpy(bias.copy())
            layers.append(linear)
        elif layer_type == "layernorm":
            norm = nn.LayerNorm(width)
            for parameter in LAYER_TYPES[layer_type][1]:
                value = file.array(f"{key}.{parameter}", "float32", (width,))
                getattr(norm, parameter).data = torch.from_numpy(value.copy())
            layers.append(norm)
        elif isinstance(layer_type, str) and layer_type in LAYER_TYPES:
            layers.append(LAYER_TYPES[layer_type][0]())
        else:
            raise InputError(
                f"{key}: expected {', '.join(LAYER_TYPES)} or a list of these, got {str(layer_type)[:20]!r}"
            )
    return nn.Sequential(*layers), width


def save_heads(path: Path, heads: HeadSet) -> None:
    arrays: dict[str, np.ndarray] = {}
    entries = [_describe(head, arrays) for head in heads.heads]
    space = {name: getattr(heads.space, name) for name in heads.space.__dataclass_fields__}
    write_archive(path, arrays, {"space": space, "heads": entries})


def _describe(measured: MeasuredHead, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The header's entry of a head, whose arrays are added to `arrays`."""
    head = measured.head
    arrays[f"{head.name}.mean"] = measured.mean
    return {
        "name": head.name,
        "text": head.text,
        "model": head.model,
        "layers": describe_layers(head.body, head.name, arrays),
        **{name: getattr(measured, name) for name in FIGURES},
    }


def load_heads(path: Path) -> HeadSet:
    with open_archive(path) as file:
        space = read_heads_space(file)
        heads = tuple(_read(file, entry, space.channels) for entry in file.value("heads", list))
        if len({head.name for head in heads}) < len(heads):
            raise InputError("expected heads of different names")
    return HeadSet(space=space, heads=heads)


def _read(file: Archive, entry: Any, channels: int) -> MeasuredHead:
    kinds = {"name": str, "text": str, "model": str, "layers": list, **FIGURES}
    good = isinstance(entry, dict) and all(type(entry.get(key)) is kind for key, kind in kinds.items())
    if not good or not entry["layers"] or not 0 < entry["scale"] < float("inf"):
        raise InputError(f"expected heads with {', '.join(kinds)}, got {str(entry)[:80]}")
    name = entry["name"]
    if name.rpartition(".")[2] not in PARTS or entry["text"] not in ("", *TEXT_KINDS):
        raise InputError(f"expected a head called NAME.summary or NAME.features, got {str(entry)[:80]}")
    body, width = read_layers(file, entry["layers"], name, channels)
    return MeasuredHead(
        head=Head(name=name, body=body.requires_grad_(False).eval(), text=entry["text"], model=entry["model"]),
        mean=file.array(f"{name}.mean", "float32", (width,)),
        **{figure: entry[figure] for figure in FIGURES},
    )


def find_head(heads: HeadSet, name: str, option: str = "head") -> MeasuredHead:
    """The head that a name stands for: NAME.summary, NAME.features, or NAME for the one that is meant most often."""
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
    """The heads of some names, in their order, each once."""
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
