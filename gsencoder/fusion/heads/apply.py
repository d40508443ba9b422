"""Features and rendered tokens in the space of an adapter head (SplatDistill secs. 3.2 and 3.4).

The backbone's features are distilled and stored; a head is applied to them when its space is asked for. Features in the
coordinates of a basis are decoded first.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64
from torch import Tensor

from gsencoder.core.errors import about
from gsencoder.fusion.heads.measure import CHUNK, MeasuredHead, head_outputs
from gsencoder.fusion.store.heads_file import check_heads_space
from gsencoder.types import FeatureSpace, GaussianFeatures


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
